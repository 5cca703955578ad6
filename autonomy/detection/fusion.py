"""Objects of LiDAR and radar put together: the LiDAR says where, the radar how fast, and each what the other misses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from autonomy.detection.cloud import Pose
from autonomy.detection.radar import RadarConfig
from autonomy.detection.road_objects import ROAD_OBJECT_DTYPE, RoadObjects, Sensor, no_objects
from autonomy.frenet import FloatArray
from autonomy.opponents.tracker import Scan

#: Beyond that no number of an object is one, whatever its unit.
_LARGEST = 1.0e6


@dataclass(frozen=True)
class SensorObjects:
    """What one sensor has: time of the measurement, us, and ROAD_OBJECT_DTYPE in the vehicle frame of that time."""

    time_us: int
    objects: RoadObjects


class SourceStatus(IntEnum):
    """What became of one sensor's objects; those of all but USED and PARTLY_USED are left out."""

    USED = 0
    PARTLY_USED = 1
    """Objects with numbers that are not finite, or no object's, or whose covariance is none, were left out."""
    MISSING = 2
    """There are none: the sensor has no new scan."""
    MALFORMED = 3
    """Not an array of ROAD_OBJECT_DTYPE and shape (n,), or more than `FusionConfig.objects`."""
    OUT_OF_ORDER = 4
    """Not later than its last."""
    STALE = 5
    """Too old."""
    FROM_THE_FUTURE = 6


@dataclass(frozen=True)
class FusionConfig:
    """Figures of the fusion, all ours.

    Attributes
    ----------
    gate_probability : that two measurements of one object are within the gate.
    stale_us : age from which a scan is not used; two periods.
    mount_x : see `RadarConfig`.
    acceleration : m/s2, 1 sigma of what changes the range rate between the two scans.
    objects : of one sensor, at most.
    """

    gate_probability: float = 0.99
    stale_us: int = 100_000
    mount_x: float = RadarConfig.mount_x
    acceleration: float = 10.0
    objects: int = 64

    @property
    def gate(self) -> float:
        """Squared Mahalanobis distance: quantile of chi-square with two degrees of freedom."""
        return -2.0 * math.log(1.0 - self.gate_probability)


@dataclass(frozen=True)
class Fused:
    """Objects of both sensors.

    Attributes
    ----------
    time_us : that they hold for: of the LiDAR's scan, without it of the radar's, else of the step.
    lidar, radar : what became of each sensor's objects.
    objects : ROAD_OBJECT_DTYPE; the LiDAR's in their order, then what only the radar has.
    """

    time_us: int
    lidar: SourceStatus
    radar: SourceStatus
    objects: RoadObjects


class Fusion:
    """Joins what two sensors saw at nearly the same time. Of scans before, only their times are kept."""

    def __init__(self, config: FusionConfig | None = None) -> None:
        self.config = config or FusionConfig()
        self._last_us: dict[Sensor, int] = {}

    def step(
        self, now_us: int, lidar: SensorObjects | None, radar: SensorObjects | None, yaw_rate: float = 0.0
    ) -> Fused:
        """Fuse one scan of each; never raises.

        Every object of the LiDAR that is used is in the result. Where one of the radar's is assigned to it, it keeps
        its place and covariance, takes the range rate, and gains confidence as from two independent witnesses.

        Parameters
        ----------
        now_us : time of the step.
        lidar, radar : None where there is no new scan.
        yaw_rate : of the car, rad/s; taken as 0 when it is not finite.
        """
        lidar_status, seen = self._accept(Sensor.LIDAR, now_us, lidar)
        radar_status, heard = self._accept(Sensor.RADAR, now_us, radar)
        times = {SourceStatus.USED, SourceStatus.PARTLY_USED}
        time_us = now_us
        if radar is not None and radar_status in times:
            time_us = radar.time_us
        if lidar is not None and lidar_status in times:
            later_s = 1e-6 * (lidar.time_us - time_us) if radar_status in times else 0.0
            heard = moved(heard, later_s, yaw_rate if math.isfinite(yaw_rate) else 0.0, self.config)
            time_us = lidar.time_us
        rows, columns = assign(mahalanobis2(seen, heard), self.config.gate)
        fused = seen.copy()
        for name in ("range_rate", "ground_rate", "rate_std", "radar_track"):
            fused[name][rows] = heard[name][columns]
        doubt = (1.0 - seen["confidence"][rows]) * (1.0 - heard["confidence"][columns])
        fused["confidence"][rows] = 1.0 - doubt
        fused["sensors"][rows] |= np.uint8(Sensor.RADAR)
        rest = np.setdiff1d(np.arange(len(heard)), columns)
        return Fused(time_us, lidar_status, radar_status, np.concatenate((fused, heard[rest])))

    def _accept(self, sensor: Sensor, now_us: int, given: SensorObjects | None) -> tuple[SourceStatus, RoadObjects]:
        nothing = no_objects()
        if given is None:
            return SourceStatus.MISSING, nothing
        objects: object = given.objects
        if not isinstance(objects, np.ndarray) or objects.dtype != ROAD_OBJECT_DTYPE or objects.ndim != 1:
            return SourceStatus.MALFORMED, nothing
        if len(objects) > self.config.objects:
            return SourceStatus.MALFORMED, nothing
        if given.time_us > now_us:
            return SourceStatus.FROM_THE_FUTURE, nothing
        if given.time_us < now_us - self.config.stale_us:
            return SourceStatus.STALE, nothing
        if given.time_us <= self._last_us.get(sensor, given.time_us - 1):
            return SourceStatus.OUT_OF_ORDER, nothing
        self._last_us[sensor] = given.time_us
        usable = _usable(objects)
        return SourceStatus.USED if usable.all() else SourceStatus.PARTLY_USED, objects[usable]


