"""Pace of a run against a clock that the test turns."""

from __future__ import annotations

import pytest

from bridge import pace
from bridge.pace import WallClockPace
from dbc.errors import ConfigurationError


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0
        self.slept_s: list[float] = []

    def perf_counter(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now_s += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(pace, "time", clock)
    return clock


@pytest.mark.parametrize("ratio", [0.5, 1.0, 4.0])
def test_ticks_start_on_an_absolute_grid(clock: Clock, ratio: float):
    paced = WallClockPace(ratio)
    for tick in range(100):
        paced.wait(tick * 10_000)
        assert clock.now_s == pytest.approx(1000.0 + tick * 0.01 / ratio)
        clock.now_s += 0.001  # the tick's own work does not add up
    assert paced.late_ticks == 0


def test_a_late_tick_is_counted_and_caught_up(clock: Clock):
    paced = WallClockPace(1.0)
    paced.wait(0)
    clock.now_s += 0.025
    paced.wait(10_000)
    paced.wait(20_000)
    assert paced.late_ticks == 2
    assert paced.worst_lateness_s == pytest.approx(0.015)
    paced.wait(30_000)
    assert clock.now_s == pytest.approx(1000.03)


def test_a_run_may_start_late_in_simulated_time(clock: Clock):
    paced = WallClockPace(1.0)
    paced.wait(5_000_000)
    assert clock.slept_s == []
    paced.wait(5_010_000)
    assert clock.slept_s == [pytest.approx(0.01)]


@pytest.mark.parametrize("ratio", [0.0, -1.0, float("nan")])
def test_impossible_ratio_is_refused(ratio: float):
    with pytest.raises(ConfigurationError, match="must be more than 0"):
        WallClockPace(ratio)
