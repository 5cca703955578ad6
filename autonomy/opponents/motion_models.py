"""Motion models of an opponent, over one common state, so that their estimates can be mixed.

State: x, y (m, track frame), vx, vy (m/s), turn rate (rad/s). Velocity in Cartesian components makes constant
velocity and random motion linear, needs no wrapped angle, and is defined at standstill.
All noises are continuous white noise: two steps of dt/2 give the same as one of dt.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from autonomy.frenet import FloatArray

X, Y, VX, VY, TURN_RATE = range(5)
STATES = 5


class MotionModel(Protocol):
    """Carries mean and covariance of many states on at once."""

    def predict(self, mean: FloatArray, covariance: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """Mean (n, 5) and covariance (n, 5, 5) after dt >= 0, s."""
        ...


@dataclass(frozen=True)
class ConstantVelocity:
    """Constant velocity, driven by white acceleration. Linear: the Kalman prediction is exact.

    Attributes
    ----------
    acceleration_noise : m/s2 per sqrt(Hz), in x and in y.
    turn_rate_noise : rad/s per sqrt(s); the model does not use the turn rate, which wanders.
    """

    acceleration_noise: float = 1.0
    turn_rate_noise: float = 0.15

    def predict(self, mean: FloatArray, covariance: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """See MotionModel."""
        transition = _straight_on(dt)
        noise = _driven(dt, self.acceleration_noise, self.turn_rate_noise)
        return mean @ transition.T, transition @ covariance @ transition.T + noise


@dataclass(frozen=True)
class ConstantTurnRate:
    """Constant turn rate and velocity (CTRV): the velocity turns and keeps its amount. Unscented prediction.

    Sigma points lie at mean +- sqrt(5) times the columns of the covariance's Cholesky factor, all of weight 1/10
    (Julier with kappa 0): no weight is negative, so that the covariance stays positive definite.

    Attributes
    ----------
    acceleration_noise : m/s2 per sqrt(Hz), in x and in y.
    turn_rate_noise : rad/s per sqrt(s).
    """

    acceleration_noise: float = 5.0
    turn_rate_noise: float = 0.15

    def predict(self, mean: FloatArray, covariance: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """See MotionModel. Covariance positive definite."""
        spread = np.sqrt(float(STATES)) * np.linalg.cholesky(covariance).swapaxes(-1, -2)
        centre = mean[:, None, :]
        points = turned(np.concatenate((centre + spread, centre - spread), axis=1), dt)
        moved = points.sum(axis=1) * (0.5 / STATES)
        off = points - moved[:, None, :]
        noise = _driven(dt, self.acceleration_noise, self.turn_rate_noise)
        return moved, off.swapaxes(-1, -2) @ off * (0.5 / STATES) + noise


@dataclass(frozen=True)
class RandomMotion:
    """Random motion: position and velocity wander, whatever the velocity was. Linear.

    Attributes
    ----------
    position_noise : m per sqrt(s).
    acceleration_noise : m/s2 per sqrt(Hz); moves the velocity only.
    turn_rate_noise : rad/s per sqrt(s).
    """

    position_noise: float = 3.0
    acceleration_noise: float = 10.0
    turn_rate_noise: float = 0.15

    def predict(self, mean: FloatArray, covariance: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """See MotionModel."""
        return mean, covariance + _wander(dt, self.position_noise, self.acceleration_noise, self.turn_rate_noise)


def turned(state: FloatArray, dt: float) -> FloatArray:
    """States (..., 5) after dt (s) of constant turn rate and speed, exactly.

    The way covered is the chord of the arc: sin(a)/a times v dt, turned by a, with a half the angle turned.
    """
    half = (0.5 * dt) * state[..., TURN_RATE]
    cos, sin = np.cos(half), np.sin(half)
    chord = dt * np.divide(sin, half, out=np.ones_like(half), where=half != 0.0)
    vx, vy = state[..., VX], state[..., VY]
    # Velocity at half the angle; turned once more by the same half, it is the one at the end.
    middle_x, middle_y = cos * vx - sin * vy, sin * vx + cos * vy
    out = np.empty_like(state)
    out[..., X] = state[..., X] + chord * middle_x
    out[..., Y] = state[..., Y] + chord * middle_y
    out[..., VX] = cos * middle_x - sin * middle_y
    out[..., VY] = sin * middle_x + cos * middle_y
    out[..., TURN_RATE] = state[..., TURN_RATE]
    return out


# Scans come at a steady rate: the matrices of the last few steps are kept, and none is written to.


@lru_cache(maxsize=64)
def _straight_on(dt: float) -> FloatArray:
    transition = np.eye(STATES)
    transition[X, VX] = transition[Y, VY] = dt
    return transition


@lru_cache(maxsize=64)
def _driven(dt: float, acceleration: float, turn_rate: float) -> FloatArray:
    """Covariance that white acceleration, integrated twice, and a wandering turn rate add in dt."""
    noise = _wander(dt, 0.0, acceleration, turn_rate).copy()
    noise[X, X] = noise[Y, Y] = acceleration**2 * dt**3 / 3.0
    noise[X, VX] = noise[VX, X] = noise[Y, VY] = noise[VY, Y] = acceleration**2 * dt**2 / 2.0
    return noise


@lru_cache(maxsize=64)
def _wander(dt: float, position: float, velocity: float, turn_rate: float) -> FloatArray:
    return np.diag(np.square([position, position, velocity, velocity, turn_rate]) * dt)
