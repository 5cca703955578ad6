"""All sensors of the car, each with a random stream of its own: those on CAN-S, the radar on CAN-R, and the LiDARs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bridge.interfaces import Origin, Road
from bridge.sensors.gnss import ERRORS_A, ERRORS_B, Gnss
from bridge.sensors.imu import Imu
from bridge.sensors.lidar import AXLE_HEIGHT, Cloud, Lidar, due
from bridge.sensors.radar import Radar
from bridge.sensors.radar_scene import OtherCar
from bridge.sensors.spatial_lidar import Motion, SpatialLidar
from bridge.sensors.surfaces import RoadSurface, track_mesh
from bridge.sensors.truth import Truth

#: Receiver B solves between two solutions of A: in the tick nearest to half a period.
PHASE_B_US = 20_000


class SensorSuite:
    """GNSS A and B, the LiDARs and the radar at 20 Hz each, staggered, and the IMU at 100 Hz.

    Parameters
    ----------
    origin : of the track frame.
    seed : of the scenario; the streams of the sensors are independent of each other, so that a change to one
        sensor leaves the noise of the others as it was.
    walls : see `Lidar` and `Radar`; none by default.
    cg_to_rear_axle : m, places LiDARs and radar.
    radar : whether the car has the front radar.
    spatial : road that the LiDARs see all around them; by default they see the walls, in a plane.

    Attributes
    ----------
    radar : None in a car without.
    """

    def __init__(
        self,
        origin: Origin,
        seed: int,
        walls: Sequence[NDArray[np.floating]] = (),
        cg_to_rear_axle: float = 0.0,
        *,
        radar: bool = False,
        spatial: Road | None = None,
    ) -> None:
        generators = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(5)]
        self.imu = Imu(generators[0])
        self.gnss_a = Gnss("a", origin, generators[1], ERRORS_A)
        self.gnss_b = Gnss("b", origin, generators[2], ERRORS_B, PHASE_B_US)
        self.lidar = (
            Lidar(walls, cg_to_rear_axle, generators[3])
            if spatial is None
            else _LidarsOnRoad(spatial, cg_to_rear_axle, generators[3])
        )
        # Of a wall with a radius of 230 m, given every metre, chords over four of them are off by 9 mm.
        coarse = [wall[::4] for wall in walls]
        self.radar = Radar(coarse, cg_to_rear_axle, generators[4]) if radar else None

    def emit(self, now_us: int, truth: Truth, cars: Sequence[OtherCar] = ()) -> bytes:
        """Frames of every sensor that is due, for CAN-S and CAN-R; `cars` are the others."""
        frames = self.imu.emit(truth)
        for receiver in (self.gnss_a, self.gnss_b):
            if receiver.due(now_us):
                frames += receiver.emit(truth)
        if self.radar is not None and self.radar.due(now_us):
            frames += self.radar.emit(truth, cars)
        return frames

    def scan(self, now_us: int, truth: Truth, cars: Sequence[Motion] = ()) -> Cloud | None:
        """Points of the LiDARs; None when no scan is due. The planar ones see no cars."""
        if not due(now_us):
            return None
        return self.lidar.scan(truth, cars) if isinstance(self.lidar, _LidarsOnRoad) else self.lidar.scan(truth)


class _LidarsOnRoad:
    """The spatial LiDARs on the car that the truth is of."""

    def __init__(self, road: Road, cg_to_rear_axle: float, generator: np.random.Generator) -> None:
        self._road, self._surface = road, RoadSurface(road)
        self._lidars = SpatialLidar(track_mesh(road), generator, origin=(cg_to_rear_axle, 0.0, -AXLE_HEIGHT))

    def scan(self, truth: Truth, cars: Sequence[Motion]) -> Cloud:
        place = self._road.project(truth.x, truth.y)
        own = Motion(
            *(truth.x, truth.y, self._surface.at(*place), truth.yaw, truth.pitch, truth.roll),
            velocity=(truth.vx, truth.vy, 0.0),
            rate=(0.0, 0.0, truth.yaw_rate),
        )
        return self._lidars.scan(own, cars).aged
