"""What became of each mutant, kept in a file so that a run can go on where the last one stopped."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import IntEnum
from pathlib import Path


class Verdict(IntEnum):
    """What became of a mutant."""

    SURVIVED = 0
    KILLED = 1
    CRASHED = 2
    TIMED_OUT = 3
    NOT_REACHED = 4


@dataclass(frozen=True)
class Row:
    """A verdict and what it rests on.

    Attributes
    ----------
    mutant : its key.
    project : digest of all that is not a test module: with another one the verdict is void.
    verdict : name of a `Verdict`.
    by : test that killed it, or was the first to crash or to run out of time.
    tests : how many tests reach it.
    modules : digest of each test module that had its say, by path; of a killed mutant the killer's only.
    """

    mutant: str
    project: str
    verdict: str
    by: str
    tests: int
    modules: Mapping[str, str]

    def unheard(self, project: str, modules: Mapping[str, str]) -> set[str]:
        """Those of `modules` that have not had their say in their present form."""
        if self.project != project:
            return set(modules)
        changed = {name for name, digest in modules.items() if self.modules.get(name) != digest}
        if Verdict[self.verdict] is not Verdict.KILLED:
            return changed
        return set() if self.modules.items() <= modules.items() else set(modules)


def load(path: Path) -> dict[str, Row]:
    """Newest row of each mutant; a line that was cut off is left out."""
    rows: dict[str, Row] = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            row = Row(**json.loads(line))
        except ValueError:
            continue
        rows[row.mutant] = row
    return rows


def append(path: Path, row: Row) -> None:
    """Add a row, in one write so that several processes may do it."""
    with path.open("a") as lines:
        lines.write(json.dumps(asdict(row)) + "\n")
