"""Which process of a real-time run gets which core and which priority.

Without a priority every process is an ordinary one. With one:

- The ECUs get it. They sleep most of the time, and at their phases they are never due at once.
- The hub comes directly below. Its turn is between the cycles of the ECUs, so a flood on a bus delays no cycle; a frame
  is stamped when the kernel takes it in, so the hub's turn moves no stamp either.
- Plant and autonomy come below the hub, plant first, because its phase is the first of a period.
- Observer and recorder stay ordinary: they read what queues have kept for them.

With a core, ECUs and hub get that core and everything else gets the others, if there are any.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum

from dbc.errors import RaceloopError

PRIORITIES = range(1, 100)
"""Of SCHED_FIFO."""


class Role(IntEnum):
    """What a process does; the value is how far its priority lies below that of the ECUs."""

    ECU = 0
    HUB = 1
    PLANT = 2
    AUTONOMY = 3


@dataclass(frozen=True)
class Placement:
    """Cores and priorities of a run.

    Attributes
    ----------
    priority : SCHED_FIFO priority of the ECUs, or None.
    cpu : core of ECUs and hub, or None for all that the process may use.
    """

    priority: int | None = None
    cpu: int | None = None

    def check(self) -> None:
        """See whether this process may place others like that.

        Raises
        ------
        RaceloopError
            When the core does not exist or the priority is not permitted.
        """
        cores = os.sched_getaffinity(0)
        if self.cpu is not None and self.cpu not in cores:
            known = ", ".join(str(core) for core in sorted(cores))
            raise RaceloopError(f"--cpu {self.cpu}: no such core for this process; allowed are {known}")
        if self.priority is not None:
            _check_priority(self.priority)

    def options(self, role: Role) -> list[str]:
        """Options that a station's or the hub's command line gets."""
        options = []
        if self.priority is not None:
            options += ["--priority", str(max(self.priority - role, PRIORITIES.start))]
        if self.cpu is not None and role in (Role.ECU, Role.HUB):
            options += ["--cpu", str(self.cpu)]
        return options

    def other_cores(self, available: Set[int]) -> set[int]:
        """Cores for everything but ECUs and hub; with a single core, that one."""
        return set(available) - {self.cpu} or set(available)

    @contextmanager
    def on_other_cores(self) -> Iterator[None]:
        """Keep this process off the core of the ECUs, and with it what it starts meanwhile."""
        before = os.sched_getaffinity(0)
        os.sched_setaffinity(0, self.other_cores(before))
        try:
            yield
        finally:
            os.sched_setaffinity(0, before)


def _check_priority(priority: int) -> None:
    if priority not in PRIORITIES:
        raise RaceloopError(f"--priority {priority}: must be {PRIORITIES.start} to {PRIORITIES.stop - 1}")
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError as error:
        raise RaceloopError(
            f"--priority {priority}: not permitted; run as root, or allow it with 'ulimit -r {priority}'"
            " (rtprio in /etc/security/limits.conf)"
        ) from error
    os.sched_setscheduler(0, policy, parameters)
