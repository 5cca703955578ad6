"""Three LiDARs around the car, 20 Hz: point clouds of road, walls and other cars, with the motion within a scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.sensors.lidar import MOUNTS, PERIOD_US, Cloud, Mount
from bridge.sensors.surfaces import CAR_PARTS, QuadMesh, boxes

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Motion:
    """Where a body is at the end of a scan, and how it moves during the scan.

    Attributes
    ----------
    x, y, z : m, of its origin in the track frame.
    yaw, pitch, roll : rad, ISO 8855; turned in this order.
    velocity : of its origin, in its own axes, m/s.
    rate : in its own axes, rad/s.
    """

    x: float
    y: float
    z: float = 0.0
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    velocity: Vector = (0.0, 0.0, 0.0)
    rate: Vector = (0.0, 0.0, 0.0)

    @property
    def finite(self) -> bool:
        """Whether all of it is."""
        pose = (self.x, self.y, self.z, self.yaw, self.pitch, self.roll)
        return all(map(math.isfinite, (*pose, *self.velocity, *self.rate)))


@dataclass(frozen=True)
class BeamPattern:
    """The beams of one LiDAR: columns from right to left, one after the other, and lines from below.

    The field of view across is that of a Luminar H3. The rest is ours, columns and lines as in the benchmark of
    detection: an H3 reaches 500 m, and draws 640 lines in a second, half as many as these.
    """

    columns: int = 480
    lines: int = 64
    field_of_view: float = math.radians(120.0)
    elevation: tuple[float, float] = (math.radians(-15.0), math.radians(15.0))
    range_min: float = 0.5  # m
    range_max: float = 200.0  # m

    def __post_init__(self) -> None:
        if not 1 <= self.columns <= lib.BEAM_COLUMNS_MAX:
            raise ValueError(f"columns is {self.columns}; must be 1 to {lib.BEAM_COLUMNS_MAX}")
        if not 1 <= self.lines <= lib.BEAM_LINES_MAX:
            raise ValueError(f"lines is {self.lines}; must be 1 to {lib.BEAM_LINES_MAX}")
        if not 0.0 < self.field_of_view <= math.radians(150.0):
            raise ValueError(f"field_of_view is {self.field_of_view:g}; must be above 0, at most 150 degrees in rad")
        low, high = self.elevation
        if not -math.radians(80.0) <= low <= high <= math.radians(80.0):
            raise ValueError(f"elevation is {low:g} to {high:g}; must ascend, within 80 degrees in rad")
        if not 0.0 < self.range_min < self.range_max < math.inf:
            raise ValueError(f"range is {self.range_min:g} to {self.range_max:g}; must be above 0, finite, and ascend")


@dataclass(frozen=True)
class Detection:
    """How well echoes come back.

    Attributes
    ----------
    range_noise : m, standard deviation; the precision of a Luminar H3.
    gain : m2, see `bridge/native/beam_echo.h`. Ours: at 250 m, 9 of 10 echoes come back from a surface that is met
        squarely and reflects a tenth of the light.
    """

    range_noise: float = 0.01
    gain: float = -math.log(0.1) * 250.0**2 / 0.1

    def __post_init__(self) -> None:
        for name, value in (("range_noise", self.range_noise), ("gain", self.gain)):
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name} is {value:g}; must be 0 or more, and finite")


@dataclass(frozen=True)
class Scan:
    """One merged scan.

    Attributes
    ----------
    aged : points in the axes that the vehicle had when each was taken, with their ages at the end of the scan.
    beam : shape (n,), number of each point's beam: LiDAR after LiDAR, column after column, line after line.
    """

    aged: Cloud
    beam: NDArray[np.uint32]

    @property
    def cloud(self) -> NDArray[np.float32]:
        """The points alone, shape (n, 3), m."""
        return np.ascontiguousarray(self.aged[:, :3])

    @property
    def age(self) -> NDArray[np.float32]:
        """The ages alone, shape (n,), s."""
        return self.aged[:, 3]


class SpatialLidar:
    """All LiDARs of the car, scanning at the same time.

    Parameters
    ----------
    track : what stands still, in the track frame.
    generator : gives each scan its key; all of its randomness follows from that.
    origin : of the vehicle's frame, m from the middle of the rear axle: (cg_to_rear_axle, 0, `CG_OVER_AXLE`) for the
        centre of gravity.
    mounts : of the LiDARs, from the middle of the rear axle.
    pattern, detection : see there.
    car : what another car looks like, in its own frame.
    """

    def __init__(
        self,
        track: QuadMesh,
        generator: np.random.Generator,
        *,
        origin: Vector = (0.0, 0.0, 0.0),
        mounts: Sequence[Mount] = MOUNTS,
        pattern: BeamPattern | None = None,
        detection: Detection | None = None,
        car: QuadMesh | None = None,
    ) -> None:
        self.pattern = pattern = pattern or BeamPattern()
        self._generator = generator
        self._track = _Surface(track)
        self._car = _Surface(car or boxes(CAR_PARTS))
        self._still = _native_motion(Motion(0.0, 0.0))
        self._pattern = _native_pattern(pattern)
        self._mounts = [_native_mount(mount, origin) for mount in mounts]
        self._hits = ffi.new("beam_hits *")
        self._room = ffi.new("beam_column[]", lib.BEAM_COLUMNS_MAX)
        detection = detection or Detection()
        noise = {"gain": detection.gain, "noise": detection.range_noise, "quantile": _normal_quantiles()}
        self._detector = ffi.new("beam_detector *", noise)
        self._beams = pattern.columns * pattern.lines
        self._points = np.empty((len(mounts) * self._beams, 4), np.float32)
        self._numbers = np.empty(len(self._points), np.uint32)
        self._c_points = ffi.from_buffer("float[]", self._points)
        self._c_numbers = ffi.from_buffer("uint32_t[]", self._numbers)

    def scan(self, vehicle: Motion, cars: Sequence[Motion] = ()) -> Scan:
        """Take one merged scan, which ends where the motions say.

        Parameters
        ----------
        vehicle : that carries the LiDARs; its origin is the one given above.
        cars : others, in the frame of the `car` mesh: by default from the middle of the outline on the ground.

        Raises
        ------
        ValueError
            When a motion is not finite; the generator is left as it was.
        """
        natives = self._natives(vehicle, cars)
        key = int(self._generator.integers(2**64, dtype=np.uint64))
        count = 0
        for number, mount in enumerate(self._mounts):
            self._cast(mount, natives)
            count += lib.beam_echo(
                *(self._pattern, mount, self._detector, self._hits, key, number * self._beams),
                *(self._c_points + 4 * count, self._c_numbers + count),
            )
        return Scan(self._points[:count].copy(), self._numbers[:count].copy())

    def cast(self, vehicle: Motion, cars: Sequence[Motion] = ()) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where all beams end, without noise or loss.

        Returns
        -------
        ranges : shape (LiDARs, columns, lines), m; infinite where nothing is in reach.
        echoes : of the same shape, reflectivity times the sine of the incidence, 0 without a surface.

        Raises
        ------
        ValueError
            When a motion is not finite.
        """
        natives = self._natives(vehicle, cars)
        shape = (len(self._mounts), self.pattern.columns, self.pattern.lines)
        ranges, echoes = np.empty(shape), np.empty(shape)
        for number, mount in enumerate(self._mounts):
            self._cast(mount, natives)
            for result, hits in ((ranges, self._hits.range), (echoes, self._hits.echo)):
                result[number] = np.frombuffer(ffi.buffer(hits), count=self._beams).reshape(shape[1:])
        ranges[echoes < 0.0] = np.inf
        return ranges, np.maximum(echoes, 0.0)

    def _natives(self, vehicle: Motion, cars: Sequence[Motion]) -> list[Any]:
        if not all(motion.finite for motion in (vehicle, *cars)):
            raise ValueError("a motion is not finite")
        return [_native_motion(motion) for motion in (vehicle, *cars)]

    def _cast(self, mount: Any, natives: Sequence[Any]) -> None:
        vehicle, *cars = natives
        lib.beam_hits_clear(self._pattern, self._hits)
        for body, surface in ((self._still, self._track), *((car, self._car) for car in cars)):
            lib.beam_cast(
                *(self._pattern, mount, vehicle, body, surface.quads, surface.count, surface.centre, surface.radius),
                *(self._room, self._hits),
            )


