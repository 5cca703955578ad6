"""IMM-UKF-PDAF: against a textbook Kalman filter, filterpy, enumerated hypotheses, and its own statistics."""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal, poisson

from autonomy.opponents.imm_pdaf import Belief, ImmPdaf, SensorModel
from autonomy.opponents.motion_models import ConstantTurnRate, ConstantVelocity, RandomMotion, turned
from tools.opponent_peers import FilterpyImm, discretised
from tools.opponent_scenes import MANOEUVRES

DT = 0.05
CERTAIN = SensorModel("lidar", 1.0, 1e-12)
WIDE = 1.0 - 1e-12  # gate probability: nothing that a test draws is outside
ALONE = np.array([True])
START_P = np.diag([0.09, 0.09, 4.0, 4.0, 0.0025])


def noise(count, deviation=0.3):
    return np.tile(deviation**2 * np.eye(2), (count, 1, 1))


def belief_of_three(seed=0, tracks=1):
    """A belief whose models disagree."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(tracks, 3, 5, 5)) * [0.3, 0.3, 1.0, 1.0, 0.05]
    mean = np.array([0.0, 0.0, 60.0, 5.0, 0.1]) + rng.normal(size=(tracks, 3, 5)) * [0.3, 0.3, 1.0, 1.0, 0.05]
    p = a.swapaxes(-1, -2) @ a + np.diag([0.1, 0.1, 0.5, 0.5, 0.01])
    return Belief(rng.dirichlet([5.0, 3.0, 2.0], tracks), mean, p)


def mixture(weights, means, covariances):
    """Moments of a mixture, written out."""
    mean = sum(w * m for w, m in zip(weights, means, strict=True))
    p = sum(w * (c + np.outer(m - mean, m - mean)) for w, m, c in zip(weights, means, covariances, strict=True))
    return mean, p


def test_one_linear_model_is_the_kalman_filter():
    rng = np.random.default_rng(1)
    model = ConstantVelocity(3.0, 0.1)
    filter_ = ImmPdaf((model,), (1.0,), (1.0,), gate_probability=WIDE)
    mean, p = np.array([1.0, 2.0, 60.0, -10.0, 0.0]), START_P.copy()
    belief = filter_.started(mean[None], p[None])
    transition = np.eye(5)
    transition[0, 2] = transition[1, 3] = DT
    h, r, q = np.eye(2, 5), 0.09 * np.eye(2), discretised(model, DT)
    for _ in range(100):
        z = mean[:2] + DT * mean[2:4] + rng.normal(0.0, 0.4, 2)
        belief, association = filter_.update(filter_.predict(belief, DT), z[None], noise(1), CERTAIN, ALONE)
        mean, p = transition @ mean, transition @ p @ transition.T + q
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        mean, p = mean + gain @ (z - h @ mean), (np.eye(5) - gain @ h) @ p
        np.testing.assert_allclose(belief.mean[0, 0], mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(belief.covariance[0, 0], p, rtol=1e-7, atol=1e-9)
        assert association.probability[0, 0] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("manoeuvre", MANOEUVRES)
def test_with_one_certain_detection_it_is_filterpys_imm(manoeuvre):
    """Same models, same data: mean, covariance and weights of the models, all the way."""
    truth, rng = MANOEUVRES[manoeuvre](), np.random.default_rng(2)
    filter_ = ImmPdaf(gate_probability=WIDE)
    mean = truth.state[0] + rng.normal(0.0, np.sqrt(np.diag(START_P)))
    belief = filter_.started(mean[None], START_P[None])
    peer = FilterpyImm(filter_, mean, START_P, 0.3, DT)
    least = 1.0
    for state in truth.state[1:]:
        z = state[None, :2] + rng.normal(0.0, 0.3, (1, 2))
        belief, _ = filter_.update(filter_.predict(belief, DT), z, noise(1), CERTAIN, ALONE)
        peer.step(z)
        mean, p = (part[0] for part in belief.combined)
        np.testing.assert_allclose(mean, peer.imm.x, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(p, peer.imm.P, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(belief.weight[0], peer.imm.mu, rtol=1e-5, atol=1e-9)
        least = min(least, belief.weight[0, 0])
    # The comparison means something: where the car manoeuvres, the models change places.
    assert (least < 0.2) == (manoeuvre != "straight")


def test_mixing_is_the_textbooks():
    """With the matrix of transition probabilities and a loop over all pairs of models."""
    filter_, belief = ImmPdaf(sojourn_s=0.4), belief_of_three()
    keep = math.exp(-DT / 0.4)
    transition = keep * np.eye(3) + (1.0 - keep) * filter_.draws[None, :]
    np.testing.assert_allclose(transition.sum(axis=1), 1.0)
    predicted = filter_.predict(belief, DT)
    weight, mean, p = belief.weight[0], belief.mean[0], belief.covariance[0]
    for j, model in enumerate(filter_.models):
        expected = transition[:, j] @ weight
        assert predicted.weight[0, j] == pytest.approx(expected)
        mixed = mixture(transition[:, j] * weight / expected, mean, p)
        moved, moved_p = model.predict(mixed[0][None], mixed[1][None], DT)
        np.testing.assert_allclose(predicted.mean[0, j], moved[0], rtol=1e-10)
        np.testing.assert_allclose(predicted.covariance[0, j], moved_p[0], rtol=1e-8, atol=1e-12)


def test_a_track_that_is_not_drawn_keeps_its_models():
    filter_, belief = ImmPdaf(), belief_of_three(1, tracks=2)
    some, all_, none = (filter_.predict(belief, DT, np.array(drawn)) for drawn in ([1, 0], [1, 1], [0, 0]))
    extrapolated = filter_.extrapolate(belief, DT)
    for part in ("weight", "mean", "covariance"):
        np.testing.assert_allclose(getattr(none, part), getattr(extrapolated, part), rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(getattr(some, part), [getattr(all_, part)[0], getattr(none, part)[1]])
        assert not np.allclose(getattr(all_, part), getattr(none, part), rtol=1e-6)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
@pytest.mark.parametrize("detected", [0.6, 0.95, 1.0])
def test_weights_are_those_of_enumerated_hypotheses(count, detected):
    """Every hypothesis of which detection is the car's, each model: its likelihood with all clutter, and its update.

    Bar-Shalom, Willett, Tian (2011), 3.4: clutter is Poisson in number and uniform over the validation volume, here
    any volume that holds the gates.
    """
    rng = np.random.default_rng(count)
    filter_, belief = ImmPdaf(gate_probability=0.99), belief_of_three()
    sensor, volume = SensorModel("lidar", detected, 0.02), 500.0
    z = rng.normal(0.0, 0.5, (count, 2))
    r = np.array([np.diag(rng.uniform(0.05, 0.3, 2)) + 0.02 for _ in range(count)]).reshape(-1, 2, 2)
    updated, association = filter_.update(belief, z, r, sensor, ALONE)
    h = np.eye(2, 5)
    model_likelihood, model_probability = [], []
    for j in range(3):
        mean, p = belief.mean[0, j], belief.covariance[0, j]
        hypotheses = [((1.0 - detected * 0.99) * poisson.pmf(count, 0.02 * volume) / volume**count, mean, p)]
        for i in range(count):
            s = h @ p @ h.T + r[i]
            off = z[i] - mean[:2]
            inside = multivariate_normal.pdf(off, np.zeros(2), s) / 0.99
            likelihood = (
                detected * 0.99 * inside / count * poisson.pmf(count - 1, 0.02 * volume) / volume ** (count - 1)
            )
            gain = p @ h.T @ np.linalg.inv(s)
            hypotheses.append((likelihood, mean + gain @ off, p - gain @ s @ gain.T))
        total = sum(each[0] for each in hypotheses)
        probability = np.array([each[0] for each in hypotheses]) / total
        expected = mixture(probability, [each[1] for each in hypotheses], [each[2] for each in hypotheses])
        np.testing.assert_allclose(updated.mean[0, j], expected[0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(updated.covariance[0, j], expected[1], rtol=1e-8, atol=1e-12)
        model_likelihood.append(total)
        model_probability.append(probability[1:])
    weight = belief.weight[0] * model_likelihood
    empty = poisson.pmf(count, 0.02 * volume) / volume**count
    assert association.evidence[0] == pytest.approx(weight.sum() / empty)
    weight /= weight.sum()
    np.testing.assert_allclose(updated.weight[0], weight)
    np.testing.assert_allclose(association.probability[0], weight @ np.array(model_probability))


def test_what_is_outside_of_the_gate_does_not_exist():
    filter_, belief, sensor = ImmPdaf(), belief_of_three(), SensorModel()
    near, far = np.array([[0.2, 0.1]]), np.array([[30.0, 0.0]])
    alone, _ = filter_.update(belief, near, noise(1), sensor, ALONE)
    both, association = filter_.update(belief, np.concatenate((near, far)), noise(2), sensor, ALONE)
    np.testing.assert_array_equal(alone.mean, both.mean)
    np.testing.assert_array_equal(alone.covariance, both.covariance)
    assert association.probability[0, 1] == 0.0


@pytest.mark.parametrize("probability", [0.5, 0.99, 0.999])
def test_the_gate_holds_the_share_that_it_should(probability):
    filter_ = ImmPdaf(gate_probability=probability)
    assert filter_.gate == pytest.approx(chi2.ppf(probability, 2))


def test_a_tracks_rows_do_not_touch_another_ones():
    """Tracks far apart, in one call and one by one."""
    filter_, sensor, belief = ImmPdaf(), SensorModel(), belief_of_three(3, tracks=4)
    belief.mean[:, :, 0] += 100.0 * np.arange(4)[:, None]
    z = np.random.default_rng(0).normal(0.0, 0.4, (6, 2))
    z[:, 0] += [0, 0, 100, 200, 200, 450]
    together, association = filter_.update(filter_.predict(belief, DT), z, noise(6), sensor, np.full(4, True))
    for t in range(4):
        one, alone = filter_.update(filter_.predict(belief.only([t]), DT), z, noise(6), sensor, ALONE)
        np.testing.assert_allclose(together.mean[t], one.mean[0], rtol=1e-9)
        np.testing.assert_allclose(together.covariance[t], one.covariance[0], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(association.probability[t], alone.probability[0], atol=1e-9)


def test_the_detections_of_other_cars_are_taken_for_that():
    """Two tracks 2 m apart and one detection each: the density of clutter that each sees, written out in loops."""
    filter_, sensor = ImmPdaf(), SensorModel("lidar", 0.9, 0.01)
    belief = belief_of_three(5, tracks=2)
    belief.mean[1, :, 1] += 2.0
    z = np.array([[0.1, 0.3], [0.0, 1.6]])
    for established in itertools.product([False, True], repeat=2):
        _, association = filter_.update(belief, z, noise(2), sensor, np.array(established))
        density = np.array(
            [
                [
                    [
                        multivariate_normal.pdf(
                            z[i], belief.mean[t, j, :2], belief.covariance[t, j, :2, :2] + noise(1)[0]
                        )
                        for i in range(2)
                    ]
                    for j in range(3)
                ]
                for t in range(2)
            ]
        )
        for t in range(2):
            other = 1 - t
            clutter = 0.01 + 0.9 * established[other] * (belief.weight[other] @ density[other])
            ratio = 0.9 * density[t] / clutter
            likelihood = 1.0 - 0.9 * filter_.gate_probability + ratio.sum(axis=1)
            weight = belief.weight[t] * likelihood
            expected = (weight / weight.sum()) @ (ratio / likelihood[:, None])
            np.testing.assert_allclose(association.probability[t], expected, rtol=1e-6)


def matched_runs(model, seed, runs, steps=60):
    """NEES and NIS (steps, runs) of cars that move exactly as the model says, with noise as stated.

    All runs at once, as tracks 1 km apart: no detection is in the gate of another one's track.
    """
    rng = np.random.default_rng(seed)
    filter_ = ImmPdaf((model,), (1.0,), (1.0,), gate_probability=WIDE)
    mean = np.tile([0.0, 0.0, 60.0, 5.0, 0.2], (runs, 1))
    mean[:, 1] = 1000.0 * np.arange(runs)
    state = mean + rng.multivariate_normal(np.zeros(5), START_P, runs)
    belief = filter_.started(mean, np.tile(START_P, (runs, 1, 1)))
    q = discretised(model, DT)
    nees, nis = [], []
    for _ in range(steps):
        match model:
            case ConstantVelocity():
                state[:, :2] += DT * state[:, 2:4]
            case ConstantTurnRate():
                state = turned(state, DT)
        state = state + rng.multivariate_normal(np.zeros(5), q, runs)
        z = state[:, :2] + rng.normal(0.0, 0.3, (runs, 2))
        belief = filter_.predict(belief, DT)
        off = z - belief.mean[:, 0, :2]
        nis.append(squared_distance(off, belief.covariance[:, 0, :2, :2] + noise(1)))
        belief, association = filter_.update(belief, z, noise(runs), CERTAIN, np.full(runs, False))
        np.testing.assert_allclose(association.probability, np.eye(runs), atol=1e-9)
        nees.append(squared_distance(state - belief.mean[:, 0], belief.covariance[:, 0]))
    return np.array(nees), np.array(nis)


def squared_distance(off, p):
    return np.einsum("ri,ri->r", off, np.linalg.solve(p, off[..., None])[..., 0])


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    "model", [ConstantVelocity(), ConstantTurnRate(), RandomMotion()], ids=lambda m: type(m).__name__
)
def test_errors_and_innovations_are_as_large_as_the_filter_says(model, seed):
    """NEES and NIS over 150 runs (Bar-Shalom, 5.4): inside the 95 % bounds of chi-square, at 95 % of the times."""
    runs = 150
    nees, nis = matched_runs(model, seed, runs)
    for name, values, freedom in (("NEES", nees, 5), ("NIS", nis, 2)):
        low, high = chi2.ppf([0.025, 0.975], freedom * runs) / runs
        mean = values.mean(axis=1)
        inside = np.mean((low < mean) & (mean < high))
        print(f"seed {seed} {type(model).__name__} {name}: {inside:.2f} of the times inside, mean {values.mean():.3f}")
        # Of 60 times, three are outside on the average; nine happen once in 400 tests.
        assert inside >= 0.85
    # The innovations are white: the sum over all times has chi-square statistics, too; here 99.9 % of it.
    low, high = chi2.ppf([0.0005, 0.9995], 2 * nis.size) / nis.size
    assert low < nis.mean() < high


def test_a_sensor_worse_than_it_says_shows():
    """The statistics would tell: detections 1.3 times as far off as the filter is told."""
    rng, filter_, runs = (
        np.random.default_rng(3),
        ImmPdaf((ConstantVelocity(),), (1.0,), (1.0,), gate_probability=WIDE),
        150,
    )
    belief = filter_.started(np.zeros((1, 5)), START_P[None])
    nis = []
    for _ in range(runs):
        z = rng.normal(0.0, 0.39, (1, 2))
        belief = filter_.predict(belief, DT)
        off = z - belief.mean[:, 0, :2]
        nis.append(squared_distance(off, belief.covariance[:, 0, :2, :2] + noise(1)))
        belief, _ = filter_.update(belief, z, noise(1), CERTAIN, ALONE)
    assert np.mean(nis) > chi2.ppf(0.975, 2 * runs) / runs


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"weights": (0.5, 0.5)}, "weights"),
        ({"draws": (0.5, 0.3, 0.3)}, "draws"),
        ({"draws": (0.7, 0.3, 0.0)}, "draws"),
        ({"weights": (0.5, 0.3, 0.3)}, "weights"),
        ({"weights": (1.0, 0.5, -0.5)}, "weights"),
        ({"sojourn_s": 0.0}, "sojourn_s"),
        ({"sojourn_s": math.nan}, "sojourn_s"),
        ({"gate_probability": 1.0}, "gate_probability"),
    ],
)
def test_a_filter_that_cannot_be_is_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        ImmPdaf(**arguments)


@pytest.mark.parametrize("detected", [0.0, 1.1, math.nan])
def test_a_detection_probability_that_cannot_be_is_refused(detected):
    with pytest.raises(ValueError, match="detection_probability"):
        SensorModel("lidar", detected)


@pytest.mark.parametrize("density", [0.0, -1.0, math.inf, math.nan])
def test_a_clutter_density_that_cannot_be_is_refused(density):
    with pytest.raises(ValueError, match="clutter_density"):
        SensorModel("lidar", 0.9, density)


def test_the_papers_models_and_weights_are_the_default():
    filter_ = ImmPdaf()
    assert [type(model) for model in filter_.models] == [ConstantVelocity, ConstantTurnRate, RandomMotion]
    np.testing.assert_array_equal(filter_.weights, [0.5, 0.3, 0.2])
    np.testing.assert_array_equal(filter_.started(np.zeros((1, 5)), START_P[None]).weight, [[0.5, 0.3, 0.2]])
