"""ct_state machine, against its transition list, over every combination of inputs."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import pytest

from bridge._native import ffi, lib

RED, ORANGE, YELLOW, GREEN = 1, 2, 3, 4
CHEQUERED, PURPLE = 4, 8


class Inputs(NamedTuple):
    sys_state: int = 0
    track_flag: int = 0
    vehicle_flag: int = 0
    raptor_alive: bool = True
    configuration_accepted: bool = True
    nominal: bool = True
    full_brake: bool = False
    standing_still: bool = True


def step(state: int, inputs: Inputs) -> int:
    return int(lib.ct_state_next(state, ffi.new("ct_input *", inputs._asdict())))


# from, to, condition on the inputs; the first that holds is taken.
TRANSITIONS = [
    *((s, 12, lambda i: i.full_brake) for s in (3, 4, 5, 6, 7, 8, 9, 10)),
    *((s, 12, lambda i: i.vehicle_flag == PURPLE) for s in (8, 9, 10)),
    *((s, 1, lambda i: i.raptor_alive and i.track_flag == RED) for s in (255, 0)),
    (1, 2, lambda i: i.configuration_accepted),
    (2, 3, lambda i: i.sys_state == 4 and i.track_flag == RED),
    (3, 4, lambda i: i.sys_state == 5 and i.track_flag == RED),
    (4, 5, lambda i: i.sys_state == 6 and i.track_flag == ORANGE),
    (5, 6, lambda i: i.sys_state == 8),
    (6, 7, lambda i: i.track_flag == YELLOW and i.nominal),
    (7, 8, lambda i: i.sys_state == 9 and i.track_flag == YELLOW),
    (8, 10, lambda i: i.track_flag == RED),
    (9, 10, lambda i: i.track_flag == RED),
    (8, 11, lambda i: i.vehicle_flag == CHEQUERED and i.standing_still),
    (8, 9, lambda i: i.track_flag == GREEN and i.vehicle_flag in (0, 1)),
    (9, 8, lambda i: i.vehicle_flag == CHEQUERED),
    (10, 8, lambda i: i.track_flag in (YELLOW, GREEN)),
]
STATES = [*range(13), 255, 13, 200]


@pytest.mark.parametrize("state", STATES)
def test_every_combination(state: int) -> None:
    rows = [(to, holds) for origin, to, holds in TRANSITIONS if origin == state]
    booleans = list(product((False, True), repeat=5))
    for sys_state, track, vehicle in product((0, 1, 4, 5, 6, 7, 8, 9, 16), range(6), (0, 1, 2, 4, 5, 8, 15)):
        for flags in booleans:
            inputs = Inputs(sys_state, track, vehicle, *flags)
            expected = next((to for to, holds in rows if holds(inputs)), state)
            assert step(state, inputs) == expected, inputs


def test_driving_states() -> None:
    assert [state for state in STATES if lib.ct_state_drives(state)] == [8, 9, 10]


def test_a_whole_run() -> None:
    script = [
        (Inputs(track_flag=RED, raptor_alive=False), 255),
        (Inputs(track_flag=RED, configuration_accepted=False), 1),
        (Inputs(track_flag=RED), 2),
        (Inputs(4, RED), 3),
        (Inputs(5, RED), 4),
        (Inputs(6, RED), 4),
        (Inputs(6, ORANGE), 5),
        (Inputs(8, ORANGE), 6),
        (Inputs(8, YELLOW, nominal=False), 6),
        (Inputs(8, YELLOW), 7),
        (Inputs(9, YELLOW), 8),
        (Inputs(9, GREEN), 9),
        (Inputs(9, RED), 10),
        (Inputs(9, GREEN), 8),
        (Inputs(9, GREEN), 9),
        (Inputs(9, GREEN, CHEQUERED, standing_still=False), 8),
        (Inputs(9, GREEN, CHEQUERED, standing_still=False), 8),
        (Inputs(9, GREEN, CHEQUERED), 11),
        (Inputs(9, GREEN), 11),
    ]
    state = 255
    for inputs, expected in script:
        state = step(state, inputs)
        assert state == expected, inputs
