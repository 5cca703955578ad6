"""How commands that have something to put in order at their end take Ctrl-C and SIGTERM."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def asked_to_stop_is_ctrl_c() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt, so that all is put in order and nothing is left running."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def never_interrupted() -> Iterator[Callable[[], bool]]:
    """Give a function that tells whether one of them has come in; whatever runs goes on, however often they come.

    An exception out of a signal comes between any two instructions: what has just taken a lock may never return it,
    and what has just taken frames from a bus may lose them.
    """
    came = False

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal came
        came = True

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Give a function that tells whether one of them has come in; a second one acts as ever."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    came = False

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal came
        came = True
        restore()

    before = {number: signal.signal(number, note) for number in numbers}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    try:
        yield lambda: came
    finally:
        restore()