def mahalanobis2(seen: RoadObjects, heard: RoadObjects) -> FloatArray:
    """Squared Mahalanobis distances of all pairs, shape (n, m), by the sum of the covariances of the two."""
    dx, dy = (seen[name][:, None] - heard[name][None, :] for name in ("x", "y"))
    total = seen["covariance"][:, None] + heard["covariance"][None, :]
    xx, xy, yy = total[..., 0, 0], 0.5 * (total[..., 0, 1] + total[..., 1, 0]), total[..., 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance2 = (yy * dx**2 - 2.0 * xy * dx * dy + xx * dy**2) / (xx * yy - xy**2)
    return np.where(distance2 >= 0.0, distance2, np.inf)  # where rounding left nothing of the determinant


def assign(distance2: FloatArray, gate: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs within the gate, each row and column in one at most, whose sum of (gate - distance) is the largest.

    That is the global nearest neighbour with the gate as the price of leaving a pair apart (S. Blackman, R. Popoli,
    Modern Tracking Systems, 1999, 6.4).

    Parameters
    ----------
    distance2 : shape (n, m).

    Returns
    -------
    rows, columns : shape (k,) each, rows ascending.
    """
    rows, columns = linear_sum_assignment(np.minimum(distance2 - gate, 0.0))
    within = distance2[rows, columns] < gate
    return rows[within], columns[within]


def moved(objects: RoadObjects, later_s: float, yaw_rate: float, config: FusionConfig) -> RoadObjects:
    """Radar objects some time later (or earlier), in the vehicle frame of then.

    They move along the sight by their range rate; the car turns under them. A range rate that is not known is taken for
    what the wire carried.
    """
    sight = np.column_stack((objects["x"] - config.mount_x, objects["y"]))
    sight /= np.maximum(np.hypot(*sight.T), 1e-6)[:, None]
    rate_std = np.where(objects["rate_std"] < _LARGEST, objects["rate_std"], 0.0)
    change_std = np.abs(later_s) * (rate_std + 0.5 * np.abs(later_s) * config.acceleration)
    place = np.column_stack((objects["x"], objects["y"])) + objects["range_rate"][:, None] * later_s * sight
    cos, sin = math.cos(yaw_rate * later_s), math.sin(yaw_rate * later_s)
    turn = np.array([[cos, sin], [-sin, cos]])
    later = objects.copy()
    later["x"], later["y"] = turn @ place.T
    later["yaw"] = np.remainder(objects["yaw"] - yaw_rate * later_s + math.pi, 2.0 * math.pi) - math.pi
    spread = change_std[:, None, None] ** 2 * sight[:, :, None] * sight[:, None, :]
    later["covariance"] = turn @ (objects["covariance"] + spread) @ turn.T
    later["range"] = np.maximum(objects["range"] + objects["range_rate"] * later_s, 0.0)
    return later


def scan_of(fused: Fused, pose: Pose, height_std: float = 10.0) -> Scan:
    """Fused objects as the opponents' tracker takes them.

    Parameters
    ----------
    pose : of the car at `Fused.time_us`; roll and pitch are left out.
    height_std : m, 1 sigma of the height, of which nothing is known.
    """
    objects = fused.objects
    cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
    axes = np.array([[cos, -sin], [sin, cos]])
    count = len(objects)
    centre, size, covariance = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3, 3))
    centre[:, :2] = [pose.x, pose.y] + np.column_stack((objects["x"], objects["y"])) @ axes.T
    size[:, 0], size[:, 1] = objects["length"], objects["width"]
    covariance[:, :2, :2] = axes @ objects["covariance"] @ axes.T
    covariance[:, 2, 2] = height_std**2
    return Scan(fused.time_us, centre, size, covariance)


def _usable(objects: RoadObjects) -> NDArray[np.bool_]:
    """Whether all that is computed with is a number of a size that objects have, and the covariance is one."""
    names = ("x", "y", "yaw", "length", "width", "range", "range_rate", "ground_rate", "confidence")
    covariance = objects["covariance"]
    numbers = np.column_stack([*(objects[name] for name in names), covariance.reshape(-1, 4)])
    usable = (np.abs(numbers) <= _LARGEST).all(axis=1) & (objects["rate_std"] > 0.0)
    (xx, xy), (yx, yy) = np.moveaxis(np.where(usable[:, None, None], covariance, np.eye(2)), 0, -1)
    return np.asarray(usable & (xx > 0.0) & (yy > 0.0) & (xx * yy > (0.5 * (xy + yx)) ** 2))
