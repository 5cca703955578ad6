"""Ray casting the long way: every beam with every triangle, poses by the matrix exponential."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from bridge.sensors.spatial_lidar import BeamPattern, Motion

PERIOD = 0.05  # s

#: What rounding may do to where a beam passes the edge of a triangle, as a share of its sides.
MARGIN = 1e-7


def pose_at(motion: Motion, time: float) -> np.ndarray:
    """4 x 4 matrix from the body's axes to the frame that the motion is in."""
    start = np.eye(4)
    start[:3, :3] = Rotation.from_euler("ZYX", [motion.yaw, motion.pitch, motion.roll]).as_matrix()
    start[:3, 3] = motion.x, motion.y, motion.z
    p, q, r = motion.rate
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0.0, -r, q], [r, 0.0, -p], [-q, p, 0.0]]
    twist[:3, 3] = motion.velocity
    return np.asarray(start @ expm(time * twist))


def directions(pattern: BeamPattern) -> np.ndarray:
    """Unit vectors of all beams in the LiDAR's axes, shape (columns, lines, 3)."""
    count = pattern.columns
    azimuth = ((np.arange(count) + 0.5) / count - 0.5) * pattern.field_of_view
    turn, rise = np.meshgrid(azimuth, np.linspace(*pattern.elevation, pattern.lines), indexing="ij")
    return np.stack((np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)), axis=-1)


def column_times(pattern: BeamPattern) -> np.ndarray:
    """When the columns are taken, s, the scan ends at 0."""
    return PERIOD * ((np.arange(pattern.columns) + 0.5) / pattern.columns - 1.0)


def beam_frames(pattern, mount, vehicle):
    """Starts, shape (columns, 3), and directions, shape (columns, lines, 3), of the beams in the track frame."""
    sensor = np.eye(4)
    sensor[:3, :3] = Rotation.from_euler("Z", mount.yaw).as_matrix()
    sensor[:3, 3] = mount.x, mount.y, mount.z
    frames = np.array([pose_at(vehicle, time) @ sensor for time in column_times(pattern)])
    return frames[:, :3, 3], np.einsum("cij,clj->cli", frames[:, :3, :3], directions(pattern))


def ranges_between(pattern, mount, vehicle, bodies):
    """Distance along each beam to the nearest triangle; of two kinds, shape (columns, lines), m.

    The first with all triangles larger by a margin, the second with all of them smaller. `bodies` are pairs of corners,
    shape (n, 4, 3), and a motion.
    """
    starts, beams = beam_frames(pattern, mount, vehicle)
    results = [np.full(beams.shape[:2], np.inf) for _ in range(2)]
    for column, time in enumerate(column_times(pattern)):
        worlds = []
        for corners, motion in bodies:
            pose = pose_at(motion, time)
            worlds.append(corners @ pose[:3, :3].T + pose[:3, 3])
        quads = np.concatenate(worlds)
        triangles = np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))
        distance, slack = _meet(starts[column], beams[column], triangles)
        in_reach = (distance >= pattern.range_min) & (distance < pattern.range_max)
        for result, margin in zip(results, (MARGIN, -MARGIN), strict=True):
            result[column] = np.where(in_reach & (slack >= -margin), distance, np.inf).min(axis=1)
    return results


def _meet(start, beams, triangles):
    """Distance to the planes, and how far inside the triangles they are met as a share of the sides (negative outside).

    Moller and Trumbore, 1997; shape (lines, triangles).
    """
    a, b, c = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    away = start - a
    turned = np.cross(away, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (beams @ np.cross(c, b).T)  # b . (beam x c) = beam . (c x b)
        u = scale * (beams @ np.cross(c, away).T)
        v = scale * (beams @ turned.T)
        distance = scale * np.einsum("ij,ij->i", c, turned)
    slack = np.minimum(np.minimum(u, v), 1.0 - u - v)
    return distance, slack
