"""The parameter matrix: every cell through the real path, and no motion after a rejection.

File, `firmware.parameters`, frames on CAN-A, a fresh onboard computer, its verdict back in words. All the while the
computer hears what a healthy car and a willing operator send, so that it would drive if it took the configuration.
"""

from __future__ import annotations

import itertools
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from obc_harness import OPERATION, TICK_US, ObcHarness, Outbox, cast_frames
from parameter_cells import (
    BY_NAME,
    EDGES,
    KINDS,
    SCHEMA,
    Cell,
    operation_text,
    parameter_cells,
    rule_cells,
    rule_name,
    violated,
)

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Bus, iterate
from dbc.states import CtState
from firmware.parameters import check_operation, encode_operation, load_operation
from firmware.tables import PARAMETERS_FILE

#: After these the computer is NOMINAL with a good configuration: sensors need their full second.
TICKS = 130

PARAMETER_CELLS, RULE_CELLS = list(parameter_cells()), list(rule_cells())

#: Commands, and the value that each keeps in a car that must not move.
AT_REST = {
    "brake_pressure_cmd": 4500.0,
    "accelerator_cmd": 0.0,
    "steering_cmd": 0.0,
    "gear_shift_cmd": 0.0,
}


@cache
def surroundings() -> list[bytes]:
    """What everybody else sends on the way to NOMINAL, tick by tick."""
    harness = ObcHarness()
    harness.configure()
    configuration = b"".join(harness.extra)
    heard: list[bytes] = []

    def record(frames: bytes) -> bytes:
        heard.append(frames.removeprefix(configuration))
        return frames

    harness.filters.append(record)
    harness.run(TICKS)
    return heard


