"""Motion of the car within a scan taken out of its cloud: a LiDAR needs 50 ms for it, a car drives 3 m meanwhile."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.cloud import Cloud
from autonomy.detection.road_objects import RoadObjects
from autonomy.vehicle import CG_TO_REAR_AXLE


class LidarScan(NamedTuple):
    """A merged scan as the LiDARs give it.

    Attributes
    ----------
    cloud : float32, shape (n, 3), m, each point in the axes that the vehicle had when it was taken.
    age : float32, shape (n,), s, from then to the end of the scan.
    """

    cloud: Cloud
    age: NDArray[np.float32]


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

    def cloud(self, scan: LidarScan, vx: float, vy: float, yaw_rate: float) -> Cloud:
        """Points in the axes at the end of the scan, where what stands still keeps its shape and place.

        Parameters
        ----------
        scan : shapes as stated.
        vx, vy, yaw_rate : motion of the vehicle frame in its own axes during the scan, m/s and rad/s.

        Notes
        -----
        The car moves by a constant twist, whose exponential is a turn by the angle theta and a chord in the direction
        of theta / 2, as long as the way times sin(theta / 2) / (theta / 2) (Murray, Li, Sastry, A Mathematical
        Introduction to Robotic Manipulation, 1994, 2.3).
        """
        cloud, age = scan
        turn = np.float32(-yaw_rate) * age
        half = np.float32(0.5) * turn
        chord = -age * np.sinc(half / np.float32(math.pi))
        cos, sin = np.cos(turn), np.sin(turn)
        cos_half, sin_half = np.cos(half), np.sin(half)
        x, y = cloud[:, 0], cloud[:, 1]
        moved = np.empty_like(cloud)
        moved[:, 0] = cos * x - sin * y + chord * (np.float32(vx) * cos_half - np.float32(vy) * sin_half)
        moved[:, 1] = sin * x + cos * y + chord * (np.float32(vx) * sin_half + np.float32(vy) * cos_half)
        moved[:, 2] = cloud[:, 2]
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
