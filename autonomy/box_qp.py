"""Convex quadratic programs with bounds on every variable."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from autonomy.frenet import FloatArray


def solve_box_qp(
    hessian: csc_array, gradient: FloatArray, lower: FloatArray, upper: FloatArray, tolerance: float = 1.0e-9
) -> FloatArray:
    """Minimise 0.5 x'Hx + g'x subject to lower <= x <= upper.

    Primal-dual interior point method with Mehrotra's predictor and corrector (Nocedal and Wright, Numerical
    Optimization, chapter 16.6). One sparse factorisation per iteration, so a banded problem costs linear time.

    Parameters
    ----------
    hessian : shape (n, n), positive semidefinite, sparse.
    gradient : shape (n,).
    lower, upper : shape (n,), finite, lower < upper.
    tolerance : on the mean complementarity, relative to the gradient's and the box's size.

    Returns
    -------
    x, shape (n,), strictly inside the bounds.

    Raises
    ------
    ArithmeticError : no convergence, which only an ill-posed problem shows.
    """
    count = len(gradient)
    width = upper - lower
    x = 0.5 * (lower + upper)
    scale = max(1.0, float(np.max(np.abs(hessian @ x + gradient)))) if count else 1.0
    below, above = np.full(count, scale), np.full(count, scale)  # multipliers of the bounds
    for _ in range(100):
        low_gap, high_gap = x - lower, upper - x
        residual = hessian @ x + gradient - below + above
        complementarity = float(below @ low_gap + above @ high_gap) / (2 * count)
        if complementarity < tolerance * scale * float(np.mean(width)) and np.max(np.abs(residual)) < tolerance * scale:
            return x
        factor = splu(csc_array(hessian + diags_array(below / low_gap + above / high_gap)))

        def step(low_target: FloatArray, high_target: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            """Newton step towards low_gap * below = low_target and high_gap * above = high_target."""
            low_rest, high_rest = low_target / low_gap - below, high_target / high_gap - above
            dx = factor.solve(-residual + low_rest - high_rest)
            return dx, low_rest - below * dx / low_gap, high_rest + above * dx / high_gap

        dx, d_below, d_above = step(np.zeros(count), np.zeros(count))
        reach = _reach(low_gap, dx, high_gap, below, d_below, above, d_above, 1.0)
        predicted = (
            float((low_gap + reach * dx) @ (below + reach * d_below))
            + float((high_gap - reach * dx) @ (above + reach * d_above))
        ) / (2 * count)
        centring = (predicted / complementarity) ** 3 * complementarity
        dx, d_below, d_above = step(centring - dx * d_below, centring + dx * d_above)
        reach = _reach(low_gap, dx, high_gap, below, d_below, above, d_above, 0.995)
        x, below, above = x + reach * dx, below + reach * d_below, above + reach * d_above
    raise ArithmeticError("the quadratic program does not converge")


def _reach(
    low_gap: FloatArray, dx: FloatArray, high_gap: FloatArray, below: FloatArray, d_below: FloatArray,
    above: FloatArray, d_above: FloatArray, fraction: float,
) -> float:
    """Longest step, at most 1, that keeps gaps and multipliers positive."""
    reach = 1.0
    for value, change in ((low_gap, dx), (high_gap, -dx), (below, d_below), (above, d_above)):
        shrinking = change < 0.0
        if np.any(shrinking):
            reach = min(reach, fraction * float(np.min(-value[shrinking] / change[shrinking])))
    return reach
