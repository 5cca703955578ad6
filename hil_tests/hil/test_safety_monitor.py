"""The safety monitor beside the real loop: a car whose brakes are gone is found out, and a sound one is not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bridge.bench import Bench
from bridge.scenario import load_scenario
from bridge.surroundings import TICK_US
from dbc.frames import Station
from tools.run import build_bench, find_scenario

SCENARIO = load_scenario(find_scenario("short_drive"))


def drive_to(bench: Bench, speed: float) -> None:
    while bench.truth.vx < speed:
        assert bench.now_us < 15_000_000
        bench.tick()


def test_a_space_drive_without_power_does_not_brake() -> None:
    """The Raptor sees that the Space Drive is gone and asks for a full brake that nobody applies."""
    with build_bench(SCENARIO) as bench:
        drive_to(bench, 10.0)
        bench.silent.add(Station.SPACE_DRIVE)
        gone_us = bench.now_us
        for _ in range(100):
            bench.tick()
        bench.finish()
        assert set(bench.safety.broken) == {"SAFE-3"}
        first = bench.safety.violations[0]
        # The Raptor notices within 120 ms; then the rise time of the brakes.
        assert 220_000 <= first.time_us - gone_us <= 400_000
        assert first.seen.startswith("brake_pressure_")


@pytest.mark.parametrize("profile", ["V14", "V26"])
def test_an_onboard_computer_that_dies_breaks_nothing(profile: str) -> None:
    with build_bench(replace(SCENARIO, profile=profile)) as bench:
        drive_to(bench, 10.0)
        bench.silent.add(Station.OBC)
        for _ in range(200):
            bench.tick()
        bench.finish()
        assert abs(bench.truth.vx) < 0.1
        assert bench.safety.violations == []
        assert bench.now_us // TICK_US > 800


def test_a_brake_line_that_fades(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plant gets half of what the Space Drive asks for."""
    with build_bench(SCENARIO) as bench:
        drive_to(bench, 10.0)
        drive = bench.wiring.drive

        def faded() -> None:
            bench.wiring.space_drive_out.brake_pressure_demand *= 0.5
            drive()

        monkeypatch.setattr(bench.wiring, "drive", faded)
        bench.silent.add(Station.OBC)
        for _ in range(60):
            bench.tick()
        bench.finish()
        assert set(bench.safety.broken) == {"SAFE-3"}
