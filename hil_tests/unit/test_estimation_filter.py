"""One receiver's filter: against an own Kalman filter, consistency over seeded runs, bank compensation."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from autonomy.estimation import (
    BIAS_AX,
    BIAS_AY,
    BIAS_R,
    DRIFT_X,
    DRIFT_Y,
    DRIFT_YAW,
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


STATED = (0.05, 0.05, 0.03, 0.003)
SHARE = np.array([FilterTuning.position_drift, FilterTuning.position_drift, FilterTuning.yaw_drift])
DRIFTS = SHARE * np.array([0.05, 0.05, 0.003])
DECAY = math.exp(-EPOCH * DT / FilterTuning.drift_time_s)


def epoch(truth, rng, std=STATED, drifts=(0.0, 0.0, 0.0)):
    """One epoch with white noise of the shares that are white, and these drifts."""
    sx, sy, sv, syaw = std
    white_x, white_y, white_yaw = np.sqrt(1.0 - SHARE**2) * (sx, sy, syaw)
    drift_x, drift_y, drift_yaw = drifts
    return GnssSample(
        truth.x + drift_x + rng.normal(0, white_x),
        truth.y + drift_y + rng.normal(0, white_y),
        truth.v * math.cos(truth.yaw) + rng.normal(0, sv),
        truth.v * math.sin(truth.yaw) + rng.normal(0, sv),
        math.remainder(truth.yaw + drift_yaw + rng.normal(0, white_yaw), math.tau),
        sx,
        sy,
        sv,
        syaw,
    )


def state_error(f, truth, biases, drifts):
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
            *(drifts - f.drifts),
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
    drifts = rng.normal(0.0, DRIFTS)
    f.start(epoch(truth, rng, drifts=drifts))
    f.ax, f.ay, f.yaw_rate = truth.ax, truth.ay, truth.rate
    nees, nis = [], []
    for k in range(1, epochs * EPOCH + 1):
        truth.step(DT)
        bias = bias + rng.normal(0.0, walk * math.sqrt(DT))
        noise = rng.normal(0.0, white)
        f.predict(LevelMotion(*(np.array([truth.ax, truth.ay, truth.rate]) + bias + noise)), DT)
        if k % EPOCH == 0:
            drifts = DECAY * drifts + math.sqrt(1.0 - DECAY**2) * rng.normal(0.0, DRIFTS)
            assert f.update(epoch(truth, rng, drifts=drifts))
            error = state_error(f, truth, bias, drifts)
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
        low, high = chi2.ppf([0.0005, 0.9995], 11 * runs) / runs
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
    state = np.array([0.0, 0.0, 20.0 * c, 20.0 * s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    drift = SHARE * (0.05, 0.05, 1e-6)
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
                *drift,
            ]
        )
        ** 2
    )
    transition, h = np.eye(11), np.eye(5, 11)
    for k, (measured, its_drift) in enumerate(((X, DRIFT_X), (Y, DRIFT_Y), (YAW, DRIFT_YAW))):
        p[measured, its_drift] = p[its_drift, measured] = -(drift[k] ** 2)
        transition[its_drift, its_drift] = DECAY
        h[measured, its_drift] = 1.0
    transition[X, VE] = transition[Y, VN] = dt
    for row, half in ((VE, 1.0), (X, 0.5 * dt)):
        transition[row, BIAS_AX], transition[row, BIAS_AY] = -dt * c * half, dt * s * half
    for row, half in ((VN, 1.0), (Y, 0.5 * dt)):
        transition[row, BIAS_AX], transition[row, BIAS_AY] = -dt * s * half, -dt * c * half
    transition[YAW, BIAS_R] = -dt
    q = np.zeros((11, 11))
    q[DRIFT_X:, DRIFT_X:] = np.diag((1.0 - DECAY**2) * drift**2)
    for a, b in ((X, VE), (Y, VN)):
        q[np.ix_([a, b], [a, b])] = tuning.acceleration_noise**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    q[YAW, YAW] = tuning.yaw_rate_noise**2 * dt
    q[BIAS_AX, BIAS_AX] = q[BIAS_AY, BIAS_AY] = tuning.acceleration_bias_noise**2 * dt
    q[BIAS_R, BIAS_R] = tuning.yaw_rate_bias_noise**2 * dt
    for k in range(1, 40):
        for _ in range(EPOCH):
            f.predict(LevelMotion(0.0, 0.0, 0.0), DT)
        state, p = transition @ state, transition @ p @ transition.T + q
        # Exact heading with next to no noise keeps the problem linear.
        z = np.array([20.0 * c * k * dt, 20.0 * s * k * dt, 20.0 * c, 20.0 * s, 0.0])
        z[:4] += rng.normal(0.0, [0.05, 0.05, 0.03, 0.03])
        r = np.diag([*(0.05, 0.05), *(0.03, 0.03), 1e-6]) ** 2 * (1.0 - np.array([*SHARE[:2], 0.0, 0.0, SHARE[2]]) ** 2)
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        state, p = state + gain @ (z - h @ state), (np.eye(11) - gain @ h) @ p
        f.update(GnssSample(z[0], z[1], z[2], z[3], yaw, 0.05, 0.05, 0.03, 1e-6))
        got = [f.x, f.y, f.velocity_east, f.velocity_north, f.yaw - yaw, f.bias_ax, f.bias_ay, f.bias_yaw_rate]
        got += f.drifts.tolist()
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
    assert not f.update(good._replace(x=0.7))  # 0.2 m: a drift does not step, and white is little
    assert f.update(good._replace(x=0.5))


def settled(seconds=30.0, drift=0.05):
    """A filter of a car that stands, and whose receiver has had a drift for so long."""
    f, standing = GnssFilter(FilterTuning()), GnssSample(drift, 0.0, 0.0, 0.0, 0.0, 0.05, 0.05, 0.03, 0.002)
    f.start(standing)
    carry_on(f, standing, seconds)
    return f, standing


def carry_on(f, gnss, seconds):
    """Refused epochs of a car that stands, all of them alike."""
    refused = 0
    for k in range(1, round(seconds / DT) + 1):
        f.predict(LevelMotion(0.0, 0.0, 0.0), DT)
        if k % EPOCH == 0:
            refused += not f.update(gnss)
    return refused


def test_a_drift_is_not_averaged_away():
    f, _ = settled()
    assert 0.7 * DRIFTS[0] < f.position_deviation < 0.05
    independent = GnssFilter(FilterTuning(position_drift=0.0, yaw_drift=0.0))
    start = GnssSample(0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.05, 0.03, 0.002)
    independent.start(start)
    carry_on(independent, start, 30.0)
    assert independent.position_deviation < 0.3 * f.position_deviation


def test_another_solution_has_another_drift():
    """From fixed to float: the place steps by decimetres, in keeping with the new deviation; and back."""
    f, fixed = settled()
    x, deviation = f.x, f.position_deviation
    float_solution = fixed._replace(x=0.45, std_x=0.5, std_y=0.5)
    assert carry_on(f, float_solution, 5.0) == 0
    assert f.x == pytest.approx(x, abs=0.03)
    assert f.drifts[0] == pytest.approx(0.45 - f.x, abs=0.1)
    # No epoch of it tells much, and standing for five seconds costs little.
    assert 0.9 * deviation < f.position_deviation < 2.0 * deviation
    assert carry_on(f, fixed, 5.0) == 0
    assert f.x == pytest.approx(x, abs=0.03)
    assert 0.5 * deviation < f.position_deviation < 0.05
    # Without the deviation the step is refused.
    f, fixed = settled()
    assert not f.update(fixed._replace(x=0.45))


def test_a_stated_deviation_that_jitters_is_of_one_solution():
    """Else each change would make the drift a new one, and the average of them all would count as the place."""
    rng = np.random.default_rng(6)
    f, standing = settled(1.0)
    jittering = standing
    for _ in range(600):
        for _ in range(EPOCH):
            f.predict(LevelMotion(0.0, 0.0, 0.0), DT)
        jittering = standing._replace(std_x=0.05 * rng.uniform(0.85, 1.15), std_y=0.05 * rng.uniform(0.85, 1.15))
        assert f.update(jittering)
    steady, _ = settled(31.0)
    assert f.position_deviation == pytest.approx(steady.position_deviation, rel=0.1)


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
