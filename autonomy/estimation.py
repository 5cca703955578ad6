"""State estimation: one Kalman filter per GNSS receiver, both driven by the IMU, and a choice between them.

Each filter is an error-state Kalman filter: the nominal state is carried on by the IMU at 100 Hz in plain floats,
and filterpy's KalmanFilter holds the error of that state, which is linear and small. Covariance is needed only
when a measurement arrives, so it is carried on once per GNSS epoch, not per IMU sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter

from autonomy.frenet import FloatArray, wrap_angle

GRAVITY = 9.81  # m/s2


class ImuSample(NamedTuple):
    """Specific force (m/s2) and angular rates (rad/s) in vehicle axes (ISO 8855), at the centre of gravity."""

    specific_force_x: float
    specific_force_y: float
    specific_force_z: float
    roll_rate: float
    pitch_rate: float
    yaw_rate: float


class GnssSample(NamedTuple):
    """One epoch of a receiver in the track frame, referred to the centre of gravity; standard deviations beside."""

    x: float
    y: float
    velocity_east: float
    velocity_north: float
    yaw: float
    std_x: float
    std_y: float
    std_velocity: float
    std_yaw: float


class LevelMotion(NamedTuple):
    """IMU sample turned into the horizontal plane: accelerations along and across the heading, heading rate."""

    ax: float
    ay: float
    yaw_rate: float


def level(imu: ImuSample, bank: float, grade: float) -> LevelMotion:
    """Take bank and grade of the road out of an IMU sample.

    The car lies on the road, so the road's attitude is the car's. Turning the measured specific force into the
    horizontal plane removes gravity, which stands upright on it. The car turns with the banking about the
    vertical: the gyroscope along the road's normal sees cos(bank) cos(grade) of the heading rate.

    Parameters
    ----------
    imu : sample in vehicle axes.
    bank : rad, positive with the left side low. grade : rad, positive uphill.
    """
    cos_bank, sin_bank = math.cos(bank), math.sin(bank)
    cos_grade, sin_grade = math.cos(grade), math.sin(grade)
    across = imu.specific_force_y * cos_bank + imu.specific_force_z * sin_bank
    upright = imu.specific_force_z * cos_bank - imu.specific_force_y * sin_bank
    along = imu.specific_force_x * cos_grade - upright * sin_grade
    return LevelMotion(along, across, imu.yaw_rate / (cos_bank * cos_grade))


@dataclass(frozen=True)
class FilterTuning:
    """Noise of the filters.

    A receiver states one deviation. Part of it is white from epoch to epoch, the rest a drift: a first-order
    Gauss-Markov process, for a receiver's multipath and corrections change slowly.

    Attributes
    ----------
    acceleration_noise : m/s2 per sqrt(Hz), of the accelerometer with what bank compensation leaves.
    yaw_rate_noise : rad/s per sqrt(Hz).
    acceleration_bias_noise : m/s2 per sqrt(s), wander of the bias.
    yaw_rate_bias_noise : rad/s per sqrt(s).
    start_acceleration_bias, start_yaw_rate_bias : 1 sigma at the start.
    position_drift, yaw_drift : deviation of the drift over that which the receiver states, below 1.
    drift_time_s : in which a drift forgets all but 1/e of itself, above 0.
    other_solution : ratio of two stated deviations beyond which they are of different solutions, above 1.
    gate : Mahalanobis distance of an epoch beyond which it is not used (5 degrees of freedom).
    """

    acceleration_noise: float = 0.008
    yaw_rate_noise: float = 0.0002
    acceleration_bias_noise: float = 0.003
    yaw_rate_bias_noise: float = 0.00003
    start_acceleration_bias: float = 0.02
    start_yaw_rate_bias: float = 0.0003
    position_drift: float = 0.93
    yaw_drift: float = 0.37
    drift_time_s: float = 60.0
    other_solution: float = 1.5
    gate: float = 5.0


# Order of the error state.
X, Y, VE, VN, YAW, BIAS_AX, BIAS_AY, BIAS_R, DRIFT_X, DRIFT_Y, DRIFT_YAW = range(11)
_STATES = 11
_MEASUREMENTS = 5
_DRIFTS = [DRIFT_X, DRIFT_Y, DRIFT_YAW]
#: What the receiver measures with these drifts in it, in the same order.
_DRIFTING = [X, Y, YAW]


class GnssFilter:
    """Error-state Kalman filter of one receiver.

    The nominal state takes each correction in, which leaves an error of mean 0; the drifts of the receiver have no
    nominal state: their means stay in the filter.

    Attributes
    ----------
    started : a first epoch has arrived.
    distance : Mahalanobis distance of the last epoch from the prediction, used or not; infinite before.
    position_deviation : 1 sigma of the worse of both coordinates, m.
    """

    def __init__(self, tuning: FilterTuning) -> None:
        self._tuning = tuning
        drift = np.array([tuning.position_drift, tuning.position_drift, 0.0, 0.0, tuning.yaw_drift])
        self._white_share = 1.0 - drift**2
        # filterpy has no types; all of it stays behind this attribute.
        self._kalman: Any = KalmanFilter(dim_x=_STATES, dim_z=_MEASUREMENTS)
        self._kalman.H = np.eye(_MEASUREMENTS, _STATES)
        self._kalman.H[_DRIFTING, _DRIFTS] = 1.0
        self._transition = np.eye(_STATES)
        self._process = np.zeros((_STATES, _STATES))
        self._noise = np.eye(_MEASUREMENTS)
        self._noise_of: tuple[float, ...] = ()
        # Deviations of x, y and heading as stated for the solution in use, and the variances of its drifts.
        self._solution: tuple[float, float, float] = (1.0, 1.0, 1.0)
        self._drift_variance = np.zeros(3)
        self._reset_clock()
        self.started = False
        self.position_deviation = math.inf
        self.distance = math.inf
        self.x = self.y = self.velocity_east = self.velocity_north = self.yaw = 0.0
        self.bias_ax = self.bias_ay = self.bias_yaw_rate = 0.0
        self.ax = self.ay = self.yaw_rate = 0.0

    def start(self, gnss: GnssSample) -> None:
        """Take a first epoch as it is."""
        t = self._tuning
        self.x, self.y, self.yaw = gnss.x, gnss.y, wrap_angle(gnss.yaw)
        self.velocity_east, self.velocity_north = gnss.velocity_east, gnss.velocity_north
        self.bias_ax = self.bias_ay = self.bias_yaw_rate = 0.0
        deviations = (
            gnss.std_x,
            gnss.std_y,
            gnss.std_velocity,
            gnss.std_velocity,
            gnss.std_yaw,
            t.start_acceleration_bias,
            t.start_acceleration_bias,
            t.start_yaw_rate_bias,
            *(0.0, 0.0, 0.0),
        )
        self._kalman.x = np.zeros((_STATES, 1))
        self._kalman.P = np.diag(np.square(deviations))
        self._draw_drifts(gnss)
        # The drift of this epoch is in the place taken from it.
        self._kalman.P[_DRIFTING, _DRIFTS] = self._kalman.P[_DRIFTS, _DRIFTING] = -self._drift_variance
        self._reset_clock()
        self._note_deviation()
        self.distance = 0.0
        self.started = True

    def predict(self, motion: LevelMotion, dt: float) -> None:
        """Carry the nominal state on by one IMU sample taken at the end of dt (s)."""
        ax, ay = motion.ax - self.bias_ax, motion.ay - self.bias_ay
        rate = motion.yaw_rate - self.bias_yaw_rate
        # The mean of the samples at both ends of the step is exact for linearly changing motion.
        mean_ax, mean_ay, mean_rate = 0.5 * (ax + self.ax), 0.5 * (ay + self.ay), 0.5 * (rate + self.yaw_rate)
        yaw = self.yaw + 0.5 * dt * mean_rate
        cos, sin = math.cos(yaw), math.sin(yaw)
        east, north = mean_ax * cos - mean_ay * sin, mean_ax * sin + mean_ay * cos
        self.x += dt * (self.velocity_east + 0.5 * dt * east)
        self.y += dt * (self.velocity_north + 0.5 * dt * north)
        self.velocity_east += dt * east
        self.velocity_north += dt * north
        self.yaw = wrap_angle(self.yaw + dt * mean_rate)
        self.ax, self.ay, self.yaw_rate = ax, ay, rate
        self._elapsed += dt
        self._sum_east += dt * east
        self._sum_north += dt * north

    def propagate_covariance(self) -> None:
        """Carry the covariance on over the IMU samples since the last call."""
        dt = self._elapsed
        if dt <= 0.0:
            return
        t = self._tuning
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        half = 0.5 * dt
        f, q = self._transition, self._process
        f[X, VE] = f[Y, VN] = dt
        # A yaw error turns the acceleration; a bias adds to it in vehicle axes.
        f[VE, YAW], f[VN, YAW] = -self._sum_north, self._sum_east
        f[X, YAW], f[Y, YAW] = -half * self._sum_north, half * self._sum_east
        f[VE, BIAS_AX], f[VE, BIAS_AY] = -dt * cos, dt * sin
        f[VN, BIAS_AX], f[VN, BIAS_AY] = -dt * sin, -dt * cos
        f[X, BIAS_AX], f[X, BIAS_AY] = -half * dt * cos, half * dt * sin
        f[Y, BIAS_AX], f[Y, BIAS_AY] = -half * dt * sin, -half * dt * cos
        f[YAW, BIAS_R] = -dt
        # The heading that a rate bias has turned away turns the acceleration too.
        sixth = dt * dt / 6.0
        f[VE, BIAS_R], f[VN, BIAS_R] = half * self._sum_north, -half * self._sum_east
        f[X, BIAS_R], f[Y, BIAS_R] = sixth * self._sum_north, -sixth * self._sum_east
        acceleration = t.acceleration_noise**2
        q[X, X] = q[Y, Y] = acceleration * dt**3 / 3.0
        q[X, VE] = q[VE, X] = q[Y, VN] = q[VN, Y] = acceleration * dt**2 / 2.0
        q[VE, VE] = q[VN, VN] = acceleration * dt
        q[YAW, YAW] = t.yaw_rate_noise**2 * dt
        q[BIAS_AX, BIAS_AX] = q[BIAS_AY, BIAS_AY] = t.acceleration_bias_noise**2 * dt
        q[BIAS_R, BIAS_R] = t.yaw_rate_bias_noise**2 * dt
        decay = math.exp(-dt / t.drift_time_s)
        f[_DRIFTS, _DRIFTS] = decay
        # In its stationary distribution a drift stays: what it forgets comes anew.
        q[_DRIFTS, _DRIFTS] = (1.0 - decay * decay) * self._drift_variance
        self._kalman.predict(F=f, Q=q)
        self._note_deviation()
        self._reset_clock()

    def update(self, gnss: GnssSample) -> bool:
        """Use one epoch, if it is inside the gate.

        Returns
        -------
        Whether it was used. `distance` tells how far off it was.
        """
        self.propagate_covariance()
        innovation = np.array(
            [
                [gnss.x - self.x],
                [gnss.y - self.y],
                [gnss.velocity_east - self.velocity_east],
                [gnss.velocity_north - self.velocity_north],
                [wrap_angle(gnss.yaw - self.yaw)],
            ]
        )
        deviations = (gnss.std_x, gnss.std_y, gnss.std_velocity, gnss.std_velocity, gnss.std_yaw)
        if deviations != self._noise_of:  # a receiver reports the same ones most of the time
            self._noise, self._noise_of = np.diag(np.square(deviations) * self._white_share), deviations
            if self._is_other_solution(gnss):
                self._draw_drifts(gnss)
        kalman = self._kalman
        prior_x, prior = kalman.x, kalman.P
        kalman.update(innovation, R=self._noise)
        # The filter has inverted the innovation's covariance already; asking it first would cost that twice.
        self.distance = math.sqrt((kalman.y.T @ kalman.SI @ kalman.y).item())
        if not self.distance <= self._tuning.gate:
            kalman.x, kalman.P = prior_x, prior
            return False
        error = kalman.x[:DRIFT_X, 0].tolist()
        kalman.x[:DRIFT_X] = 0.0
        self.x += error[X]
        self.y += error[Y]
        self.velocity_east += error[VE]
        self.velocity_north += error[VN]
        self.yaw = wrap_angle(self.yaw + error[YAW])
        self.bias_ax += error[BIAS_AX]
        self.bias_ay += error[BIAS_AY]
        self.bias_yaw_rate += error[BIAS_R]
        # The next step averages with these: they follow the biases.
        self.ax -= error[BIAS_AX]
        self.ay -= error[BIAS_AY]
        self.yaw_rate -= error[BIAS_R]
        self._note_deviation()
        return True

    @property
    def coasted(self) -> float:
        """Time since the covariance was last carried on, s."""
        return self._elapsed

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the error state at the last propagation, shape (11, 11)."""
        return np.asarray(self._kalman.P)

    @property
    def drifts(self) -> FloatArray:
        """Drifts of the receiver in x, y (m) and heading (rad), shape (3,)."""
        return np.asarray(self._kalman.x[_DRIFTS, 0])

    def _is_other_solution(self, gnss: GnssSample) -> bool:
        """Whether the receiver states quite other deviations than for the solution in use."""
        stated = (gnss.std_x, gnss.std_y, gnss.std_yaw)
        return any(
            max(new, old) > self._tuning.other_solution * min(new, old)
            for new, old in zip(stated, self._solution, strict=True)
        )

    def _draw_drifts(self, gnss: GnssSample) -> None:
        """Begin with the solution of an epoch: its drifts owe nothing to those of the one before."""
        t, kalman = self._tuning, self._kalman
        self._solution = gnss.std_x, gnss.std_y, gnss.std_yaw
        self._drift_variance = np.square((t.position_drift, t.position_drift, t.yaw_drift)) * np.square(self._solution)
        kalman.x[_DRIFTS] = 0.0
        kalman.P[_DRIFTS] = kalman.P[:, _DRIFTS] = 0.0
        kalman.P[_DRIFTS, _DRIFTS] = self._drift_variance

    def _note_deviation(self) -> None:
        covariance = self._kalman.P
        self.position_deviation = math.sqrt(max(covariance[X, X], covariance[Y, Y]))

    def _reset_clock(self) -> None:
        self._elapsed = self._sum_east = self._sum_north = 0.0
