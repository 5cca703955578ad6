"""What others would track an opponent with: filterpy's IMM of three UKFs, and Stone Soup's PDA.

Neither is used by the car: they are what `tools.tracking_bench` and the tests compare with. They share no code with
`autonomy.opponents`; the models are written in their textbook form.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import datetime, timedelta
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
from filterpy.common import van_loan_discretization
from filterpy.kalman import IMMEstimator, JulierSigmaPoints, UnscentedKalmanFilter

from autonomy.frenet import FloatArray
from autonomy.opponents.imm_pdaf import ImmPdaf, SensorModel
from autonomy.opponents.motion_models import ConstantTurnRate, ConstantVelocity, MotionModel, RandomMotion

CLOCK_START = datetime(2022, 1, 7)


class Peer(Protocol):
    """Follows one car; state x, y, vx, vy, turn rate."""

    def step(self, positions: FloatArray) -> None:
        """One scan later, with its detections (n, 2), m."""
        ...

    @property
    def mean(self) -> FloatArray:
        """Estimate; at least x, y, vx, vy."""
        ...


def constant_velocity(state: FloatArray, dt: float) -> FloatArray:
    """Straight on."""
    x, y, vx, vy, rate = state
    return np.array([x + vx * dt, y + vy * dt, vx, vy, rate])


def constant_turn_rate(state: FloatArray, dt: float) -> FloatArray:
    """Round an arc; Bar-Shalom, Estimation with Applications to Tracking and Navigation, 11.7.1."""
    x, y, vx, vy, rate = state
    if abs(rate) < 1.0e-7:
        return constant_velocity(state, dt)
    sin, cos = math.sin(rate * dt), math.cos(rate * dt)
    return np.array(
        [
            x + sin / rate * vx - (1.0 - cos) / rate * vy,
            y + (1.0 - cos) / rate * vx + sin / rate * vy,
            cos * vx - sin * vy,
            sin * vx + cos * vy,
            rate,
        ]
    )


def random_motion(state: FloatArray, dt: float) -> FloatArray:  # noqa: ARG001
    """Stay."""
    return state


def discretised(model: MotionModel, dt: float) -> FloatArray:
    """Process noise of a model by Van Loan's method from its continuous form."""
    drift, noise = np.zeros((5, 5)), np.zeros((5, 5))
    match model:
        case ConstantVelocity() | ConstantTurnRate():
            drift[0, 2] = drift[1, 3] = 1.0
        case RandomMotion():
            noise[0, 0] = noise[1, 1] = model.position_noise
        case _:
            raise TypeError(f"no noise is known of {model!r}")
    noise[2, 2] = noise[3, 3] = model.acceleration_noise
    noise[4, 4] = model.turn_rate_noise
    return np.asarray(van_loan_discretization(drift, noise, dt)[1])


def _motion(model: MotionModel) -> Callable[[FloatArray, float], FloatArray]:
    match model:
        case ConstantVelocity():
            return constant_velocity
        case ConstantTurnRate():
            return constant_turn_rate
        case RandomMotion():
            return random_motion
    raise TypeError(f"no textbook form is known of {model!r}")


class FilterpyImm:
    """filterpy's IMM of UKFs, with the nearest detection inside the gate.

    Parameters
    ----------
    like : filter whose models, weights, transitions and gate to take.
    mean, covariance : (5,) and (5, 5) at the start.
    deviation : 1 sigma of a detection, m.
    dt : between scans, s.
    """

    def __init__(self, like: ImmPdaf, mean: FloatArray, covariance: FloatArray, deviation: float, dt: float) -> None:
        filters = []
        for model in like.models:
            ukf = UnscentedKalmanFilter(
                dim_x=5,
                dim_z=2,
                dt=dt,
                fx=_motion(model),
                hx=lambda state: state[:2],
                points=JulierSigmaPoints(5, kappa=0.0),
            )
            ukf.x, ukf.P = mean.copy(), covariance.copy()
            ukf.Q, ukf.R = discretised(model, dt), deviation**2 * np.eye(2)
            filters.append(ukf)
        keep = math.exp(-dt / like.sojourn_s)
        transition = keep * np.eye(len(filters)) + (1.0 - keep) * like.draws
        self.imm: Any = IMMEstimator(filters, like.weights, transition)
        self._gate = like.gate
        self._noise = deviation**2 * np.eye(2)

    def step(self, positions: FloatArray) -> None:
        """See Peer."""
        imm = self.imm
        imm.predict()
        if not len(positions):
            return
        off = positions - imm.x[:2]
        distance = np.einsum("ni,ij,nj->n", off, np.linalg.inv(imm.P[:2, :2] + self._noise), off)
        nearest = int(np.argmin(distance))
        if distance[nearest] <= self._gate:
            imm.update(positions[nearest])

    @property
    def mean(self) -> FloatArray:
        """See Peer."""
        return np.asarray(self.imm.x)


