"""One receiver's filter: against an own Kalman filter, consistency over seeded runs, bank compensation."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from autonomy.estimation import (
    BIAS_AX,
    BIAS_AY,
    BIAS_R,
    GRAVITY,
    VE,
    VN,
    YAW,
    FilterTuning,
    GnssFilter,
    GnssSample,
    ImuSample,
    LevelMotion,
    X,
    Y,
    level,
)

DT = 0.01
EPOCH = 5  # IMU samples per epoch


class Truth:
    """A car that turns and accelerates smoothly, in closed form enough: fine Euler steps."""

    def __init__(self, rng):
        self.x, self.y, self.v, self.yaw, self.t = 10.0, -20.0, 40.0, 0.4, 0.0
        self.phase = rng.uniform(0.0, 6.0)
        self.ax = self.ay = self.rate = 0.0
        self.step(0.0)

    def step(self, dt, parts=20):
        h = dt / parts
        for _ in range(parts):
            self._motion()
            self.x += h * self.v * math.cos(self.yaw)
            self.y += h * self.v * math.sin(self.yaw)
            self.v += h * self.ax
            self.yaw += h * self.rate
            self.t += h
        self._motion()

    def _motion(self):
        self.ax = 2.0 * math.sin(0.7 * self.t + self.phase)
        self.rate = 0.2 + 0.1 * math.sin(0.5 * self.t)
        self.ay = self.v * self.rate


def epoch(truth, rng, std=(0.05, 0.05, 0.03, 0.003)):
    sx, sy, sv, syaw = std
    return GnssSample(
        truth.x + rng.normal(0, sx),
        truth.y + rng.normal(0, sy),
        truth.v * math.cos(truth.yaw) + rng.normal(0, sv),
        truth.v * math.sin(truth.yaw) + rng.normal(0, sv),
        math.remainder(truth.yaw + rng.normal(0, syaw), math.tau),
        sx,
        sy,
        sv,
        syaw,
    )


def state_error(f, truth, biases):
    return np.array(
        [
            truth.x - f.x,
            truth.y - f.y,
            truth.v * math.cos(truth.yaw) - f.velocity_east,
            truth.v * math.sin(truth.yaw) - f.velocity_north,
            math.remainder(truth.yaw - f.yaw, math.tau),
            biases[0] - f.bias_ax,
            biases[1] - f.bias_ay,
            biases[2] - f.bias_yaw_rate,
        ]
    )


def run(seed, epochs=120):
    """Errors, covariances and squared distances at the epochs, with noise exactly as the tuning says."""
    rng = np.random.default_rng(seed)
    tuning = FilterTuning(acceleration_noise=0.05, yaw_rate_noise=0.002, gate=math.inf)
    truth, f = Truth(rng), GnssFilter(tuning)
    bias = rng.normal(0.0, [tuning.start_acceleration_bias, tuning.start_acceleration_bias, tuning.start_yaw_rate_bias])
    walk = np.array([tuning.acceleration_bias_noise, tuning.acceleration_bias_noise, tuning.yaw_rate_bias_noise])
    white = np.array([tuning.acceleration_noise, tuning.acceleration_noise, tuning.yaw_rate_noise]) / math.sqrt(DT)
    f.start(epoch(truth, rng))
    f.ax, f.ay, f.yaw_rate = truth.ax, truth.ay, truth.rate
    nees, nis = [], []
    for k in range(1, epochs * EPOCH + 1):
        truth.step(DT)
        bias = bias + rng.normal(0.0, walk * math.sqrt(DT))
        noise = rng.normal(0.0, white)
        f.predict(LevelMotion(*(np.array([truth.ax, truth.ay, truth.rate]) + bias + noise)), DT)
        if k % EPOCH == 0:
            assert f.update(epoch(truth, rng))
            error = state_error(f, truth, bias)
            nees.append(float(error @ np.linalg.solve(f.covariance, error)))
            nis.append(f.distance**2)
    return np.array(nees), np.array(nis)


def test_errors_and_innovations_are_consistent_over_seeded_runs():
    """NEES and NIS (Bar-Shalom, Estimation with Applications to Tracking and Navigation, 5.4) inside 99.9 %."""
    seeds = range(300, 325)
    print("seeds", seeds)
    nees, nis = (np.array(v) for v in zip(*(run(seed) for seed in seeds), strict=True))
    runs = len(seeds)
    # At one time the runs are independent: the sum over them has chi-square statistics.
    for k in (20, 60, 119):
        low, high = chi2.ppf([0.0005, 0.9995], 8 * runs) / runs
        assert low < nees[:, k].mean() < high
    low, high = chi2.ppf([0.0005, 0.9995], 5 * nis.size) / nis.size
    # The trapezoid over noisy samples halves their shortest waves, so innovations are a little smaller than white.
    assert 0.95 * low < nis.mean() < high


def test_a_receiver_noisier_than_it_says_shows():
    rng = np.random.default_rng(5)
    truth, f = Truth(rng), GnssFilter(FilterTuning(gate=math.inf))
    f.start(epoch(truth, rng))
    f.ax, f.ay, f.yaw_rate = truth.ax, truth.ay, truth.rate
    distances = []
    for k in range(1, 401):
        truth.step(DT)
        f.predict(LevelMotion(truth.ax, truth.ay, truth.rate), DT)
        if k % EPOCH == 0:
            noisy = epoch(truth, rng, (0.2, 0.2, 0.12, 0.012))
            f.update(noisy._replace(std_x=0.05, std_y=0.05, std_velocity=0.03, std_yaw=0.003))
            distances.append(f.distance)
    assert np.mean(distances) > 4.0


def test_it_matches_an_own_kalman_filter():
    """Straight line, constant heading: the problem is linear, and a textbook filter in plain numpy must agree."""
    rng = np.random.default_rng(8)
    tuning = FilterTuning(gate=math.inf)
    yaw, dt = 0.6, EPOCH * DT
    f = GnssFilter(tuning)
    c, s = math.cos(yaw), math.sin(yaw)
    first = GnssSample(0.0, 0.0, 20.0 * c, 20.0 * s, yaw, 0.05, 0.05, 0.03, 1e-6)
    f.start(first)
    state = np.array([0.0, 0.0, 20.0 * c, 20.0 * s, 0.0, 0.0, 0.0, 0.0])
    p = (
        np.diag(
            [
                0.05,
                0.05,
                0.03,
                0.03,
                1e-6,
                tuning.start_acceleration_bias,
                tuning.start_acceleration_bias,
                tuning.start_yaw_rate_bias,
            ]
        )
        ** 2
    )
    transition = np.eye(8)
    transition[X, VE] = transition[Y, VN] = dt
    for row, half in ((VE, 1.0), (X, 0.5 * dt)):
        transition[row, BIAS_AX], transition[row, BIAS_AY] = -dt * c * half, dt * s * half
    for row, half in ((VN, 1.0), (Y, 0.5 * dt)):
        transition[row, BIAS_AX], transition[row, BIAS_AY] = -dt * s * half, -dt * c * half
    transition[YAW, BIAS_R] = -dt
    q = np.zeros((8, 8))
    for a, b in ((X, VE), (Y, VN)):
        q[np.ix_([a, b], [a, b])] = tuning.acceleration_noise**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    q[YAW, YAW] = tuning.yaw_rate_noise**2 * dt
    q[BIAS_AX, BIAS_AX] = q[BIAS_AY, BIAS_AY] = tuning.acceleration_bias_noise**2 * dt
    q[BIAS_R, BIAS_R] = tuning.yaw_rate_bias_noise**2 * dt
    h = np.eye(5, 8)
    for k in range(1, 40):
        for _ in range(EPOCH):
            f.predict(LevelMotion(0.0, 0.0, 0.0), DT)
        state, p = transition @ state, transition @ p @ transition.T + q
        # Exact heading with next to no noise keeps the problem linear.
        z = np.array([20.0 * c * k * dt, 20.0 * s * k * dt, 20.0 * c, 20.0 * s, 0.0])
        z[:4] += rng.normal(0.0, [0.05, 0.05, 0.03, 0.03])
        r = np.diag([0.05, 0.05, 0.03, 0.03, 1e-6]) ** 2
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        state, p = state + gain @ (z - h @ state), (np.eye(8) - gain @ h) @ p
        f.update(GnssSample(z[0], z[1], z[2], z[3], yaw, 0.05, 0.05, 0.03, 1e-6))
        got = [f.x, f.y, f.velocity_east, f.velocity_north, f.yaw - yaw, f.bias_ax, f.bias_ay, f.bias_yaw_rate]
        np.testing.assert_allclose(got, state, atol=2e-6)
        np.testing.assert_allclose(f.covariance, p, rtol=1e-4, atol=1e-8)  # the estimated bias bends the line a little


@pytest.mark.parametrize("state", ["yaw", "bias_ax", "bias_ay", "bias_yaw_rate"])
def test_the_covariance_moves_as_the_state_does(state):
    """Sensitivity of the prediction to one initial error by finite differences, against the propagated covariance."""
    sigma, change = 0.01, 1e-6
    index = {"yaw": YAW, "bias_ax": BIAS_AX, "bias_ay": BIAS_AY, "bias_yaw_rate": BIAS_R}[state]
    quiet = FilterTuning(0.0, 0.0, 0.0, 0.0, sigma if state in ("bias_ax", "bias_ay") else 0.0, sigma)

    def predicted(error):
        f = GnssFilter(quiet)
        f.start(GnssSample(0.0, 0.0, 40.0, 10.0, 0.7, 1e-9, 1e-9, 1e-9, sigma if state == "yaw" else 1e-9))
        setattr(f, state, getattr(f, state) + error)
        f.ax, f.ay, f.yaw_rate = 5.0 - f.bias_ax, 17.0 - f.bias_ay, 0.1 - f.bias_yaw_rate
        for _ in range(EPOCH):
            f.predict(LevelMotion(5.0, 17.0, 0.1), DT)
        f.propagate_covariance()
        return f

    reference, moved = predicted(0.0), predicted(change)
    slopes = [
        (getattr(moved, name) - getattr(reference, name)) / change
        for name in ("x", "y", "velocity_east", "velocity_north", "yaw")
    ]
    got = reference.covariance[: YAW + 1, index] / sigma**2
    np.testing.assert_allclose(got, slopes, rtol=0.02, atol=2e-3)


def test_prediction_alone_follows_a_circle():
    f = GnssFilter(FilterTuning())
    v, radius = 60.0, 233.0
    f.start(GnssSample(radius, 0.0, 0.0, v, math.pi / 2, 0.05, 0.05, 0.03, 0.002))
    f.ax, f.ay, f.yaw_rate = 0.0, v * v / radius, v / radius
    steps = 1000
    for _ in range(steps):
        f.predict(LevelMotion(0.0, v * v / radius, v / radius), DT)
    angle = v / radius * steps * DT
    assert math.hypot(f.x - radius * math.cos(angle), f.y - radius * math.sin(angle)) < 0.02
    assert math.remainder(f.yaw - math.pi / 2 - angle, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_a_spike_is_gated_and_changes_nothing():
    f = GnssFilter(FilterTuning())
    good = GnssSample(0.0, 0.0, 10.0, 0.0, 0.0, 0.05, 0.05, 0.03, 0.002)
    f.start(good)
    for _ in range(EPOCH):
        f.predict(LevelMotion(0.0, 0.0, 0.0), DT)
    before = (f.x, f.y, f.velocity_east, f.yaw)
    assert not f.update(good._replace(x=5.0))
    assert (f.x, f.y, f.velocity_east, f.yaw) == before
    assert f.distance > 30.0
    assert f.update(good._replace(x=0.5))


def attitude(bank, grade):
    """Rotation from the vehicle axes of a car on the road to axes along its heading, to the left, and up."""
    # Grade about the horizontal left axis lifts the nose; then bank about the car's own x axis lowers its left.
    cg, sg, cb, sb = math.cos(grade), math.sin(grade), math.cos(bank), math.sin(bank)
    nose_up = np.array([[cg, 0.0, -sg], [0.0, 1.0, 0.0], [sg, 0.0, cg]])
    left_low = np.array([[1.0, 0.0, 0.0], [0.0, cb, sb], [0.0, -sb, cb]])
    return nose_up @ left_low


@pytest.mark.parametrize("bank", [0.0, 0.2, 0.35, -0.1])
@pytest.mark.parametrize("grade", [0.0, 0.02, -0.05])
def test_bank_and_grade_leave_the_horizontal_acceleration(bank, grade):
    horizontal = np.array([1.3, 16.0, 0.0])
    rotation = attitude(bank, grade)
    force = rotation.T @ (horizontal + np.array([0.0, 0.0, GRAVITY]))
    rates = rotation.T @ np.array([0.0, 0.0, 0.27])
    motion = level(ImuSample(*force, *rates), bank, grade)
    assert (motion.ax, motion.ay) == pytest.approx((1.3, 16.0), abs=1e-9)
    assert motion.yaw_rate == pytest.approx(0.27, abs=1e-9)


def test_a_standing_car_on_the_bank_has_no_acceleration():
    bank = math.radians(20.0)
    force = ImuSample(0.0, -GRAVITY * math.sin(bank), GRAVITY * math.cos(bank), 0.0, 0.0, 0.0)
    assert level(force, bank, 0.0) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
