"""The node that finds the wall: points in, wall messages and status out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.cloud import DetectionStatus
from autonomy.detection.ground_filter import GroundFilter
from autonomy.detection.motion_compensation import AgedCloud, MotionCompensation, check_scan
from autonomy.detection.radar import OwnMotion
from autonomy.messages import NodeWriter, WallWriter
from autonomy.status import NodeId, NodeStatus
from autonomy.track import Track
from autonomy.wall_fit import AHEAD, BEHIND, WallFit, fit_wall

#: Tangent, ahead, up to which a wall may be on the other side: on a radius of 230 m, 60 m ahead of a car at it, 0.11.
ACROSS = 0.15
#: m, by which points may come nearer while the car's motion is taken out of them.
MARGIN = 5.0
#: Points that are enough for a fit, about.
ENOUGH = 600
#: Three scans: as long without one, and the node says that it fails.
SILENCE_US = 150_000


class WallNode:
    """Fits the outer wall to every scan. It needs neither an estimate nor GNSS.

    Of a spatial scan it takes what stands out of the ground on the wall's side. A height over the vehicle's plane would
    not do: a banked turn rises by 0.7 m in it, 30 m ahead. Where an estimate says how the car moves, and be it the last
    one before GNSS was lost, the motion within the scan is taken out.

    Parameters
    ----------
    track : tells the side on which the wall stands: the outer one.
    spatial : whether scans have heights; those of planar LiDARs are walls alone.
    """

    def __init__(self, track: Track, spatial: bool = False) -> None:
        self._spatial = spatial
        self._ground_filter = GroundFilter()
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
        return fit_wall(self._beside(scan, motion), self._side, self._fit)

    def _beside(self, scan: AgedCloud, motion: OwnMotion | None) -> NDArray[np.float32]:
        """Points that may be of the wall, where they are at the end of the scan; shape (n, 3) or wider."""
        if not self._spatial:
            return scan
        x = scan[:, 0]
        # On the other side an apron may stand out. A wall that bends in front of the car comes over a little.
        near = (x > BEHIND - MARGIN) & (x < AHEAD + MARGIN) & (self._side * scan[:, 1] > -ACROSS * np.maximum(x, 0.0))
        points = scan[near]
        if motion is None or not motion.plausible or not np.isfinite(points[:, 3]).all():
            cloud = np.ascontiguousarray(points[:, :3])
        else:
            cloud = self._compensation.cloud(points, motion.vx, motion.vy, motion.yaw_rate)
        raised, _ = self._ground_filter.apply(cloud)
        return raised[:: max(1, len(raised) // ENOUGH)]
