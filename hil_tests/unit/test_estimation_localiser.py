"""Choice between the receivers: loss, spikes, drift, disagreement; no jump at a switch; quality levels."""

import itertools
import math

import numpy as np
import pytest

from autonomy.estimation import GRAVITY, FilterTuning, GnssSample, ImuSample
from autonomy.localisation import Localiser, Quality, QualityLimits
from bridge.sensors.noise import DriftingNoise

SEED = 41
RADIUS, SPEED = 233.0, 60.0
BANK = 0.35
TICK_US = 10_000
#: Of position and velocity in both directions, and of heading: what of a stated deviation is drift.
DRIFT = np.array([FilterTuning.position_drift] * 2 + [0.0] * 2 + [FilterTuning.yaw_drift])
DEVIATIONS = (0.03, 0.06)  # m, of the positions of A and B
STD_VELOCITY, STD_YAW = 0.03, 0.003


def pose(t):
    angle = SPEED / RADIUS * t
    return RADIUS * math.cos(angle), RADIUS * math.sin(angle), math.remainder(angle + math.pi / 2, math.tau)


def imu_sample():
    """What an IMU reads on the banked circle."""
    lateral, rate = SPEED**2 / RADIUS, SPEED / RADIUS
    cos, sin = math.cos(BANK), math.sin(BANK)
    return ImuSample(0.0, lateral * cos - GRAVITY * sin, lateral * sin + GRAVITY * cos, 0.0, -rate * sin, rate * cos)


class Rig:
    """A car on a banked circle with both receivers; faults are functions from time to a changed sample or None.

    Of what the receivers state, `drift` is the share that drifts; `road` is the map's.
    """

    def __init__(
        self, fault_a=None, fault_b=None, imu=True, seed=SEED, limits=None, drift=DRIFT, road=lambda *_: (BANK, 0.0)
    ):
        print("seed", seed)
        generator = np.random.default_rng(seed)
        stated = [np.array([std, std, STD_VELOCITY, STD_VELOCITY, STD_YAW]) for std in DEVIATIONS]
        self.noises = [
            DriftingNoise(generator, std * np.sqrt(1.0 - drift**2), std * drift, FilterTuning.drift_time_s, 0.05)
            for std in stated
        ]
        self.faults = (fault_a, fault_b)
        self.imu = imu if callable(imu) else lambda _: imu
        self.localiser = Localiser(road, limits=limits)
        self.tick = 0

    def sample(self, t, std, noise, fault):
        x, y, yaw = pose(t)
        off_x, off_y, off_east, off_north, off_yaw = noise.next()
        gnss = GnssSample(
            x + off_x,
            y + off_y,
            SPEED * math.cos(yaw) + off_east,
            SPEED * math.sin(yaw) + off_north,
            math.remainder(yaw + off_yaw, math.tau),
            std,
            std,
            STD_VELOCITY,
            STD_YAW,
        )
        return fault(t, gnss) if fault else gnss

    def run(self, seconds):
        """Yield time, estimate and position error per tick."""
        for _ in range(round(seconds * 100)):
            now = self.tick * TICK_US
            t = now * 1e-6
            gnss = (None, None)
            if now % 50_000 == 0:
                receivers = zip(DEVIATIONS, self.noises, self.faults, strict=True)
                gnss = tuple(self.sample(t, *receiver) for receiver in receivers)
            estimate = self.localiser.step(now, imu_sample() if self.imu(t) else None, *gnss)
            self.tick += 1
            x, y, _ = pose(t)
            yield t, estimate, math.hypot(estimate.x - x, estimate.y - y) if estimate else math.nan


def after(start, change):
    return lambda t, gnss: change(t - start, gnss) if t >= start else gnss


LOST = after(5.0, lambda *_: None)


def steps(history):
    """Motion between ticks that the speed does not explain."""
    e = [h[1] for h in history]
    return [
        math.hypot(b.x - a.x - 0.01 * SPEED * math.cos(b.yaw), b.y - a.y - 0.01 * SPEED * math.sin(b.yaw))
        for a, b in itertools.pairwise(e)
    ]


def test_before_the_first_epoch_there_is_no_estimate():
    localiser = Localiser(lambda *_: (0.0, 0.0))
    assert localiser.step(0, imu_sample(), None, None) is None
    assert localiser.step(10_000, None, None, None) is None


def test_undisturbed_it_is_accurate_and_good():
    history = list(Rig().run(15.0))
    settled = [h for h in history if h[0] > 3.0]
    assert all(h[1].quality is Quality.GOOD for h in settled)
    assert all(h[1].source == 1 for h in settled)
    assert max(h[2] for h in settled) < 0.06
    last = history[-1][1]
    assert (last.vx, last.vy) == pytest.approx((SPEED, 0.0), abs=0.1)
    assert last.ay == pytest.approx(SPEED**2 / RADIUS, abs=0.2)
    assert last.ax == pytest.approx(0.0, abs=0.2)
    assert last.yaw_rate == pytest.approx(SPEED / RADIUS, abs=0.005)
    # White noise: the mean of a chi distribution with five degrees of freedom is 2.13.
    assert np.mean([h[1].distance_a for h in settled]) == pytest.approx(2.1, abs=0.3)


