"""pytest plug-in: once through the tests with no mutant alive, then each mutant against the tests that reach it.

A mutant gets a process of its own, forked from this one, so that nothing has to be loaded again and a crash is its own.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from typing import Any

import pytest

#: Extension modules that hold the firmware, each with a copy of its own.
_MODULES = ("bridge._native", "dbc._codec")

_PATIENCE_S = 20.0


class Verdict(IntEnum):
    """What became of a mutant."""

    SURVIVED = 0
    KILLED = 1
    CRASHED = 2
    TIMED_OUT = 3
    NOT_REACHED = 4


class Switch:
    """The numbers in the extension modules that say which mutant is alive.

    Parameters
    ----------
    count : of mutants.
    """

    def __init__(self, count: int) -> None:
        libraries = [ctypes.CDLL(str(importlib.import_module(name).__file__)) for name in _MODULES]
        self._alive = [ctypes.c_uint32.in_dll(library, "mutation_alive") for library in libraries]
        self._reached = [(ctypes.c_uint8 * (count + 1)).in_dll(library, "mutation_reached") for library in libraries]

    def wake(self, number: int) -> None:
        """Let one mutant live."""
        for alive in self._alive:
            alive.value = number

    def take_reached(self) -> set[int]:
        """Mutants that were reached since this was asked last."""
        found: set[int] = set()
        for reached in self._reached:
            found.update(number for number, mark in enumerate(bytes(reached)) if mark)
            ctypes.memset(reached, 0, len(reached))
        return found


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that the command passes."""
    parser.addoption("--mutants", type=int, help="how many there are")
    parser.addoption("--mutants-out", type=Path, help="file for the verdicts")
    parser.addoption("--mutants-part", default="0/1", help="which of how many parts")


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool:
    """Run the tests, and then the mutants."""
    count = session.config.getoption("--mutants")
    part, parts = map(int, session.config.getoption("--mutants-part").split("/"))
    switch = Switch(count)
    tests = _baseline(session, switch)
    out: Path = session.config.getoption("--mutants-out")
    with out.open("w") as lines:
        for number in range(1 + part, count + 1, parts):
            reaching = sorted((one for one in tests if number in one.reached), key=lambda one: one.seconds)
            verdict, test = _judge(switch, number, reaching)
            json.dump({"mutant": number, "verdict": verdict.name, "tests": len(reaching), "by": test}, lines)
            lines.write("\n")
            lines.flush()
    return True


class _Test:
    """A test with what it reaches."""

    def __init__(self, item: pytest.Item, seconds: float, reached: set[int]) -> None:
        self.item, self.seconds, self.reached = item, seconds, reached


def _baseline(session: pytest.Session, switch: Switch) -> list[_Test]:
    tests = []
    for place, item in enumerate(session.items):
        following = session.items[place + 1] if place + 1 < len(session.items) else None
        switch.take_reached()
        started = time.perf_counter()
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        tests.append(_Test(item, time.perf_counter() - started, switch.take_reached()))
    if session.testsfailed:
        raise session.Failed("a test fails without any mutant")
    return tests


def _judge(switch: Switch, number: int, reaching: list[_Test]) -> tuple[Verdict, str]:
    """Run the tests in a child until one fails."""
    if not reaching:
        return Verdict.NOT_REACHED, ""
    patience_s = _PATIENCE_S + 10.0 * sum(test.seconds for test in reaching)
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read_end)
        _live(switch, number, reaching, write_end)
    os.close(write_end)
    with _alarm(child, patience_s), os.fdopen(read_end) as pipe:
        test = pipe.read()
        _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        killed_by = os.WTERMSIG(status)
        return (Verdict.TIMED_OUT if killed_by == signal.SIGKILL else Verdict.CRASHED), signal.Signals(killed_by).name
    return Verdict(os.WEXITSTATUS(status)), test


def _live(switch: Switch, number: int, reaching: list[_Test], write_end: int) -> None:
    """In the child: never returns."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    switch.wake(number)
    session = reaching[0].item.session
    session.testsfailed = 0
    for place, test in enumerate(reaching):
        following = reaching[place + 1].item if place + 1 < len(reaching) else None
        test.item.config.hook.pytest_runtest_protocol(item=test.item, nextitem=following)
        if session.testsfailed:
            os.write(write_end, test.item.nodeid.encode())
            os._exit(Verdict.KILLED)
    os._exit(Verdict.SURVIVED)


@contextmanager
def _alarm(child: int, seconds: float) -> Iterator[None]:
    """Kill a child that takes too long."""

    def kill(*_: Any) -> None:
        os.kill(child, signal.SIGKILL)

    before = signal.signal(signal.SIGALRM, kill)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
