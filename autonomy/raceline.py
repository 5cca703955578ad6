"""The race line: path of minimum curvature inside the track."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, diags_array

from autonomy.box_qp import solve_box_qp
from autonomy.frenet import Curve, FloatArray, Projector
from autonomy.track import Track

DESIGN_SPACING = 4.0  # m, between the nodes of the optimisation
_ROUNDS = 8
_SETTLED = 0.002  # m; the line moves less than this in a round


def minimum_curvature_path(track: Track, clearance: float, spacing: float = DESIGN_SPACING) -> Curve:
    """Find the closed path with the least integral of squared curvature between the boundaries.

    Moving the nodes of a path by a along its normals changes the curvature to k + k^2 a + a'' and the length
    element to (1 - k a) ds, to first order; so k sqrt(ds) becomes (k + k^2 a / 2 + a'') sqrt(ds), and the best
    a solves a quadratic program with bounds. It is solved again about its own result until the line stays, so
    that the linearisation does not matter (after Heilmeier et al., Vehicle System Dynamics 58, 2020, who keep
    the centre line as the reference).

    Parameters
    ----------
    track : with boundaries.
    clearance : distance of the path from both boundaries, m; at least half the car's width.
    spacing : distance of the nodes, m.

    Raises
    ------
    ValueError : the track is too narrow for the clearance.
    """
    if float(np.min(track.width_left + track.width_right)) <= 2.0 * clearance + 0.1:
        raise ValueError(f"the track is too narrow for a clearance of {clearance:g} m on both sides")
    projector = Projector(track.centre)
    count = round(track.length / spacing)
    stations = np.arange(count) * (track.length / count)
    path = Curve.through(*track.centre.offset(stations, np.zeros(count)), count)
    for _ in range(_ROUNDS):
        lower, upper = _room(track, projector, path, clearance)
        shift = _best_shift(path, lower, upper)
        path = Curve.through(path.x - shift * np.sin(path.heading), path.y + shift * np.cos(path.heading), count)
        if float(np.max(np.abs(shift))) < _SETTLED:
            break
    return path


def lateral_offsets(track: Track, path: Curve) -> tuple[FloatArray, FloatArray]:
    """Station and offset of all nodes of a path on the track's centre line, shape (n,) each, m."""
    projector = Projector(track.centre)
    pairs = [projector.project(x, y) for x, y in zip(path.x.tolist(), path.y.tolist(), strict=True)]
    stations, offsets = np.array(pairs).T
    return stations, offsets


def _room(track: Track, projector: Projector, path: Curve, clearance: float) -> tuple[FloatArray, FloatArray]:
    """How far each node may move along its normal, to the right (negative) and to the left."""
    pairs = [projector.project(x, y) for x, y in zip(path.x.tolist(), path.y.tolist(), strict=True)]
    stations, offsets = np.array(pairs).T
    left = np.interp(stations, track.centre.stations, track.width_left, period=track.length) - clearance
    right = np.interp(stations, track.centre.stations, track.width_right, period=track.length) - clearance
    lower, upper = -right - offsets, left - offsets
    # A node that ended a hair outside its bounds must still have an interior.
    return np.minimum(lower, upper - 0.01), np.maximum(upper, lower + 0.01)


def _best_shift(path: Curve, lower: FloatArray, upper: FloatArray) -> FloatArray:
    curvature = _turning(path)
    change = csc_array(_periodic_second_difference(path.count, path.spacing) + diags_array(0.5 * curvature**2))
    # Scaled to unit size so that the solver's tolerances mean something.
    scale = path.spacing**4
    return solve_box_qp(csc_array(scale * (change.T @ change)), scale * (change.T @ curvature), lower, upper)


def _turning(path: Curve) -> FloatArray:
    """Curvature as the turn of the polygon at each node over the spacing.

    Unlike the spline's, it answers to a shift of one node exactly as the second difference does, so the rounds
    converge also at the shortest wavelength.
    """
    heading = np.arctan2(np.roll(path.y, -1) - path.y, np.roll(path.x, -1) - path.x)
    turn = heading - np.roll(heading, 1)
    return (turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi))) / path.spacing


def _periodic_second_difference(count: int, spacing: float) -> csc_array:
    rows = np.arange(count)
    columns = np.concatenate(((rows - 1) % count, rows, (rows + 1) % count))
    values = np.concatenate((np.ones(count), np.full(count, -2.0), np.ones(count))) / spacing**2
    return csc_array((values, (np.tile(rows, 3), columns)), shape=(count, count))
