"""Perception of other cars as one step: LiDAR scans, radar tracks and the own motion in, tracks and predictions out."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.boundary_estimate import BoundaryEstimate
from autonomy.detection.cloud import DetectionStatus, Pose
from autonomy.detection.detector import DetectionConfig, Detections, Detector
from autonomy.detection.fusion import Fused, Fusion, SensorObjects, scan_of
from autonomy.detection.motion_compensation import AgedCloud, MotionCompensation, check_scan
from autonomy.detection.radar import OwnMotion, RadarDetections, RadarDetector, RadarStatus
from autonomy.detection.road_objects import RoadObjects, levelled, lidar_objects, no_objects
from autonomy.opponents.imm_pdaf import SensorModel
from autonomy.opponents.prediction import OpponentPredictor, Prediction
from autonomy.opponents.tracker import OpponentTracker, ScanStatus, TrackedObject
from autonomy.status import NodeStatus
from autonomy.track import Track

#: Tracks and predictions leave that often: 50 Hz (paper, tracking).
OUTPUT_PERIOD_US = 20_000
#: Three scans: as long without one of a sensor, and its detection says that it fails.
SILENCE_US = 150_000

#: Ticks for which the own motion is kept: a radar scan is some 20 ms on its way.
_MOTIONS = 8


class Source(IntEnum):
    """Sensors of perception."""

    LIDAR = 0
    RADAR = 1


#: What becomes of scans that can be used.
GOOD: Mapping[Source, frozenset[DetectionStatus] | frozenset[RadarStatus]] = {
    Source.LIDAR: frozenset({DetectionStatus.OK, DetectionStatus.TOO_MANY_OBJECTS}),
    Source.RADAR: frozenset({RadarStatus.OK, RadarStatus.EMPTY}),
}


@dataclass(frozen=True)
class PerceptionConfig:
    """What can be chosen of the chain as a whole; figures ours.

    Attributes
    ----------
    detection : thresholds of LiDAR detection.
    estimate_boundary : whether the walls that are seen tighten the geofence.
    compensation : of the motion within a scan.
    middle : m, of what is seen of a car over the road.
    fused, radar_alone : how much a car is in a scan of both sensors, and of the radar alone, and how much is not.
    wait_us : for which radar objects wait for a LiDAR scan to be fused with; then they are used alone.
    look_us, follow_us : after the end of a scan, when its objects are looked for, and when they are fused and tracked.
        A minor frame has no room for both, nor for either beside the plan. Tracks are extrapolated over the delay.
    """

    detection: DetectionConfig = field(default_factory=DetectionConfig)
    estimate_boundary: bool = True
    compensation: MotionCompensation = field(default_factory=MotionCompensation)
    middle: float = 0.5
    fused: SensorModel = field(default_factory=lambda: SensorModel("fused", 0.8, 1.0e-3))
    radar_alone: SensorModel = field(default_factory=lambda: SensorModel("radar", 0.6, 1.0e-3))
    wait_us: int = 30_000
    look_us: int = 0
    follow_us: int = 0


@dataclass(frozen=True)
class Perceived:
    """What one tick gave; None where nothing was due.

    Attributes
    ----------
    time_us : of the tick.
    lidar, radar : what became of a scan that was looked at.
    scan_us : when that of the LiDARs ended.
    lidar_objects : of that scan, at its end and as seen from above; empty unless it could be used.
    fused : objects that went to the tracker, and what it made of them.
    tracks, predictions : 50 times a second, for this time.
    """

    time_us: int
    lidar: Detections | None = None
    radar: RadarDetections | None = None
    lidar_objects: RoadObjects | None = None
    fused: Fused | None = None
    used: ScanStatus | None = None
    tracks: list[TrackedObject] | None = None
    predictions: list[Prediction] | None = None
    scan_us: int | None = None


class _Waiting(NamedTuple):
    """A scan of the LiDARs that was not looked at yet."""

    time_us: int
    motion: OwnMotion
    scan: object


class _Looked(NamedTuple):
    """Objects of a scan of the LiDARs that were not fused yet."""

    time_us: int
    motion: OwnMotion
    objects: RoadObjects


class _Heard(NamedTuple):
    """Radar objects that wait for a LiDAR scan, and the pose of the car when they were measured."""

    objects: SensorObjects
    pose: Pose


class Perception:
    """Detection, fusion, tracking and prediction in a row; `step` never raises, whatever the sensors give.

    Parameters
    ----------
    track : on which the car drives.
    config : see there.

    Raises
    ------
    ValueError
        When the track cannot be fenced in (`Geofence`).
    """

    def __init__(self, track: Track, config: PerceptionConfig | None = None) -> None:
        self.config = config = config or PerceptionConfig()
        boundary = BoundaryEstimate(track) if config.estimate_boundary else None
        self._detector = Detector(track, config.detection, boundary)
        self._radar_detector = RadarDetector(track)
        self._fusion = Fusion()
        self._tracker = OpponentTracker()
        self._predictor = OpponentPredictor(track)
        self._waiting: _Waiting | None = None
        self._looked: _Looked | None = None
        self._heard: _Heard | None = None
        self._good_us: dict[Source, int | None] = dict.fromkeys(Source)
        self._last_cloud: object = None
        self._last_tracks: object = None
        self._motions: deque[tuple[int, OwnMotion]] = deque(maxlen=_MOTIONS)
        self._output = -1

    def step(
        self,
        now_us: int,
        motion: OwnMotion | None,
        scan: AgedCloud | None = None,
        radar: object | None = None,
        radar_us: int | None = None,
    ) -> Perceived:
        """One tick.

        Parameters
        ----------
        now_us : time of the tick.
        motion : of the car now, as estimated; None as long as there is no estimate: scans are then of no use.
        scan : of the LiDARs, that ended in this tick, see `AgedCloud`.
        radar : TRACK_DTYPE, tracks that came in this tick.
        radar_us : when the radar measured them; now by default.
        """
        found = heard = objects = scan_us = fused = used = tracks = predictions = None
        if motion is not None:
            self._motions.append((now_us, motion))
            if radar is not None:
                heard = self._hear(now_us if radar_us is None else radar_us, radar)
            if scan is not None:
                self._waiting = _Waiting(now_us, motion, scan)
            waiting = self._waiting
            if waiting is not None and now_us - waiting.time_us >= self.config.look_us:
                found, objects = self._look(waiting.scan, waiting.motion)
                scan_us, self._waiting = waiting.time_us, None
                if found.status in GOOD[Source.LIDAR]:
                    self._good_us[Source.LIDAR] = scan_us
                    self._looked = _Looked(scan_us, waiting.motion, objects)
            fused, used = self._follow(now_us)
        if now_us // OUTPUT_PERIOD_US != self._output:
            self._output = now_us // OUTPUT_PERIOD_US
            tracks = self._tracker.objects(now_us)
            predictions = self._predictor.step(now_us, tracks)
        return Perceived(now_us, found, heard, objects, fused, used, tracks, predictions, scan_us)

    def status(self, now_us: int, source: Source) -> NodeStatus:
        """Status of the detection with a sensor: INITIALIZED before its first good scan, ERROR without one for long."""
        good_us = self._good_us[source]
        if good_us is None:
            return NodeStatus.INITIALIZED
        return NodeStatus.ERROR if now_us - good_us > SILENCE_US else NodeStatus.OK

    def _hear(self, measured_us: int, tracks: object) -> RadarDetections:
        """Take a scan of the radar."""
        then = self._motion_at(measured_us)
        heard = self._listen(measured_us, tracks, then)
        if heard.status in GOOD[Source.RADAR]:
            self._good_us[Source.RADAR] = measured_us
            self._heard = _Heard(SensorObjects(measured_us, heard.objects), then.pose)
        return heard

    def _follow(self, now_us: int) -> tuple[Fused | None, ScanStatus | None]:
        """Fuse and track what is due."""
        looked, heard = self._looked, self._heard
        if looked is not None and now_us - looked.time_us >= self.config.follow_us:
            self._looked = self._heard = None
            both = SensorObjects(looked.time_us, looked.objects), heard and heard.objects
            fused = self._fusion.step(now_us, *both, looked.motion.yaw_rate)
            return fused, self._tracker.update(now_us, scan_of(fused, looked.motion.pose), self.config.fused)
        if heard is None or looked is not None or self._waiting is not None:
            return None, None
        if now_us - heard.objects.time_us >= self.config.wait_us:
            self._heard = None
            fused = self._fusion.step(now_us, None, heard.objects)
            return fused, self._tracker.update(now_us, scan_of(fused, heard.pose), self.config.radar_alone)
        return None, None

    def _motion_at(self, time_us: int) -> OwnMotion:
        """The motion that was known nearest to a time."""
        return min(self._motions, key=lambda known: abs(known[0] - time_us))[1]

    def _listen(self, now_us: int, tracks: object, motion: OwnMotion) -> RadarDetections:
        before, self._last_tracks = self._last_tracks, _kept(tracks)
        # One bit toggles with each scan, so the same tracks are the same scan. Without tracks there is no bit.
        if isinstance(tracks, np.ndarray) and tracks.size and _same(tracks, before):
            return RadarDetections.nothing(RadarStatus.FROZEN)
        return self._radar_detector.step(now_us, tracks, motion)

    def _look(self, scan: object, motion: OwnMotion) -> tuple[Detections, RoadObjects]:
        before, self._last_cloud = self._last_cloud, _kept(scan)
        status = check_scan(scan)
        # Noise makes each scan another one, to the last bit.
        if status is DetectionStatus.OK and _same(np.asarray(scan), before):
            status = DetectionStatus.FROZEN
        elif status is DetectionStatus.OK and not motion.plausible:
            status = DetectionStatus.BAD_POSE
        if status is not DetectionStatus.OK:
            return Detections.nothing(status), no_objects()
        compensation = self.config.compensation
        cloud = compensation.cloud(np.asarray(scan), motion.vx, motion.vy, motion.yaw_rate)
        found = self._detector.step(cloud, motion.pose)
        objects = compensation.objects(lidar_objects(found), motion.vx, motion.vy)
        middle = 0.5 * (found.objects["z_low"] + found.objects["z_high"]).astype(np.float64)
        return found, levelled(objects, middle - self.config.middle, motion.pose)


def _kept(value: object) -> object:
    """A copy of a sample for the next comparison: a driver may use its buffer again."""
    return (value.shape, _sample(value)) if isinstance(value, np.ndarray) else None


def _sample(array: NDArray[Any]) -> bytes:
    """Some thousand rows. Noise makes each scan another one in every row."""
    return array[:: max(1, len(array) // 4096)].tobytes() if array.ndim else array.tobytes()


def _same(array: NDArray[Any], before: object) -> bool:
    """Whether an array is the one that a sample was kept of."""
    return before is not None and before == (array.shape, _sample(array))
