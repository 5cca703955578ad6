"""`raceloop dbw check` beside the loop one would write with python-can and cantools, on the same log, in turns."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

import can
from rich.console import Console

from bridge.bus import CHANNELS
from bridge.scenario import Condition, Scenario
from dbc.buses import DATABASES, DIRECTORY
from dbc.network import load_database
from tools.dbw.conformance import Conformance
from tools.dbw.log_source import read_chunks
from tools.run import build_bench

TARGET_RATIO = 20.0


def record(scenario: Scenario, simulated_s: float, folder: Path) -> Path:
    """Drive the beginning of a scenario; gives its candump log."""
    with build_bench(scenario) as bench:
        bench.record_to(folder)
        bench.run(until=Condition(time_us=round(simulated_s * 1e6)))
        recording = bench.finish()
    assert recording is not None
    return recording.candump


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
    databases = {CHANNELS[bus]: load_database(DIRECTORY / f"{stem}.dbc") for stem, bus in DATABASES.items()}
    count = 0
    with can.LogReader(log) as reader:
        for message in reader:
            databases[str(message.channel)].decode_message(message.arbitration_id, bytes(message.data))
            count += 1
    return count


def bench_check(scenario: Scenario, repeats: int, simulated_s: float, console: Console) -> bool:
    """Print the figures; tells whether the target was met."""
    with tempfile.TemporaryDirectory(prefix="raceloop-") as folder:
        log = record(scenario, simulated_s, Path(folder))
        frames = check(log)
        ours: list[float] = []
        plain: list[float] = []
        for _ in range(repeats):
            for times, work in ((ours, check), (plain, decode)):
                started = time.perf_counter()
                assert work(log) == frames
                times.append((time.perf_counter() - started) / frames)
    ratios = [slow / fast for slow, fast in zip(plain, ours, strict=True)]
    median = statistics.median(ratios)
    console.print(
        f"\ndbw check, a candump log of {frames} frames: us per frame min {min(ours) * 1e6:.2f},"
        f" median {statistics.median(ours) * 1e6:.2f}, max {max(ours) * 1e6:.2f}"
    )
    console.print(
        f"python-can's reader and cantools' decode_message in a loop: min {min(plain) * 1e6:.2f},"
        f" median {statistics.median(plain) * 1e6:.2f}, max {max(plain) * 1e6:.2f}"
    )
    console.print(
        f"loop / check: min {min(ratios):.1f}, median {median:.1f}, max {max(ratios):.1f}"
        f" (target {TARGET_RATIO:g}: {'met' if median >= TARGET_RATIO else 'missed'})"
    )
    return median >= TARGET_RATIO
