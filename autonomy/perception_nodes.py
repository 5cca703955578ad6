"""The nodes of perception: scans and the estimate in, their health, tracked objects and predictions out."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from autonomy.detection.cloud import Pose
from autonomy.detection.motion_compensation import AgedCloud
from autonomy.detection.radar import OwnMotion
from autonomy.localisation import Estimate
from autonomy.messages import ObjectWriter, PerceptionStatusWriter, SensorNoticeWriter
from autonomy.opponents.prediction import Prediction
from autonomy.opponents.tracker import TrackedObject
from autonomy.perception import GOOD, Perceived, Perception, Source
from autonomy.radar_inbox import ReceivedScan, ScanStatus
from autonomy.status import NodeId, NodeStatus, SensorId
from autonomy.track import Track

_DETECTIONS = {Source.LIDAR: NodeId.LIDAR_DETECTION, Source.RADAR: NodeId.RADAR_DETECTION}
_SENSORS = {Source.LIDAR: SensorId.LIDAR, Source.RADAR: SensorId.RADAR}
_FOLLOWING = (NodeId.TRACKING, NodeId.PREDICTION)
#: Scans over which a detection tells how reliable it is: half a second.
_MEMORY = 10
#: Of tracks that rest on one sensor alone.
_ALONE = 0.7


def own_motion(estimate: Estimate, track: Track) -> OwnMotion:
    """Motion of the vehicle frame on the road where the estimate has the car."""
    bank, grade = track.road_at(estimate.x, estimate.y)
    pose = Pose(estimate.x, estimate.y, estimate.yaw, pitch=-grade, roll=-bank)
    return OwnMotion(pose, estimate.vx, estimate.vy, estimate.yaw_rate)


class PerceptionNodes:
    """Detection with each sensor, tracking and prediction, as the SSM sees them.

    Parameters
    ----------
    perception : what they do.

    Attributes
    ----------
    predictions : the newest.
    """

    def __init__(self, perception: Perception) -> None:
        self._perception = perception
        self._notices = {source: SensorNoticeWriter(_SENSORS[source]) for source in Source}
        self._nodes = {node: PerceptionStatusWriter(node) for node in (*_DETECTIONS.values(), *_FOLLOWING)}
        self._objects = ObjectWriter()
        self._sequence = dict.fromkeys(Source, 0)
        self._points = 0  # of the newest scan
        self._good: dict[Source, deque[bool]] = {source: deque(maxlen=_MEMORY) for source in Source}
        self.predictions: list[Prediction] = []

    def inactive(self, status: NodeStatus) -> bytes:
        """Status of nodes that do not run yet, or do not any more."""
        return b"".join(writer.frame(status, 0.0) for writer in self._nodes.values())

    def tick(self, now_us: int, motion: OwnMotion | None, cloud: AgedCloud | None, radar: ReceivedScan | None) -> bytes:
        """Frames of this tick.

        Parameters
        ----------
        motion : of the car; None while it is not known.
        cloud : scan of the LiDARs that ended in this tick.
        radar : scan that came in.
        """
        tracks = None
        if radar is not None and radar.status is ScanStatus.COMPLETE:
            tracks = radar.tracks
        perceived = self._perception.step(now_us, motion, cloud, tracks, None if radar is None else radar.time_us)
        notices = b""
        if cloud is not None:
            self._points = len(cloud) if isinstance(cloud, np.ndarray) and cloud.ndim else 0
        if perceived.scan_us is not None or (cloud is not None and motion is None):
            age_us = 0 if perceived.scan_us is None else now_us - perceived.scan_us
            notices += self._notice(Source.LIDAR, perceived, self._points, age_us)
        if radar is not None:
            notices += self._notice(Source.RADAR, perceived, radar.frames, now_us - radar.time_us)
        objects = b""
        if perceived.tracks is not None and perceived.predictions is not None:
            objects = self._objects.frames(_nearest_first(perceived.tracks, motion), now_us)
            self.predictions = perceived.predictions
        return notices + self._health(now_us, perceived) + objects

    def _notice(self, source: Source, perceived: Perceived, size: int, age_us: int) -> bytes:
        """Tell the SSM of a scan, and note what became of it."""
        found = perceived.lidar if source is Source.LIDAR else perceived.radar
        if found is not None:
            self._nodes[_DETECTIONS[source]].heartbeat += 1
        self._good[source].append(found is not None and found.status in GOOD[source])
        if found is None or found.status.name != "FROZEN":
            self._sequence[source] += 1
        return self._notices[source].frame(self._sequence[source], size, age_us)

    def _health(self, now_us: int, perceived: Perceived) -> bytes:
        statuses = {source: self._perception.status(now_us, source) for source in Source}
        frames = b""
        for source, node in _DETECTIONS.items():
            good = self._good[source]
            frames += self._nodes[node].frame(statuses[source], sum(good) / len(good) if good else 0.0)
        working = sum(status is NodeStatus.OK for status in statuses.values())
        failed = all(status is NodeStatus.ERROR for status in statuses.values())
        status = NodeStatus.OK if working else NodeStatus.ERROR if failed else NodeStatus.INITIALIZED
        for node in _FOLLOWING:
            writer = self._nodes[node]
            writer.heartbeat += perceived.tracks is not None
            frames += writer.frame(status, (0.0, _ALONE, 1.0)[working])
        return frames


def _nearest_first(tracks: list[TrackedObject], motion: OwnMotion | None) -> list[TrackedObject]:
    if motion is None:
        return tracks
    return sorted(tracks, key=lambda one: math.hypot(one.x - motion.pose.x, one.y - motion.pose.y))
