"""cyclictest of rt-tests: the wake-up lateness that this machine has for any program."""

from __future__ import annotations

import json
import resource
from dataclasses import dataclass
from pathlib import Path

from dbc.errors import RaceloopError
from tools.jitter.background import Background, find_program
from tools.jitter.figures import Distribution

#: Debian package.
PACKAGE = "rt-tests"

#: Longest lateness that the histogram tells apart, us; what is later counts as the maximum.
_HISTOGRAM_US = 100_000

#: cyclictest begins at the next full second of CLOCK_MONOTONIC, or the one after it when less than this is left.
_MARGIN_NS = 100_000_000

#: It must have looked at the clock this long after it was started.
_START_NS = 500_000_000

_SECOND_NS = 1_000_000_000

#: It ends by itself after this, should nobody stop it.
_LONGEST_NS = 2 * 3600 * _SECOND_NS

#: How long it may take to write its result, s.
_PATIENCE_S = 10.0


@dataclass(frozen=True)
class CyclicTest:
    """One run of cyclictest, until it is stopped.

    Attributes
    ----------
    period_ns : of its thread.
    deadline_ns : any one of the deadlines of its grid, CLOCK_MONOTONIC; all others are whole periods away.
    priority : SCHED_FIFO priority, or None.
    cpu : core, or None for no pinning.
    result : file that it writes.
    """

    period_ns: int
    deadline_ns: int
    priority: int | None
    cpu: int | None
    result: Path

    def offset_us(self, second_ns: int) -> int:
        """Distance of its grid from the full second at which it begins."""
        return (self.deadline_ns - second_ns) % self.period_ns // 1000

    def command(self, program: str, second_ns: int) -> list[str]:
        """Command line; second_ns: the full second of CLOCK_MONOTONIC at which it will begin."""
        command = [
            program, "--quiet", "--threads=1", f"--interval={self.period_ns // 1000}",
            f"--loops={_LONGEST_NS // self.period_ns}", f"--secaligned={self.offset_us(second_ns)}",
            f"--histogram={_HISTOGRAM_US}", f"--json={self.result}",
            "--default-system",  # measure the machine as it is, power management included
        ]  # fmt: skip
        command += ["--policy=other"] if self.priority is None else [f"--priority={self.priority}"]
        if self.cpu is not None:
            command.append(f"--affinity={self.cpu}")
        if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY:
            command.append("--mlockall")
        return command

    def start(self, now_ns: int) -> Background | None:
        """Start it; None when there is no cyclictest. now_ns: CLOCK_MONOTONIC; must be `may_start`."""
        program = find_program("cyclictest")
        if program is None:
            return None
        return Background("cyclictest", self.command(program, (now_ns // _SECOND_NS + 1) * _SECOND_NS))

    def finish(self, started: Background) -> Distribution:
        """Stop it and read what it has found: wake-up lateness in whole microseconds, rounded down.

        Raises
        ------
        RaceloopError
            When it has failed: with its own words.
        """
        started.stop(_PATIENCE_S)
        try:
            return parse(self.result.read_text(encoding="utf-8"))
        except OSError as error:
            raise RaceloopError(f"cyclictest left no result: {error.strerror}") from error


def may_start(now_ns: int) -> bool:
    """True when a cyclictest started now begins with the next full second for certain; now_ns: CLOCK_MONOTONIC."""
    return now_ns % _SECOND_NS < _SECOND_NS - _MARGIN_NS - _START_NS


def parse(text: str) -> Distribution:
    """Read what cyclictest has written as JSON.

    Raises
    ------
    RaceloopError
        When it is not that.
    """
    try:
        thread = json.loads(text)["thread"]["0"]
        histogram = {float(value): int(count) for value, count in thread["histogram"].items()}
        beyond = int(thread["cycles"]) - sum(histogram.values())
        maximum = float(thread["max"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RaceloopError(f"cyclictest gave a result that cannot be read: {' '.join(str(error).split())}") from error
    if beyond > 0:
        histogram[maximum] = histogram.get(maximum, 0) + beyond
    return Distribution.of_histogram(histogram)
