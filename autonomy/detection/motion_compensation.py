"""Motion of the car within a scan taken out of its cloud: a LiDAR needs 50 ms for it, a car drives 3 m meanwhile."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from autonomy._native import ffi, lib
from autonomy.detection.cloud import Cloud, DetectionStatus, check_cloud
from autonomy.detection.road_objects import RoadObjects
from autonomy.vehicle import CG_TO_REAR_AXLE

#: A merged scan as the LiDARs give it: float32, shape (n, 4); x, y and z, m, of each point in the axes that the vehicle
#: had when it was taken, and the time from then to the end of the scan, s.
AgedCloud: TypeAlias = NDArray[np.float32]


def check_scan(value: object) -> DetectionStatus:
    """Whether something is a scan of points with ages: OK, EMPTY, or what is wrong with it."""
    status = check_cloud(value, columns=4)
    if status is DetectionStatus.OK and not np.isfinite(np.asarray(value)[:, 3]).all():
        return DetectionStatus.BAD_AGE
    return status


@dataclass(frozen=True)
class Sweep:
    """How a LiDAR turns: a field of view, rad, about a heading in the vehicle frame, rad, from right to left."""

    x: float
    y: float
    heading: float
    field_of_view: float = math.radians(120.0)
    period_s: float = 0.05

    def age(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """When it looked at places, s before the end of its scan; NaN where it does not look."""
        off = np.arctan2(y - self.y, x - self.x) - self.heading
        off = np.remainder(off + math.pi, 2.0 * math.pi) - math.pi
        share = off / self.field_of_view + 0.5
        return np.where((share >= 0.0) & (share <= 1.0), (1.0 - share) * self.period_s, np.nan)


#: Front, left and right LiDAR of the AV-21 (AWSIM's model of it), from the centre of gravity on, m and rad.
SWEEPS = (
    Sweep(2.242 - CG_TO_REAR_AXLE, 0.0, 0.0),
    Sweep(1.549 - CG_TO_REAR_AXLE, 0.267, math.radians(120.0)),
    Sweep(1.549 - CG_TO_REAR_AXLE, -0.267, math.radians(-120.0)),
)


@dataclass(frozen=True)
class MotionCompensation:
    """Brings scans to the time at which they end.

    Attributes
    ----------
    sweeps : of the LiDARs.
    speed_std : m/s, 1 sigma of the difference between another car's velocity and the own one; ours.
    """

    sweeps: Sequence[Sweep] = SWEEPS
    speed_std: float = 10.0

    def cloud(self, scan: AgedCloud, vx: float, vy: float, yaw_rate: float) -> Cloud:
        """Points in the axes at the end of the scan, where what stands still keeps its shape and place.

        Parameters
        ----------
        scan : as `check_scan` lets pass.
        vx, vy, yaw_rate : motion of the vehicle frame in its own axes during the scan, m/s and rad/s.

        Raises
        ------
        ValueError
            When an age is not finite.
        """
        moved = np.empty((len(scan), 3), dtype=np.float32)
        twist = ffi.new("planar_twist *", {"vx": vx, "vy": vy, "yaw_rate": yaw_rate})
        points = ffi.from_buffer("aged_point[]", np.ascontiguousarray(scan))
        if not lib.motion_compensate(points, len(scan), twist, ffi.from_buffer("cloud_point[]", moved)):
            raise ValueError("an age is not finite")
        return moved

    def objects(self, objects: RoadObjects, vx: float, vy: float) -> RoadObjects:
        """Objects of a compensated cloud at the end of the scan.

        Compensation puts a car to where it was when the LiDAR looked at it. From then on it is taken to drive as the
        own car does, and what it may drive otherwise goes into the covariance.

        Parameters
        ----------
        objects : in the vehicle frame.
        vx, vy : of the own car, m/s.
        """
        ages = np.array([sweep.age(objects["x"], objects["y"]) for sweep in self.sweeps])
        seen = np.isfinite(ages)
        # Where two LiDARs look, their mean; where none does, which rounding may bring about, half a period.
        count = seen.sum(axis=0)
        total = np.where(seen, ages, 0.0).sum(axis=0)
        age = np.where(count > 0, total / np.maximum(count, 1), 0.5 * self.sweeps[0].period_s)
        later = objects.copy()
        later["x"] += vx * age
        later["y"] += vy * age
        later["covariance"] += (self.speed_std * age)[:, None, None] ** 2 * np.eye(2)
        return later
