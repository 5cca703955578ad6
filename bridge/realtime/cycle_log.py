"""Reads the cycle log of a station: the file of firmware/ports/linux/cycle_log.h, while it grows or afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bridge._native import lib
from dbc.errors import RaceloopError

#: ``cycle_record``: one cycle.
RECORD_DTYPE = np.dtype(
    [
        ("slot", "<u8"),
        ("deadline_ns", "<u8"),
        ("wake_ns", "<u8"),
        ("received_ns", "<u8"),
        ("ticked_ns", "<u8"),
        ("sent_ns", "<u8"),
        ("newest_ns", "<u8", (lib.CYCLE_LOG_BUSES,)),
        ("cpu_ns", "<u4"),
        ("run_queue_ns", "<u4"),
        ("skipped", "<u4"),
        ("page_faults", "<u4"),
        ("preemptions", "<u2"),
        ("cpu", "<u2"),
        ("frames_in", "<u2"),
        ("frames_out", "<u2"),
        ("refused", "<u2"),
        ("tasks_run", "<u2"),
        ("reserved", "<u4"),
        ("task_us", "<u2", (lib.CYCLE_LOG_TASKS_MAX,)),
    ]
)

#: ``cycle_log_header``: start of the file.
HEADER_DTYPE = np.dtype(
    [
        ("magic", "<u4"),
        ("version", "<u4"),
        ("record_size", "<u4"),
        ("capacity", "<u4"),
        ("epoch_ns", "<u8"),
        ("phase_ns", "<u8"),
        ("period_ns", "<u8"),
        ("written", "<u8"),
        ("process", "<u4"),
        ("priority", "<i4"),
        ("cpu", "<i4"),
        ("task_count", "<u4"),
        ("name", f"S{lib.CYCLE_LOG_NAME_MAX}"),
        ("task_names", f"S{lib.CYCLE_LOG_NAME_MAX}", (lib.CYCLE_LOG_TASKS_MAX,)),
    ]
)


@dataclass(frozen=True)
class CycleLog:
    """What a station has logged.

    Attributes
    ----------
    name : of the station.
    process : its id.
    priority : SCHED_FIFO priority, or None.
    cpu : core that it is pinned to, or None.
    epoch_ns, phase_ns, period_ns : of its grid; the epoch is CLOCK_MONOTONIC.
    task_names : in the order of the bits of `tasks_run` and of the columns of `task_us`.
    records : array of `RECORD_DTYPE` in order; its times are ns on CLOCK_MONOTONIC.
    overwritten : records before the first of these, which the file no longer holds.
    """

    name: str
    process: int
    priority: int | None
    cpu: int | None
    epoch_ns: int
    phase_ns: int
    period_ns: int
    task_names: tuple[str, ...]
    records: NDArray[np.void]
    overwritten: int


def read_cycle_log(path: Path) -> CycleLog:
    """Read a cycle log.

    Raises
    ------
    RaceloopError
        When the file cannot be read or is no cycle log of this version.
    """
    try:
        size = path.stat().st_size
        if size < HEADER_DTYPE.itemsize:
            raise RaceloopError(f"{path}: no cycle log: too short")
        memory = np.memmap(path, dtype=np.uint8, mode="r")
    except OSError as error:
        raise RaceloopError(f"{path}: cannot read the cycle log: {error.strerror}") from error
    live = memory[: HEADER_DTYPE.itemsize].view(HEADER_DTYPE)
    header = live[0].copy()
    capacity = int(header["capacity"])
    expected = (lib.CYCLE_LOG_MAGIC, lib.CYCLE_LOG_VERSION, RECORD_DTYPE.itemsize)
    if (header["magic"], header["version"], header["record_size"]) != expected:
        raise RaceloopError(f"{path}: no cycle log of version {lib.CYCLE_LOG_VERSION}")
    if size != HEADER_DTYPE.itemsize + capacity * RECORD_DTYPE.itemsize:
        raise RaceloopError(f"{path}: the cycle log was cut off")
    complete = int(header["written"])
    ring = memory[HEADER_DTYPE.itemsize :].view(RECORD_DTYPE).copy()
    # What its writer may have overwritten while the ring was copied is left out, the record in the making included.
    started = int(live["written"][0]) + (1 if complete != int(live["written"][0]) else 0)
    oldest = max(0, started - capacity)
    places = np.arange(oldest, max(complete, oldest)) % capacity
    return CycleLog(
        name=_text(header["name"]),
        process=int(header["process"]),
        priority=int(header["priority"]) or None,
        cpu=int(header["cpu"]) if header["cpu"] >= 0 else None,
        epoch_ns=int(header["epoch_ns"]),
        phase_ns=int(header["phase_ns"]),
        period_ns=int(header["period_ns"]),
        task_names=tuple(_text(name) for name in header["task_names"][: int(header["task_count"])]),
        records=ring[places],
        overwritten=oldest,
    )


def _text(name: bytes) -> str:
    return name.decode("utf-8", "replace")
