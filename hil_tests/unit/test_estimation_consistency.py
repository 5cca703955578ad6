"""Consistency of the filter: NEES and NIS over 100 seeded runs inside their bounds, and what judges them."""

import math

import numpy as np
import pytest
from scipy.stats import binom, chi2

from autonomy.estimation import GRAVITY, FilterTuning, GnssFilter, level
from bridge.sensors.gnss import ERRORS_A
from tools.estimation_bench import (
    INNOVATION,
    PARTS,
    REPORTED,
    assumed_runs,
    bench_runs,
    consistency,
    effective_times,
    follow,
    normalised,
    share_bounds,
    study,
)
from tools.estimation_peer import PlainLocaliser
from tools.estimation_scene import (
    BANK_STRAIGHT,
    BANK_TURN,
    EPOCH_TICKS,
    LAP_S,
    TICK_S,
    assumed_sensors,
    bench_sensors,
    drive,
    on_paper,
    plane_state,
    road,
    solo_lap,
    truths,
)

SEEDS = range(1, 101)
SECONDS = 15


@pytest.fixture(scope="module")
def assumed():
    print("seeds", SEEDS)
    return study(assumed_runs(SECONDS, SEEDS))


MOTION = [*list(PARTS)[1:], INNOVATION]


@pytest.fixture(scope="module")
def of_the_bench():
    print("seeds", SEEDS)
    return tuple(study(runs) for runs in bench_runs(on_paper(SECONDS), SEEDS))


@pytest.fixture(scope="module")
def of_the_solo_lap():
    seeds = SEEDS[:40]
    print("seeds", seeds)
    return tuple(study(runs) for runs in bench_runs(solo_lap(SECONDS), seeds))


@pytest.mark.parametrize("part", [*PARTS, INNOVATION])
def test_with_sensors_as_assumed_the_share_inside_is_that_of_chi_square(assumed, part):
    one = assumed[part]
    assert one.consistent, one
    # By the averages of all times together, too: to 99.9 % of what the runs scatter, and to 2 % of the noise that the
    # trapezoid over two samples takes from the IMU.
    assert abs(one.mean - one.degrees) < 1.7 * one.half_width + 0.02 * one.degrees, one


@pytest.mark.parametrize("louder", [0.8, 1.25])
def test_a_receiver_that_is_not_as_loud_as_it_says_is_seen(louder):
    results = study(assumed_runs(5, SEEDS[:50], louder))
    assert not results[INNOVATION].consistent
    assert not results["velocity"].consistent
    for name in (INNOVATION, "velocity", "all 11"):
        one = results[name]
        assert math.copysign(1.0, louder - 1.0) * (one.mean - one.degrees) > 2.0 * one.half_width, name


@pytest.mark.parametrize("receiver", [0, 1], ids="AB")
@pytest.mark.parametrize("part", MOTION)
def test_with_the_benchs_sensors_it_is_consistent(of_the_bench, receiver, part):
    one = of_the_bench[receiver][part]
    assert one.consistent, one
    assert one.low < one.mean < one.high, one


def test_the_deviation_that_leaves_is_true(of_the_bench):
    one = of_the_bench[0][REPORTED]
    assert one.consistent, one
    assert 0.7 * one.degrees < one.mean < one.high, one


@pytest.mark.parametrize("receiver", [0, 1], ids="AB")
def test_on_the_solo_lap_the_velocity_is_a_little_bold_and_nothing_else_is(of_the_solo_lap, receiver):
    """What docs/estimation.md explains: the plant's lap is not quite what the map and the IMU say."""
    results = of_the_solo_lap[receiver]
    for part in ("position", "heading", INNOVATION):
        assert results[part].consistent, results[part]
    assert results["velocity"].mean < 1.5 * results["velocity"].degrees


