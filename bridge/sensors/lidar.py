"""Three LiDARs around the car, 20 Hz: a planar scan of the walls.

The scan is the slice of the point clouds in the horizontal plane, levelled as their preprocessing does it; nothing but
walls returns an echo. Points travel as arrays, not on CAN.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.sensors.truth import Truth

PERIOD_US = 50_000
#: The tick of a scan lies between those of the receivers' epochs.
PHASE_US = 40_000

#: Points as rows of x, y, z, m, in vehicle axes from the ground below the centre of gravity, and of their age at the
#: end of the scan, s: float32, shape (n, 4). A point is in the axes that the vehicle had when it was taken.
Cloud = NDArray[np.float32]


def due(now_us: int) -> bool:
    """Whether a scan belongs to this tick."""
    return now_us % PERIOD_US == PHASE_US


@dataclass(frozen=True)
class Mount:
    """Where a LiDAR sits: m from the middle of the rear axle, vehicle axes, and its heading there, rad."""

    x: float
    y: float
    z: float
    yaw: float


#: Front, left and right, from AWSIM's model of the AV-21 (urdf).
MOUNTS = (
    Mount(2.242, 0.0, 0.448, 0.0),
    Mount(1.549, 0.267, 0.543, math.radians(120.0)),
    Mount(1.549, -0.267, 0.543, math.radians(-120.0)),
)
#: Height of the centre of gravity over the middle of the rear axle, m (same source), and of that over the ground.
CG_OVER_AXLE = 0.236
AXLE_HEIGHT = 0.31


@dataclass(frozen=True)
class LidarErrors:
    """What the sensors can and cannot do.

    Field of view and range precision are those of a Luminar H3; it reaches 500 m, but what the paper's cars made use of
    ends at 70 m. Angular resolution of the slice and the loss of echoes at grazing incidence are ours.
    """

    field_of_view: float = math.radians(120.0)
    step: float = math.radians(0.5)
    range_max: float = 80.0  # m
    range_white: float = 0.01  # m, 1 sigma
    grazing_none: float = math.sin(math.radians(2.0))  # sine of the incidence below which no echo returns
    grazing_all: float = math.sin(math.radians(6.0))  # and from which all do; in between linear


class Lidar:
    """All LiDARs of the car, scanning at the same time.

    Parameters
    ----------
    walls : closed lines of points, each of shape (n, 2), m, in the track frame.
    cg_to_rear_axle : m.
    generator : source of noise and lost echoes.
    errors : see `LidarErrors`.
    """

    def __init__(
        self,
        walls: Sequence[NDArray[np.floating]],
        cg_to_rear_axle: float,
        generator: np.random.Generator,
        errors: LidarErrors | None = None,
    ) -> None:
        self._errors = errors = errors or LidarErrors()
        self._generator = generator
        lines = [np.hstack((wall, np.roll(wall, -1, axis=0))) for wall in (_thinned(wall) for wall in walls)]
        self._segments = np.ascontiguousarray(np.concatenate(lines) if lines else np.empty((0, 4)), dtype=np.float64)
        self._longest = float(np.hypot(*(self._segments[:, 2:] - self._segments[:, :2]).T).max(initial=0.0))
        count = round(errors.field_of_view / errors.step)
        first = 0.5 * errors.step - 0.5 * errors.field_of_view
        angles = first + errors.step * np.arange(count)
        self._rays = np.column_stack((np.cos(angles), np.sin(angles)))
        fan = {"first": first, "step": errors.step, "range_max": errors.range_max, "count": count}
        self._fan = ffi.new("lidar_fan *", fan | {"rays": ffi.from_buffer("double[]", self._rays)})
        self._pose = ffi.new("lidar_pose *")
        self._places = [(mount.x - cg_to_rear_axle, mount.y, mount.yaw) for mount in MOUNTS]
        total = len(MOUNTS) * count
        self._ranges, self._incidence = np.empty(total, np.float32), np.empty(total, np.float32)
        c_ranges, c_incidence = (ffi.from_buffer("float[]", array) for array in (self._ranges, self._incidence))
        self._c_segments = ffi.from_buffer("double[]", self._segments)
        self._results = [(c_ranges + i * count, c_incidence + i * count) for i in range(len(MOUNTS))]
        bearings = np.concatenate([angles + mount.yaw for mount in MOUNTS])
        self._cos, self._sin = np.cos(bearings).astype(np.float32), np.sin(bearings).astype(np.float32)
        heights = [mount.z + AXLE_HEIGHT for mount in MOUNTS]
        origins = np.array([(x, y, z, 0.0) for (x, y, _), z in zip(self._places, heights, strict=True)], np.float32)
        self._origins = np.repeat(origins, count, axis=0)

    def scan(self, truth: Truth) -> Cloud:
        """Points of this tick.

        Returns
        -------
        ndarray of float32, shape (n, 4)
            Echoes, in no order that means anything; all of age 0.
        """
        cos, sin = math.cos(truth.yaw), math.sin(truth.yaw)
        pose, count = self._pose, len(self._segments)
        for (x, y, yaw), (ranges, incidence) in zip(self._places, self._results, strict=True):
            pose.x, pose.y = truth.x + cos * x - sin * y, truth.y + sin * x + cos * y
            pose.axis_x, pose.axis_y = math.cos(truth.yaw + yaw), math.sin(truth.yaw + yaw)
            lib.lidar_cast(self._fan, pose, self._c_segments, count, self._longest, ranges, incidence)
        errors, generator = self._errors, self._generator
        noise = generator.standard_normal(len(self._ranges), dtype=np.float32)
        luck = generator.random(len(self._ranges), dtype=np.float32)
        lost_below = errors.grazing_none + luck * (errors.grazing_all - errors.grazing_none)
        echo = np.flatnonzero(self._incidence > lost_below)
        distance = self._ranges[echo] + errors.range_white * noise[echo]
        cloud = self._origins[echo]
        cloud[:, 0] += distance * self._cos[echo]
        cloud[:, 1] += distance * self._sin[echo]
        return cloud


def _thinned(wall: NDArray[np.floating]) -> NDArray[np.floating]:
    """Every second point: of a wall with a radius of 240 m, given every metre, the chords are off by 2 mm."""
    return wall[::2]
