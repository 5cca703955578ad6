"""Settings of the process that a Python station runs in (``firmware/ports/linux/realtime.h``)."""

from __future__ import annotations

from collections.abc import Callable

from bridge._native import ffi, lib
from dbc.errors import RaceloopError


def end_with_parent() -> None:
    """Let the kernel ask this process to stop (SIGTERM) when its parent dies."""
    lib.realtime_end_with_parent()


def schedule(priority: int | None, cpu: int | None) -> None:
    """Schedule the calling thread.

    Parameters
    ----------
    priority : SCHED_FIFO 1..99, or None for an ordinary thread.
    cpu : core to pin it to, or None.

    Raises
    ------
    RaceloopError
        When there is no such core or the priority is not permitted.
    """
    text = ffi.new("char[]", lib.REALTIME_TEXT_MAX)
    if lib.realtime_schedule(priority or 0, -1 if cpu is None else cpu, text) != 0:
        raise RaceloopError(ffi.string(text).decode())


def keep_memory(must: bool, say: Callable[[str], None]) -> None:
    """Keep in place what the process has used and will use, so that no cycle waits for a page; after the warm-up.

    Parameters
    ----------
    must : when it is refused, raise RaceloopError rather than say so and go on.
    say : takes a line for people.
    """
    text = ffi.new("char[]", lib.REALTIME_TEXT_MAX)
    if lib.realtime_keep_memory(text) != 0:
        line = ffi.string(text).decode()
        if must:
            raise RaceloopError(line)
        say(line)
