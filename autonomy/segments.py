"""Centre lines put together from straights, arcs and clothoids."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autonomy.frenet import Curve, FloatArray

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(6)


@dataclass(frozen=True)
class Piece:
    """One piece of a centre line: curvature runs linearly from start to end (1/m) over its length (m)."""

    length: float
    curvature_start: float
    curvature_end: float

    @property
    def turn(self) -> float:
        """Change of heading over the piece, rad."""
        return 0.5 * (self.curvature_start + self.curvature_end) * self.length


def mirrored_lap(half: list[Piece], start: tuple[float, float, float], spacing: float) -> Curve:
    """Build a closed lap from half a lap, mirrored at the normals of its two ends.

    All curvatures are scaled by one common factor so that the lap turns exactly 2 pi; then a last straight is
    added, and its length is what closes the lap: the half lap must end on the axis of symmetry.

    Parameters
    ----------
    half : pieces from station 0, the middle of the front stretch, without the last half straight.
    start : x, y (m) and heading (rad) at station 0.
    spacing : wanted distance of the nodes, m.

    Raises
    ------
    ValueError : the pieces do not turn, or no straight closes them.
    """
    turn = sum(piece.turn for piece in half)
    if turn == 0.0:
        raise ValueError("the pieces do not turn the lap")
    factor = math.pi / abs(turn)
    pieces = [Piece(p.length, factor * p.curvature_start, factor * p.curvature_end) for p in half]
    lap_half = sum(p.length for p in pieces)
    # Drawn from the origin with heading 0, the half lap ends with heading +-pi: going on shortens x by the same length.
    end_x = float(_points(pieces, np.array([lap_half]))[0][0])
    if end_x < 0.0:
        raise ValueError(f"the pieces overshoot the axis of symmetry by {-end_x:.3f} m; no straight closes the lap")
    pieces.append(Piece(end_x, 0.0, 0.0))
    lap = pieces + [Piece(p.length, p.curvature_end, p.curvature_start) for p in reversed(pieces)]
    length = 2.0 * (lap_half + end_x)
    count = max(16, round(length / spacing))
    x, y, heading, curvature = _points(lap, np.arange(count) * (length / count))
    x0, y0, yaw = start
    cos, sin = math.cos(yaw), math.sin(yaw)
    return Curve(x0 + cos * x - sin * y, y0 + sin * x + cos * y, heading + yaw, curvature, length)


def _points(pieces: list[Piece], stations: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """x, y, heading, curvature at ascending stations of a chain that starts at the origin with heading 0."""
    knots = np.concatenate(([0.0], np.cumsum([p.length for p in pieces])))
    # Cells end at every station and at every joint, so that the curvature is linear inside each cell.
    ends = np.unique(np.concatenate((knots, stations)))
    index = np.clip(np.searchsorted(knots, ends[:-1], side="right") - 1, 0, len(pieces) - 1)
    start_curvature = np.array([p.curvature_start for p in pieces])
    slope = np.array([(p.curvature_end - p.curvature_start) / p.length if p.length > 0.0 else 0.0 for p in pieces])
    step = np.diff(ends)
    cell_curvature = start_curvature[index] + slope[index] * (ends[:-1] - knots[index])
    cell_slope = slope[index]
    heading = np.concatenate(([0.0], np.cumsum(cell_curvature * step + 0.5 * cell_slope * step**2)))
    t = 0.5 * step[:, None] * (_GAUSS_NODES[None, :] + 1.0)
    inner = heading[:-1, None] + cell_curvature[:, None] * t + 0.5 * cell_slope[:, None] * t**2
    x = np.concatenate(([0.0], np.cumsum(0.5 * step * (np.cos(inner) @ _GAUSS_WEIGHTS))))
    y = np.concatenate(([0.0], np.cumsum(0.5 * step * (np.sin(inner) @ _GAUSS_WEIGHTS))))
    curvature = np.append(cell_curvature, pieces[-1].curvature_end)
    at = np.searchsorted(ends, stations)
    return x[at], y[at], heading[at], curvature[at]
