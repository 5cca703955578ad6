"""Priority, processor and memory of a process, as the kernel then says; in a process of their own."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

LIMIT_S = 60.0
PRELUDE = """
import os
from bridge._native import ffi, lib
text = ffi.new("char[]", lib.REALTIME_TEXT_MAX)
"""


def run(code: str) -> list[str]:
    """Lines that the code prints."""
    done = subprocess.run(
        [sys.executable, "-c", PRELUDE + code], capture_output=True, text=True, timeout=LIMIT_S, check=True
    )
    return done.stdout.splitlines()


def test_a_process_runs_on_the_processor_it_is_given():
    cpu = max(os.sched_getaffinity(0))
    lines = run(f"print(lib.realtime_schedule(0, {cpu}, text), ffi.string(text), os.sched_getaffinity(0))")
    assert lines == [f"0 b'' {{{cpu}}}"]


@pytest.mark.parametrize("cpu", [1023, 1024, 10**6])
def test_a_processor_that_does_not_exist(cpu: int):
    error, text, kept = run(
        f"before = os.sched_getaffinity(0)\nprint(lib.realtime_schedule(0, {cpu}, text))\n"
        "print(ffi.string(text).decode())\nprint(os.sched_getaffinity(0) == before)"
    )
    assert (int(error) != 0, kept) == (True, "True")
    assert re.fullmatch(rf"no processor {cpu} for this process: allowed are [0-9,-]+", text)


def test_a_priority_is_not_passed_on_to_children():
    """As far as this user may have one."""
    error, scheduler, priority, child = run(
        "print(lib.realtime_schedule(7, -1, text))\n"
        "print(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO)\n"
        "print(os.sched_getparam(0).sched_priority)\n"
        "import subprocess, sys\n"
        "print(subprocess.run([sys.executable, '-c', 'import os; print(os.sched_getscheduler(0))'],"
        " capture_output=True, text=True).stdout.strip())"
    )
    if int(error) == 0:
        assert (scheduler, priority, child) == ("True", "7", str(os.SCHED_OTHER))
    else:
        assert (scheduler, priority) == ("False", "0")


def test_wake_ups_are_exact_without_a_priority():
    (slack,) = run("lib.realtime_schedule(0, -1, text)\nprint(open('/proc/self/timerslack_ns').read().strip())")
    assert slack == "1"


@pytest.mark.parametrize("function", ["realtime_lock_memory", "realtime_keep_memory"])
def test_memory_is_locked_or_the_line_says_how_to_allow_it(function: str):
    error, text, locked = run(
        f"print(lib.{function}(text))\nprint(ffi.string(text).decode())\n"
        "print([line for line in open('/proc/self/status') if line.startswith('VmLck')][0].split()[1])"
    )
    if int(error) == 0:
        assert text == ""
        assert int(locked) > 0
    else:
        assert "ulimit -l unlimited" in text
        assert int(locked) == 0
