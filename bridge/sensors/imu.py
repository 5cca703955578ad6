"""Inertial measurement unit at the centre of gravity, 100 Hz."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bridge.sensors.noise import DriftingNoise
from bridge.sensors.truth import Truth
from dbc.codec import database

PERIOD_US = 10_000


@dataclass(frozen=True)
class ImuErrors:
    """One-sigma errors of the unit.

    The white figures are those of a tactical-grade unit on a vibrating race car, below the input noise that TUM's
    AV-21 estimator assumes (gyro 0.0075 rad/s, acceleration 0.5 m/s2; TUMFTM/3DVehicleDynamicsStateEstimation); the
    drift figures and the correlation time are ours, of the order of in-run bias stabilities of such units.
    """

    gyro_white: float = 0.002  # rad/s
    gyro_drift: float = 0.0003  # rad/s
    acceleration_white: float = 0.08  # m/s2
    acceleration_drift: float = 0.02  # m/s2
    time_constant_s: float = 300.0


class Imu:
    """Emits imu_rates and imu_specific_force every tick.

    Its axes are those of the road under the car, in which the plant gives specific force and yaw rate; body roll and
    pitch, one degree at most, do not turn them, but their rates are felt.

    Parameters
    ----------
    generator : source of the noise.
    errors : one-sigma figures.
    """

    def __init__(self, generator: np.random.Generator, errors: ImuErrors | None = None) -> None:
        errors = errors or ImuErrors()
        self._noise = DriftingNoise(
            generator,
            white=[errors.gyro_white] * 3 + [errors.acceleration_white] * 3,
            drift=[errors.gyro_drift] * 3 + [errors.acceleration_drift] * 3,
            time_constant_s=errors.time_constant_s,
            period_s=PERIOD_US * 1e-6,
        )
        self._rates = database.message("imu_rates")
        self._force = database.message("imu_specific_force")
        self._counter = 0
        self._last: Truth | None = None

    def emit(self, truth: Truth) -> bytes:
        """Frames of this tick."""
        roll_rate, pitch_rate = body_rates(truth, self._last or truth)
        self._last = truth
        wx, wy, wz, fx, fy, fz = self._noise.next()
        counter = self._counter
        self._counter = (counter + 1) & 0xFF
        return self._rates.frame(
            _saturate(roll_rate + wx, 6.5),
            _saturate(pitch_rate + wy, 6.5),
            _saturate(truth.yaw_rate + wz, 6.5),
            counter,
        ) + self._force.frame(
            _saturate(truth.specific_force_x + fx, 65.0),
            _saturate(truth.specific_force_y + fy, 65.0),
            _saturate(truth.specific_force_z + fz, 65.0),
            counter,
        )


def body_rates(truth: Truth, last: Truth) -> tuple[float, float]:
    r"""Angular velocity about the car's forward and left axes.

    With ISO 8855 angles (yaw, then pitch positive nose down, then roll positive left side up) the rates about the
    turned axes are :math:`p = \dot\phi - \dot\psi \sin\theta` and
    :math:`q = \dot\theta \cos\phi + \dot\psi \sin\phi \cos\theta` (Diebel, Representing Attitude, 2006, for this
    sequence of angles). On a banked left turn roll is negative and so is q: the nose swings up along the road's normal.

    Parameters
    ----------
    truth, last : motion in this tick and the one before; roll and pitch change linearly in between.

    Returns
    -------
    tuple of float
        Roll rate p and pitch rate q, rad/s.
    """
    per_second = 1e6 / PERIOD_US
    roll, pitch = truth.road_roll, truth.road_pitch
    heading_rate = truth.yaw_rate / math.cos(roll)  # about the vertical, as the plant turns the car
    roll_rate = (truth.roll - last.roll) * per_second
    pitch_rate = (truth.pitch - last.pitch) * per_second
    return (
        roll_rate - heading_rate * math.sin(pitch),
        pitch_rate * math.cos(roll) + heading_rate * math.sin(roll) * math.cos(pitch),
    )


def _saturate(value: float, limit: float) -> float:
    """Clip at the sensor's range, just inside what the DBC can carry."""
    return limit if value > limit else -limit if value < -limit else value
