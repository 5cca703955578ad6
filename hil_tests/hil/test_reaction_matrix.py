"""The reaction matrix: every fault in every operating state for several durations, each cell measured and judged.

`make matrix` runs all cells; a share of them, one of each fault, runs with every other test. See docs/reactions.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pytest

from bridge.faults.provocations import OPERATING_STATES, Duration
from tools.reactions.cells import Cell, Matrix
from tools.reactions.report import as_row
from tools.reactions.run import run_cell
from tools.reactions.states import SCENARIO, SEEING, OperatingStates

#: The car that drives alone, and the one that sees others.
ALONE, WITH_PERCEPTION = Matrix(SCENARIO), Matrix(SEEING)
MATRICES = {cell: matrix for matrix in (ALONE, WITH_PERCEPTION) for cell in matrix.cells()}
SHARE = ALONE.share() | WITH_PERCEPTION.share()


def parameter(cell: Cell) -> object:
    marks = [pytest.mark.matrix(share=cell in SHARE), pytest.mark.xdist_group(f"{cell.layer}-{cell.name}")]
    return pytest.param(cell, id=str(cell), marks=marks)


@pytest.fixture(scope="session")
def states(request: pytest.FixtureRequest) -> Iterator[Mapping[str, OperatingStates]]:
    """By the scenario's perception."""
    seed = request.config.getoption("--raceloop-seed")
    driven = {scenario.perception: OperatingStates(scenario, seed) for scenario in (SCENARIO, SEEING)}
    yield driven
    for each in driven.values():
        each.close()


@pytest.mark.parametrize("cell", [parameter(cell) for cell in MATRICES])
def test_cell(states: Mapping[str, OperatingStates], cell: Cell, request: pytest.FixtureRequest) -> None:
    matrix = MATRICES[cell]
    measured = run_cell(matrix, states[matrix.scenario.perception].at(cell.state), cell)
    request.node.user_properties.append(("reaction", as_row(measured)))
    again = f"again: pytest '{request.node.nodeid.partition('@')[0]}'"
    assert measured.complaints == [], again


def test_the_matrix_has_its_cells() -> None:
    assert len(MATRICES) == len(list(ALONE.cells())) + len(list(WITH_PERCEPTION.cells())) >= 600
    assert {cell.state for cell in SHARE} == set(OPERATING_STATES)
    assert {cell.duration for cell in SHARE} == {duration.value for duration in Duration}
    provocations = [one for layer in ALONE.provocations.values() for one in layer.values()]
    provoked = {(one.layer, one.name) for one in provocations if one.plans}
    assert {(cell.layer, cell.name) for cell in SHARE} == provoked
