"""Where the walls are, from the scans themselves, for the sake of a geofence whose track file is wrong.

A wall is long, thin and runs along the track. So in the Frenet frame of the centre line, and measured from the boundary
of the file, it is a slowly changing offset along the stations, the same on each scan. A car is short and moves on.

On each side of each scan:

1. Per station bin the outermost dense returns near the file's boundary: their mean offset is one datum.
2. A smooth line through the data: Whittaker's smoother (squared residuals, and squared second differences by a
   stiffness; P. H. C. Eilers, "A Perfect Smoother", Anal. Chem. 75, 2003), by iteratively reweighted least squares
   with Cauchy's weights. It begins stiff and wide, which is what tells a car beside the wall from the wall behind it,
   and ends soft and narrow, which follows a boundary that bends away from the file's.
3. Support: only runs of bins that are near the line, long enough and without long gaps, are a wall.
4. What is known of each bin of the lap moves towards the line, at most so far per scan, and is forgotten after a while.

The fence is then the tighter of the two: the file's boundary less its margin, the seen wall less its own. What is seen
never widens it. Nothing in here is drawn at random.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from autonomy.detection.cloud import RANGE, Cloud, Pose
from autonomy.detection.frenet_raster import FrenetRaster
from autonomy.detection.geofence import Geofence
from autonomy.frenet import FloatArray
from autonomy.track import Track

_BIN = 2.0  # m of station
_CELL = 0.2  # m of offset; the returns of a datum lie within two
_FULL = 5  # returns; a datum of as many or more has full weight
_STAGES = ((1e5, 2.0), (1e4, 1.0), (1e3, 0.5), (1e2, 0.3), (30.0, 0.2))  # stiffness, and Cauchy's width in m
_LEAST_WEIGHT = 1.0e-6  # of an offset of 0, so that the equations can be solved whatever the data


class BoundaryStatus(IntEnum):
    """What became of a scan."""

    OK = 0
    """A wall was seen, on one side at least."""
    NO_WALL = 1
    """None was seen; what is known of earlier scans counts on."""
    EMPTY = 2
    """No points."""
    BAD_POSE = 3
    """The pose is not finite; no point is inside."""


@dataclass(frozen=True)
class BoundaryConfig:
    """Thresholds of the estimate.

    Attributes
    ----------
    margin : m, from the seen wall to the fence.
    inward, outward : m, how far inside and outside the file's boundary a wall is looked for; 0.5 or more.
    dense : returns, at least, of a datum.
    near : m from the line, where a datum supports it.
    run, gap : m, shortest run of supported bins, and longest gap in one.
    beyond : m, how far past the ends of what is seen the line is taken to go on.
    gain : share of the way from what is known to what is seen, per scan, 0..1.
    rate : m, longest way per scan.
    memory : scans, after which what is not seen again is forgotten.
    """

    margin: float = 1.0
    inward: float = 4.0
    outward: float = 2.0
    dense: int = 2
    near: float = 0.3
    run: float = 30.0
    gap: float = 2.0
    beyond: float = 20.0
    gain: float = 0.3
    rate: float = 0.2
    memory: int = 20

    def __post_init__(self) -> None:
        for name, low, high in (
            ("margin", 0.0, 3.0),
            ("inward", 0.5, 10.0),
            ("outward", 0.5, 10.0),
            ("dense", 1, 1000),
            ("near", 0.01, 2.0),
            ("run", 10.0, RANGE),
            ("gap", 0.0, RANGE),
            ("beyond", 0.0, RANGE),
            ("gain", 0.01, 1.0),
            ("rate", 0.001, 10.0),
            ("memory", 0, 10_000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} is {value:g}; must be {low:g} to {high:g}")


@dataclass(frozen=True)
class Boundary:
    """What one scan gave.

    Attributes
    ----------
    status : OK, or why no wall was seen.
    inside : shape (n,), of each point whether it is inside the fence.
    seen : on the left and on the right, whether a wall was.
    """

    status: BoundaryStatus
    inside: NDArray[np.bool_]
    seen: tuple[bool, bool]


class BoundaryEstimate:
    """A geofence that goes by the walls that are seen, where they are inside those of the track file.

    Parameters
    ----------
    track : as its file has it.
    config : thresholds.

    Attributes
    ----------
    offset : shape (2, bins), m; of the left and the right wall per bin of the lap, from the file's boundary, positive
        outside. All of its state, with `unseen`.
    unseen : shape (2, bins); scans since the offset was seen; above the memory there is none.

    Raises
    ------
    ValueError
        When the track, widened by the outward search, cannot be fenced in (`Geofence`).
    """

    def __init__(self, track: Track, config: BoundaryConfig | None = None) -> None:
        self.config = config or BoundaryConfig()
        outward = self.config.outward
        self._widths = np.stack((track.width_left, track.width_right))
        around = Track(
            track.name,
            track.origin,
            track.centre,
            width_left=track.width_left + outward,
            width_right=track.width_right + outward,
            bank=track.bank,
            grade=track.grade,
        )
        #: Lets pass what the estimate looks at: the track and what lies not far outside.
        self.around = Geofence(around, 0.0)
        self._raster = FrenetRaster(track, float(self._widths.max()) + outward)
        self._spacing, self._count = track.centre.spacing, track.centre.count
        self._project = track.project
        bins = max(1, round(track.length / _BIN))
        self._bin = track.length / bins
        self._window = min(2 * math.ceil(RANGE / self._bin) + 1, bins)
        self._cells = math.ceil((self.config.inward + outward) / _CELL)
        self._stiffness = _second_differences(self._window)
        self.offset = np.zeros((2, bins))
        self.unseen = np.full((2, bins), self.config.memory + 1, dtype=np.int64)

    def forget(self) -> None:
        """Start afresh, as after a jump of the pose."""
        self.unseen[:] = self.config.memory + 1

    def step(self, cloud: Cloud, pose: Pose, margin: float) -> Boundary:
        """Take in a scan, and fence it in.

        Parameters
        ----------
        cloud : without ground, of what is `around` and finite.
        pose : of the car when the cloud was taken.
        margin : m, from the file's boundary to the fence.
        """
        if not pose.finite:
            return Boundary(BoundaryStatus.BAD_POSE, np.zeros(len(cloud), dtype=np.bool_), (False, False))
        np.minimum(self.unseen + 1, self.config.memory + 1, out=self.unseen)
        if len(cloud) == 0:
            return Boundary(BoundaryStatus.EMPTY, np.empty(0, dtype=np.bool_), (False, False))
        bins = self.offset.shape[1]
        station, left = self._raster.project(cloud, pose)
        node = np.rint(station / self._spacing).astype(np.int64) % self._count
        place = np.floor(station / self._bin).astype(np.int64) % bins
        first = int(self._project(pose.x, pose.y)[0] / self._bin) - self._window // 2
        inside = np.ones(len(cloud), dtype=np.bool_)
        seen = []
        for side, across in enumerate((left, -left)):
            beyond = across - self._widths[side, node]
            seen.append(self._look(side, first, (place - first) % bins, beyond))
            wall = np.where(self.unseen[side] <= self.config.memory, self.offset[side] - self.config.margin, np.inf)
            inside &= beyond < np.minimum(wall, -margin)[place]
        status = BoundaryStatus.OK if any(seen) else BoundaryStatus.NO_WALL
        return Boundary(status, inside, (seen[0], seen[1]))

    def _look(self, side: int, first: int, place: NDArray[np.int64], beyond: FloatArray) -> bool:
        """Move what is known of one side to what this scan shows; whether it shows a wall.

        Parameters
        ----------
        first : bin of the lap with which the window begins.
        place : of each point, its bin in the window; outside of it, the window's length or more.
        beyond : of each point, how far outside the file's boundary it is, m.
        """
        config = self.config
        datum, weight = self._data(place, beyond)
        least = config.run / self._bin
        if np.count_nonzero(weight) * (1.0 + config.gap / self._bin) < least:
            return False
        line, near = _smooth(self._stiffness, datum, weight, config.near)
        on = _runs(near, least, config.gap / self._bin)
        if not on.any():
            return False
        # Off the runs, data had nothing to compare them with: they count where the line of the runs leads to them.
        past = round(config.beyond / self._bin)
        for _ in range(2):
            line = _solved(self._stiffness, _STAGES[-1][0], datum, weight * on)
            on |= _spread(on, past) & (np.abs(datum - line) < config.near) & (weight > 0.0)
        places = (np.arange(self._window) + first) % self.offset.shape[1]
        unknown = self.unseen[side, places] > config.memory
        # What is merely led to is no news of what was seen.
        moved = _between(on) | _spread(on, past) & unknown
        self._move(side, places[moved], line[moved])
        return True

    def _data(self, place: NDArray[np.int64], beyond: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of each bin of the window, mean offset of its outermost dense returns, m, and its weight, 0..1."""
        cell = np.floor((beyond + self.config.inward) / _CELL).astype(np.int64)
        near = (place < self._window) & (cell >= 0) & (cell < self._cells)
        flat, shape = place[near] * self._cells + cell[near], (self._window, self._cells)
        count = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape)
        total = np.bincount(flat, weights=beyond[near], minlength=shape[0] * shape[1]).reshape(shape)
        taken = count > 0
        count[:, 1:] += count[:, :-1].copy()
        total[:, 1:] += total[:, :-1].copy()
        dense = taken & (count >= self.config.dense)
        outermost = self._cells - 1 - np.argmax(dense[:, ::-1], axis=1)
        every = np.arange(self._window)
        returns = np.where(dense[every, outermost], count[every, outermost], 0)
        return total[every, outermost] / np.maximum(returns, 1), np.minimum(returns, _FULL) / _FULL

    def _move(self, side: int, places: NDArray[np.int64], seen: FloatArray) -> None:
        config = self.config
        seen = seen.clip(-config.inward, config.outward)
        known = self.offset[side, places]
        step = (config.gain * (seen - known)).clip(-config.rate, config.rate)
        self.offset[side, places] = np.where(self.unseen[side, places] <= config.memory, known + step, seen)
        self.unseen[side, places] = 0


