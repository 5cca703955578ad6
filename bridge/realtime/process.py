"""Settings of the process that a Python station runs in."""

from __future__ import annotations

import ctypes
import os
import signal

from dbc.errors import RaceloopError

_LIBC = ctypes.CDLL(None, use_errno=True)
_PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Let the kernel ask this process to stop (SIGTERM) when its parent dies."""
    if _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM) != 0:
        raise RaceloopError(f"--with-parent: {os.strerror(ctypes.get_errno())}")


def place(priority: int | None, cpu: int | None) -> None:
    """Put this process on a core and under SCHED_FIFO; `Placement.check` says beforehand whether that can be done.

    Parameters
    ----------
    priority : 1..99, or None for an ordinary process.
    cpu : core to pin it to, or None.
    """
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    if priority is not None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