def test_a_receiver_that_scatters_where_it_should_drift_is_not_good():
    history = list(Rig(drift=np.zeros(5)).run(20.0))
    qualities = [h[1].quality for h in history[300:]]
    assert qualities.count(Quality.DEGRADED) > 0.5 * len(qualities)
    assert min(qualities) is Quality.DEGRADED


def wrong_bank(degrees, metres):
    """A map whose bank is wrong by a sine along the road; the same everywhere with an infinite wavelength."""

    def road(x, y):
        phase = math.pi / 2 + math.tau * RADIUS * math.atan2(y, x) / metres
        return BANK + math.radians(degrees) * math.sin(phase), 0.0

    return road


@pytest.mark.parametrize(
    ("degrees", "metres", "least"),
    [(1.0, math.inf, Quality.GOOD), (0.3, 377.0, Quality.GOOD), (1.0, 377.0, Quality.BAD)],
)
def test_a_wrong_bank_of_the_map_is_a_bias_where_it_stays_and_is_seen_where_it_swings(degrees, metres, least):
    history = list(Rig(road=wrong_bank(degrees, metres)).run(20.0))
    assert min(h[1].quality for h in history[300:]) is least


@pytest.mark.parametrize(("which", "keeps"), [("a", 2), ("b", 1)])
def test_losing_one_receiver_switches_without_a_jump(which, keeps):
    rig = Rig(fault_a=LOST if which == "a" else None, fault_b=LOST if which == "b" else None)
    history = list(rig.run(12.0))
    assert history[-1][1].source == keeps
    assert history[-1][1].quality is Quality.GOOD
    assert max(steps(history[300:])) < 0.08
    assert max(h[2] for h in history[300:]) < 0.2
    distance = history[-1][1].distance_a if which == "a" else history[-1][1].distance_b
    assert distance == math.inf


def test_receivers_that_differ_do_not_make_the_estimate_jump_at_the_switch():
    offset = after(0.0, lambda _, g: g._replace(x=g.x + 0.5))
    history = list(Rig(fault_a=LOST, fault_b=offset).run(12.0))
    assert history[-1][1].source == 2
    assert history[-1][2] == pytest.approx(0.5, abs=0.1)  # it does go over to B's place in the end
    assert max(steps(history[300:])) < 0.04


def test_the_switch_after_a_loss_is_quick():
    history = list(Rig(fault_a=LOST).run(8.0))
    switched = next(h[0] for h in history if h[1].source == 2)
    assert 5.0 < switched < 5.3


def test_spikes_of_the_receiver_in_use_do_not_reach_the_estimate():
    def spike(t, gnss):
        return gnss._replace(x=gnss.x + 8.0, y=gnss.y - 5.0) if round(t * 20) % 10 == 0 else gnss

    history = list(Rig(fault_a=after(4.0, spike)).run(12.0))
    assert max(h[2] for h in history[300:]) < 0.15
    assert max(steps(history[300:])) < 0.08


def test_a_jump_of_one_receiver_moves_to_the_other():
    jump = after(5.0, lambda _, g: g._replace(x=g.x + 3.0))
    history = list(Rig(fault_a=jump).run(20.0))
    assert max(h[2] for h in history[300:]) < 0.3
    assert history[-1][1].source == 2
    # A restarts at its own wrong place: both look healthy and disagree, and the estimate must not claim to be good.
    assert history[-1][1].quality is Quality.DEGRADED


def test_a_drifting_receiver_is_left():
    drift = after(5.0, lambda t, g: g._replace(x=g.x + 1.0 * t))
    history = list(Rig(fault_a=drift).run(15.0))
    assert history[-1][1].source == 2
    assert max(h[2] for h in history[300:]) < 1.5
    assert history[-1][2] < 0.3


def test_a_short_difference_does_not_flip_the_source():
    history = list(Rig().run(30.0))
    assert len({h[1].source for h in history}) == 1


def test_losing_both_degrades_to_lost_while_dead_reckoning_goes_on():
    history = list(Rig(fault_a=LOST, fault_b=LOST).run(9.0))
    level = {round(h[0], 2): h[1].quality for h in history}
    assert level[5.0] is Quality.GOOD
    assert level[5.4] is Quality.DEGRADED
    assert level[6.0] is Quality.BAD
    assert level[7.5] is Quality.LOST
    qualities = [h[1].quality for h in history[490:]]
    assert all(b <= a for a, b in itertools.pairwise(qualities))
    at_six = next(h[2] for h in history if h[0] >= 6.0)
    assert at_six < 0.5
    assert history[-1][1].deviation > history[490][1].deviation


