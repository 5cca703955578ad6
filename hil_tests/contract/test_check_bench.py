"""The benchmark of the checker does what it says, on a short stretch; and the checker's memory does not grow."""

from __future__ import annotations

import re
import tracemalloc
from pathlib import Path

from rich.console import Console

from bridge.scenario import load_scenario
from tools.check_bench import bench_check, check, decode, record
from tools.dbw.chunk import CHUNK
from tools.run import DEFAULT_SCENARIO


def test_both_read_all_frames_of_the_log(tmp_path: Path):
    log = record(load_scenario(DEFAULT_SCENARIO), 1.0, tmp_path / "out")
    lines = len(log.read_text().splitlines())
    assert check(log) == decode(log) == lines > 4000


def test_figures_are_printed_for_every_kind_of_log():
    console = Console(width=100, highlight=False, color_system=None)
    with console.capture() as captured:
        bench_check(load_scenario(DEFAULT_SCENARIO), 2, console, 0.5)
    page = captured.get()
    three = r" +(?:\d+\.\d+ +){3}│"
    rows = re.findall(rf"^│ (\.\w+) +│ +(\d+) │{three}{three} +\d+\.\d +(\d+\.\d) +\d+\.\d │$", page, re.MULTILINE)
    assert [kind for kind, _, _ in rows] == [".log", ".blf", ".asc", ".trc"]
    assert len({frames for _, frames, _ in rows}) == 1
    assert all(float(ratio) > 1 for _, _, ratio in rows)
    assert re.search(r"^memory at most: \d+ MB; with a log 4 times as long \d+ MB$", page, re.MULTILINE)
    assert re.search(r"^loop / check: .* \(target 20: (met|missed)\)$", page, re.MULTILINE)


def peak_bytes(log: Path) -> int:
    """Memory that a check takes beyond what was there."""
    tracemalloc.start()
    try:
        check(log)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_is_flat(tmp_path: Path):
    short, long = tmp_path / "short.log", tmp_path / "long.log"
    line = "({}.{:06d}) CAN1 57A#2D07{:02X}0000000000\n"
    for path, count in ((short, 3 * CHUNK), (long, 12 * CHUNK)):
        with path.open("w") as out:
            for number in range(count):
                out.write(line.format(*divmod(10_000 * number, 1_000_000), number % 256))
    check(short)  # what is loaded once is loaded now
    assert peak_bytes(long) < 1.1 * peak_bytes(short)
