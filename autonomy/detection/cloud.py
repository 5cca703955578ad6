"""Point clouds as they cross into C, and what may be wrong with them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from autonomy._native import ffi, lib

#: Points in the vehicle frame (x forward, y left, z up), shape (n, 3), m, C-contiguous.
Cloud: TypeAlias = NDArray[np.float32]

POINTS_MAX: int = lib.CLOUD_POINTS_MAX
RANGE: float = float(lib.CLOUD_RANGE_M)


class DetectionStatus(IntEnum):
    """What became of a scan; each but OK, and TOO_MANY_OBJECTS, comes without objects."""

    OK = 0
    EMPTY = 1
    """No points."""
    NOT_FLOAT32 = 2
    """Not an array of float32."""
    BAD_SHAPE = 3
    """Not of shape (n, 3); (n, 4) of a scan with ages."""
    TOO_MANY_POINTS = 4
    """More than POINTS_MAX."""
    NOTHING_FINITE = 5
    """Every point has a coordinate that is NaN or infinite."""
    BAD_POSE = 6
    """The pose of the car is not finite."""
    TOO_DENSE = 7
    """Clustering would take too long."""
    TOO_MANY_OBJECTS = 8
    """Only the nearest objects are there."""
    FROZEN = 9
    """The points are those of the scan before; `Perception` says so, as a scan alone does not tell."""
    BAD_AGE = 10
    """A point has no finite age: it can be anywhere."""


@dataclass(frozen=True)
class Pose:
    """Vehicle frame in the track frame (ISO 8855): x, y in m, angles in rad; yaw first, then pitch, then roll."""

    x: float
    y: float
    yaw: float
    pitch: float = 0.0
    roll: float = 0.0

    @property
    def finite(self) -> bool:
        """Whether all of it is."""
        return all(map(math.isfinite, (self.x, self.y, self.yaw, self.pitch, self.roll)))


@dataclass(frozen=True)
class Tally:
    """Where the points of a cloud went: kept, removed for what the filter is for, beyond RANGE, not finite."""

    kept: int
    removed: int
    far: int
    not_finite: int

    @classmethod
    def of(cls, tally: Any) -> Tally:
        """From the C struct `cloud_tally`."""
        return cls(tally.kept, tally.removed, tally.far, tally.not_finite)


def check_cloud(value: object, columns: int = 3) -> DetectionStatus:
    """Whether something is a cloud that the filters take, of rows so long: OK, EMPTY, or what is wrong with it."""
    if not isinstance(value, np.ndarray) or value.dtype != np.float32:
        return DetectionStatus.NOT_FLOAT32
    if value.ndim != 2 or value.shape[1] != columns:
        return DetectionStatus.BAD_SHAPE
    if len(value) > POINTS_MAX:
        return DetectionStatus.TOO_MANY_POINTS
    return DetectionStatus.OK if len(value) else DetectionStatus.EMPTY


def to_native(cloud: Cloud) -> Any:
    """C array `cloud_point[]` on the memory of a cloud (a copy's where it is not contiguous).

    Raises
    ------
    ValueError
        When `check_cloud` finds anything wrong with it.
    """
    status = check_cloud(cloud)
    if status not in (DetectionStatus.OK, DetectionStatus.EMPTY):
        raise ValueError(f"not a cloud: {status.name}")
    return ffi.from_buffer("cloud_point[]", np.ascontiguousarray(cloud))


def to_room(out: Cloud | None, count: int) -> Cloud:
    """Room for the result of a filter: what was given, or new.

    Raises
    ------
    ValueError
        When what was given is not contiguous or has room for less.
    """
    if out is None:
        return np.empty((count, 3), dtype=np.float32)
    if len(out) < count or not out.flags.c_contiguous or not out.flags.writeable:
        raise ValueError(f"out must be contiguous, writeable and have room for {count} points")
    return out