def test_drift_taken_for_white_noise_makes_the_filter_bold():
    seeds, white = SEEDS[:10], FilterTuning(position_drift=0.0, yaw_drift=0.0)
    print("seeds", seeds)
    course, runs = on_paper(SECONDS), []
    for seed in seeds:
        samples = [(tick.imu, tick.gnss_a) for tick in bench_sensors(course, seed)]
        runs.append(follow(course.state, samples, course.road, white))
    results = study(runs)
    assert results["position"].mean > 5.0 * results["position"].degrees
    assert not results["position"].consistent
    assert not results[INNOVATION].consistent
    assert results[INNOVATION].mean < 4.0


def test_normalised_squares_by_the_definition():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((20, 8, 8))
    covariances = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(8)
    errors = rng.standard_normal((20, 8))
    expected = [float(e @ np.linalg.inv(c) @ e) for e, c in zip(errors, covariances, strict=True)]
    np.testing.assert_allclose(normalised(errors, covariances), expected, rtol=1e-8)


def squares_of_a_markov_process(rng, runs, count, degrees, decay, studies=1):
    """Squares of unit Gauss-Markov errors, shape (studies, runs, count): consistent by construction."""
    error = rng.standard_normal((studies, runs, degrees))
    squares = np.empty((studies, runs, count))
    for k in range(count):
        squares[:, :, k] = np.sum(error**2, axis=2)
        error = decay * error + math.sqrt(1.0 - decay**2) * rng.standard_normal(error.shape)
    return squares


@pytest.mark.parametrize("decay", [0.0, 0.5, 0.9])
def test_effective_times_of_a_markov_process(decay):
    seed, count = 11, 2000
    print("seed", seed)
    (squares,) = squares_of_a_markov_process(np.random.default_rng(seed), 100, count, 2, decay)
    # The squares' correlation is the square of the errors' one; the series of its squares is geometric.
    fourth = decay**4
    assert effective_times(squares) == pytest.approx(count * (1.0 - fourth) / (1.0 + fourth), rel=0.05)


def test_the_share_scatters_no_more_than_the_effective_times_say():
    seed, count = 12, 200
    print("seed", seed)
    studies = squares_of_a_markov_process(np.random.default_rng(seed), 25, count, 3, 0.9, studies=400)
    low, high = chi2.ppf([0.025, 0.975], 3 * 25) / 25
    average = studies.mean(axis=1)
    shares = np.mean((average >= low) & (average <= high), axis=1)
    assert np.mean(shares) == pytest.approx(0.95, abs=0.006)
    times = np.median([effective_times(one) for one in studies])
    assert times < 0.3 * count
    assert 0.6 < np.var(shares) / (0.95 * 0.05 / times) < 1.2
    # A consistent filter fails about once in 1000; among 400 more than four would be one in 10000.
    assert sum(not consistency(one, 3).consistent for one in studies) <= 4


def test_a_covariance_a_fifth_too_small_is_seen():
    seed = 13
    print("seed", seed)
    (squares,) = squares_of_a_markov_process(np.random.default_rng(seed), 100, 300, 8, 0.5)
    assert consistency(squares, 8).consistent
    assert not consistency(squares / 0.8, 8).consistent
    assert not consistency(squares / 1.25, 8).consistent


def test_errors_that_stay_are_seen():
    """A bias for each run that the covariance does not know of: one independent time, yet far from chi-square."""
    seed = 14
    print("seed", seed)
    rng = np.random.default_rng(seed)
    errors = rng.standard_normal((100, 300)) + 2.0 * rng.standard_normal((100, 1))
    one = consistency(errors**2, 1)
    assert share_bounds(one.effective)[0] <= 0.5
    assert one.far
    assert not one.consistent
    assert not consistency(rng.standard_normal((100, 300)) ** 2, 1).far


def test_share_bounds_are_those_of_the_binomial():
    low, high = share_bounds(60.7)
    assert binom.cdf(round(60 * low) - 1, 60, 0.95) < 0.0005 <= binom.cdf(round(60 * low), 60, 0.95)
    assert (low, high) == pytest.approx((0.85, 1.0), abs=0.04)
    assert share_bounds(0.2) == (0.0, 1.0)


