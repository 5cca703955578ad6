"""Scenario steps over time: conditions, hold times, flags, telegrams, safety switch, laps."""

from __future__ import annotations

import pytest

from bridge._native import ffi
from bridge.laps import LapTimer
from bridge.race_control import RaceControl, SafetySwitch
from bridge.scenario import Condition, FlagStep, Situation, SwitchStep, Trigger
from dbc.states import CtState, SysState, TrackFlag, VehicleFlag

NOW = Situation(
    time_us=5_000_000, sys_state=9, ct_state=8, distance_m=100.0, laps=1, standstill=False
)  # fmt: skip
TICK_US = 10_000


@pytest.mark.parametrize(
    ("holding", "failing"),
    [
        (Condition(time_us=5_000_000), Condition(time_us=5_000_001)),
        (Condition(sys_state=SysState.DRIVING), Condition(sys_state=SysState.ENG_IDLE)),
        (Condition(ct_state=CtState.CAUTION), Condition(ct_state=CtState.NOM_RACE)),
        (Condition(distance_m=100.0), Condition(distance_m=100.1)),
        (Condition(laps=1), Condition(laps=2)),
        (Condition(standstill=False), Condition(standstill=True)),
    ],
)
def test_each_part_of_a_condition_decides(holding: Condition, failing: Condition):
    assert holding.holds(NOW)
    assert not failing.holds(NOW)


def test_all_parts_must_hold_at_once():
    assert Condition(laps=1, sys_state=SysState.DRIVING, time_us=0).holds(NOW)
    assert not Condition(laps=1, sys_state=SysState.DRIVING, time_us=0, standstill=True).holds(NOW)


def test_hold_time_counts_without_a_break():
    trigger = Trigger(Condition(standstill=True, for_us=30_000))
    pattern = [True, True, True, False, True, True, True, True]
    results = [
        trigger.update(NOW._replace(time_us=tick * TICK_US, standstill=stands)) for tick, stands in enumerate(pattern)
    ]
    assert results == [False] * 7 + [True]


def test_steps_are_taken_in_order_at_most_one_per_tick():
    control = RaceControl(
        [
            FlagStep(Condition(time_us=0), track_flag=TrackFlag.RED),
            FlagStep(Condition(laps=1), track_flag=TrackFlag.GREEN),
            FlagStep(Condition(laps=1), vehicle_flag=VehicleFlag.CHEQUERED),
        ]
    )
    radio = ffi.new("raptor_race_control *")
    shown = []
    for tick, laps in enumerate([0, 0, 1, 1, 0]):
        control.tick(NOW._replace(time_us=tick * TICK_US, laps=laps), 0.0, 0.0, radio)
        shown.append((control.track_flag, control.vehicle_flag))
    red, green = TrackFlag.RED, TrackFlag.GREEN
    none, chequered = VehicleFlag.NONE, VehicleFlag.CHEQUERED
    assert shown == [(red, none), (red, none), (green, none), (green, chequered), (green, chequered)]
    assert control.waiting_for is None


def test_telegrams_leave_at_10_hz_and_carry_what_is_shown():
    control = RaceControl(
        [FlagStep(Condition(time_us=250_000), track_flag=TrackFlag.YELLOW, round_target_speed_mph=31)]
    )
    radio = ffi.new("raptor_race_control *")
    beats = []
    for tick in range(400):
        control.tick(NOW._replace(time_us=tick * TICK_US, laps=300), 70_000.9, 41.5, radio)
        beats.append(radio.heartbeat)
        if tick == 25:
            assert radio.track_flag == TrackFlag.UNKNOWN  # decided, not sent yet
    changes = [tick for tick in range(1, 400) if beats[tick] != beats[tick - 1]]
    assert changes == list(range(10, 400, 10))
    assert set(beats) == set(range(16))
    assert radio.linked
    assert (radio.track_flag, radio.round_target_speed) == (TrackFlag.YELLOW, 31)
    assert (radio.lap_count, radio.lap_distance) == (255, 65535)  # what the fields hold, not wrapped
    assert radio.lap_time == pytest.approx(41.5)


def test_safety_switch_turns_by_its_conditions():
    switch = SafetySwitch(
        [
            SwitchStep(Condition(time_us=0), 1),
            SwitchStep(Condition(sys_state=SysState.SUBSYS_CON), 3),
            SwitchStep(Condition(sys_state=SysState.ACT_TEST_PASSED), 4),
        ]
    )
    wired = ffi.new("raptor_wired_in *")
    positions = []
    for tick, state in enumerate([1, 2, 3, 3, 4, 5]):
        switch.tick(NOW._replace(time_us=tick * TICK_US, sys_state=state), wired)
        positions.append(wired.safety_switch)
    assert positions == [1, 3, 3, 3, 4, 4]


def drive(timer: LapTimer, start_m: float, speed: float, until_s: float, length: float = 1000.0) -> None:
    for tick in range(int(until_s * 100) + 1):
        timer.update(tick * TICK_US, (start_m + speed * tick * 0.01) % length)


def test_laps_are_timed_between_ticks():
    timer = LapTimer(1000.0)
    drive(timer, start_m=123.0, speed=61.7, until_s=60.0)
    first = (1000.0 - 123.0) / 61.7
    assert [us * 1e-6 for us in timer.crossings_us] == pytest.approx([first + lap * 1000.0 / 61.7 for lap in range(3)])
    assert timer.count == 2
    assert timer.laps_s == pytest.approx([1000.0 / 61.7] * 2, abs=1e-9)


def test_the_first_crossing_begins_a_lap_but_is_none():
    timer = LapTimer(1000.0)
    drive(timer, start_m=900.0, speed=50.0, until_s=10.0)
    assert len(timer.crossings_us) == 1
    assert timer.count == 0


def test_rolling_back_over_the_line_takes_the_crossing_back():
    timer = LapTimer(1000.0)
    for tick, station in enumerate([998.0, 0.5, 999.5, 999.8, 0.2]):
        timer.update(tick * TICK_US, station)
    assert len(timer.crossings_us) == 1
    timer = LapTimer(1000.0)
    for tick, station in enumerate([0.5, 999.5, 0.5]):  # started just behind the line, rolled back, then went
        timer.update(tick * TICK_US, station)
    assert timer.count == 0
