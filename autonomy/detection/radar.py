"""Radar tracks to objects on the road: plausibility, moving or not, geofence."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.cloud import Pose
from autonomy.detection.cross_check import VehicleShape
from autonomy.detection.geofence import Geofence
from autonomy.detection.road_objects import RoadObjects, Sensor, no_objects, turned
from autonomy.frenet import FloatArray
from autonomy.track import Track
from autonomy.vehicle import CG_TO_REAR_AXLE
from dbc.radar_tracks import TRACK_DTYPE, TRACKS, RangeMode, Tracks, TrackStatus, resolution, wire_limits


@dataclass(frozen=True)
class OwnMotion:
    """Pose of the vehicle frame in the track frame, and its motion along its own axes: m/s, m/s and rad/s."""

    pose: Pose
    vx: float
    vy: float
    yaw_rate: float

    @property
    def plausible(self) -> bool:
        """Whether all of it is finite, and below 1000 m/s and 100 rad/s."""
        return self.pose.finite and all(abs(rate) < 1000.0 for rate in (self.vx, self.vy, 10.0 * self.yaw_rate))


class RadarStatus(IntEnum):
    """What became of a scan; each but OK comes without objects."""

    OK = 0
    EMPTY = 1
    """No tracks."""
    NOT_TRACKS = 2
    """Not an array of TRACK_DTYPE."""
    BAD_SHAPE = 3
    """Not of shape (n,)."""
    TOO_MANY_TRACKS = 4
    """More than 64."""
    BAD_NUMBERS = 5
    """Numbers of tracks are not 1 to 64, or occur twice."""
    BAD_MOTION = 6
    """The motion of the car is not finite, or no car's."""
    OUT_OF_ORDER = 7
    """Not later than the last scan."""
    FROZEN = 8
    """The tracks are those of the scan before, and so is the bit that toggles; `Perception` says so."""


class Verdict(IntEnum):
    """What became of a track; the first that applies."""

    KEPT = 0
    NOT_FINITE = 1
    NOT_MEASURED = 2
    """Coasted, or with no status that speaks of a measurement."""
    IMPLAUSIBLE = 3
    """Out of what the radar can measure, or faster over ground than a car."""
    STATIONARY = 4
    """Its range rate is that of something that does not move."""
    OUTSIDE = 5
    """Outside the geofence."""


@dataclass(frozen=True)
class RadarConfig:
    """What is known of the radar and of cars.

    Attributes
    ----------
    mount_x : m, of the radar ahead of the origin of the vehicle frame: 1.784 m ahead of the rear axle (AWSIM's model of
        the AV-21), the centre of gravity `CG_TO_REAR_AXLE`.
    margin : of the geofence, m, the paper's.
    range_std, rate_std : m and m/s, 1 sigma (F. de Ponte Mueller, 2017, of the ESR).
    long_angle_std, medium_angle_std : rad, 1 sigma in long and in medium range; the first ours, the second that of the
        Aptiv MRR.
    speed_std : m/s, 1 sigma of the own speed; ours.
    range_min, angle_max : m and rad, of a track: ours, and what the wire can carry.
    speed_max : m/s over ground; ours.
    stationary_gate : sigmas by which the range rate of something that stands may be off; ours.
    stationary_speed : m/s over ground along the sight, below which everything stands; ours.
    confidence : by status of the track; ours.
    shape : of the cars.
    """

    mount_x: float = 1.784 - CG_TO_REAR_AXLE
    margin: float = 1.0
    range_std: float = 1.8
    rate_std: float = 0.12
    long_angle_std: float = math.radians(0.5)
    medium_angle_std: float = math.radians(1.0)
    speed_std: float = 0.1
    range_min: float = 1.0
    angle_max: float = math.radians(51.1)
    speed_max: float = 100.0
    stationary_gate: float = 4.0
    stationary_speed: float = 3.0
    confidence: dict[int, float] = field(
        default_factory=lambda: {
            TrackStatus.NEW.value: 0.2,
            TrackStatus.NEW_UPDATED.value: 0.5,
            TrackStatus.UPDATED.value: 0.8,
            TrackStatus.MERGED.value: 0.5,
        }
    )
    shape: VehicleShape = field(default_factory=VehicleShape)


