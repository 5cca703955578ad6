"""The node that finds the wall: points in, wall messages and status out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.cloud import DetectionStatus
from autonomy.detection.motion_compensation import AgedCloud, MotionCompensation, check_scan
from autonomy.detection.radar import OwnMotion
from autonomy.messages import NodeWriter, WallWriter
from autonomy.status import NodeId, NodeStatus
from autonomy.track import Track
from autonomy.wall_fit import WallFit, fit_wall

#: m over the road, between which points count: the middle of a wall of 1.1 m, and of the planar LiDARs' slice.
LOW, HIGH = 0.4, 0.9
#: Tangent, ahead, up to which a wall may be on the other side: on a radius of 230 m, 60 m ahead of a car at it, 0.11.
ACROSS = 0.15
#: Points of a scan to choose from, and those that are enough for a fit; about.
PLENTY, ENOUGH = 15_000, 600
#: Three scans: as long without one, and the node says that it fails.
SILENCE_US = 150_000


class WallNode:
    """Fits the outer wall to every scan. It needs neither an estimate nor GNSS.

    Of a scan it takes the points at the height of a wall's middle. Where an estimate says how the car moves, and be it
    the last one before GNSS was lost, the motion within the scan is taken out.

    Parameters
    ----------
    track : tells the side on which the wall stands: the outer one.
    """

    def __init__(self, track: Track) -> None:
        self._side = -1 if track.centre.turn > 0.0 else 1
        self._compensation = MotionCompensation()
        self._writer = WallWriter()
        self._status = NodeWriter(NodeId.WALL)
        self._scan_us: int | None = None
        self._reliability = 0.0
        self._fit: WallFit | None = None

    def inactive(self, status: NodeStatus) -> bytes:
        """Status of a node that does not run yet, or does not any more."""
        return self._status.frame(status, 0.0)

    def tick(self, now_us: int, cloud: AgedCloud | None, motion: OwnMotion | None = None) -> bytes:
        """Frames of this tick: the status, and a polynomial when there was a scan.

        Parameters
        ----------
        cloud : from the ground below the centre of gravity.
        motion : of the car, when it is known.
        """
        frames = b""
        if cloud is not None:
            self._fit = fit = self._look(cloud, motion)
            self._scan_us = now_us
            self._status.heartbeat += 1
            self._reliability = 0.0 if fit is None else fit.share
            frames = self._writer.frames(fit)
        if self._scan_us is None:
            return self.inactive(NodeStatus.INITIALIZED)
        silent = now_us - self._scan_us > SILENCE_US
        return (
            self._status.frame(NodeStatus.ERROR if silent else NodeStatus.OK, 0.0 if silent else self._reliability)
            + frames
        )

    def _look(self, scan: AgedCloud, motion: OwnMotion | None) -> WallFit | None:
        """The wall of a scan; of what is no scan there is none."""
        if check_scan(scan) not in (DetectionStatus.OK, DetectionStatus.BAD_AGE):
            return None
        return fit_wall(self._slice(scan, motion), self._side, self._fit)

    def _slice(self, scan: AgedCloud, motion: OwnMotion | None) -> NDArray[np.float32]:
        """Points of a wall's middle, shape (n, 3) or wider, where they are at the end of the scan."""
        scan = scan[:: max(1, len(scan) // PLENTY)]
        high = scan[:, 2]
        points = scan[(high > LOW) & (high < HIGH)]
        # On the other side an apron may be as high. A wall that bends in front of the car comes over a little.
        points = points[self._side * points[:, 1] > -ACROSS * np.maximum(points[:, 0], 0.0)]
        points = points[:: max(1, len(points) // ENOUGH)]
        if motion is None or not motion.plausible or not np.isfinite(points[:, 3]).all():
            return points
        return self._compensation.cloud(points, motion.vx, motion.vy, motion.yaw_rate)
