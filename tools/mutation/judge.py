"""One mutant against the tests that reach it, in a process of its own.

The process is forked from one that has everything loaded, so that a mutant costs milliseconds and a crash is its own.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import os
import resource
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from hashlib import sha256

import pytest

from tools.mutation.verdicts import Verdict

#: Extension modules that hold the firmware, each with a copy of its own.
_MODULES = ("bridge._native", "dbc._codec")

_PATIENCE_S = 1.0
_WALL_CLOCK_FACTOR = 30.0
_TROUBLES_MAX = 2
"""After so many crashes and time-outs no more tests are asked."""


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
            marks = bytes(reached)
            if any(marks):
                found.update(number for number, mark in enumerate(marks) if mark)
                ctypes.memset(reached, 0, len(reached))
        return found


@dataclass
class ReachingTest:
    """A test with what it reaches, itself and in the fixtures that it shares with others.

    Attributes
    ----------
    item : pytest's.
    seconds : CPU time that it took when no mutant was alive.
    reached : numbers of mutants.
    """

    item: pytest.Item
    seconds: float
    reached: set[int]

    @property
    def name(self) -> str:
        """Pytest's identifier of it."""
        return self.item.nodeid

    @property
    def module(self) -> str:
        """Path of its file."""
        return self.name.partition("::")[0]

    @property
    def function(self) -> str:
        """Its name without parameters."""
        return self.name.partition("[")[0]


def order(tests: Sequence[ReachingTest], favourites: Sequence[str]) -> list[ReachingTest]:
    """Favourites, one test of each function, a few more of each, and then all others.

    Siblings that differ in parameters seldom differ in what they notice. Within a round a module's tests stay together,
    cheap modules first, so that what they share is set up once.
    """
    by_function: dict[str, list[ReachingTest]] = {}
    for test in sorted(tests, key=lambda one: sha256(one.name.encode()).digest()):
        by_function.setdefault(test.function, []).append(test)
    rank = {id(test): place for siblings in by_function.values() for place, test in enumerate(siblings)}
    seconds: dict[str, list[float]] = {}
    for test in tests:
        seconds.setdefault(test.module, []).append(test.seconds)
    cost = {module: sum(taken) / len(taken) for module, taken in seconds.items()}

    def place(test: ReachingTest) -> tuple[int, int, float, str, float]:
        favour = favourites.index(test.name) if test.name in favourites else len(favourites)
        round_of = 0 if rank[id(test)] == 0 else 1 if rank[id(test)] < 4 else 2
        return favour, round_of, cost[test.module], test.module, test.seconds

    return sorted(tests, key=place)


class Judge:
    """Decides about mutants.

    Parameters
    ----------
    wake : lets the mutant of a number live.
    patience : CPU time (s) that a test of a module may take beyond `_PATIENCE_S`, by module.
    """

    def __init__(self, wake: Callable[[int], None], patience: dict[str, float]) -> None:
        self._wake, self._patience = wake, patience
        self._sound: dict[str, bool] = {}
        gc.freeze()

    def verdict(self, number: int, tests: Sequence[ReachingTest]) -> tuple[Verdict, str]:
        """What becomes of a mutant, and by which test.

        A killer must fail alone as well, and must pass alone when no mutant is alive. Where a test crashes or runs out
        of time, others are asked for a plain failure first.
        """
        troubles: list[tuple[Verdict, str]] = []
        rest = list(tests)
        while rest and len(troubles) < _TROUBLES_MAX:
            verdict, place = self._try(number, rest)
            if verdict is Verdict.SURVIVED:
                break
            test = rest[place]
            if verdict is not Verdict.KILLED:
                troubles.append((verdict, test.name))
            elif (place == 0 or self._try(number, [test])[0] is Verdict.KILLED) and self._is_sound(test):
                return verdict, test.name
            rest = rest[place + 1 :]
        return troubles[0] if troubles else (Verdict.SURVIVED, "")

    def _is_sound(self, test: ReachingTest) -> bool:
        if test.name not in self._sound:
            self._sound[test.name] = self._try(0, [test])[0] is Verdict.SURVIVED
            if not self._sound[test.name]:
                print(f"fails alone without any mutant, and is not asked: {test.name}", flush=True)
        return self._sound[test.name]

    def _try(self, number: int, tests: Sequence[ReachingTest]) -> tuple[Verdict, int]:
        """Verdict, and the place of the last test that was started."""
        read_end, write_end = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                os.close(read_end)
                self._live(number, tests, write_end)
            finally:  # whatever a mutant raises, this process must not go on as if it were its parent
                os._exit(Verdict.CRASHED)
        os.close(write_end)
        with os.fdopen(read_end, "rb") as pipe:
            started = len(pipe.read())
        _, status = os.waitpid(child, 0)
        place = max(started - 1, 0)
        if os.WIFSIGNALED(status):
            timed_out = os.WTERMSIG(status) in (signal.SIGPROF, signal.SIGALRM)
            return Verdict.TIMED_OUT if timed_out else Verdict.CRASHED, place
        return Verdict(os.WEXITSTATUS(status)), place

    def _live(self, number: int, tests: Sequence[ReachingTest], write_end: int) -> None:
        """In the child: never returns."""
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        self._wake(number)
        session = tests[0].item.session
        session.testsfailed = 0
        for place, test in enumerate(tests):
            patience = _PATIENCE_S + self._patience[test.module]
            # CPU time, which other work on the machine does not use up; the clock is for one that waits for ever.
            signal.setitimer(signal.ITIMER_PROF, patience)
            signal.setitimer(signal.ITIMER_REAL, _WALL_CLOCK_FACTOR * patience)
            os.write(write_end, b".")
            following = tests[place + 1].item if place + 1 < len(tests) else None
            test.item.config.hook.pytest_runtest_protocol(item=test.item, nextitem=following)
            if session.testsfailed:
                os._exit(Verdict.KILLED)
        os._exit(Verdict.SURVIVED)