def test_a_receiver_that_comes_back_is_used_again():
    gap = after(5.0, lambda t, g: None if t < 4.0 else g)
    history = list(Rig(fault_a=gap, fault_b=gap).run(16.0))
    assert history[-1][1].quality is Quality.GOOD
    assert history[-1][2] < 0.1
    # The correction is several metres long, but it comes in at no more than a fraction of the speed.
    assert max(steps(history[300:])) < 0.1


def test_a_silent_imu_is_bad():
    history = list(Rig(imu=lambda t: t < 5.0).run(6.0))
    assert next(h[1].quality for h in history if h[0] >= 5.0) is Quality.GOOD
    assert history[-1][1].quality is Quality.BAD


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_epoch_that_is_not_finite_counts_as_lost(value):
    history = list(Rig(fault_a=after(5.0, lambda _, g: g._replace(x=value))).run(8.0))
    assert history[-1][1].source == 2
    assert max(h[2] for h in history[300:]) < 0.2


def test_an_epoch_that_is_not_finite_starts_nothing():
    localiser = Localiser(lambda *_: (0.0, 0.0))
    nothing = GnssSample(math.nan, 0.0, 0.0, 0.0, 0.0, 0.05, 0.05, 0.03, 0.003)
    assert localiser.step(0, imu_sample(), nothing, None) is None


def test_runs_are_reproducible():
    first, second = ([h[1] for h in Rig().run(3.0)] for _ in range(2))
    assert first == second


FARTHEST = 3.0  # m, of a faulty place, not counting spikes
RECKONED, DRIFTED = 1.0, 1.0  # m and m/s: errors of position and velocity after 2 s without epochs, at the very most


def step_bound(limits):
    """How far the estimate may step in a tick beyond the motion, m.

    What is not faded is at most `jump`. What fades is the offset to the filter in use; both are wrong by a fault and
    dead reckoning at most. And the velocity is wrong.
    """
    faded = 1.0 - math.exp(-1e-6 * TICK_US / limits.settle_s)
    return limits.jump + faded * 2.0 * (FARTHEST + RECKONED) + 1e-6 * TICK_US * DRIFTED


def random_fault(rng):
    """Any of: places that drift away, that step away, spikes, outages, with times and sizes by chance."""
    start, length = rng.uniform(3.0, 7.0), rng.uniform(0.3, 2.0)
    direction = rng.uniform(-math.pi, math.pi)
    far, rate = rng.uniform(0.3, FARTHEST), rng.uniform(0.2, 2.0)
    moved = {
        "drift": lambda t: min(far, rate * (t - start)),
        "step": lambda _: far,
        "spikes": lambda _: rng.uniform(5.0, 50.0) if rng.random() < 0.5 else 0.0,
        "outage": lambda t: None if t < start + length else 0.0,
        "end": lambda _: None,
    }
    kind = str(rng.choice(list(moved)))

    def fault(t, gnss):
        off = moved[kind](t) if t >= start else 0.0
        if off is None:
            return None
        return gnss._replace(x=gnss.x + off * math.cos(direction), y=gnss.y + off * math.sin(direction))

    return kind, fault


def excess(history):
    """Steps of the estimate between ticks beyond the true motion, m."""
    off = [(e.x - pose(t)[0], e.y - pose(t)[1]) for t, e, _ in history]
    return [math.dist(a, b) for a, b in itertools.pairwise(off)]


def drive_with_random_faults(seed, limits):
    """Faults of A, or of both; B is somewhere else from the start."""
    rng = np.random.default_rng(seed)
    kind, fault_a = random_fault(rng)
    kind_b, fault_b = random_fault(rng) if rng.random() < 0.3 else ("none", None)
    x, y = rng.uniform(-0.5 * FARTHEST, 0.5 * FARTHEST, 2)

    def apart(t, gnss):
        gnss = fault_b(t, gnss) if fault_b else gnss
        return gnss and gnss._replace(x=gnss.x + x, y=gnss.y + y)

    print("faults", kind, kind_b)
    history = list(Rig(fault_a, apart, seed=seed, limits=limits).run(13.0))
    switches = sum(a[1].source != b[1].source for a, b in itertools.pairwise(history))
    return {kind, kind_b}, switches, max(excess(history))


def test_no_fault_of_either_receiver_makes_the_estimate_jump():
    limits = QualityLimits()
    kinds, switches, largest = set(), 0, []
    for seed in range(60):
        seen, count, step = drive_with_random_faults(seed, limits)
        kinds, switches = kinds | seen, switches + count
        largest.append(step)
        assert step <= step_bound(limits), seed
    assert step_bound(limits) == pytest.approx(0.173, abs=0.001)  # the car itself moves 0.6 m in a tick
    assert kinds == {"drift", "step", "spikes", "outage", "end", "none"}
    assert switches > 20
    assert max(largest) > limits.jump / 2  # they did come near


def test_without_fading_it_would_jump():
    sudden = QualityLimits(jump=math.inf, settle_s=1e-6)
    worst = max(drive_with_random_faults(seed, sudden)[2] for seed in range(20))
    assert worst > 2.0 * step_bound(QualityLimits())