def _second_differences(count: int) -> FloatArray:
    """Diagonals of the matrix of the sum of squared second differences, as `solveh_banded` has them; shape (3, n)."""
    difference = np.diff(np.eye(count), 2, axis=0)
    square = difference.T @ difference
    return np.stack([np.concatenate((np.zeros(k), np.diagonal(square, k))) for k in (2, 1, 0)])


def _solved(stiffness: FloatArray, stiff: float, datum: FloatArray, weights: FloatArray) -> FloatArray:
    matrix = stiff * stiffness
    matrix[2] += weights + _LEAST_WEIGHT
    line: FloatArray = solveh_banded(matrix, weights * datum, check_finite=False)
    return line


def _smooth(
    stiffness: FloatArray, datum: FloatArray, weight: FloatArray, near: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Line through the data, shape (n,), and of each datum whether it is near."""
    weights, line = weight, datum
    for stiff, width in _STAGES:
        line = _solved(stiffness, stiff, datum, weights)
        weights = weight / (1.0 + ((datum - line) / width) ** 2)
    return line, (np.abs(datum - line) < near) & (weight > 0.0)


def _runs(near: NDArray[np.bool_], least: float, gap: float) -> NDArray[np.bool_]:
    """Supported bins of runs that are so many bins long, with gaps of at most so many between."""
    (places,) = np.nonzero(near)
    on = np.zeros_like(near)
    for part in np.split(places, np.flatnonzero(np.diff(places) - 1 > gap) + 1):
        if len(part) and part[-1] - part[0] + 1 >= least:
            on[part] = True
    return on


def _spread(on: NDArray[np.bool_], past: int) -> NDArray[np.bool_]:
    """From so many bins before the first to so many past the last."""
    (places,) = np.nonzero(on)
    wide = np.zeros_like(on)
    wide[max(places[0] - past, 0) : places[-1] + past + 1] = True
    return wide


def _between(on: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """From the first to the last."""
    return _spread(on, 0)