class Car:
    """A fresh onboard computer in a healthy car."""

    def __init__(self) -> None:
        self.obc = ffi.new("obc *")
        lib.obc_init(self.obc)
        self.outbox = Outbox()
        self.ticks = 0
        self.sent = bytearray()

    def tick(self, frames: bytes = b"") -> list[tuple[int, bytes]]:
        """Run one tick; what it sent on CAN-A as (id, data)."""
        array, count = cast_frames(surroundings()[self.ticks % TICKS] + frames)
        lib.obc_tick(self.obc, self.ticks * TICK_US, array, count, self.outbox.c)
        self.ticks += 1
        sent = self.outbox.take()
        self.sent += sent
        return [(frame.id, frame.data) for frame in iterate(sent) if frame.bus == Bus.CAN_A]

    def run_to_the_end(self) -> None:
        while self.ticks < TICKS:
            array, count = cast_frames(surroundings()[self.ticks])
            lib.obc_tick(self.obc, self.ticks * TICK_US, array, count, self.outbox.c)
            self.ticks += 1
            self.sent += self.outbox.take()

    def commanded(self, name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """First signal of all frames of a message that were sent."""
        message = database.message(name)
        frames = np.frombuffer(self.sent, dtype=FRAME_DTYPE)
        chosen = frames[(frames["bus"] == message.bus) & (frames["id"] == message.frame_id)]
        return message.columns(chosen)[message.signals.index("ct_state") if name == "ct_report" else 0]

    def assert_at_rest(self) -> None:
        """No motion command has left, from the first tick on."""
        for name, value in AT_REST.items():
            values = self.commanded(name)
            assert len(values) > 0
            assert (values == value).all(), name
        assert set(self.commanded("ct_report")) <= {CtState.DEFAULT, CtState.PWR_ON}
        assert self.obc.ssm_output.state == lib.SSM_FULL_BRAKE
        assert self.obc.ssm_output.worst_fault == lib.FAULT_PARAMETERS_REJECTED

    def in_force(self, name: str) -> tuple[float, int]:
        value = self.obc.parameters.active[list(BY_NAME).index(name)]
        return float(value.real), int(value.integer)


def wanted(name: str, value: float) -> tuple[float, int]:
    """What a value is in the firmware."""
    return float(np.float32(value)), 0 if BY_NAME[name].type == "float" else int(value)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("matrix") / "operation.yaml"


def validate(cell: Cell, path: Path, test: str) -> Car:
    """Run a cell up to the verdict and compare it."""
    print(f"again: python -m pytest 'hil_tests/unit/{Path(__file__).name}::{test}[{cell.name}]'")
    path.write_text(cell.text)
    car = Car()
    operation = load_operation(path)
    verdict = check_operation(operation, car.tick, SCHEMA)
    assert sorted((offence.key, offence.reason) for offence in verdict.offences) == cell.offences
    assert verdict.accepted == (not cell.offences)
    for offence in verdict.offences:
        given = [repr(value) for name, value in operation if name == offence.key]
        assert offence.value == (", ".join(given) or "not given")
        if offence.reason == "contradicts another parameter":
            assert offence.allowed in [rule.allowed() for rule in SCHEMA.cross_checks if rule.left == offence.key]
        elif offence.key in BY_NAME:
            assert offence.allowed == BY_NAME[offence.key].allowed()
    if not verdict.accepted:
        car.run_to_the_end()
        car.assert_at_rest()
    else:
        for name, value in cell.values.items():
            assert car.in_force(name) == wanted(name, value)
    return car


@pytest.mark.parametrize("cell", PARAMETER_CELLS, ids=lambda cell: cell.name)
def test_cell(cell: Cell, path: Path) -> None:
    car = validate(cell, path, "test_cell")
    if cell.late:
        (write, _commit) = encode_operation([cell.late], SCHEMA)
        answers = car.tick(write)
        result = database.message("parameter_result")
        decoded = [result.decode(data)[:2] for identifier, data in answers if identifier == result.frame_id]
        assert (BY_NAME[cell.late[0]].key, lib.PARAMETER_LATE) in decoded
        assert car.obc.ssm.faults.faults[lib.FAULT_PARAMETER_WRITE_LATE].active
        assert car.in_force(cell.late[0]) == wanted(cell.late[0], cell.values[cell.late[0]])
        assert car.in_force(cell.late[0]) != wanted(*cell.late)


@pytest.mark.parametrize("cell", RULE_CELLS, ids=lambda cell: cell.name)
def test_rule(cell: Cell, path: Path) -> None:
    validate(cell, path, "test_rule")
    broken = [rule_name(rule) for rule in violated(cell.values)]
    assert broken == ([cell.subject] if cell.kind == "just_violated" else [])


def test_no_cell_is_left_out() -> None:
    """Counted against the source itself, not against what made the cells."""
    source = yaml.safe_load(PARAMETERS_FILE.read_text())
    names = [entry["name"] for entry in source["parameters"]]
    rules = [f"{entry['left']}-{entry['kind']}-{entry['right']}" for entry in source["cross_checks"]]
    assert len(PARAMETER_CELLS) == len(names) * 15
    assert {(c.subject, c.kind) for c in PARAMETER_CELLS} == set(itertools.product(names, KINDS))
    assert len(RULE_CELLS) == len(rules) * 2
    assert {(c.subject, c.kind) for c in RULE_CELLS} == set(itertools.product(rules, EDGES))
    assert len({cell.name for cell in PARAMETER_CELLS + RULE_CELLS}) == len(PARAMETER_CELLS) + len(RULE_CELLS)


def test_every_parameter_is_accepted_somewhere_and_refused_for_every_reason() -> None:
    """Or the matrix could be all of one kind. No rule makes a limit of a range impossible."""
    for name, parameter in BY_NAME.items():
        cells = {cell.kind: cell.offences for cell in PARAMETER_CELLS if cell.subject == name}
        allowed = ("at_minimum", "inside", "at_maximum", "changed_after_validation")
        assert [kind for kind in KINDS if not cells[kind]] == list(allowed), name
        number = parameter.type != "bool"
        expected = {
            "below_minimum": "wrong type"
            if not number
            else "wrong sign"
            if parameter.min == 0
            else "below the minimum",
            "above_maximum": "above the maximum" if number else "wrong type",
            "wrong_sign": "wrong sign" if number else "wrong type",
            "wrong_type": "wrong type",
            "nan": "not a finite number" if parameter.type == "float" else "wrong type",
            "missing": "missing",
            "duplicate": "given more than once",
        }
        assert {kind: cells[kind] for kind in expected} == {k: [(name, r)] for k, r in expected.items()}, name


def test_the_surroundings_would_let_the_car_go() -> None:
    """The negative of all rejections: with the shipped file the same frames lead to NOMINAL."""
    car = Car()
    frames = encode_operation(load_operation(OPERATION), SCHEMA)
    car.tick(b"".join(frames))
    car.run_to_the_end()
    assert car.obc.ssm_output.state == lib.SSM_NOMINAL
    assert (car.commanded("brake_pressure_cmd")[-1], car.commanded("ct_report")[-1]) == (2000.0, CtState.INITIALIZED)


def test_a_lost_commit_leaves_the_full_brake() -> None:
    """Truncated on the bus instead of in the file: no verdict, no motion."""
    car = Car()
    frames = encode_operation(load_operation(OPERATION), SCHEMA)[:-1]
    car.tick(b"".join(frames))
    car.run_to_the_end()
    assert car.obc.ssm_output.state == lib.SSM_CONFIG_CHECK
    assert set(car.commanded("brake_pressure_cmd")) == {4500.0}
    assert set(car.commanded("accelerator_cmd")) == {0.0}


def test_text_of_a_good_file_is_the_shipped_one(path: Path) -> None:
    path.write_text(operation_text(dict(load_operation(OPERATION))))
    assert load_operation(path) == load_operation(OPERATION)
    assert len(b"".join(encode_operation(load_operation(path), SCHEMA))) == (len(BY_NAME) + 1) * FRAME_SIZE
