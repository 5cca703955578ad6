"""All sensors of the car on CAN-S, each with a random stream of its own."""

from __future__ import annotations

import numpy as np

from bridge.interfaces import Origin
from bridge.sensors.gnss import ERRORS_A, ERRORS_B, Gnss
from bridge.sensors.imu import Imu
from bridge.sensors.truth import Truth

#: Receiver B solves between two solutions of A: in the tick nearest to half a period.
PHASE_B_US = 20_000


class SensorSuite:
    """GNSS A and B at 20 Hz each, staggered, and the IMU at 100 Hz.

    Parameters
    ----------
    origin : of the track frame.
    seed : of the scenario; the streams of the sensors are independent of each other, so that a change to one
        sensor leaves the noise of the others as it was.
    """

    def __init__(self, origin: Origin, seed: int) -> None:
        generators = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3)]
        self.imu = Imu(generators[0])
        self.gnss_a = Gnss("a", origin, generators[1], ERRORS_A)
        self.gnss_b = Gnss("b", origin, generators[2], ERRORS_B, PHASE_B_US)

    def emit(self, now_us: int, truth: Truth) -> bytes:
        """Frames of every sensor that is due, for CAN-S."""
        frames = self.imu.emit(truth)
        for receiver in (self.gnss_a, self.gnss_b):
            if receiver.due(now_us):
                frames += receiver.emit(truth)
        return frames