def test_the_motion_is_that_of_its_position():
    """Derivatives of the positions, by central differences."""
    motion = drive(LAP_S)
    place, velocity = motion.state[:, :2], motion.state[:, 2:4]
    np.testing.assert_allclose((place[2:] - place[:-2]) / (2 * TICK_S), velocity[1:-1], atol=1e-3)
    acceleration = (velocity[2:] - velocity[:-2]) / (2 * TICK_S)
    yaw = np.unwrap(motion.state[:, 4])
    cos, sin = np.cos(yaw[1:-1]), np.sin(yaw[1:-1])
    turned = np.column_stack(
        (acceleration[:, 0] * cos + acceleration[:, 1] * sin, acceleration[:, 1] * cos - acceleration[:, 0] * sin)
    )
    np.testing.assert_allclose(turned, motion.acceleration[1:-1], atol=1e-4)
    np.testing.assert_allclose((yaw[2:] - yaw[:-2]) / (2 * TICK_S), motion.yaw_rate[1:-1], atol=1e-5)
    speed = np.hypot(*velocity.T)
    assert 3.6 * speed.max() == pytest.approx(227.0, abs=2.0)
    assert np.ptp(motion.acceleration[:, 0]) > 5.0  # brakes and accelerates
    np.testing.assert_allclose(place[-1], place[0], atol=1e-6)


def test_the_road_is_that_under_the_car():
    motion = drive(LAP_S)
    for k in range(0, len(motion.state), 97):
        bank, grade = road(*motion.state[k, :2])
        assert (bank, grade) == (pytest.approx(motion.bank[k], abs=1e-9), 0.0)
    assert (motion.bank.min(), motion.bank.max()) == pytest.approx((BANK_STRAIGHT, BANK_TURN), abs=1e-6)


def test_the_truth_that_sensors_read_gives_the_motion_back():
    motion = drive(10.0)
    for k, truth in enumerate(truths(motion)):
        bank = motion.bank[k]
        force = (truth.specific_force_x, truth.specific_force_y, truth.specific_force_z)
        # Turned about the car's x axis by the bank: gravity leaves the plane, and the upward force is all of it.
        across = force[1] * math.cos(bank) + force[2] * math.sin(bank)
        upward = force[2] * math.cos(bank) - force[1] * math.sin(bank)
        assert (force[0], across) == pytest.approx(tuple(motion.acceleration[k]), abs=1e-9)
        assert upward == pytest.approx(GRAVITY, abs=1e-9)
        assert truth.road_roll == -bank
        speed = math.hypot(truth.vx, truth.vy * math.cos(bank))
        assert speed == pytest.approx(math.hypot(*motion.state[k, 2:4]), abs=1e-9)
        assert truth.yaw_rate == pytest.approx(motion.yaw_rate[k] * math.cos(bank), abs=1e-12)


def test_the_state_that_the_sensors_truth_gives_is_the_motions():
    motion = drive(10.0)
    states = np.array([plane_state(truth) for truth in truths(motion)])
    np.testing.assert_allclose(states, motion.state, atol=1e-9)


def test_the_solo_lap_is_at_racing_speed_on_the_maps_road():
    course = solo_lap(1.0)
    assert len(course.state) == len(course.truths) == 101
    speed = np.hypot(course.state[:, 2], course.state[:, 3])
    assert 200.0 < 3.6 * speed.min() < 3.6 * speed.max() < 230.0
    path = np.diff(course.state[:, :2], axis=0) / TICK_S
    np.testing.assert_allclose(path, 0.5 * (course.state[1:, 2:4] + course.state[:-1, 2:4]), atol=0.02)
    for (x, y, *_), truth in zip(course.state.tolist(), course.truths, strict=True):
        bank, grade = course.road(x, y)
        assert (-bank, -grade) == pytest.approx((truth.road_roll, truth.road_pitch), abs=1e-3)