@dataclass(frozen=True)
class RadarDetections:
    """What one scan gave.

    Attributes
    ----------
    status : OK, or why there are no objects.
    objects : ROAD_OBJECT_DTYPE, in the vehicle frame, nearest first.
    verdicts : `Verdict` of each track, in the order of the tracks; empty unless the status is OK.
    """

    status: RadarStatus
    objects: RoadObjects
    verdicts: NDArray[np.uint8]

    @classmethod
    def nothing(cls, status: RadarStatus) -> RadarDetections:
        """No objects, and why."""
        return cls(status, no_objects(), np.empty(0, dtype=np.uint8))


class RadarDetector:
    """Plausibility, moving-object test and geofence in a row.

    Parameters
    ----------
    track : on which the car drives.
    config : figures.

    Raises
    ------
    ValueError
        When the track cannot be fenced in (`Geofence`).
    """

    def __init__(self, track: Track, config: RadarConfig | None = None) -> None:
        self.config = config or RadarConfig()
        self._geofence = Geofence(track, self.config.margin)
        self._line = np.column_stack((track.centre.x, track.centre.y))
        self._heading = track.centre.heading
        self._last_us: int | None = None
        self.scans: Counter[RadarStatus] = Counter()
        """Scans so far, by status."""
        self.tracks: Counter[Verdict] = Counter()
        """Tracks so far, by verdict."""

    def step(self, time_us: int, tracks: object, motion: OwnMotion) -> RadarDetections:
        """Objects of one scan; never raises.

        Of scans before, only the time is kept: it has to grow. A scan that is refused leaves it as it was.

        Parameters
        ----------
        time_us : of the scan.
        tracks : TRACK_DTYPE, shape (n,), n up to 64.
        motion : of the car when the radar measured.
        """
        status = self._check(time_us, tracks, motion)
        self.scans[status] += 1
        if status not in (RadarStatus.OK, RadarStatus.EMPTY):
            return RadarDetections.nothing(status)
        self._last_us = time_us
        objects, verdicts = self._detect(np.asarray(tracks), motion)
        self.tracks.update(Verdict(verdict) for verdict in verdicts.tolist())
        return RadarDetections(status, objects, verdicts)

    def _check(self, time_us: int, tracks: object, motion: OwnMotion) -> RadarStatus:
        if not isinstance(tracks, np.ndarray) or tracks.dtype != TRACK_DTYPE:
            return RadarStatus.NOT_TRACKS
        if tracks.ndim != 1:
            return RadarStatus.BAD_SHAPE
        if len(tracks) > TRACKS:
            return RadarStatus.TOO_MANY_TRACKS
        numbers = tracks["id"]
        if len(np.unique(numbers)) != len(numbers) or ((numbers < 1) | (numbers > TRACKS)).any():
            return RadarStatus.BAD_NUMBERS
        if not motion.plausible:
            return RadarStatus.BAD_MOTION
        if self._last_us is not None and time_us <= self._last_us:
            return RadarStatus.OUT_OF_ORDER
        return RadarStatus.OK if len(tracks) else RadarStatus.EMPTY

    def _detect(self, tracks: Tracks, motion: OwnMotion) -> tuple[RoadObjects, NDArray[np.uint8]]:
        config = self.config
        finite = np.isfinite(tracks["range"]) & np.isfinite(tracks["angle"]) & np.isfinite(tracks["range_rate"])
        distance, angle, rate = (np.where(finite, tracks[name], 0.0) for name in ("range", "angle", "range_rate"))
        confidence = np.array([config.confidence.get(status, 0.0) for status in tracks["status"].tolist()])
        angle_std = np.where(
            tracks["mode"] & np.uint8(RangeMode.LONG_RANGE), config.long_angle_std, config.medium_angle_std
        )
        closing, across = _own_speed(motion, config.mount_x, angle)
        over_ground = rate + closing
        beyond = wire_limits("range")[1] - 0.5 * resolution("range")
        plausible = (distance >= config.range_min) & (distance < beyond) & (np.abs(angle) <= config.angle_max)
        plausible &= np.abs(over_ground) <= config.speed_max
        distance = np.where(plausible, distance, 0.0)
        # A wall that comes nearer faster than the wire can say is sent with what the wire can say.
        slowest, fastest = wire_limits("range_rate")
        off = np.abs(rate - np.clip(-closing, slowest, fastest))
        off_std = np.hypot(math.hypot(config.rate_std, config.speed_std), across * angle_std)
        stationary = off <= np.maximum(config.stationary_gate * off_std, config.stationary_speed)

        verdicts = np.select(
            [~finite, confidence <= 0.0, ~plausible, stationary],
            [Verdict.NOT_FINITE, Verdict.NOT_MEASURED, Verdict.IMPLAUSIBLE, Verdict.STATIONARY],
            Verdict.KEPT,
        ).astype(np.uint8)
        (moving,) = np.nonzero(verdicts == Verdict.KEPT)
        rate = rate[moving]
        objects = no_objects(len(moving))
        objects["range"], objects["range_rate"], objects["ground_rate"] = distance[moving], rate, over_ground[moving]
        # Of a rate at the end of the scale nothing is known but that it may be more.
        saturated = (rate <= slowest) | (rate >= fastest)
        objects["rate_std"] = np.where(saturated, np.inf, config.rate_std)
        objects["length"], objects["width"] = config.shape.length, config.shape.width
        objects["confidence"], objects["sensors"] = confidence[moving], Sensor.RADAR
        objects["radar_track"] = tracks["id"][moving]
        self._place(objects, distance[moving], angle[moving], angle_std[moving], motion.pose)
        inside = self._inside(objects, motion.pose)
        verdicts[moving[~inside]] = Verdict.OUTSIDE
        kept = objects[inside]
        return kept[np.argsort(kept["range"], kind="stable")], verdicts

    def _place(
        self, objects: RoadObjects, distance: FloatArray, angle: FloatArray, angle_std: FloatArray, pose: Pose
    ) -> None:
        """Set middle, heading and covariance of cars of which the nearest point is seen, heading as the road does.

        The middle lies half a car's length behind that point. Where across the car the echo came from is not known;
        half the width is taken as one sigma.
        """
        config, half = self.config, 0.5 * self.config.shape.length
        sight = distance[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
        nearest = sight + np.array([config.mount_x, 0.0])
        x, y = _to_track(nearest, pose).T
        apart = np.hypot(x[:, None] - self._line[:, 0], y[:, None] - self._line[:, 1])
        heading = self._heading[np.argmin(apart, axis=1)] - pose.yaw
        along = np.column_stack((np.cos(heading), np.sin(heading)))
        behind = np.sum(sight * along, axis=1).clip(-half, half)
        objects["x"], objects["y"] = (nearest + behind[:, None] * along).T
        objects["yaw"] = np.arctan2(np.sin(heading), np.cos(heading))
        variance = np.column_stack((np.full(len(distance), config.range_std**2), (distance * angle_std) ** 2))
        unknown = np.column_stack((np.zeros(len(distance)), np.full(len(distance), 0.25 * config.shape.width**2)))
        objects["covariance"] = turned(angle, variance) + turned(heading, unknown)

    def _inside(self, objects: RoadObjects, pose: Pose) -> NDArray[np.bool_]:
        places = _to_track(np.column_stack((objects["x"], objects["y"])), pose)
        return np.array([self._geofence.has(x, y) for x, y in places.tolist()], dtype=np.bool_)


def _own_speed(motion: OwnMotion, mount_x: float, angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Speed of the radar along sights and across them, m/s."""
    vx, vy = motion.vx, motion.vy + motion.yaw_rate * mount_x
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(vx * cos + vy * sin), np.asarray(vy * cos - vx * sin)


def _to_track(places: FloatArray, pose: Pose) -> FloatArray:
    """Places of the vehicle frame in the track frame, shape (n, 2), m; roll and pitch are left out."""
    cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
    return np.asarray([pose.x, pose.y] + places @ np.array([[cos, sin], [-sin, cos]]))
