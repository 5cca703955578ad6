"""IMM-UKF-PDAF: interacting multiple models with probabilistic data association, for many tracks at once.

Y. Bar-Shalom, X.-R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 11.6;
Y. Bar-Shalom, P. Willett, X. Tian, Tracking and Data Fusion (2011), 3.4. Detections measure the position, which is
linear in the state: the unscented update then equals the Kalman update, and is written as that.
Arrays are stacked by track, model and detection, in this order; shapes below use t, m and n for their numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autonomy.frenet import FloatArray
from autonomy.opponents.motion_models import ConstantTurnRate, ConstantVelocity, MotionModel, RandomMotion

Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class SensorModel:
    """What is known of a sensor's detections.

    Attributes
    ----------
    name : of the sensor.
    detection_probability : that a scan holds a detection of a car in view, in (0, 1].
    clutter_density : detections per m2 and scan that come from no car, > 0.

    Raises
    ------
    ValueError : outside of these ranges.
    """

    name: str = "lidar"
    detection_probability: float = 0.9
    clutter_density: float = 1.0e-3

    def __post_init__(self) -> None:
        if not 0.0 < self.detection_probability <= 1.0:
            raise ValueError(f"detection_probability is {self.detection_probability}, allowed is 0 < p <= 1")
        if not 0.0 < self.clutter_density < math.inf:
            raise ValueError(f"clutter_density is {self.clutter_density}, allowed is > 0 and finite")


@dataclass(frozen=True)
class Belief:
    """Estimates of all tracks under each model. Its arrays are not to be written to.

    Attributes
    ----------
    weight : (t, m), probabilities of the models.
    mean : (t, m, 5).
    covariance : (t, m, 5, 5).
    """

    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray

    @cached_property
    def combined(self) -> tuple[FloatArray, FloatArray]:
        """Mean (t, 5) and covariance (t, 5, 5) of the mixture over the models."""
        weight = self.weight[:, :, None]
        mean = (weight * self.mean).sum(axis=1)
        off = self.mean - mean[:, None, :]
        covariance = (weight[..., None] * self.covariance).sum(axis=1)
        return mean, covariance + (weight * off).swapaxes(-1, -2) @ off

    def only(self, chosen: Mask | Integers) -> Belief:
        """Belief of some tracks."""
        return Belief(self.weight[chosen], self.mean[chosen], self.covariance[chosen])

    def joined(self, other: Belief) -> Belief:
        """Belief of these tracks and others behind them."""
        return Belief(
            np.concatenate((self.weight, other.weight)),
            np.concatenate((self.mean, other.mean)),
            np.concatenate((self.covariance, other.covariance)),
        )


class Association(NamedTuple):
    """What a scan had of the tracks.

    Attributes
    ----------
    probability : (t, n), that a detection is of a track's car; what a row lacks to 1: that none is.
    evidence : (t,), likelihood of the scan with the car there over that without it.
    """

    probability: FloatArray
    evidence: FloatArray


class ImmPdaf:
    """The filter; it keeps no state between calls.

    Parameters
    ----------
    models : motion models.
    weights : of the models at the start; they sum to 1.
    draws : probabilities of the models when a car draws a new one, the same one included; they sum to 1.
    sojourn_s : mean time between draws, s. The transition probabilities over dt are then exp(-dt / sojourn) for
        staying, and the rest by the draws: a Markov chain in continuous time.
    gate_probability : that a car's own detection is inside its gate, in (0, 1).
    """

    def __init__(
        self,
        models: Sequence[MotionModel] = (ConstantVelocity(), ConstantTurnRate(), RandomMotion()),
        weights: Sequence[float] = (0.5, 0.3, 0.2),
        draws: Sequence[float] = (0.6, 0.39, 0.01),
        sojourn_s: float = 3.0,
        gate_probability: float = 0.999,
    ) -> None:
        for name, shares in (("weights", weights), ("draws", draws)):
            if len(models) != len(shares) or min(shares) <= 0.0 or not math.isclose(sum(shares), 1.0):
                raise ValueError(
                    f"{name} {tuple(shares)} for {len(models)} models; allowed are as many, > 0, with sum 1"
                )
        if not sojourn_s > 0.0:
            raise ValueError(f"sojourn_s is {sojourn_s}, allowed is > 0")
        if not 0.0 < gate_probability < 1.0:
            raise ValueError(f"gate_probability is {gate_probability}, allowed is 0 < p < 1")
        self.models = tuple(models)
        self.weights, self.draws = np.array(weights), np.array(draws)
        self.sojourn_s = sojourn_s
        self.gate_probability = gate_probability
        #: Squared Mahalanobis distance: the quantile of chi-square with two degrees of freedom, which is closed.
        self.gate = -2.0 * math.log(1.0 - gate_probability)

    def started(self, mean: FloatArray, covariance: FloatArray) -> Belief:
        """Belief of new tracks, the same under each model: mean (t, 5), covariance (t, 5, 5)."""
        count = len(self.models)
        return Belief(
            np.repeat(self.weights[None, :], len(mean), axis=0),
            np.repeat(mean[:, None], count, axis=1),
            np.repeat(covariance[:, None], count, axis=1),
        )

    def predict(self, belief: Belief, dt: float, drawn: Mask | None = None) -> Belief:
        """Mix the models' estimates and carry each on by dt >= 0, s.

        Tracks that are not `drawn` (t,) keep their models: they are only carried on.

        Because a draw is the same from each model, a mixed estimate is a blend of the model's own and the combined
        one: two parts for each model, instead of one from each.
        """
        keep = np.exp(-dt / self.sojourn_s * (np.ones((len(belief.weight), 1)) if drawn is None else drawn[:, None]))
        weight = keep * belief.weight + (1.0 - keep) * self.draws
        own = (keep * belief.weight / weight)[:, :, None]
        mean, covariance = belief.combined
        off = belief.mean - mean[:, None, :]
        mixed = mean[:, None, :] + own * off
        share = own[..., None]
        spread = (own * (1.0 - own) * off)[..., None] * off[..., None, :]
        mixed_covariance = share * belief.covariance + (1.0 - share) * covariance[:, None] + spread
        return self.extrapolate(Belief(weight, mixed, mixed_covariance), dt)

    def extrapolate(self, belief: Belief, dt: float) -> Belief:
        """Carry each model's estimate on by dt >= 0, s, each model as likely as it is now."""
        mean, covariance = np.empty_like(belief.mean), np.empty_like(belief.covariance)
        for index, model in enumerate(self.models):
            mean[:, index], covariance[:, index] = model.predict(belief.mean[:, index], belief.covariance[:, index], dt)
        return Belief(belief.weight, mean, covariance)

    def update(
        self,
        belief: Belief,
        position: FloatArray,
        noise: FloatArray,
        sensor: SensorModel,
        established: Mask,
    ) -> tuple[Belief, Association]:
        """Use the detections of one scan.

        Parameters
        ----------
        belief : predicted to the time of the scan.
        position : (n, 2), m. noise : (n, 2, 2), its covariance, m2.
        sensor : that made the scan.
        established : (t,), of which tracks the detections are no clutter to the others.

        Returns
        -------
        The updated belief, and what was taken for what.
        """
        covariance = belief.covariance
        # Innovations and what their covariances' inverses make of them: 2 x 2, so in closed form.
        off_x = position[:, 0] - belief.mean[:, :, 0, None]
        off_y = position[:, 1] - belief.mean[:, :, 1, None]
        s_xx = covariance[:, :, 0, 0, None] + noise[:, 0, 0]
        s_xy = covariance[:, :, 0, 1, None] + noise[:, 0, 1]
        s_yy = covariance[:, :, 1, 1, None] + noise[:, 1, 1]
        determinant = s_xx * s_yy - s_xy * s_xy
        i_xx, i_xy, i_yy = s_yy / determinant, -s_xy / determinant, s_xx / determinant
        y_x, y_y = i_xx * off_x + i_xy * off_y, i_xy * off_x + i_yy * off_y
        distance = off_x * y_x + off_y * y_y
        # One gate for all models of a track, or their likelihoods could not be compared.
        validated: Mask = np.any(distance <= self.gate, axis=1)
        density = np.exp(-0.5 * distance) / (2.0 * math.pi * np.sqrt(determinant)) * validated[:, None, :]
        ratio = density * (sensor.detection_probability / self._clutter(belief, density, sensor, established))
        missed = 1.0 - sensor.detection_probability * self.gate_probability
        likelihood = missed + ratio.sum(axis=-1)
        probability = ratio / likelihood[..., None]

        def mean_of(values: FloatArray) -> FloatArray:
            return np.asarray((probability * values).sum(axis=-1))

        pull = np.empty((*likelihood.shape, 2, 1))
        pull[..., 0, 0], pull[..., 1, 0] = mean_of(y_x), mean_of(y_y)
        shrink = pull * pull.swapaxes(-1, -2)
        shrink[..., 0, 0] += mean_of(i_xx - y_x * y_x)
        shrink[..., 1, 1] += mean_of(i_yy - y_y * y_y)
        shrink[..., 0, 1] += mean_of(i_xy - y_x * y_y)
        shrink[..., 1, 0] = shrink[..., 0, 1]
        cross = covariance[..., :2]
        weight = belief.weight * likelihood
        evidence = weight.sum(axis=1)
        weight /= evidence[:, None]
        mean = belief.mean + (cross @ pull)[..., 0]
        updated = covariance - cross @ shrink @ cross.swapaxes(-1, -2)
        updated = 0.5 * (updated + updated.swapaxes(-1, -2))
        association = Association((weight[:, :, None] * probability).sum(axis=1), evidence)
        return Belief(weight, mean, updated), association

    @staticmethod
    def _clutter(belief: Belief, density: FloatArray, sensor: SensorModel, established: Mask) -> FloatArray:
        """Density (t, 1, n) of detections that are not of a track's car: clutter, and those of the other cars.

        Linear multitarget tracking (D. Musicki, B. La Scala, IEEE Trans. Aerospace and Electronic Systems 44, 2008).
        A lone track has plain PDA.
        """
        if len(established) == 1:
            return np.full((1, 1, 1), sensor.clutter_density)
        cars = sensor.detection_probability * established[:, None] * (belief.weight[:, :, None] * density).sum(axis=1)
        others = np.maximum(cars.sum(axis=0) - cars, 0.0)
        density_of_others: FloatArray = sensor.clutter_density + others
        return density_of_others[:, None, :]