def stone_soup_is_there() -> bool:
    """Whether Stone Soup is installed (`pip install stonesoup`)."""
    return find_spec("stonesoup") is not None


class StoneSoupPda:
    """Stone Soup's PDA around a Kalman filter with one model, constant velocity.

    Parameters
    ----------
    model : constant velocity.
    sensor : of the scans. gate_probability : as ImmPdaf has it.
    mean, covariance, deviation, dt : as FilterpyImm has them.
    """

    def __init__(
        self,
        model: ConstantVelocity,
        sensor: SensorModel,
        gate_probability: float,
        mean: FloatArray,
        covariance: FloatArray,
        deviation: float,
        dt: float,
    ) -> None:
        from stonesoup.dataassociator.probability import PDA  # noqa: PLC0415
        from stonesoup.functions import gm_reduce_single  # noqa: PLC0415
        from stonesoup.hypothesiser.probability import PDAHypothesiser  # noqa: PLC0415
        from stonesoup.models.measurement.linear import LinearGaussian  # noqa: PLC0415
        from stonesoup.models.transition import linear  # noqa: PLC0415
        from stonesoup.predictor.kalman import KalmanPredictor  # noqa: PLC0415
        from stonesoup.types.array import StateVectors  # noqa: PLC0415
        from stonesoup.types.detection import Detection  # noqa: PLC0415
        from stonesoup.types.state import GaussianState  # noqa: PLC0415
        from stonesoup.types.track import Track  # noqa: PLC0415
        from stonesoup.types.update import GaussianStateUpdate  # noqa: PLC0415
        from stonesoup.updater.kalman import KalmanUpdater  # noqa: PLC0415

        self._types: Any = Detection, StateVectors, GaussianStateUpdate, gm_reduce_single
        noise = model.acceleration_noise**2
        transition = linear.CombinedLinearGaussianTransitionModel([linear.ConstantVelocity(noise) for _ in range(2)])
        # Its order is x, vx, y, vy.
        self._measured = LinearGaussian(4, (0, 2), deviation**2 * np.eye(2))
        self._updater: Any = KalmanUpdater(self._measured)
        hypothesiser = PDAHypothesiser(
            KalmanPredictor(transition),
            self._updater,
            sensor.clutter_density,
            prob_detect=sensor.detection_probability,
            prob_gate=gate_probability,
        )
        self._associator: Any = PDA(hypothesiser)
        order = [0, 2, 1, 3]
        self._time = CLOCK_START
        self._step = timedelta(seconds=dt)
        start = GaussianState(mean[order], covariance[np.ix_(order, order)], timestamp=self._time)
        self._track: Any = Track([start])

    def step(self, positions: FloatArray) -> None:
        """See Peer."""
        detection, state_vectors, update_of, reduced = self._types
        self._time += self._step
        seen = {detection(place, timestamp=self._time, measurement_model=self._measured) for place in positions}
        hypotheses = self._associator.associate({self._track}, seen, self._time)[self._track]
        states = [self._updater.update(each) if each else each.prediction for each in hypotheses]
        mean, covariance = reduced(
            state_vectors([each.state_vector for each in states]),
            np.stack([each.covar for each in states], axis=2),
            np.asarray([each.probability for each in hypotheses]),
        )
        self._track.append(update_of(mean, covariance, hypotheses, self._time))

    @property
    def mean(self) -> FloatArray:
        """See Peer."""
        return np.asarray(self._track.state_vector, dtype=float).ravel()[[0, 2, 1, 3]]
