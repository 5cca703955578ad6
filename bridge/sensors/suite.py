"""All sensors of the car, each with a random stream of its own: those on CAN-S, the radar on CAN-R, and the LiDARs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bridge.interfaces import Origin
from bridge.sensors.gnss import ERRORS_A, ERRORS_B, Gnss
from bridge.sensors.imu import Imu
from bridge.sensors.lidar import Cloud, Lidar
from bridge.sensors.radar import Radar
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
        radar: bool = False,
    ) -> None:
        generators = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(5)]
        self.imu = Imu(generators[0])
        self.gnss_a = Gnss("a", origin, generators[1], ERRORS_A)
        self.gnss_b = Gnss("b", origin, generators[2], ERRORS_B, PHASE_B_US)
        self.lidar = Lidar(walls, cg_to_rear_axle, generators[3])
        self.radar = Radar(walls, cg_to_rear_axle, generators[4]) if radar else None

    def emit(self, now_us: int, truth: Truth) -> bytes:
        """Frames of every sensor that is due, for CAN-S and CAN-R."""
        frames = self.imu.emit(truth)
        for receiver in (self.gnss_a, self.gnss_b):
            if receiver.due(now_us):
                frames += receiver.emit(truth)
        if self.radar is not None and self.radar.due(now_us):
            frames += self.radar.emit(truth)
        return frames

    def scan(self, now_us: int, truth: Truth) -> Cloud | None:
        """Points of the LiDARs, see `Lidar.scan`; None when no scan is due."""
        return self.lidar.scan(truth) if self.lidar.due(now_us) else None
