"""A fault leaves the car its share of the limits, and gives the rest back when it clears: on the bus and at the car."""

from __future__ import annotations

import itertools

import pytest

from bridge.faults import Drop, SensorOutage
from bridge.observed_bench import ObservedBench

TICK_S = 0.01
THROTTLE_RISE = 1.5
"""1/s, of the command (docs/ssm.md)."""

NOMINAL, GNSS_A, ACCELERATOR = (63.1, 8.0), (30.0, 3.0), (30.0, 1.5)
"""Largest speed and acceleration that solo.yaml allows, and what of it these faults leave, m/s and m/s2."""


def wait_for_limits(bench: ObservedBench, limits: tuple[float, float], within_s: float) -> None:
    names = ("ssm_max_speed", "ssm_max_acceleration")
    bench.wait_for("ssm_status", within_s, lambda status: tuple(round(status[name], 3) for name in names) == limits)


def throttle_until(bench: ObservedBench, speed: float, within_s: float) -> list[float]:
    """Throttle in each tick until the car is so fast."""
    seen = []
    end_us = bench.now_us + round(within_s * 1e6)
    while bench.truth.vx < speed:
        bench.tick()
        seen.append(bench.wiring.raptor_out.throttle_demand)
        assert bench.now_us < end_us, bench.truth.vx
    return seen


@pytest.mark.raceloop("solo_lap")
@pytest.mark.expects_faults("gnss_a_timeout", "gnss_a_low_rate", "accelerator_report_missing")
def test_the_car_follows_the_limits_of_its_faults_down_and_up_again(bench: ObservedBench) -> None:
    bench.run_to(lambda: bench.truth.vx > 36.0, within_s=90.0)
    receiver = bench.inject(SensorOutage(sensor="gnss_a"))
    wait_for_limits(bench, GNSS_A, within_s=0.3)
    report = bench.inject(Drop(message="accelerator_report"))
    wait_for_limits(bench, ACCELERATOR, within_s=0.2)
    bench.run_to(lambda: bench.truth.vx < 30.0, within_s=2.0)
    bench.run_for(2.0)
    assert 29.0 < bench.truth.vx < 30.3
    report.cancel()
    wait_for_limits(bench, GNSS_A, within_s=0.7)
    receiver.cancel()
    wait_for_limits(bench, NOMINAL, within_s=2.5)
    begin_us, slow = bench.now_us, bench.truth.vx
    before = bench.wiring.raptor_out.throttle_demand
    throttle = [before, *throttle_until(bench, 36.0, within_s=5.0)]
    steepest = max(after - before for before, after in itertools.pairwise(throttle))
    assert 0.0 < steepest <= THROTTLE_RISE * TICK_S + 2e-4, "no jump; the wire rounds to 0.0001"
    assert (bench.truth.vx - slow) / ((bench.now_us - begin_us) * 1e-6) < NOMINAL[1]
    bench.finish()
    assert bench.safety.violations == []
