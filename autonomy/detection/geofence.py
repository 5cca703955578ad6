"""Geofence by the track model; the work on points is done in C."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from autonomy._native import ffi, lib
from autonomy.detection.cloud import Cloud, Pose, Tally, to_native, to_room
from autonomy.track import Track

_NODE = np.dtype([(name, np.float32) for name in ("x", "y", "cosine", "sine", "curvature", "left", "right")])
_RASTER_CELL = 0.5  # m, or more for a track that would not fit
_SPARE_CELLS = 2  # at each edge, all outside


class Geofence:
    """Lets pass what lies on the track, at least a margin inside its boundaries.

    Parameters
    ----------
    track : its centre line and widths are read once.
    margin : m, 0 or more.

    Raises
    ------
    ValueError
        When the margin leaves nothing of the track, or the track is too long.
    """

    def __init__(self, track: Track, margin: float = 1.0) -> None:
        narrow = float(min(track.width_left.min(), track.width_right.min()))
        if not 0.0 <= margin < narrow:
            raise ValueError(f"margin is {margin:g}; must be 0 or more and below {narrow:g} m, half of the track")
        line = track.centre
        if line.count > lib.GEOFENCE_NODES_MAX:
            raise ValueError(f"{track.name} has {line.count} nodes; at most {lib.GEOFENCE_NODES_MAX} are possible")
        self.margin = margin
        fence: Any = ffi.new("geofence *")
        reach = float(max(track.width_left.max(), track.width_right.max()))
        low, high = np.array([line.x.min(), line.y.min()]) - reach, np.array([line.x.max(), line.y.max()]) + reach
        cell = max(_RASTER_CELL, math.sqrt(float((high - low).prod()) / (0.9 * lib.GEOFENCE_RASTER_MAX)))
        self._corner = low - _SPARE_CELLS * cell
        fence.spacing, fence.cell_size = line.spacing, cell
        fence.columns, fence.rows = np.ceil((high - low) / cell).astype(int) + 2 * _SPARE_CELLS
        fence.node_count = line.count
        nodes = np.frombuffer(ffi.buffer(fence.nodes), dtype=_NODE)[: line.count]
        nodes["x"], nodes["y"] = line.x - self._corner[0], line.y - self._corner[1]
        nodes["cosine"], nodes["sine"] = np.cos(line.heading), np.sin(line.heading)
        nodes["curvature"] = line.curvature
        nodes["left"], nodes["right"] = track.width_left - margin, track.width_right - margin
        if not lib.geofence_draw(fence):
            raise ValueError(f"{track.name} has no room in a raster of {lib.GEOFENCE_RASTER_MAX} cells")
        self._fence = fence

    def has(self, x: float, y: float) -> bool:
        """Whether a place of the track frame (m) is inside; so far off the track that it overflows, it is not."""
        return bool(lib.geofence_has(self._fence, x - self._corner[0], y - self._corner[1]))

    def apply(self, cloud: Cloud, pose: Pose, out: Cloud | None = None) -> tuple[Cloud, Tally]:
        """Points inside the fence, in the order they came in.

        Parameters
        ----------
        pose : of the car when the cloud was taken.
        out : room for the result, of at least as many points, if it is not to be new; may be the cloud itself.

        Raises
        ------
        ValueError
            When cloud or out is not a cloud (`check_cloud`) or the pose is not finite.
        """
        if not pose.finite:
            raise ValueError("the pose is not finite")
        points = to_native(cloud)
        kept = to_room(out, len(cloud))
        at = ffi.new(
            "geofence_pose *", (pose.x - self._corner[0], pose.y - self._corner[1], pose.roll, pose.pitch, pose.yaw)
        )
        tally = Tally.of(lib.geofence_apply(self._fence, at, points, len(cloud), to_native(kept)))
        return kept[: tally.kept], tally
