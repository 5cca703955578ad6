"""What a run of pytest left in its JUnit file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

COUNTS = ("tests", "failures", "errors", "skipped")


@dataclass(frozen=True)
class Outcome:
    """How many tests there were, and how many of them did not pass."""

    tests: int
    failures: int
    errors: int
    skipped: int

    @property
    def passed(self) -> bool:
        """All of them ran and passed, and there was one at least: where CAN exists nothing may be skipped."""
        return self.tests > 0 and self.failures == self.errors == self.skipped == 0

    def __str__(self) -> str:
        return f"{self.tests} tests, {self.failures} failures, {self.errors} errors, {self.skipped} skipped"


def read_junit(file: Path) -> Outcome | None:
    """Read the counts; None where there is no complete file."""
    try:
        suites = ElementTree.parse(file).getroot().findall("testsuite")
    except (FileNotFoundError, ElementTree.ParseError):
        return None
    return Outcome(**{name: sum(int(suite.get(name, 0)) for suite in suites) for name in COUNTS})
