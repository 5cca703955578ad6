"""When a station counts as stopped, and when a run is over."""

from __future__ import annotations

from bridge.realtime.watch import (
    AFTERMATH_MAX_US,
    AFTERMATH_MIN_US,
    LOST_US,
    OVERTIME_US,
    STALL_US,
    CycleWatch,
    RunWatch,
    Stall,
)


def test_a_station_that_cycles_is_never_stalled():
    watch = CycleWatch()
    for look in range(100):
        assert watch.update(look * 100_000, {"obc": look * 10}) == []
    assert watch.lost(9_900_000) == []


def test_a_station_that_stops_is_told_once_and_again_when_it_comes_back():
    watch = CycleWatch()
    watch.update(0, {"obc": 5, "raptor": 5})
    watch.update(100_000, {"obc": 10, "raptor": 10})
    stopped_us = 100_000
    now_us, told = stopped_us, []
    while now_us < stopped_us + STALL_US + 300_000:
        now_us += 100_000
        told += watch.update(now_us, {"obc": 10, "raptor": now_us // 10_000})
    assert told == [Stall("obc", stopped_us, over=False)]
    assert watch.lost(stopped_us + LOST_US - 1) == []
    assert watch.lost(stopped_us + LOST_US) == ["obc"]
    assert watch.update(now_us + 100_000, {"obc": 11, "raptor": 999}) == [Stall("obc", stopped_us, over=True)]
    assert watch.lost(now_us + 10 * LOST_US) == []


def test_before_the_epoch_nothing_is_due():
    watch = CycleWatch()
    for now_us in range(-2_000_000, STALL_US, 100_000):
        assert watch.update(now_us, {"obc": 0}) == []
    assert watch.update(STALL_US, {"obc": 0}) == [Stall("obc", -2_000_000, over=False)]


def test_a_station_that_ended_is_forgotten():
    """Its end is told elsewhere; when it is started again its count begins anew."""
    watch = CycleWatch()
    watch.update(0, {"obc": 50})
    watch.update(STALL_US, {"obc": 50})
    assert watch.update(STALL_US + 1, {}) == []
    assert watch.lost(10 * LOST_US) == []
    assert watch.update(10 * LOST_US, {"obc": 50}) == []


def test_a_sound_run_ends_by_the_plant_or_long_after_its_time():
    watch = RunWatch(30_000_000)
    assert not watch.over(0, stands=True)
    assert not watch.over(30_000_000 + OVERTIME_US - 1, stands=True)
    assert watch.over(30_000_000 + OVERTIME_US, stands=False)


def test_after_a_failure_the_run_goes_on_until_the_car_stands():
    watch = RunWatch(300_000_000)
    watch.fail(50_000_000)
    watch.fail(55_000_000)
    assert watch.failed_us == 50_000_000
    assert not watch.over(50_000_000 + AFTERMATH_MIN_US - 1, stands=True)
    assert watch.over(50_000_000 + AFTERMATH_MIN_US, stands=True)
    assert not watch.over(50_000_000 + AFTERMATH_MAX_US - 1, stands=False)
    assert watch.over(50_000_000 + AFTERMATH_MAX_US, stands=False)
