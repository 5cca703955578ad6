"""The machine that a measurement ran on, and what it allows."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import dataclass
from pathlib import Path

from dbc.errors import RaceloopError

#: A core with more of its time taken by others is busy.
BUSY_SHARE = 0.5


@dataclass(frozen=True)
class Machine:
    """What decides about wake-up times on a machine.

    Attributes
    ----------
    kernel : release and version.
    preempt_rt : the kernel is fully preemptible.
    processor : model.
    cores : that this process may use.
    isolated : cores kept free of ordinary work by ``isolcpus``, as the kernel writes them; empty for none.
    nohz_full : cores without a periodic tick, as the kernel writes them; empty for none.
    governor : of the first core; empty where the kernel does not scale frequencies.
    virtual : runs under a hypervisor, whose stalls no kernel in it can avoid.
    """

    kernel: str
    preempt_rt: bool
    processor: str
    cores: tuple[int, ...]
    isolated: str
    nohz_full: str
    governor: str
    virtual: bool


def look_at_machine() -> Machine:
    """Describe the machine this runs on."""
    cpu = "/sys/devices/system/cpu"
    uname = platform.uname()
    information = _text("/proc/cpuinfo")
    models = [line.split(":", 1)[1].strip() for line in information.splitlines() if line.startswith("model name")]
    return Machine(
        kernel=f"{uname.release} {uname.version}",
        preempt_rt="PREEMPT_RT" in uname.version or _text("/sys/kernel/realtime") == "1",
        processor=models[0] if models else uname.machine,
        cores=tuple(sorted(os.sched_getaffinity(0))),
        isolated=_list(f"{cpu}/isolated"),
        nohz_full=_list(f"{cpu}/nohz_full"),
        governor=_text(f"{cpu}/cpu0/cpufreq/scaling_governor"),
        virtual=" hypervisor" in information,
    )


def choose_core(machine: Machine, wanted: int | None) -> int:
    """The core to measure on: as wanted, else the last one, which has the fewest interrupts on most machines.

    Raises
    ------
    RaceloopError
        When the core does not exist, or this process may not use it.
    """
    if wanted is None:
        return machine.cores[-1]
    if wanted not in machine.cores:
        allowed = ", ".join(str(core) for core in machine.cores)
        raise RaceloopError(f"--cpu {wanted}: no core that this process may use; allowed are {allowed}")
    return wanted


def may_have_priority(priority: int) -> bool:
    """True when this user's processes may run under SCHED_FIFO at this priority: tried, then undone."""
    policy, before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return False
    os.sched_setscheduler(0, policy, before)
    return True


def busy_share(core: int, seconds: float) -> float:
    """Share of a stretch of time, from now on, in which a core was not idle, 0..1."""
    before = _core_ticks(core)
    time.sleep(seconds)
    after = _core_ticks(core)
    total = sum(after) - sum(before)
    idle = sum(after[3:5]) - sum(before[3:5])  # idle, waiting for a disk
    return 1.0 - idle / total if total > 0 else 0.0


def _core_ticks(core: int) -> list[int]:
    """user, nice, system, idle, iowait, irq, softirq, steal of one core; guest time is part of user."""
    for line in _text("/proc/stat").splitlines():
        if line.startswith(f"cpu{core} "):
            return [int(word) for word in line.split()[1:9]]
    return [0] * 8


def _list(path: str) -> str:
    """A list of cores as the kernel writes it; it writes "(null)" for none in some files."""
    text = _text(path)
    return "" if text == "(null)" else text


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""
