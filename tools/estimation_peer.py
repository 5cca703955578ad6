"""What a plain user of filterpy would estimate the car's motion with: an ExtendedKalmanFilter per receiver.

It is not used by the car: `tools.estimation_bench` and its tests compare with it. The state, the noise and the inputs
are those of `autonomy.estimation`; state and covariance are both carried on with every IMU sample.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from autonomy.estimation import FilterTuning, GnssSample, ImuSample, LevelMotion, level
from autonomy.frenet import FloatArray
from tools.estimation_scene import TICK_S, Road

_MEASURED = np.eye(5, 11)
_MEASURED[[0, 1, 4], [8, 9, 10]] = 1.0


class _Ekf(ExtendedKalmanFilter):  # type: ignore[misc]
    """x, y, velocity east and north, yaw, biases of both accelerations and of the yaw rate, drifts of x, y and yaw.

    Parameters
    ----------
    decay : of a drift over a tick.
    """

    x: FloatArray

    def __init__(self, decay: float) -> None:
        super().__init__(dim_x=11, dim_z=5)
        self._decay = decay

    def predict_x(self, u: FloatArray) -> None:
        """Carry the state on by one sample: accelerations along and across, yaw rate."""
        x, y, east, north, yaw, bias_ax, bias_ay, bias_r, *drifts = self.x
        ax, ay, rate = u[0] - bias_ax, u[1] - bias_ay, u[2] - bias_r
        middle = yaw + 0.5 * TICK_S * rate
        cos, sin = math.cos(middle), math.sin(middle)
        a_east, a_north = ax * cos - ay * sin, ax * sin + ay * cos
        self.x = np.array(
            [
                x + TICK_S * (east + 0.5 * TICK_S * a_east),
                y + TICK_S * (north + 0.5 * TICK_S * a_north),
                east + TICK_S * a_east,
                north + TICK_S * a_north,
                yaw + TICK_S * rate,
                bias_ax,
                bias_ay,
                bias_r,
                *(self._decay * drift for drift in drifts),
            ]
        )
        self.F = np.eye(11)
        self.F[[8, 9, 10], [8, 9, 10]] = self._decay
        self.F[0, 2] = self.F[1, 3] = TICK_S
        self.F[2:4, 4] = -TICK_S * a_north, TICK_S * a_east
        self.F[2:4, 5] = -TICK_S * cos, -TICK_S * sin
        self.F[2:4, 6] = TICK_S * sin, -TICK_S * cos
        self.F[4, 7] = -TICK_S


class PlainFilter:
    """One receiver's.

    Parameters
    ----------
    tuning : noise.
    """

    def __init__(self, tuning: FilterTuning) -> None:
        self._tuning = tuning
        decay = math.exp(-TICK_S / tuning.drift_time_s)
        self.ekf: Any = _Ekf(decay)
        self.ekf.x = np.zeros(11)
        intensities = (
            *(0.0, 0.0, tuning.acceleration_noise, tuning.acceleration_noise, tuning.yaw_rate_noise),
            *(tuning.acceleration_bias_noise, tuning.acceleration_bias_noise, tuning.yaw_rate_bias_noise),
            *(0.0, 0.0, 0.0),
        )
        self.ekf.Q = TICK_S * np.diag(np.square(intensities))
        self._renewed = 1.0 - decay**2
        self.started = False
        self._last: FloatArray | None = None

    def predict(self, motion: LevelMotion) -> None:
        """Take one IMU sample, one tick after the last."""
        sample = np.array(motion)
        last, self._last = self._last, sample
        if self.started and last is not None:
            self.ekf.predict(0.5 * (last + sample))

    def update(self, gnss: GnssSample) -> None:
        """Take one epoch."""
        measured = np.array(gnss[:5])
        t, stated = self._tuning, np.square([*gnss[5:8], *gnss[7:9]])
        drift = np.square([t.position_drift, t.position_drift, 0.0, 0.0, t.yaw_drift]) * stated
        if not self.started:
            start = [t.start_acceleration_bias, t.start_acceleration_bias, t.start_yaw_rate_bias]
            self.ekf.x = np.concatenate((measured, np.zeros(6)))
            self.ekf.P = np.diag(np.concatenate((stated, np.square(start), drift[[0, 1, 4]])))
            for state, its_drift in ((0, 8), (1, 9), (4, 10)):
                self.ekf.P[state, its_drift] = self.ekf.P[its_drift, state] = -drift[state]
                self.ekf.Q[its_drift, its_drift] = self._renewed * drift[state]
            self.started = True
            return
        noise = np.diag(stated - drift)
        self.ekf.update(measured, lambda _: _MEASURED, lambda state: _MEASURED @ state, R=noise, residual=_residual)


def _residual(one: FloatArray, other: FloatArray) -> FloatArray:
    difference = one - other
    difference[4] = math.remainder(difference[4], math.tau)
    return difference


class PlainLocaliser:
    """Both receivers' filters, without quality and choice.

    Parameters
    ----------
    road : bank and grade (rad) at a position.
    """

    def __init__(self, road: Road, tuning: FilterTuning | None = None) -> None:
        self._road = road
        self.filters = (PlainFilter(tuning or FilterTuning()), PlainFilter(tuning or FilterTuning()))

    def step(self, imu: ImuSample, gnss_a: GnssSample | None, gnss_b: GnssSample | None) -> None:
        """Take what arrived in this tick."""
        place = self.filters[0].ekf.x
        motion = level(imu, *self._road(place[0], place[1]))
        for one, gnss in zip(self.filters, (gnss_a, gnss_b), strict=True):
            one.predict(motion)
            if gnss is not None:
                one.update(gnss)
