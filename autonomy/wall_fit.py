"""The wall beside the track as a polynomial in the vehicle's frame, from LiDAR points alone.

A polynomial of first or of third order, whichever describes the points better (the paper's emergency controller). A
cubic always comes nearer to the points it was fitted to, so the two are compared by the Bayesian information criterion,
which charges each coefficient ``ln n``. Points off the wall, be they of cars, of another wall or of nothing, lose their
weight by Cauchy's function while the fit converges.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autonomy.frenet import FloatArray

BEHIND, AHEAD = -20.0, 60.0  # m along the car, where points count
FEWEST = 24  # points
SHORTEST = 25.0  # m from the first to the last point
NEAR = 0.2  # m from the polynomial, where a point belongs to the wall
LEAST_SHARE = 0.5  # of the points that have to be near
_SCALE = 40.0  # m; x in these units keeps the equations well conditioned
_SEED_AT, _SEED_WIDTH = 5.0, 15.0  # m; the first line goes by the points beside the car
_WIDTHS = (2.0, 1.0, 0.5, 0.2, 0.1)  # m, of Cauchy's function, one per round
_LARGEST = 1.0e8  # sum of squared coefficients, m2; beyond, points do not determine them
_WIDEST = 100.0  # m to either side, which also leaves out what is no number
_TRUSTED_SHARE = 0.8  # of the points on a wall that was guessed, below which it is looked for afresh


@dataclass(frozen=True)
class WallFit:
    """A wall: y = sum of ``coefficients[k] * x**k`` in vehicle axes from the centre of gravity.

    Attributes
    ----------
    coefficients : of order 0 to 3; m, 1, 1/m, 1/m2.
    order : 1 or 3.
    begin, end : least and largest x of points on it, m.
    residual : root mean square distance (along y) of the points on it, m.
    share : of all points that are on it, 0..1.
    """

    coefficients: tuple[float, float, float, float]
    order: int
    begin: float
    end: float
    residual: float
    share: float

    def at(self, x: float) -> float:
        """Y of the wall, m."""
        c0, c1, c2, c3 = self.coefficients
        return c0 + x * (c1 + x * (c2 + x * c3))


def fit_wall(cloud: NDArray[np.float32], side: int, guess: WallFit | None = None) -> WallFit | None:
    """Fit the wall on one side of the car.

    Parameters
    ----------
    cloud : shape (n, 3), m, vehicle axes; n may be 0.
    side : 1 when the wall is on the left, -1 on the right.
    guess : the wall a scan ago, which saves looking for it; without one, or where it misleads, the look begins with
        the points beside the car.

    Returns
    -------
    WallFit or None
        None when too few points agree on one.
    """
    x, y = cloud[:, 0].astype(np.float64), cloud[:, 1].astype(np.float64)
    inside = (x > BEHIND) & (x < AHEAD) & (np.abs(y) < _WIDEST)
    if not inside.all():
        x, y = x[inside], y[inside]
    if len(x) < FEWEST:
        return None
    u = x * (1.0 / _SCALE)
    square = u * u
    powers = np.vstack((np.ones_like(u), u, square, square * u))
    if guess is not None:
        scaled = [c * _SCALE**k for k, c in enumerate(guess.coefficients)]
        found = _better(powers, x, y, _cauchy(y - scaled @ powers, _WIDTHS[-2]), _WIDTHS[-1:])
        if found is not None and found.share > _TRUSTED_SHARE:
            return found
    seeds = _seeds(powers, y, np.exp(-(((x - _SEED_AT) / _SEED_WIDTH) ** 2)) * (side * y > 0.0))
    return None if seeds is None else _better(powers, x, y, seeds, _WIDTHS)


def _seeds(powers: FloatArray, y: FloatArray, weights: FloatArray) -> FloatArray | None:
    """Weights of the points by a line along those beside the car; None when these are none."""
    near = np.exp(-((powers[1] * (_SCALE / (2.0 * _SEED_WIDTH))) ** 2))
    for width in _WIDTHS[:3]:
        line = _solved(powers[:2], y, weights)
        if line is None:
            return None
        # What lies ahead is told by a line only as long as it is near.
        weights = _cauchy(y - line @ powers[:2], width) * near
    return weights


def _better(
    powers: FloatArray, x: FloatArray, y: FloatArray, weights: FloatArray, widths: Sequence[float]
) -> WallFit | None:
    """The better of both orders, from weights that are narrowed down."""
    cubic = _solved(powers, y, weights)
    for width in widths:
        if cubic is None:
            return None
        weights = _cauchy(y - cubic @ powers, width)
        cubic = _solved(powers, y, weights)
    line = _solved(powers[:2], y, weights)
    if cubic is None or line is None:
        return None
    bent, plain = y - cubic @ powers, y - line @ powers[:2]
    if _score(bent, 4) < _score(plain, 2):
        return _judged(cubic, 3, x, bent)
    return _judged(line, 1, x, plain)


def _cauchy(residual: FloatArray, width: float) -> FloatArray:
    scaled = residual * (1.0 / width)
    weights: FloatArray = 1.0 / (1.0 + scaled * scaled)
    return weights


def _solved(rows: FloatArray, y: FloatArray, weights: FloatArray) -> FloatArray | None:
    """Weighted least squares; None when the points do not determine the coefficients."""
    weighted = rows * weights
    try:
        solution: FloatArray = np.linalg.solve(weighted @ rows.T, weighted @ y)
    except np.linalg.LinAlgError:
        return None
    return solution if math.fabs(solution.dot(solution)) < _LARGEST else None


def _score(residual: FloatArray, coefficients: int) -> float:
    """Bayesian information criterion: the lower, the better. A point that is off counts as far as the limit."""
    count = len(residual)
    squares = np.minimum(residual * residual, NEAR * NEAR)
    return count * math.log(float(squares.sum()) / count + 1e-12) + coefficients * math.log(count)


def _judged(fit: FloatArray, order: int, x: FloatArray, residual: FloatArray) -> WallFit | None:
    """The fit, when enough points agree with it over a length that tells."""
    near = np.abs(residual) < NEAR
    count = int(np.count_nonzero(near))
    if count < FEWEST or count < LEAST_SHARE * len(x):
        return None
    on = x[near]
    begin, end = float(on.min()), float(on.max())
    if end - begin < SHORTEST:
        return None
    off = residual[near]
    c0, c1, c2, c3 = [float(value) / _SCALE**power for power, value in enumerate(fit)] + [0.0] * (3 - order)
    return WallFit((c0, c1, c2, c3), order, begin, end, math.sqrt(float(off.dot(off)) / count), count / len(x))
