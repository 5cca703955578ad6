"""Raptor: the sys_state machine alone, every transition and everything that must not be one."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from bridge._native import ffi, lib

PWR_ON, SUBSYS_CON, ACT_TESTING, ACT_TEST_PASSED, CRANKREADY = 1, 2, 3, 4, 5
CHECKS_PASSED, CRANKING, ENG_IDLE, DRIVING, SHUT_ENG, PWR_OFF = 6, 7, 8, 9, 10, 11
CHECK_INIT, ACT_TEST_FAIL, CHECKS_FAIL, EMERGENCY, START_FAIL = 13, 14, 15, 16, 17
STATES = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 14, 15, 16, 17)
RED, ORANGE, YELLOW, GREEN = 1, 2, 3, 4
LATER_US = 60_000_000

CONFIG = ffi.new("raptor_config *", lib.raptor_config_default)


def machine_in(state: int) -> Any:
    machine = ffi.new("raptor_sys_machine *")
    lib.raptor_sys_init(machine)
    machine.state = state
    machine.started = True
    return machine


def healthy(**changes: int | bool) -> Any:
    """Input in which nothing is wrong and nothing asks to go on."""
    values: dict[str, int | bool] = {
        "subsystems_ready": True,
        "track_flag_valid": True,
        "track_flag": RED,
        "safety_switch": 4,
        "crank_conditions": True,
        "engine_running": True,
    }
    return ffi.new("raptor_sys_input *", {**values, **changes})


def settle(state: int, seconds: float = 0.0, **changes: int | bool) -> int:
    """State after `seconds` of constant input at 100 Hz, stopping at the first transition."""
    machine, inputs = machine_in(state), healthy(**changes)
    for tick in range(round(seconds * 100) + 1):
        lib.raptor_sys_step(machine, CONFIG, inputs, tick * 10_000)
        if machine.state != state:
            break
    return int(machine.state)


TRANSITIONS: list[tuple[int, float, dict[str, int | bool], int]] = [
    (PWR_ON, 0.49, {}, PWR_ON),
    (PWR_ON, 0.50, {}, SUBSYS_CON),
    (SUBSYS_CON, 60.0, {"subsystems_ready": False}, SUBSYS_CON),
    (SUBSYS_CON, 60.0, {"safety_switch": 2}, SUBSYS_CON),
    (SUBSYS_CON, 0.0, {"safety_switch": 3}, ACT_TESTING),
    (SUBSYS_CON, 60.0, {"emergency": True, "subsystems_ready": False}, SUBSYS_CON),
    (ACT_TESTING, 60.0, {"test_result": 0}, ACT_TESTING),
    (ACT_TESTING, 0.0, {"test_result": 1}, ACT_TEST_PASSED),
    (ACT_TESTING, 0.0, {"test_result": 1, "safety_switch": 3}, ACT_TEST_PASSED),
    (ACT_TESTING, 0.0, {"test_result": 2}, ACT_TEST_FAIL),
    (ACT_TESTING, 0.0, {"safety_switch": 2, "test_result": 1}, SUBSYS_CON),
    (ACT_TEST_PASSED, 60.0, {}, ACT_TEST_PASSED),
    (ACT_TEST_PASSED, 60.0, {"ct_state": 3, "safety_switch": 3}, ACT_TEST_PASSED),
    (ACT_TEST_PASSED, 60.0, {"ct_state": 3, "safety_switch": 5}, ACT_TEST_PASSED),
    (ACT_TEST_PASSED, 0.0, {"ct_state": 3}, CRANKREADY),
    (ACT_TEST_PASSED, 0.0, {"safety_switch": 0}, SUBSYS_CON),
    (CRANKREADY, 60.0, {"ct_state": 3}, CRANKREADY),
    (CRANKREADY, 0.0, {"ct_state": 4}, CHECK_INIT),
    (CHECK_INIT, 0.19, {"ct_state": 4}, CHECK_INIT),
    (CHECK_INIT, 0.20, {"ct_state": 4}, CHECKS_PASSED),
    (CHECK_INIT, 1.99, {"crank_conditions": False}, CHECK_INIT),
    (CHECK_INIT, 2.00, {"crank_conditions": False}, CHECKS_FAIL),
    (CHECKS_PASSED, 60.0, {"ct_state": 5}, CHECKS_PASSED),
    (CHECKS_PASSED, 60.0, {"ct_state": 4, "track_flag": ORANGE}, CHECKS_PASSED),
    (CHECKS_PASSED, 60.0, {"ct_state": 5, "track_flag": ORANGE, "track_flag_valid": False}, CHECKS_PASSED),
    (CHECKS_PASSED, 0.0, {"ct_state": 5, "track_flag": ORANGE}, CRANKING),
    (CHECKS_PASSED, 0.0, {"ct_state": 5, "track_flag": ORANGE, "crank_conditions": False}, CHECKS_FAIL),
    (CRANKING, 0.29, {}, CRANKING),
    (CRANKING, 0.30, {}, ENG_IDLE),
    (CRANKING, 4.99, {"engine_running": False}, CRANKING),
    (CRANKING, 5.00, {"engine_running": False}, START_FAIL),
    (ENG_IDLE, 60.0, {"ct_state": 6, "track_flag": YELLOW}, ENG_IDLE),
    (ENG_IDLE, 60.0, {"ct_state": 7, "track_flag": RED}, ENG_IDLE),
    (ENG_IDLE, 60.0, {"ct_state": 7, "track_flag": ORANGE}, ENG_IDLE),
    (ENG_IDLE, 60.0, {"ct_state": 7, "track_flag": GREEN, "track_flag_valid": False}, ENG_IDLE),
    (ENG_IDLE, 0.0, {"ct_state": 7, "track_flag": YELLOW}, DRIVING),
    (ENG_IDLE, 0.0, {"ct_state": 7, "track_flag": GREEN}, DRIVING),
    (ENG_IDLE, 0.29, {"engine_running": False}, ENG_IDLE),
    (ENG_IDLE, 0.30, {"engine_running": False}, START_FAIL),
    (DRIVING, 60.0, {"ct_state": 9}, DRIVING),
    (DRIVING, 60.0, {"ct_state": 10, "track_flag": RED}, DRIVING),
    (DRIVING, 0.0, {"ct_state": 11}, SHUT_ENG),
    (SHUT_ENG, 60.0, {"ct_state": 11, "engine_stopped": False}, SHUT_ENG),
    (SHUT_ENG, 0.0, {"ct_state": 11, "engine_stopped": True}, PWR_OFF),
]


@pytest.mark.parametrize(("state", "seconds", "changes", "expected"), TRANSITIONS)
def test_transition(state: int, seconds: float, changes: dict[str, int | bool], expected: int) -> None:
    assert settle(state, seconds, **changes) == expected


@pytest.mark.parametrize("state", STATES)
def test_emergency_requests_from_every_state(state: int) -> None:
    supervised = state not in {PWR_ON, SUBSYS_CON, PWR_OFF}
    assert settle(state, emergency=True, safety_switch=0) == (EMERGENCY if supervised else state)
    assert settle(state, stopping=True, safety_switch=0) == (PWR_OFF if state == PWR_OFF else EMERGENCY)
    assert settle(state, ct_state=12) == (PWR_OFF if state == PWR_OFF else EMERGENCY)


@pytest.mark.parametrize("state", [CRANKREADY, CHECK_INIT, CHECKS_PASSED, CRANKING, ENG_IDLE, DRIVING])
@pytest.mark.parametrize("switch", [0, 1, 2, 3, 5, 6, 7])
def test_the_safety_switch_stops_a_car_with_its_engine_enabled(state: int, switch: int) -> None:
    assert settle(state, safety_switch=switch) == EMERGENCY


#: Ends, and the only ways out of them.
FINAL = {
    PWR_OFF: {PWR_OFF},
    EMERGENCY: {EMERGENCY},
    ACT_TEST_FAIL: {ACT_TEST_FAIL, EMERGENCY},
    CHECKS_FAIL: {CHECKS_FAIL, EMERGENCY},
    START_FAIL: {START_FAIL, EMERGENCY},
}


def test_every_input_leads_only_where_it_may() -> None:
    """All 256 ct_states with flags, switch positions and triggers: the dangerous transitions need all their keys."""
    inputs = healthy()
    machine = machine_in(PWR_ON)
    ct_states, flags, switches = range(256), (0, RED, ORANGE, YELLOW, GREEN, 15), (0, 2, 3, 4, 7)
    reached: dict[int, set[int]] = {state: set() for state in STATES}
    for state, switch, emergency, linked in itertools.product(STATES, switches, (False, True), (False, True)):
        inputs.safety_switch, inputs.emergency, inputs.track_flag_valid = switch, emergency, linked
        for flag, ct_state in itertools.product(flags, ct_states):
            inputs.track_flag, inputs.ct_state = flag, ct_state
            machine.state, machine.entered_us = state, 0
            machine.conditions.active, machine.conditions.since_us = True, 0
            lib.raptor_sys_step(machine, CONFIG, inputs, LATER_US)
            after = machine.state
            reached[state].add(after)
            keys = not emergency and linked and switch == 4
            if after == CRANKING != state:
                assert keys
                assert (state, ct_state, flag) == (CHECKS_PASSED, 5, ORANGE)
            if after == DRIVING != state:
                assert keys
                assert (state, ct_state) == (ENG_IDLE, 7)
                assert flag in {YELLOW, GREEN}
    for state, allowed in FINAL.items():
        assert reached[state] <= allowed
    assert CRANKING in reached[CHECKS_PASSED]
    assert DRIVING in reached[ENG_IDLE]


def test_wide_ct_states_are_not_mistaken_for_small_ones() -> None:
    """ct_state has 16 bits on the wire; its low byte alone must not steer the machine."""
    assert settle(ENG_IDLE, 1.0, ct_state=0x0107, track_flag=GREEN) == ENG_IDLE
    assert settle(DRIVING, 1.0, ct_state=0x010C) == DRIVING


def test_a_zeroed_machine_goes_nowhere() -> None:
    for emergency in (False, True):
        machine = ffi.new("raptor_sys_machine *")
        inputs = healthy(ct_state=7, track_flag=GREEN, emergency=emergency)
        for tick in range(1000):
            lib.raptor_sys_step(machine, CONFIG, inputs, tick * 10_000)
        assert machine.state == 0


def test_a_start_forgets_what_was_before_and_counts_from_its_first_step() -> None:
    machine = ffi.new("raptor_sys_machine *")
    ffi.buffer(machine)[:] = b"\x01" * ffi.sizeof("raptor_sys_machine")
    lib.raptor_sys_init(machine)
    start_us, power_on_us = 10**12, CONFIG.power_on_us
    states = []
    for late_us in (0, power_on_us - 1, power_on_us):
        lib.raptor_sys_step(machine, CONFIG, healthy(), start_us + late_us)
        states.append(machine.state)
    assert states == [PWR_ON, PWR_ON, SUBSYS_CON]


def entered(before: int, state: int, now_us: int, **changes: int | bool) -> Any:
    """A machine that has just gone from one state to another, with conditions that have held since long before."""
    machine = machine_in(before)
    machine.conditions.active = True
    lib.raptor_sys_step(machine, CONFIG, healthy(**changes), now_us)
    assert machine.state == state
    return machine


ENTRIES: dict[int, tuple[int, dict[str, int | bool]]] = {
    CHECK_INIT: (CRANKREADY, {"ct_state": 4}),
    CRANKING: (CHECKS_PASSED, {"ct_state": 5, "track_flag": ORANGE}),
}


@pytest.mark.parametrize(
    ("state", "hold_us", "after"),
    [(CHECK_INIT, CONFIG.crank_check_us, CHECKS_PASSED), (CRANKING, CONFIG.engine_settle_us, ENG_IDLE)],
)
def test_what_held_before_a_state_was_entered_is_not_counted_in_it(state: int, hold_us: int, after: int) -> None:
    before, keys = ENTRIES[state]
    machine = entered(before, state, LATER_US, **keys)
    for late_us, expected in ((1, state), (hold_us, state), (hold_us + 1, after)):
        lib.raptor_sys_step(machine, CONFIG, healthy(), LATER_US + late_us)
        assert machine.state == expected


@pytest.mark.parametrize(
    ("state", "limit_us", "after"),
    [(CHECK_INIT, CONFIG.crank_check_limit_us, CHECKS_FAIL), (CRANKING, CONFIG.crank_limit_us, START_FAIL)],
)
def test_the_limit_of_a_state_counts_from_its_entry(state: int, limit_us: int, after: int) -> None:
    before, keys = ENTRIES[state]
    machine = entered(before, state, LATER_US, **keys)
    for late_us, expected in ((limit_us - 1, state), (limit_us, after)):
        lib.raptor_sys_step(machine, CONFIG, healthy(crank_conditions=False, engine_running=False), LATER_US + late_us)
        assert machine.state == expected


def test_conditions_must_hold_without_a_break() -> None:
    machine, good, bad = machine_in(CHECK_INIT), healthy(), healthy(crank_conditions=False)
    for tick in range(150):
        lib.raptor_sys_step(machine, CONFIG, bad if tick % 15 == 14 else good, tick * 10_000)
        assert machine.state == CHECK_INIT
