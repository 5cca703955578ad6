"""`raceloop dbw check` beside the loop one would write with python-can and cantools, on the same log, in turns."""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import can
from cantools.database.can import Database
from rich.console import Console
from rich.table import Table

from bridge.bus import CHANNELS
from bridge.scenario import Condition, Scenario
from dbc.buses import DATABASES, DIRECTORY
from dbc.network import load_database
from tools.dbw.conformance import Conformance
from tools.dbw.log_source import read_chunks
from tools.run import build_bench

TARGET_RATIO = 20.0

#: The log that is checked, simulated seconds: a million frames.
LOG_S = 190.0

#: Frames of the logs of other kinds, which python-can takes its time to write, and of the loop on them.
_OTHERS = 200_000

#: How many times longer the log is on which memory is measured again.
_LONGER = 4


@dataclass(frozen=True)
class Comparison:
    """Wall times of both on one log, in pairs, s per frame.

    Attributes
    ----------
    kind : suffix of the log.
    frames : in it.
    check, loop : times.
    """

    kind: str
    frames: int
    check: list[float]
    loop: list[float]

    @property
    def ratios(self) -> list[float]:
        """How many times as long the loop takes, pair by pair."""
        return [slow / fast for slow, fast in zip(self.loop, self.check, strict=True)]


def record(scenario: Scenario, simulated_s: float, folder: Path) -> Path:
    """Drive the beginning of a scenario; gives its candump log."""
    with build_bench(scenario) as bench:
        bench.record_to(folder)
        bench.run(until=Condition(time_us=round(simulated_s * 1e6)))
        recording = bench.finish()
    assert recording is not None
    return recording.candump


def endless(scenario: Scenario) -> Scenario:
    """A scenario without its chequered flag: the race goes on."""
    return replace(scenario, race_control=scenario.race_control[:-1])


def check(log: Path) -> int:
    """All checks; gives the number of frames."""
    conformance = Conformance()

    def broken(frame: int, text: str) -> None:
        raise AssertionError(f"frame {frame}: {text}")

    for chunk in read_chunks(log, None, broken):
        conformance.update(chunk)
    conformance.finish()
    assert not conformance.findings
    return conformance.frames


def decode(log: Path) -> int:
    """No check at all, but every signal decoded; gives the number of frames."""
    databases = _databases(log.suffix)
    count = 0
    with can.LogReader(log) as reader:
        for message in reader:
            databases[str(message.channel)].decode_message(message.arbitration_id, bytes(message.data))
            count += 1
    return count


def _databases(kind: str) -> Mapping[str, Database]:
    """By channel, as python-can calls it in a kind of log."""
    first = 1 if kind == ".trc" else 0
    named = kind == ".log"
    return {
        CHANNELS[bus] if named else str(int(bus) + first): load_database(DIRECTORY / f"{stem}.dbc")
        for stem, bus in DATABASES.items()
    }


def compare(log: Path, repeats: int) -> Comparison:
    """Both on a log, in turns."""
    frames = check(log)
    comparison = Comparison(log.suffix, frames, [], [])
    for _ in range(repeats):
        for times, work in ((comparison.check, check), (comparison.loop, decode)):
            started = time.perf_counter()
            assert work(log) == frames
            times.append((time.perf_counter() - started) / frames)
    return comparison


def convert(log: Path, count: int) -> list[Path]:
    """The first frames of a candump log, as python-can writes other kinds of log."""
    numbers = {name: int(bus) for bus, name in CHANNELS.items()}
    paths = [log.with_name(f"part{kind}") for kind in (".blf", ".asc", ".trc")]
    with can.LogReader(log) as reader:
        messages = list(islice(reader, count))
    for message in messages:
        message.channel = numbers[str(message.channel)]
    for path in paths:
        with can.Logger(path) as logger:
            for message in messages:
                logger.on_message_received(message)
    return paths


def peak_mb(log: Path) -> float:
    """Memory that the process of a check had at its most."""
    code = (
        "import sys; from tools.cli import main\n"
        "main(['dbw', 'check', sys.argv[1]])\n"
        "print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))"
    )
    out = subprocess.run([sys.executable, "-c", code, str(log)], check=True, capture_output=True, text=True).stdout
    return int(out.split()[-1]) / 1024


def bench_check(scenario: Scenario, repeats: int, console: Console, log_s: float = LOG_S) -> bool:
    """Print the figures; tells whether the target was met on the log that a drive leaves."""
    with tempfile.TemporaryDirectory(prefix="raceloop-") as folder:
        log = record(endless(scenario), log_s, Path(folder))
        comparisons = [compare(log, repeats)]
        comparisons += [compare(path, repeats) for path in convert(log, _OTHERS)]
        longer = log.with_name("longer.log")
        with longer.open("wb") as out:
            for _ in range(_LONGER):
                with log.open("rb") as source:
                    shutil.copyfileobj(source, out)
        memory = peak_mb(log), peak_mb(longer)
    console.print(
        "\ndbw check beside python-can's reader with cantools' decode_message in a loop, per frame: min, median, max"
    )
    table = Table()
    for heading in ("log", "frames", "check, us", "loop, us", "loop / check"):
        table.add_column(heading, justify="left" if heading == "log" else "right", no_wrap=True)
    for one in comparisons:
        check_us, loop_us = ([1e6 * time_s for time_s in times] for times in (one.check, one.loop))
        table.add_row(one.kind, str(one.frames), _spread(check_us, 2), _spread(loop_us, 2), _spread(one.ratios, 1))
    console.print(table)
    console.print(f"memory at most: {memory[0]:.0f} MB; with a log {_LONGER} times as long {memory[1]:.0f} MB")
    ratios = comparisons[0].ratios
    median = statistics.median(ratios)
    console.print(
        f"loop / check: min {min(ratios):.1f}, median {median:.1f}, max {max(ratios):.1f}"
        f" (target {TARGET_RATIO:g}: {'met' if median >= TARGET_RATIO else 'missed'})"
    )
    return median >= TARGET_RATIO


def _spread(values: list[float], digits: int) -> str:
    return "  ".join(f"{of(values):.{digits}f}" for of in (min, statistics.median, max))
