"""Onboard computer: what is old, contradicts itself or was never received moves neither the car nor its states."""

from __future__ import annotations

import pytest
from obc_harness import ObcHarness

from bridge._native import lib
from firmware.tables import own_faults

FAULT = {fault.name: fault.id for fault in own_faults()}


def racing(speed: float = 30.0) -> ObcHarness:
    harness = ObcHarness()
    harness.plan_speed = speed
    harness.drive()
    harness.set_speed(speed)
    harness.run(5)
    return harness


def chequered(harness: ObcHarness) -> None:
    harness.signals["base_to_car_summary"]["veh_flag"] = 4
    harness.run(12)
    assert harness.ct_state == lib.CT_CAUTION


def test_locked_wheels_are_no_standstill() -> None:
    """Under a hard brake the front wheels stop before the car does: it must not be shut down at speed."""
    harness = racing()
    chequered(harness)
    harness.signals["wheel_speed_report"] = {f"wheel_speed_{wheel}": 0.0 for wheel in ("FL", "FR", "RL", "RR")}
    harness.run(50)
    assert harness.ct_state == lib.CT_CAUTION
    harness.set_speed(0.0)
    harness.run(5)
    assert harness.ct_state == lib.CT_CNTRL_SHUTDOWN


def test_a_wheel_speed_that_is_missing_is_no_standstill() -> None:
    harness = racing()
    harness.set_speed(0.0)
    harness.run(5)
    del harness.periods["wheel_speed_report"]
    harness.run(12)
    assert FAULT["wheel_speed_missing"] in harness.active_faults()
    chequered(harness)
    harness.run(50)
    assert harness.ct_state == lib.CT_CAUTION


def test_a_stuck_wheel_speed_does_not_make_the_car_run_away() -> None:
    """Every report is fresh, its counter moves, and it always says 0: the limit must hold all the same."""
    harness = racing(speed=60.0)
    harness.signals["pt_report_1"] |= {"current_gear": 4, "engine_speed_rpm": 5000}
    harness.signals["wheel_speed_report"] = {f"wheel_speed_{wheel}": 0.0 for wheel in ("FL", "FR", "RL", "RR")}
    harness.signals["estimate_motion"]["estimate_vx"] = 70.0
    harness.run(30)
    assert harness.throttle == 0
    assert harness.brake_kpa > 0


@pytest.mark.parametrize("silent", ["base_to_car_summary", "misc_report"])
def test_old_flags_and_old_sys_states_lead_nowhere(silent: str) -> None:
    """Red and ACT_TEST_PASSED together lead on; here one of them was said seconds ago."""
    harness = ObcHarness()
    harness.signals["launch_request"]["launch_wanted"] = 0
    harness.configure()
    harness.run(30)
    assert harness.ct_state == lib.CT_INITIALIZED
    race, misc = harness.signals["base_to_car_summary"], harness.signals["misc_report"]
    if silent == "misc_report":
        race["track_flag"] = 2
        harness.run(12)
        misc["sys_state"] = 4
        harness.run(2)
    periods = dict(harness.periods)
    del harness.periods[silent]
    harness.run(120)
    race["track_flag"], misc["sys_state"] = 1, 4
    harness.run(50)
    assert harness.ct_state == lib.CT_INITIALIZED
    harness.periods = periods
    harness.run(25)
    assert harness.ct_state == lib.CT_ACT_TEST


@pytest.mark.parametrize(
    ("silent", "report", "acknowledged"),
    [
        ("base_to_car_summary", "ct_report", {"track_cond_ack": 4, "veh_sig_ack": 2}),
        (
            "marelli_report_1",
            "ct_report_2",
            {"marelli_track_flag_ack": 9, "marelli_vehicle_flag_ack": 35, "marelli_sector_flag_ack": 3},
        ),
    ],
)
def test_a_flag_that_is_not_shown_any_more_is_not_acknowledged(
    silent: str, report: str, acknowledged: dict[str, int]
) -> None:
    harness = ObcHarness()
    harness.signals["base_to_car_summary"] |= {"track_flag": 4, "veh_flag": 2}
    harness.signals["marelli_report_1"] |= {
        "marelli_track_flag": 9, "marelli_vehicle_flag": 35, "marelli_sector_flag": 3,
    }  # fmt: skip
    harness.configure()
    harness.run(51)
    assert {signal: harness.value(report, signal) for signal in acknowledged} == acknowledged
    del harness.periods[silent]
    harness.run(95)
    assert {signal: harness.value(report, signal) for signal in acknowledged} == acknowledged
    harness.run(10)
    assert {signal: harness.value(report, signal) for signal in acknowledged} == dict.fromkeys(acknowledged, 0)


def test_a_stall_longer_than_the_watchdogs_window_counts() -> None:
    """The window must not begin anew in the very tick that tells of the stall."""
    harness = ObcHarness()
    harness.launch()
    assert harness.active_faults() == set()
    harness.now_us += 3_000_000
    harness.tick()
    assert harness.obc.conditions.present[FAULT["executive_late"]]
    assert harness.obc.executive.missed_frames == 300


def test_a_clock_that_is_set_back_makes_everything_old() -> None:
    harness = racing()
    harness.now_us -= 1_000_000
    harness.tick(b"")
    assert harness.state == lib.SSM_FULL_BRAKE
    assert (harness.brake_kpa, harness.throttle) == (4500, 0)


def test_no_throttle_leaves_in_a_safe_stop_not_even_in_the_tick_that_begins_it() -> None:
    harness = racing(speed=40.0)
    harness.set_speed(20.0)
    harness.signals["pt_report_1"] |= {"current_gear": 2, "engine_speed_rpm": 5000}
    harness.run(40)
    assert harness.throttle > 10
    harness.node_codes[1] = 200
    while harness.state != lib.SSM_EMERGENCY:
        harness.tick()
    for speed in (20.0, 5.0, 1.0, 0.4, 0.0):
        harness.set_speed(speed)
        for _ in range(20):
            assert (harness.state, harness.throttle) == (lib.SSM_EMERGENCY, 0)
            harness.tick()
