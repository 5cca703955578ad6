"""Cells of the reaction matrix: one fault in one operating state for one duration."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import scenarios
from bridge.faults.provocations import OPERATING_STATES, Duration, Provocation, Provoker, load_provocations
from bridge.safety.track import TrackEdges
from bridge.scenario import Scenario
from dbc.codec import Codec, profile
from firmware.tables import Fault, own_faults
from tools.reactions.states import SCENARIO
from tools.run import load_road

PROVOCATIONS_FILE = scenarios.DIRECTORY / "campaigns" / "provocations.yaml"


@dataclass(frozen=True, order=True)
class Cell:
    """One fault, brought about in one operating state for one duration."""

    layer: str
    name: str
    state: str
    duration: str

    def __str__(self) -> str:
        """As in the test's id."""
        return f"{self.layer}-{self.name}-{self.state}-{self.duration}"


@dataclass
class Matrix:
    """All that the cells are made from.

    Parameters
    ----------
    scenario : the run that the states are taken from; without perception it has the faults of a car that drives alone,
        with perception those of perception alone.

    Attributes
    ----------
    provocations : by layer and name.
    provoker : for the operation file that the states are driven with.
    faults : the fault table, by name.
    """

    scenario: Scenario = SCENARIO
    database: Codec = field(init=False)
    provocations: Mapping[str, Mapping[str, Provocation]] = field(init=False)
    provoker: Provoker = field(init=False)
    faults: Mapping[str, Fault] = field(init=False)

    def __post_init__(self) -> None:
        self.database = profile(self.scenario.profile)
        self.provocations = load_provocations(PROVOCATIONS_FILE, self.database)
        self.provoker = Provoker(self.scenario.operation, self.database)
        self.faults = {fault.name: fault for fault in own_faults()}

    def cells(self) -> Iterator[Cell]:
        """Every cell that exists: those of one fault side by side."""
        for layer, provocations in self.provocations.items():
            for name, provocation in provocations.items():
                if not self.provoker.suits(provocation):
                    continue
                for state in OPERATING_STATES:
                    if state not in provocation.exceptions:
                        yield from (
                            Cell(layer, name, state, duration.value)
                            for duration in Duration
                            if self._exists(provocation, state, duration)
                        )

    @cached_property
    def edges(self) -> TrackEdges:
        """Of the track that the states are on."""
        return TrackEdges(*load_road(self.scenario, self.scenario.track).boundaries())

    def share(self) -> frozenset[Cell]:
        """A cell of every fault, chosen at random and always the same, so that states and durations take turns."""
        choice = random.Random(1)
        by_fault: dict[tuple[str, str], list[Cell]] = {}
        for cell in self.cells():
            by_fault.setdefault((cell.layer, cell.name), []).append(cell)
        return frozenset(choice.choice(cells) for cells in by_fault.values())

    def provocation(self, cell: Cell) -> Provocation:
        """How the cell's fault is brought about."""
        return self.provocations[cell.layer][cell.name]

    def debounce_cycles(self, cell: Cell) -> int:
        """Ticks that the condition must last; what is not the SSM's has its times in the provocation."""
        return self.faults[cell.name].debounce_cycles if cell.layer == "ssm" else 1

    def supervised(self, cell: Cell) -> bool:
        """False when the fault table leaves the fault out in the operating state."""
        return cell.layer != "ssm" or self._supervised(cell.name, cell.state)

    def _supervised(self, name: str, state: str) -> bool:
        return self.faults[name].supervised != "driving" or state != "standstill"

    def _exists(self, provocation: Provocation, state: str, duration: Duration) -> bool:
        if provocation.layer == "ssm" and not self._supervised(provocation.name, state):
            return duration is Duration.PERMANENT  # it must not be answered, however long it lasts
        cycles = self.faults[provocation.name].debounce_cycles if provocation.layer == "ssm" else 1
        return self.provoker.plans(provocation, duration, cycles) is not None
