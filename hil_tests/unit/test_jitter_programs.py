"""cyclictest and stress-ng beside a measurement: asked for the right thing, read rightly, ended whatever happens."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest

from dbc.errors import RaceloopError
from tools.jitter import cyclictest, load
from tools.jitter.alone import machine_limit
from tools.jitter.background import Background, find_program
from tools.jitter.cyclictest import CyclicTest, may_start, parse
from tools.jitter.load import LOADS, start_load

SECOND = 1_000_000_000

has_cyclictest = pytest.mark.skipif(find_program("cyclictest") is None, reason="cyclictest is not installed")
has_stress_ng = pytest.mark.skipif(find_program("stress-ng") is None, reason="stress-ng is not installed")


def alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def wait_until_gone(group: int) -> None:
    deadline = time.monotonic() + 10.0
    while alive(group):  # children of a child that was killed are reaped by init
        assert time.monotonic() < deadline
        time.sleep(0.01)


PARENT_OF_A_STUBBORN_CHILD = """
import os, signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
os.fork()
time.sleep(600)
"""


def test_a_group_that_does_not_want_to_end_is_ended():
    with Background("sleeper", [sys.executable, "-c", PARENT_OF_A_STUBBORN_CHILD]) as program:
        group = program.process_id
        assert program.running
    wait_until_gone(group)


def test_a_program_that_ends_by_itself():
    with Background("true", ["true"]) as program:
        program.wait(10.0)
        assert not program.running


def test_a_program_that_fails_is_reported_with_its_last_words():
    command = [sys.executable, "-c", "import sys; sys.exit('first\\nno such core')"]
    with Background("tester", command) as program, pytest.raises(RaceloopError, match=r"^tester: no such core$"):
        program.wait(10.0)


def test_a_program_that_takes_too_long_is_reported_and_ended():
    with Background("sleeper", ["sleep", "600"]) as program:
        group = program.process_id
        with pytest.raises(RaceloopError, match="sleeper has not ended in time"):
            program.wait(0.01)
    wait_until_gone(group)


def test_a_program_that_cannot_start(tmp_path: Path):
    with pytest.raises(RaceloopError, match="tester: cannot start"):
        Background("tester", [str(tmp_path / "nothing")])


def test_ended_also_when_the_measurement_is_interrupted():
    program = Background("sleeper", ["sleep", "600"])
    with pytest.raises(KeyboardInterrupt), program:
        signal.raise_signal(signal.SIGINT)
    wait_until_gone(program.process_id)


def case(tmp_path: Path, **changes: object) -> CyclicTest:
    values: dict[str, object] = {
        "period_ns": 10_000_000, "deadline_ns": 123 * SECOND + 9_000_000, "priority": 80, "cpu": 1,
        "result": tmp_path / "cyclictest.json",
    }  # fmt: skip
    return CyclicTest(**(values | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("period_ns", "deadline_ns", "offset_us"),
    [
        (10_000_000, 123 * SECOND + 9_000_000, 9_000),
        (10_000_000, 100 * SECOND + 1_239_000_000, 9_000),
        (10_000_000, 123 * SECOND, 0),
        (33_333_000, 200 * SECOND + 5_000_000, (80 * SECOND + 5_000_000) % 33_333_000 // 1000),
    ],
)
def test_its_grid_goes_through_the_deadline(tmp_path: Path, period_ns: int, deadline_ns: int, offset_us: int):
    test = case(tmp_path, period_ns=period_ns, deadline_ns=deadline_ns)
    begins = 120 * SECOND
    assert test.offset_us(begins) == offset_us
    assert (deadline_ns - (begins + test.offset_us(begins) * 1000)) % period_ns < 1000


def test_command_line(tmp_path: Path):
    command = case(tmp_path).command("cyclictest", 120 * SECOND)
    for word in ("--interval=10000", "--loops=720000", "--secaligned=9000", "--priority=80", "--affinity=1"):
        assert word in command
    without = case(tmp_path, priority=None, cpu=None).command("cyclictest", 120 * SECOND)
    assert "--policy=other" in without
    assert not [word for word in without if word.startswith(("--priority", "--affinity"))]


@pytest.mark.parametrize("fraction_ms", range(0, 1000, 50))
def test_it_is_started_when_its_first_second_is_certain(fraction_ms: int):
    """From 0.9 s on it waits a second longer; it may take half a second to get there."""
    assert may_start(77 * SECOND + fraction_ms * 1_000_000) == (fraction_ms < 400)


def result(histogram: dict[str, int], cycles: int, maximum: int) -> str:
    return json.dumps({"thread": {"0": {"histogram": histogram, "cycles": cycles, "max": maximum}}})


def test_result_is_a_distribution():
    distribution = parse(result({"48": 3, "52": 1}, 4, 52))
    assert distribution.values.tolist() == [48.0, 52.0]
    assert distribution.counts.tolist() == [3, 1]


def test_what_its_histogram_does_not_hold_counts_as_the_maximum():
    figures = parse(result({"48": 3}, 5, 250_000)).figures()
    assert (figures.count, figures.maximum) == (5, 250_000.0)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"thread": {"0": {"histogram": {"x": 1}, "cycles": 1, "max": 1}}}'])
def test_a_result_that_is_none(text: str):
    with pytest.raises(RaceloopError, match="cyclictest gave a result that cannot be read"):
        parse(text)


@has_cyclictest
def test_real_cyclictest_runs_until_it_is_stopped(tmp_path: Path):
    while not may_start(now := time.monotonic_ns()):
        time.sleep(0.05)
    test = case(tmp_path, priority=None, cpu=None, deadline_ns=now)
    started = test.start(now)
    assert started is not None
    with started:
        while time.monotonic_ns() < now + 2 * SECOND:  # it begins within the first of these
            assert started.running
            time.sleep(0.01)
        figures = test.finish(started).figures()
    assert 0 < figures.count < 500
    assert figures.minimum is not None
    assert figures.maximum is not None
    assert 0.0 <= figures.minimum <= figures.maximum


@has_cyclictest
def test_cyclictest_that_left_no_result(tmp_path: Path):
    test = case(tmp_path, priority=None, cpu=None, result=tmp_path / "nowhere" / "result.json")
    started = test.start(time.monotonic_ns())
    assert started is not None
    with started, pytest.raises(RaceloopError, match=r"^cyclictest"):
        test.finish(started)


@has_cyclictest
def test_a_core_that_does_not_exist_is_cyclictests_own_error(tmp_path: Path):
    test = case(tmp_path, priority=None, cpu=4095)
    started = test.start(time.monotonic_ns())
    assert started is not None
    with started, pytest.raises(RaceloopError, match=r"^cyclictest: "):
        started.wait(30.0)


@has_cyclictest
def test_measurement_goes_on_without_a_cyclictest_that_fails(tmp_path: Path):
    test = case(tmp_path, priority=None, cpu=4095)
    started = test.start(time.monotonic_ns())
    assert started is not None
    with started:
        machine, (note,) = machine_limit(test, started)
    assert machine is None
    assert note.startswith("cyclictest: ")
    assert note.endswith("; left out")


def test_stall_of_the_machine_is_named(tmp_path: Path):
    test = case(tmp_path)
    for maximum, notes in ((9_999, []), (33_000, ["the machine stalled: cyclictest itself woke up 33.0 ms late"])):
        test.result.write_text(result({"50": 99, str(maximum): 1}, 100, maximum))
        with Background("cyclictest", ["true"]) as started:
            started.wait(10.0)
            machine, said = machine_limit(test, started)
        assert machine is not None
        assert said == notes


def test_programs_that_are_not_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for module in (cyclictest, load):
        monkeypatch.setattr(module, "find_program", lambda _name: None)
    assert case(tmp_path).start(0) is None
    assert start_load("cpu", 1.0, tmp_path) is None


def test_programs_are_found_where_an_ordinary_user_does_not_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_program("no-such-program") is None
    assert shutil.which("cyclictest") is None
    program = tmp_path / "cyclictest"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    assert find_program("cyclictest") == str(program)


def test_all_is_every_load():
    single = [LOADS[name] for name in LOADS if name != "all"]
    assert [word for load in single for word in load] == list(LOADS["all"])


@has_stress_ng
@pytest.mark.parametrize("name", LOADS)
def test_real_load_runs_until_it_is_ended_and_leaves_nothing(tmp_path: Path, name: str):
    started = start_load(name, 60.0, tmp_path)
    assert started is not None
    with started:
        group = started.process_id
        deadline = time.monotonic() + 10.0
        while workers(group) < 1:
            assert started.running
            assert time.monotonic() < deadline
            time.sleep(0.01)
    wait_until_gone(group)
    assert list(tmp_path.iterdir()) == []


def workers(group: int) -> int:
    """Processes in a group besides its first."""
    count = 0
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        count += int(fields[2]) == group and int(status.parent.name) != group
    return count
