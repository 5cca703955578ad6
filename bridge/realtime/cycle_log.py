"""What every cycle of a station took: the file of ``firmware/ports/linux/cycle_log.h``, written and read.

The layout of the records is the C struct's own; no second description of it exists.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.realtime.timer import DeadlineTimer
from dbc.errors import ConfigurationError, RaceloopError


def _dtype(struct: str) -> np.dtype[np.void]:
    """Numpy's view of a C struct of integers, text and arrays of them."""
    names, formats, offsets = [], [], []
    for name, field in ffi.typeof(struct).fields:
        kind, shape = field.type, []
        while kind.kind == "array" and kind.item.cname != "char":
            shape.append(kind.length)
            kind = kind.item
        if kind.kind == "array":
            code = f"S{kind.length}"
        else:
            code = f"{'u' if kind.cname.startswith('u') else 'i'}{ffi.sizeof(kind)}"
        names.append(name)
        formats.append((code, tuple(shape)))
        offsets.append(field.offset)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": ffi.sizeof(struct)})


#: ``cycle_record``: one cycle.
RECORD_DTYPE = _dtype("cycle_record")
#: ``cycle_log_header``: start of the file.
HEADER_DTYPE = _dtype("cycle_log_header")

_LIBC = ctypes.CDLL(None)
_U16_MAX, _U32_MAX = 0xFFFF, 0xFFFFFFFF


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
    """Read a cycle log, also while it is written and after its writer was killed.

    Raises
    ------
    ConfigurationError
        When the file cannot be read or is no cycle log.
    """
    try:
        with path.open("rb", buffering=0) as file:
            head = _read_header(path, file.fileno())
            capacity = int(head["capacity"])
            if os.fstat(file.fileno()).st_size != HEADER_DTYPE.itemsize + capacity * RECORD_DTYPE.itemsize:
                raise ConfigurationError(path, "", "a cycle log that was cut off")
            data = os.pread(file.fileno(), capacity * RECORD_DTYPE.itemsize, HEADER_DTYPE.itemsize)
            now = _read_header(path, file.fileno())
    except OSError as error:
        raise ConfigurationError(path, "", error.strerror or "cannot be read") from error
    # What was overwritten while it was read is not used, nor the record that may be half overwritten now.
    oldest = max(0, int(now["written"]) + 1 - capacity)
    places = np.arange(oldest, max(oldest, int(head["written"])), dtype=np.int64) % capacity
    return CycleLog(
        name=_text(head["name"]),
        process=int(head["process"]),
        priority=int(head["priority"]) or None,
        cpu=int(head["cpu"]) if head["cpu"] >= 0 else None,
        epoch_ns=int(head["epoch_ns"]),
        phase_ns=int(head["phase_ns"]),
        period_ns=int(head["period_ns"]),
        task_names=tuple(_text(name) for name in head["task_names"][: int(head["task_count"])]),
        records=np.frombuffer(data, dtype=RECORD_DTYPE)[places],
        overwritten=oldest,
    )


def cycles_written(path: Path) -> int | None:
    """Cycles that a station has logged so far; None while there is no log."""
    try:
        with path.open("rb", buffering=0) as file:
            return int(_read_header(path, file.fileno())["written"])
    except (OSError, ConfigurationError):
        return None


def _read_header(path: Path, descriptor: int) -> np.void:
    data = os.pread(descriptor, HEADER_DTYPE.itemsize, 0)
    if len(data) == HEADER_DTYPE.itemsize:
        header: np.void = np.frombuffer(data, dtype=HEADER_DTYPE)[0]
        if (
            int(header["magic"]) == lib.CYCLE_LOG_MAGIC
            and int(header["version"]) == lib.CYCLE_LOG_VERSION
            and int(header["record_size"]) == RECORD_DTYPE.itemsize
            and int(header["capacity"]) > 0
        ):
            return header
    raise ConfigurationError(path, "", "no cycle log of this version of raceloop")


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "replace")


