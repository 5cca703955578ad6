"""Choice between the receivers: loss, spikes, drift, disagreement; no jump at a switch; quality levels."""

import itertools
import math

import numpy as np
import pytest

from autonomy.estimation import GRAVITY, GnssSample, ImuSample
from autonomy.localisation import Localiser, Quality

SEED = 41
RADIUS, SPEED = 233.0, 60.0
BANK = 0.35
TICK_US = 10_000


def pose(t):
    angle = SPEED / RADIUS * t
    return RADIUS * math.cos(angle), RADIUS * math.sin(angle), math.remainder(angle + math.pi / 2, math.tau)


def imu_sample():
    """What an IMU reads on the banked circle."""
    lateral, rate = SPEED**2 / RADIUS, SPEED / RADIUS
    cos, sin = math.cos(BANK), math.sin(BANK)
    return ImuSample(0.0, lateral * cos - GRAVITY * sin, lateral * sin + GRAVITY * cos, 0.0, -rate * sin, rate * cos)


class Rig:
    """A car on a banked circle with both receivers; faults are functions from time to a changed sample or None."""

    def __init__(self, fault_a=None, fault_b=None, imu=True, seed=SEED):
        print("seed", seed)
        self.rng = np.random.default_rng(seed)
        self.faults = (fault_a, fault_b)
        self.imu = imu if callable(imu) else lambda _: imu
        self.localiser = Localiser(lambda *_: (BANK, 0.0))
        self.tick = 0

    def sample(self, t, std, fault):
        x, y, yaw = pose(t)
        n = self.rng.normal
        gnss = GnssSample(
            x + n(0, std),
            y + n(0, std),
            SPEED * math.cos(yaw) + n(0, 0.03),
            SPEED * math.sin(yaw) + n(0, 0.03),
            math.remainder(yaw + n(0, 0.003), math.tau),
            std,
            std,
            0.03,
            0.003,
        )
        return fault(t, gnss) if fault else gnss

    def run(self, seconds):
        """Yield time, estimate and position error per tick."""
        for _ in range(round(seconds * 100)):
            now = self.tick * TICK_US
            t = now * 1e-6
            gnss = (None, None)
            if now % 50_000 == 0:
                gnss = tuple(self.sample(t, s, f) for s, f in zip((0.03, 0.06), self.faults, strict=True))
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
