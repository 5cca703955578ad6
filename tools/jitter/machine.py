"""The machine that a measurement ran on, and what it allows."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

#: A core with more of its time taken by others is busy.
BUSY_SHARE = 0.5

#: How long cores are watched before something is measured or started on them, s.
WATCH_S = 0.5


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


def busy_share(cores: Collection[int], seconds: float) -> float:
    """Share of a stretch of time, from now on, in which cores were not idle, 0..1."""
    before = _ticks(cores)
    time.sleep(seconds)
    taken = _ticks(cores) - before
    total, idle = taken.sum(), taken[3:5].sum()  # idle, waiting for a disk
    return float(1.0 - idle / total) if total > 0 else 0.0


def _ticks(cores: Collection[int]) -> NDArray[np.int64]:
    """user, nice, system, idle, iowait, irq, softirq, steal of cores together; guest time is part of user."""
    rows = (line.split() for line in _text("/proc/stat").splitlines())
    wanted = {f"cpu{core}" for core in cores}
    ticks = [[int(word) for word in row[1:9]] for row in rows if row[0] in wanted]
    total: NDArray[np.int64] = np.array(ticks or [[0] * 8], dtype=np.int64).sum(axis=0)
    return total


def _list(path: str) -> str:
    """A list of cores as the kernel writes it; it writes "(null)" for none in some files."""
    text = _text(path)
    return "" if text == "(null)" else text


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""
