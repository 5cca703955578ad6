"""A cell of the reaction matrix complains when the car is not what the fault table says: the table is altered here."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace

import pytest

from bridge.faults.provocations import Detection
from tools.reactions.cells import Cell, Matrix
from tools.reactions.run import Measurement, run_cell
from tools.reactions.states import OperatingStates

MATRIX = Matrix()


@pytest.fixture(scope="module")
def states() -> Iterator[OperatingStates]:
    driven = OperatingStates()
    yield driven
    driven.close()


@pytest.fixture
def matrix() -> Matrix:
    found = copy.copy(MATRIX)
    found.faults = dict(found.faults)
    found.provocations = {layer: dict(rows) for layer, rows in found.provocations.items()}
    return found


def run(matrix: Matrix, states: OperatingStates, name: str, duration: str = "at", layer: str = "ssm") -> Measurement:
    return run_cell(matrix, states.at("standstill"), Cell(layer, name, "standstill", duration))


@pytest.mark.parametrize(
    ("name", "duration", "change", "words"),
    [
        ("estimate_bad", "permanent", {"debounce_ms": 110, "deadline_ms": 130}, "fault_event: at"),
        ("estimate_bad", "permanent", {"debounce_ms": 60, "deadline_ms": 70}, "fault_event: not seen"),
        ("estimate_bad", "permanent", {"reaction": "safe_stop"}, "reaction safe_stop on CAN-A: not seen"),
        ("estimate_bad", "at", {"clear_ms": 1500}, "cleared: at"),
        ("estimate_bad", "at", {"clear_ms": 500}, "cleared: "),
        ("estimate_bad", "at", {"latch": "until_reset"}, "before any reset"),
        ("estimate_bad", "below", {"debounce_ms": 110}, "where nothing is allowed"),
        ("imu_frozen", "at", {"latch": "until_restart"}, "it lasts until a restart"),
        ("sd_failure", "at", {"latch": "until_reset"}, "cleared by the reset: not seen"),
    ],
)
def test_another_table_is_noticed(
    matrix: Matrix, states: OperatingStates, name: str, duration: str, change: dict[str, object], words: str
) -> None:
    assert run(matrix, states, name, duration).complaints == []
    matrix.faults[name] = replace(matrix.faults[name], **change)
    assert any(words in complaint for complaint in run(matrix, states, name, duration).complaints)


def test_a_companion_that_is_not_named_is_noticed(matrix: Matrix, states: OperatingStates) -> None:
    known = matrix.provocations["ssm"]["gnss_a_timeout"]
    matrix.provocations["ssm"]["gnss_a_timeout"] = replace(known, companions=())
    (complaint,) = run(matrix, states, "gnss_a_timeout", "permanent").complaints
    assert complaint.startswith("unexpected fault gnss_a_low_rate")


def test_a_condition_that_begins_earlier_than_it_is_detected_is_noticed(
    matrix: Matrix, states: OperatingStates
) -> None:
    known = matrix.provocations["ssm"]["imu_timeout"]
    matrix.provocations["ssm"]["imu_timeout"] = replace(known, detection=Detection(since_last=True))
    complaints = run(matrix, states, "imu_timeout", "permanent").complaints
    assert any(complaint.startswith(("fault_event: not seen", "fault_event: at")) for complaint in complaints)


def test_a_broken_safety_property_is_noticed(matrix: Matrix, states: OperatingStates) -> None:
    known = matrix.provocations["ssm"]["second_computer"]
    matrix.provocations["ssm"]["second_computer"] = replace(known, excused=())
    assert any("SAFE-17" in complaint for complaint in run(matrix, states, "second_computer").complaints)


def test_the_lower_layers_are_judged_as_well(matrix: Matrix, states: OperatingStates) -> None:
    known = matrix.provocations["space_drive"]["brake_request_crc"]
    matrix.provocations["space_drive"]["brake_request_crc"] = replace(known, diagnostic=("est1_oos_front_brk",))
    complaints = run(matrix, states, "brake_request_crc", layer="space_drive").complaints
    assert [complaint.split(":")[0] for complaint in complaints] == ["est1_oos_front_brk"]
    matrix.provocations["space_drive"]["brake_request_crc"] = replace(known, reaction="warn")
    complaints = run(matrix, states, "brake_request_crc", layer="space_drive").complaints
    assert "the Raptor is in EMERGENCY_SHUTDOWN" in complaints


def test_a_state_is_the_same_however_often_it_is_taken(states: OperatingStates) -> None:
    first = states.at("launch")
    before = (first.now_us, first.truth)
    first.run_for(0.5)
    assert (first.now_us, first.truth) != before
    again = states.at("launch")
    assert (again.now_us, again.truth) == before
