"""Projection of many points at once on the centre line, for points on and near a track."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from autonomy.detection.cloud import Cloud, Pose
from autonomy.frenet import FloatArray
from autonomy.track import Track


def rotation(pose: Pose) -> FloatArray:
    """First two rows of the rotation from the vehicle frame to the track frame, shape (2, 3)."""
    cr, sr, cp, sp = math.cos(pose.roll), math.sin(pose.roll), math.cos(pose.pitch), math.sin(pose.pitch)
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    return np.array(
        [[c * cp, c * sp * sr - s * cr, c * sp * cr + s * sr], [s * cp, s * sp * sr + c * cr, s * sp * cr - c * sr]]
    )


class FrenetRaster:
    """Stations and offsets of points, from a raster of the nearest nodes; exact on arcs and straights.

    Parameters
    ----------
    track : its centre line is read once.
    reach : m beside the centre line, within which the projection is good.
    cell : m, side of the raster's cells.
    """

    def __init__(self, track: Track, reach: float, cell: float = 4.0) -> None:
        line = track.centre
        self._x, self._y = line.x, line.y
        self._cos, self._sin = np.cos(line.heading), np.sin(line.heading)
        self._curvature = line.curvature
        self._spacing, self._count, self._length = line.spacing, line.count, line.length
        self._cell = cell
        self._low = np.array([line.x.min(), line.y.min()]) - reach - cell
        high = np.array([line.x.max(), line.y.max()]) + reach + cell
        sides = np.ceil((high - self._low) / cell).astype(int)
        middles = self._low + cell * (np.moveaxis(np.indices(tuple(sides)), 0, -1) + 0.5)
        _, nearest = cKDTree(np.column_stack((line.x, line.y))).query(middles)
        self._nearest: NDArray[np.int32] = np.asarray(nearest, dtype=np.int32)

    def project(self, cloud: Cloud, pose: Pose) -> tuple[FloatArray, FloatArray]:
        """Stations (m, within half a node of [0, length)) and offsets to the left (m) of a cloud's points.

        Parameters
        ----------
        cloud : finite.
        pose : of the car when the cloud was taken; finite.
        """
        x, y = rotation(pose) @ cloud.T.astype(np.float64)
        x += pose.x
        y += pose.y
        column = ((x - self._low[0]) / self._cell).clip(0.0, self._nearest.shape[0] - 1.0).astype(np.int32)
        row = ((y - self._low[1]) / self._cell).clip(0.0, self._nearest.shape[1] - 1.0).astype(np.int32)
        node = self._nearest[column, row]
        # From the middle of the cell to the point itself: one step on the node's circle.
        along, across = self._beside(node, x, y)
        shrink = np.maximum(1.0 - self._curvature[node] * across, 0.5)
        node = (node + np.rint(along / (self._spacing * shrink)).clip(-9.0, 9.0).astype(np.int32)) % self._count
        along, across = self._beside(node, x, y)
        curvature = self._curvature[node]
        shrink = 1.0 - curvature * across
        left = (2.0 * across - curvature * (along * along + across * across)) / (
            1.0 + np.hypot(curvature * along, shrink)
        )
        return node * self._spacing + along / np.maximum(shrink, 0.5), left

    def _beside(self, node: NDArray[np.int32], x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        dx, dy, cos, sin = x - self._x[node], y - self._y[node], self._cos[node], self._sin[node]
        return dx * cos + dy * sin, dy * cos - dx * sin
