"""The node that finds the wall: points in, wall messages and status out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from autonomy.messages import NodeWriter, WallWriter
from autonomy.status import NodeId, NodeStatus
from autonomy.track import Track
from autonomy.wall_fit import WallFit, fit_wall

#: Three scans: as long without one, and the node says that it fails.
SILENCE_US = 150_000


class WallNode:
    """Fits the outer wall to every scan. It needs neither an estimate nor GNSS.

    Parameters
    ----------
    track : tells the side on which the wall stands: the outer one.
    """

    def __init__(self, track: Track) -> None:
        self._side = -1 if track.centre.turn > 0.0 else 1
        self._writer = WallWriter()
        self._status = NodeWriter(NodeId.WALL)
        self._scan_us: int | None = None
        self._reliability = 0.0
        self._fit: WallFit | None = None

    def inactive(self, status: NodeStatus) -> bytes:
        """Status of a node that does not run yet, or does not any more."""
        return self._status.frame(status, 0.0)

    def tick(self, now_us: int, cloud: NDArray[np.float32] | None) -> bytes:
        """Frames of this tick: the status, and a polynomial when there was a scan."""
        frames = b""
        if cloud is not None:
            self._fit = fit = fit_wall(cloud, self._side, self._fit)
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