class CycleLogWriter:
    """Writes one record per cycle of the calling thread; a context manager.

    Call `wake` when the wait has returned and `write` when the cycle is done. Counts of the kernel are differences
    from one `write` to the next.

    Parameters
    ----------
    path : file to create, or None: nothing is written.
    name : of the station.
    timer : its cycle.
    capacity : records that the ring holds.
    priority, cpu : of the thread, see `CycleLog`.

    Raises
    ------
    RaceloopError
        When the file cannot be created.
    """

    def __init__(
        self,
        path: Path | None,
        name: str,
        timer: DeadlineTimer,
        capacity: int,
        priority: int | None = None,
        cpu: int | None = None,
    ) -> None:
        self._log: Any = ffi.new("cycle_log *")
        self._record: Any = ffi.new("cycle_record *")
        self._before: Any = ffi.new("thread_usage *")
        self._now: Any = ffi.new("thread_usage *")
        self._schedstat = -1
        self._timer = timer
        self._skipped = timer.skipped
        self._wake_cpu_ns = 0
        self.open = path is not None
        if path is None:
            return
        header = ffi.new("cycle_log_header *")
        header.name = name.encode()[: lib.CYCLE_LOG_NAME_MAX - 1]
        header.epoch_ns, header.phase_ns, header.period_ns = timer.epoch_ns, timer.phase_ns, timer.period_ns
        header.process, header.priority = os.getpid(), priority or 0
        header.cpu = -1 if cpu is None else cpu
        error = lib.cycle_log_create(self._log, os.fsencode(path), header, capacity)
        if error != 0:
            raise RaceloopError(f"{path}: cannot be the cycle log: {os.strerror(error)}")
        self._schedstat = lib.cycle_log_open_schedstat()
        lib.thread_usage_read(self._before, self._schedstat)

    def __enter__(self) -> CycleLogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def wake(self) -> None:
        """Note processor and processor time at the start of a cycle."""
        if self.open:
            self._wake_cpu_ns = time.thread_time_ns()
            self._record.cpu = _LIBC.sched_getcpu() & _U16_MAX

    def write(
        self,
        received_ns: int,
        ticked_ns: int,
        sent_ns: int,
        frames_in: int = 0,
        frames_out: int = 0,
        refused: int = 0,
        newest_ns: Mapping[int, int] = MappingProxyType({}),
    ) -> None:
        """Append the record of a cycle; slot, deadline and wake-up are the timer's.

        Parameters
        ----------
        received_ns, ticked_ns, sent_ns : when inputs were in, the logic done, outputs handed over; CLOCK_MONOTONIC.
        frames_in, frames_out, refused : frames received, sent, and not taken by the kernel.
        newest_ns : by bus, when the newest frame of this cycle was on it; CLOCK_MONOTONIC.
        """
        if not self.open:
            return
        record, before, now, timer = self._record, self._before, self._now, self._timer
        lib.thread_usage_read(now, self._schedstat)
        record.slot, record.deadline_ns, record.wake_ns = timer.slot, timer.deadline_ns, timer.wake_ns
        record.received_ns, record.ticked_ns, record.sent_ns = received_ns, ticked_ns, sent_ns
        for bus in range(lib.CYCLE_LOG_BUSES):
            record.newest_ns[bus] = newest_ns.get(bus, 0)
        record.cpu_ns = min(max(now.cpu_ns - self._wake_cpu_ns, 0), _U32_MAX)
        record.run_queue_ns = min(now.run_queue_ns - before.run_queue_ns, _U32_MAX)
        record.page_faults = min(now.page_faults - before.page_faults, _U32_MAX)
        record.preemptions = min(now.preemptions - before.preemptions, _U16_MAX)
        record.skipped = min(timer.skipped - self._skipped, _U32_MAX)
        record.frames_in, record.frames_out = min(frames_in, _U16_MAX), min(frames_out, _U16_MAX)
        record.refused = min(refused, _U16_MAX)
        lib.cycle_log_write(self._log, record)
        self._skipped = timer.skipped
        self._before, self._now = now, before

    def close(self) -> None:
        """Unmap the file; it stays. Safe to call twice."""
        if self._schedstat >= 0:
            os.close(self._schedstat)
            self._schedstat = -1
        lib.cycle_log_close(self._log)
        self.open = False
