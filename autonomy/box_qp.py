"""Convex quadratic programs with bounds on every variable."""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from autonomy.frenet import FloatArray

_ITERATIONS = 100
_RESIDUAL = 1.0e-9  # of the gradient, relative to its size


def solve_box_qp(
    hessian: csc_array, gradient: FloatArray, lower: FloatArray, upper: FloatArray, tolerance: float = 1.0e-12
) -> FloatArray:
    """Minimise 0.5 x'Hx + g'x subject to lower <= x <= upper.

    Primal-dual interior point method with Mehrotra's predictor and corrector (Nocedal and Wright, Numerical
    Optimization, chapter 16.6). One sparse factorisation per iteration, so a banded problem costs linear time.

    Parameters
    ----------
    hessian : shape (n, n), positive semidefinite, sparse.
    gradient : shape (n,).
    lower, upper : shape (n,), finite, lower < upper.
    tolerance : on the mean product of gap and multiplier, relative to the gradient's and the box's size.

    Returns
    -------
    x, shape (n,), strictly inside the bounds.

    Raises
    ------
    ArithmeticError : no convergence, which only an ill-posed problem shows.
    """
    count = len(gradient)
    box = np.concatenate((lower, -upper))
    scale = max(1.0, float(np.max(np.abs(hessian @ (0.5 * (lower + upper)) + gradient))))
    x = 0.5 * (lower + upper)
    multipliers = np.full(2 * count, scale)
    for _ in range(_ITERATIONS):
        # Both bounds in one vector: gaps of x - lower and upper - x.
        gaps = np.concatenate((x, -x)) - box
        residual = hessian @ x + gradient - multipliers[:count] + multipliers[count:]
        mean = float(multipliers @ gaps) / (2 * count)
        if mean < tolerance * scale * float(np.mean(upper - lower)) and np.max(np.abs(residual)) < _RESIDUAL * scale:
            return x
        newton = _Newton(hessian, gaps, multipliers, residual)
        change, multiplier_change = newton.step(np.zeros(2 * count))
        reach = min(_reach(gaps, change), _reach(multipliers, multiplier_change))
        predicted = float((gaps + reach * change) @ (multipliers + reach * multiplier_change)) / (2 * count)
        centring = (predicted / mean) ** 3 * mean
        change, multiplier_change = newton.step(centring - change * multiplier_change)
        reach = min(1.0, 0.995 * min(_reach(gaps, change, math.inf), _reach(multipliers, multiplier_change, math.inf)))
        x = x + reach * change[:count]
        multipliers = multipliers + reach * multiplier_change
    raise ArithmeticError("the quadratic program does not converge")


class _Newton:
    """Newton steps of one iterate; they share one factorisation."""

    def __init__(self, hessian: csc_array, gaps: FloatArray, multipliers: FloatArray, residual: FloatArray) -> None:
        self._gaps, self._multipliers, self._residual = gaps, multipliers, residual
        ratio = (multipliers / gaps).reshape(2, -1).sum(axis=0)
        self._factor = splu(csc_array(hessian + diags_array(ratio)))

    def step(self, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Change of gaps and multipliers towards gaps * multipliers = target."""
        rest = target / self._gaps - self._multipliers
        low, high = rest.reshape(2, -1)
        dx = self._factor.solve(low - high - self._residual)
        change = np.concatenate((dx, -dx))
        return change, rest - self._multipliers * change / self._gaps


def _reach(value: FloatArray, change: FloatArray, longest: float = 1.0) -> float:
    """Longest step that leaves no value negative."""
    shrinking = change < 0.0
    return min(longest, float(np.min(-value[shrinking] / change[shrinking], initial=longest)))
