"""The reaction matrix: every fault in every operating state for several durations, each cell measured and judged.

`make matrix` runs all cells; a share of them, one of each fault, runs with every other test. See docs/reactions.md.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bridge.faults.provocations import OPERATING_STATES, Duration
from tools.reactions.cells import Cell, Matrix
from tools.reactions.report import as_row
from tools.reactions.run import run_cell
from tools.reactions.states import OperatingStates

MATRIX = Matrix()
CELLS = list(MATRIX.cells())
SHARE = MATRIX.share()


def parameter(cell: Cell) -> object:
    marks = [pytest.mark.matrix(share=cell in SHARE), pytest.mark.xdist_group(f"{cell.layer}-{cell.name}")]
    return pytest.param(cell, id=str(cell), marks=marks)


@pytest.fixture(scope="session")
def states(request: pytest.FixtureRequest) -> Iterator[OperatingStates]:
    driven = OperatingStates(request.config.getoption("--raceloop-seed"))
    yield driven
    driven.close()


@pytest.mark.parametrize("cell", [parameter(cell) for cell in CELLS])
def test_cell(states: OperatingStates, cell: Cell, request: pytest.FixtureRequest) -> None:
    measured = run_cell(MATRIX, states.at(cell.state), cell)
    request.node.user_properties.append(("reaction", as_row(measured)))
    again = f"again: pytest '{request.node.nodeid.partition('@')[0]}'"
    assert measured.complaints == [], again


def test_the_matrix_has_its_cells() -> None:
    assert len(CELLS) == len(set(CELLS)) >= 600
    assert {cell.state for cell in SHARE} == set(OPERATING_STATES)
    assert {cell.duration for cell in SHARE} == {duration.value for duration in Duration}
    provocations = [one for layer in MATRIX.provocations.values() for one in layer.values()]
    # The car of the solo lap drives alone.
    provoked = {(one.layer, one.name) for one in provocations if one.plans and not one.perception}
    assert {(cell.layer, cell.name) for cell in SHARE} == provoked
