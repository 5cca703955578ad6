"""Opponents on paper: kinematic truths at racing speeds, and scans as a sensor would make them of these."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autonomy.frenet import FloatArray
from autonomy.opponents.imm_pdaf import SensorModel
from autonomy.opponents.tracker import Scan

SCAN_US = 50_000  # 20 Hz
CAR_SIZE = (4.9, 1.93, 1.2)  # m


@dataclass(frozen=True)
class Truth:
    """A car at the times of the scans; arrays of shape (k,), but state (k, 5): x, y, vx, vy, turn rate; z in m."""

    time_us: NDArray[np.int64]
    state: FloatArray
    z: FloatArray

    def centre(self, index: int) -> FloatArray:
        """x, y, z of one time, m."""
        return np.array([*self.state[index, :2], self.z[index]])


def drive(
    duration_s: float, speed: float, acceleration: Callable[[float], float], turn_rate: Callable[[float], float]
) -> Truth:
    """Drive from the origin along x: acceleration along the way (m/s2) and turn rate (rad/s) over time (s)."""
    parts, step_s = 50, SCAN_US * 1.0e-6
    h = step_s / parts
    x = y = yaw = 0.0
    v = speed
    count = round(duration_s / step_s) + 1
    state = np.empty((count, 5))
    for k in range(count):
        state[k] = x, y, v * math.cos(yaw), v * math.sin(yaw), turn_rate(k * step_s)
        for part in range(parts):
            t = k * step_s + (part + 0.5) * h
            middle = yaw + 0.5 * h * turn_rate(t)
            along = v + 0.5 * h * acceleration(t)
            x += h * along * math.cos(middle)
            y += h * along * math.sin(middle)
            yaw += h * turn_rate(t)
            v += h * acceleration(t)
    return Truth(np.arange(count, dtype=np.int64) * SCAN_US, state, np.full(count, 0.6))


def _none(_: float) -> float:
    return 0.0


def straight() -> Truth:
    """Straight on at 70 m/s."""
    return drive(8.0, 70.0, _none, _none)


def turn() -> Truth:
    """At 60 m/s from a straight through a transition of 1 s into a turn of 230 m radius."""
    return drive(8.0, 60.0, _none, lambda t: 60.0 / 230.0 * min(max(t - 2.0, 0.0), 1.0))


def braking() -> Truth:
    """From 70 m/s with 12 m/s2, reached within 0.2 s, to 34 m/s, and on."""
    return drive(8.0, 70.0, lambda t: -12.0 * min(max((t - 2.0) / 0.2, 0.0), 1.0) * (t < 5.1), _none)


def lane_change() -> Truth:
    """At 65 m/s, 6 m to the left within 2.5 s."""
    # A full sine of the turn rate: the yaw is a raised cosine, whose mean over the period is its amplitude.
    period = 2.5
    amplitude = 6.0 / (65.0 * period)
    rate = amplitude * 2.0 * math.pi / period
    return drive(8.0, 65.0, _none, lambda t: rate * math.sin(2.0 * math.pi * (t - 2.0) / period) * (2.0 <= t <= 4.5))


MANOEUVRES: dict[str, Callable[[], Truth]] = {
    "straight": straight,
    "turn": turn,
    "braking": braking,
    "lane change": lane_change,
}


def scans(
    truth: Truth,
    rng: np.random.Generator,
    sensor: SensorModel,
    deviation: float = 0.3,
    extent: float = 100.0,
) -> list[Scan]:
    """Scans of one car as a sensor model says, in clutter.

    Parameters
    ----------
    truth : the car.
    rng : random numbers.
    sensor : detection probability and density of the clutter, whose number is Poisson distributed.
    deviation : 1 sigma in x, y and z, m.
    extent : side of the square around the car that the clutter is spread over, m.

    Returns
    -------
    One scan per time of the truth, the detection of the car at a random place in it.
    """
    made = []
    for k in range(len(truth.time_us)):
        count = rng.poisson(sensor.clutter_density * extent**2)
        centre = truth.centre(k) + rng.uniform(-0.5, 0.5, (count, 3)) * [extent, extent, 1.0]
        if rng.random() < sensor.detection_probability:
            own = truth.centre(k) + rng.normal(0.0, deviation, 3)
            centre = np.insert(centre, rng.integers(count + 1), own, axis=0)
        made.append(scan_of(int(truth.time_us[k]), centre, deviation))
    return made


def scan_of(time_us: int, centre: FloatArray, deviation: float = 0.3) -> Scan:
    """Scan of detections at (n, 3), all the size of a car and equally exact."""
    count = len(centre)
    return Scan(time_us, centre, np.tile(CAR_SIZE, (count, 1)), np.tile(deviation**2 * np.eye(3), (count, 1, 1)))
