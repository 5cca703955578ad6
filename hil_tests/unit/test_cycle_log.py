"""Cycle logs: written through the C code, read while they grow, after a kill, and never mistaken for something else."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bridge._native import lib
from bridge.realtime.cycle_log import HEADER_DTYPE, RECORD_DTYPE, CycleLogWriter, read_cycle_log
from bridge.realtime.timer import DeadlineTimer
from dbc.errors import ConfigurationError, RaceloopError

PERIOD_NS = 1_000_000


def cycles(log: CycleLogWriter, timer: DeadlineTimer, count: int) -> None:
    for _ in range(count):
        assert timer.wait()
        log.wake()
        now_ns = timer.wake_ns
        log.write(now_ns + 1, now_ns + 2, now_ns + 3, frames_in=4, frames_out=5, refused=6, newest_ns={2: now_ns - 7})


@pytest.fixture
def timer() -> DeadlineTimer:
    return DeadlineTimer(lib.monotonic_ns(), phase_ns=300_000, period_ns=PERIOD_NS)


def test_records_carry_what_was_measured(tmp_path: Path, timer: DeadlineTimer):
    path = tmp_path / "log"
    with CycleLogWriter(path, "plant", timer, capacity=100, priority=12, cpu=1) as writer:
        cycles(writer, timer, 5)
        log = read_cycle_log(path)  # while the writer lives
        cycles(writer, timer, 1)
    assert (log.name, log.priority, log.cpu, log.task_names, log.overwritten) == ("plant", 12, 1, (), 0)
    assert (log.epoch_ns, log.phase_ns, log.period_ns) == (timer.epoch_ns, 300_000, PERIOD_NS)
    records = log.records
    assert len(records) == 5
    assert len(read_cycle_log(path).records) == 6
    assert np.array_equal(records["deadline_ns"], timer.epoch_ns + 300_000 + records["slot"] * PERIOD_NS)
    assert np.all(records["wake_ns"] >= records["deadline_ns"])
    assert np.array_equal(records["sent_ns"] - records["wake_ns"], np.full(5, 3))
    assert np.array_equal(records["newest_ns"][:, 2], records["wake_ns"] - 7)
    assert not records["newest_ns"][:, [0, 1, 3]].any()
    for field, value in (("frames_in", 4), ("frames_out", 5), ("refused", 6), ("tasks_run", 0)):
        assert np.array_equal(records[field], np.full(5, value)), field
    assert np.array_equal(np.diff(records["slot"]), 1 + records["skipped"][1:])
    assert np.all(records["cpu_ns"] > 0)
    assert np.all(records["cpu"] < 4096)


def test_a_full_ring_keeps_the_newest_in_order(tmp_path: Path, timer: DeadlineTimer):
    path = tmp_path / "log"
    with CycleLogWriter(path, "x", timer, capacity=8) as writer:
        cycles(writer, timer, 21)
    log = read_cycle_log(path)
    # The place after the newest may be half overwritten when a writer is killed, so one record fewer than fits.
    assert len(log.records) == 7
    assert log.overwritten == 14
    assert log.records["slot"][-1] == timer.slot
    assert np.all(np.diff(log.records["slot"]) > 0)
    assert (log.priority, log.cpu) == (None, None)


def test_without_a_file_nothing_is_written(tmp_path: Path, timer: DeadlineTimer):
    with CycleLogWriter(None, "x", timer, capacity=8) as writer:
        cycles(writer, timer, 2)
    assert list(tmp_path.iterdir()) == []


def test_it_outlives_a_writer_that_is_killed(tmp_path: Path):
    path = tmp_path / "log"
    program = f"""
from pathlib import Path
from bridge._native import lib
from bridge.realtime.cycle_log import CycleLogWriter
from bridge.realtime.timer import DeadlineTimer
timer = DeadlineTimer(lib.monotonic_ns(), period_ns={PERIOD_NS})
log = CycleLogWriter(Path({str(path)!r}), "x", timer, capacity=1000)
for number in range(1 << 60):
    timer.wait()
    log.wake()
    log.write(timer.wake_ns, timer.wake_ns, timer.wake_ns)
    if number == 20:
        print("running", flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"running\n"
        process.send_signal(signal.SIGKILL)
    log = read_cycle_log(path)
    assert log.process == process.pid
    assert len(log.records) >= 20
    assert np.all(np.diff(log.records["slot"]) > 0)


def test_what_is_no_cycle_log_is_one_line(tmp_path: Path, timer: DeadlineTimer):
    path = tmp_path / "log"
    with CycleLogWriter(path, "x", timer, capacity=8) as writer:
        cycles(writer, timer, 2)
    whole = path.read_bytes()
    assert len(whole) == HEADER_DTYPE.itemsize + 8 * RECORD_DTYPE.itemsize
    version = np.frombuffer(whole, HEADER_DTYPE, 1).copy()
    version["version"] += 1
    for content, complaint in (
        (b"", "no cycle log"),
        (b"once upon a time " * 100, "no cycle log"),
        (version.tobytes() + whole[HEADER_DTYPE.itemsize :], "no cycle log"),
        (whole[:-1], "cut off"),
        (whole[: HEADER_DTYPE.itemsize], "cut off"),
        (whole[: HEADER_DTYPE.itemsize - 1], "no cycle log"),
    ):
        path.write_bytes(content)
        with pytest.raises(ConfigurationError, match=complaint) as caught:
            read_cycle_log(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)
    with pytest.raises(ConfigurationError, match="No such file"):
        read_cycle_log(tmp_path / "none")
    with pytest.raises(ConfigurationError, match="directory"):
        read_cycle_log(tmp_path)


def test_a_log_that_cannot_be_created_is_one_line(tmp_path: Path, timer: DeadlineTimer):
    with pytest.raises(RaceloopError, match=r"none/log: cannot be the cycle log: No such file"):
        CycleLogWriter(tmp_path / "none" / "log", "x", timer, capacity=8)


def test_timer_refuses_a_period_that_is_none():
    for period_ns in (0, -1, 1_000_000_001):
        with pytest.raises(ValueError, match="period"):
            DeadlineTimer(0, 0, period_ns)