class _Surface:
    """A mesh as the kernel takes it."""

    def __init__(self, mesh: QuadMesh) -> None:
        self.count = len(mesh.corners)
        self.quads = ffi.new("beam_quad[]", self.count)
        for quad, corners, reflectivity in zip(
            self.quads, mesh.corners.tolist(), mesh.reflectivity.tolist(), strict=True
        ):
            quad.corner = list(zip(*corners, strict=True))
            quad.reflectivity = reflectivity
            lib.beam_quad_init(ffi.addressof(quad))
        points = mesh.corners.reshape(-1, 3)
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0)) if self.count else np.zeros(3)
        self.centre = ffi.new("double[3]", centre.tolist())
        self.radius = float(np.linalg.norm(points - centre, axis=1).max(initial=0.0))


def _rotation(yaw: float, pitch: float, roll: float) -> list[float]:
    """Rotation matrix by rows."""
    cy, sy, cp, sp, cr, sr = (f(angle) for angle in (yaw, pitch, roll) for f in (math.cos, math.sin))
    return [
        *(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        *(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        *(-sp, cp * sr, cp * cr),
    ]


def _native_motion(motion: Motion) -> Any:
    axes = _rotation(motion.yaw, motion.pitch, motion.roll)
    pose = {"place": [motion.x, motion.y, motion.z], "axes": axes}
    return ffi.new("rigid_motion *", {"pose": pose, "velocity": list(motion.velocity), "rate": list(motion.rate)})


def _native_mount(mount: Mount, origin: Vector) -> Any:
    place = [mount.x - origin[0], mount.y - origin[1], mount.z - origin[2]]
    return ffi.new("rigid_pose *", {"place": place, "axes": _rotation(mount.yaw, 0.0, 0.0)})


def _native_pattern(pattern: BeamPattern) -> Any:
    step = pattern.field_of_view / pattern.columns
    native = ffi.new("beam_pattern *")
    native.columns, native.lines = pattern.columns, pattern.lines
    native.azimuth_first, native.azimuth_step = 0.5 * (step - pattern.field_of_view), step
    native.period = PERIOD_US * 1e-6
    native.range_min, native.range_max = pattern.range_min, pattern.range_max
    lib.beam_pattern_init(native, np.linspace(*pattern.elevation, pattern.lines).tolist())
    return native


@cache
def _normal_quantiles() -> tuple[float, ...]:
    """Equally likely values of a normal distribution, of variance 1."""
    count = lib.NOISE_QUANTILES
    values = np.array([NormalDist().inv_cdf((i + 0.5) / count) for i in range(count)])
    return tuple((values / np.sqrt(np.mean(values**2))).tolist())