def test_assumed_sensors_are_what_they_say():
    seed = 21
    print("seed", seed)
    motion, tuning = drive(200.0), FilterTuning()
    ticks, hidden = assumed_sensors(motion, tuning, np.random.default_rng(seed))
    biases, drifts = hidden[:, :3], hidden[:, 3:]
    sensed = np.array([level(tick.imu, *road(x, y)) for tick, (x, y) in zip(ticks, motion.state[:, :2], strict=True)])
    noise = sensed - np.column_stack((motion.acceleration, motion.yaw_rate)) - biases
    intensity = np.array([tuning.acceleration_noise] * 2 + [tuning.yaw_rate_noise])
    np.testing.assert_allclose(noise.std(axis=0) * math.sqrt(TICK_S), intensity, rtol=0.03)
    walk = np.array([tuning.acceleration_bias_noise] * 2 + [tuning.yaw_rate_bias_noise])
    np.testing.assert_allclose(np.diff(biases, axis=0).std(axis=0) / math.sqrt(TICK_S), walk, rtol=0.03)
    epochs = [(k, tick.gnss_a) for k, tick in enumerate(ticks) if tick.gnss_a is not None]
    assert [k for k, _ in epochs] == list(range(0, len(ticks), EPOCH_TICKS))
    errors = np.array([g[:5] for _, g in epochs]) - motion.state[::EPOCH_TICKS]
    errors[:, 4] = np.arctan2(np.sin(errors[:, 4]), np.cos(errors[:, 4]))
    errors[:, [0, 1, 4]] -= drifts[::EPOCH_TICKS]
    stated = epochs[0][1]
    deviations = np.array([stated.std_x, stated.std_y, stated.std_velocity, stated.std_velocity, stated.std_yaw])
    share = np.array([tuning.position_drift, tuning.position_drift, 0.0, 0.0, tuning.yaw_drift])
    np.testing.assert_allclose(errors.std(axis=0), deviations * np.sqrt(1.0 - share**2), rtol=0.05)
    decay = math.exp(-TICK_S / tuning.drift_time_s)
    fresh = drifts[1:] - decay * drifts[:-1]
    expected = (deviations * share)[[0, 1, 4]]
    np.testing.assert_allclose(fresh.std(axis=0), expected * math.sqrt(1.0 - decay**2), rtol=0.03)
    # A drift is stationary from the beginning on.
    starts = np.array([assumed_sensors(drive(0.0), tuning, np.random.default_rng(k))[1][0, 3:] for k in range(400)])
    np.testing.assert_allclose(starts.std(axis=0), expected, rtol=0.12)
    assert stated.std_x == ERRORS_A.position_std
    assert all(tick.gnss_b is None for tick in ticks)


def test_the_plain_filters_agree_with_the_cars():
    """An own prediction at every sample, an extended filter, no error state: the same estimates."""
    seed = 5
    print("seed", seed)
    motion = drive(12.0)
    plain = PlainLocaliser(road)
    ours = [GnssFilter(FilterTuning()) for _ in range(2)]
    for k, tick in enumerate(bench_sensors(on_paper(12.0), seed)):
        plain.step(*tick)
        sample = level(tick.imu, *road(*motion.state[k, :2]))
        for f, other, gnss in zip(ours, plain.filters, tick[1:], strict=True):
            if f.started:
                f.predict(sample, TICK_S)
            if gnss is not None and not f.started:
                f.start(gnss)
                f.predict(sample, 0.0)
            elif gnss is not None:
                assert f.update(gnss)
            if k > 300:
                x = other.ekf.x
                np.testing.assert_allclose(x[8:10], f.drifts[:2], atol=0.01)
                mine = (f.x, f.y, f.velocity_east, f.velocity_north)
                np.testing.assert_allclose(x[:4], mine, atol=0.01)
                assert math.remainder(x[4] - f.yaw, math.tau) == pytest.approx(0.0, abs=3e-4)
                if gnss is not None:
                    np.testing.assert_allclose(other.ekf.P[:5, :5], f.covariance[:5, :5], rtol=0.05, atol=2e-6)
