"""Order of states and gears: all that the firmware does is allowed, and what no computer does is not."""

from __future__ import annotations

import itertools
import random

import numpy as np
import pytest

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import Bus, frame_array
from dbc.states import CtState, SysState
from tools.dbw.conformance import Conformance
from tools.dbw.findings import Place, Rule
from tools.dbw.sequences import GEAR_HOLD_US, Sequence, ct_may_follow, gear_may_follow, sys_may_follow

SEED = 20221103


def test_whatever_the_onboard_computer_does_is_allowed():
    """Every state under every input; with a Raptor that is in some state."""
    seen = set()
    inputs = ffi.new("ct_input *")
    yes_or_no = (False, True)
    for state, sys_state, track, vehicle in itertools.product(CtState, (4, 5, 6, 8, 9, 16), range(5), (0, 2, 4, 8)):
        for alive, accepted, nominal, braking, standing in itertools.product(yes_or_no, repeat=5):
            inputs.sys_state, inputs.track_flag, inputs.vehicle_flag = sys_state, track, vehicle
            inputs.raptor_alive, inputs.configuration_accepted, inputs.nominal = alive, accepted, nominal
            inputs.full_brake, inputs.standing_still = braking, standing
            after = lib.ct_state_next(int(state), inputs)
            if after != state:
                seen.add((int(state), int(after)))
    assert len(seen) > 15
    assert [pair for pair in seen if not ct_may_follow(*pair)] == []


def test_whatever_the_raptor_does_is_allowed():
    generator = random.Random(SEED)
    config = ffi.new("raptor_config *", lib.raptor_config_default)
    seen = set()
    for state in SysState:
        for _ in range(2_000):
            machine = ffi.new("raptor_sys_machine *")
            lib.raptor_sys_init(machine)
            machine.state, machine.started = state, True
            values = {
                name: generator.random() < 0.7
                for name in (
                    "subsystems_ready",
                    "track_flag_valid",
                    "crank_conditions",
                    "engine_running",
                    "engine_stopped",
                )
            }
            values |= {name: generator.random() < 0.1 for name in ("stopping", "emergency")}
            values |= {
                "track_flag": generator.randrange(5),
                "ct_state": generator.choice([int(one) for one in CtState]),
                "safety_switch": generator.choice([1, 3, 4, 4, 4]),
                "test_result": generator.randrange(3),
            }
            for now_us in (0, 60_000_000, 120_000_000):
                before = machine.state
                lib.raptor_sys_step(machine, config, ffi.new("raptor_sys_input *", values), now_us)
                if machine.state != before:
                    seen.add((int(before), int(machine.state)))
    assert len(seen) > 25, SEED
    assert [pair for pair in seen if not sys_may_follow(*pair)] == [], SEED


@pytest.mark.parametrize(
    ("before", "after"),
    [(CtState.DEFAULT, CtState.NOM_RACE), (CtState.NOM_RACE, CtState.PWR_ON), (CtState.EMRG_SHUTDOWN, CtState.CAUTION)],
)
def test_states_of_the_onboard_computer_that_do_not_follow(before: int, after: int):
    assert not ct_may_follow(before, after)


@pytest.mark.parametrize(
    ("before", "after"),
    [(SysState.PWR_ON, SysState.DRIVING), (SysState.DRIVING, SysState.PWR_ON), (SysState.PWR_OFF, SysState.DRIVING)],
)
def test_states_of_the_raptor_that_do_not_follow(before: int, after: int):
    assert not sys_may_follow(before, after)


def test_every_state_may_end_in_an_emergency_and_unknown_ones_follow_nothing():
    assert all(ct_may_follow(state, CtState.EMRG_SHUTDOWN) for state in CtState)
    assert all(sys_may_follow(state, SysState.EMERGENCY_SHUTDOWN) for state in SysState)
    assert not ct_may_follow(77, CtState.CAUTION)
    assert not sys_may_follow(SysState.DRIVING, 77)


def told(sequence: Sequence, values: list[int], step_us: int, piece: int) -> list[tuple[int, str]]:
    """What is said of values in pieces, with places in the whole."""
    times = np.arange(len(values), dtype=np.int64) * step_us
    numbers = np.array(values, dtype=np.float64)
    return [
        (begin + place, text)
        for begin in range(0, len(values), piece)
        for place, text in sequence.update(numbers[begin : begin + piece], times[begin : begin + piece])
    ]


@pytest.mark.parametrize("piece", [1, 3, 100])
def test_gears_go_one_by_one_and_not_too_fast(piece: int):
    gears = Sequence(gear_may_follow, hold_us=GEAR_HOLD_US)
    assert told(gears, [0, 0, 1, 1, 1, 2, 2, 2, 4, 4, 4, 3, 2], 100_000, piece) == [
        (8, "2 is followed by 4"),
        (12, "3 for 100.0 ms; must be at least 300 ms"),
    ]


def test_the_first_value_is_no_change():
    assert told(Sequence(gear_may_follow, hold_us=GEAR_HOLD_US), [5, 5, 4], 1000, 1) == []


@pytest.mark.parametrize(
    ("message", "signal", "values", "row", "text"),
    [
        ("ct_report", "ct_state", [255, 1, 9, 8], 2, "PWR_ON is followed by NOM_RACE"),
        ("misc_report", "sys_state", [8, 9, 1, 2], 2, "DRIVING is followed by PWR_ON"),
        ("gear_shift_cmd", "desired_gear", [1, 2, 5], 2, "2 is followed by 5"),
    ],
)
def test_found_in_traffic(message: str, signal: str, values: list[int], row: int, text: str):
    codec = database.message(message)
    counter = database.facts(message).counter
    frames = []
    for number, value in enumerate(values):
        content = dict.fromkeys(codec.signals, 0.0) | {signal: float(value)}
        if counter is not None:
            content[counter.name] = number
        frames.append(codec.frame(*content.values(), time_us=codec.cycle_us * number * 10))
    conformance = Conformance()
    conformance.update(frame_array(b"".join(frames)))
    found = conformance.findings[Place(Rule.SEQUENCE, Bus.CAN1, message, signal)]
    assert (found.count, found.first_frame, found.text) == (1, row, text)
