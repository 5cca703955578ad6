"""A measurement as a Perfetto trace: cycles and tasks of every station, frames on every bus, the worst cycles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dbc.codec import database
from dbc.frames import Bus, Flag, iterate
from tools.jitter.measurement import Cycles, Measurement
from tools.jitter.perfetto import Trace


def trace_of(measurements: Sequence[Measurement]) -> Trace:
    """Put measurements one after the other on one time line."""
    trace = Trace()
    buses = _BusTracks(trace)
    for measurement in measurements:
        stations = {measurement.ecu.name: measurement.cycles, **measurement.stations}
        for name, cycles in stations.items():
            worst = measurement.worst() if cycles is measurement.cycles else []
            _add_station(
                trace, f"{name}, {measurement.condition}", cycles, {cycle.slot: cycle.cause for cycle in worst}
            )
        buses.add(measurement.frames, measurement.cycles.log.epoch_ns)
    return trace


def _add_station(trace: Trace, name: str, cycles: Cycles, worst: dict[int, str]) -> None:
    """A station as a process: its cycles as slices, its lateness as a counter, marks for what stands out."""
    log = cycles.log
    process = trace.process(log.process, name)
    thread = trace.thread(log.process, f"{log.name} cycle")
    lateness = trace.counter("wake-up lateness", "us", process)
    marks = trace.track("worst, skipped and overrun cycles", process)
    for record, late_us in zip(log.records, cycles.times.lateness.tolist(), strict=True):
        slot, deadline, wake, received, ticked, sent = (int(value) for value in record.item()[:6])
        trace.value(lateness, wake, late_us)
        if record["skipped"]:
            trace.instant(marks, deadline, f"{record['skipped']} cycles skipped")
        if slot in worst:
            trace.begin(marks, deadline, f"worst: {worst[slot]}", slot=slot)
            trace.end(marks, sent)
        if sent > deadline + log.period_ns:
            trace.instant(marks, sent, "overrun")
        trace.begin(
            thread,
            wake,
            "cycle",
            slot=slot,
            late_us=late_us,
            processor_us=int(record["cpu_ns"]) / 1000.0,
            run_queue_us=int(record["run_queue_ns"]) / 1000.0,
            preemptions=int(record["preemptions"]),
            page_faults=int(record["page_faults"]),
            core=int(record["cpu"]),
            frames_in=int(record["frames_in"]),
            frames_out=int(record["frames_out"]),
        )
        _slice(trace, thread, wake, received, "receive")
        trace.begin(thread, received, "logic")
        for task, begin, end in _tasks(record, log.task_names, received, ticked):
            _slice(trace, thread, begin, end, task)
        trace.end(thread, ticked)
        _slice(trace, thread, ticked, sent, "send")
        trace.end(thread, sent)


def _tasks(record: np.void, names: Sequence[str], begin_ns: int, end_ns: int) -> Iterable[tuple[str, int, int]]:
    """The tasks that ran, one after the other: the log has their durations, whole microseconds, and their order."""
    for task, name in enumerate(names):
        if int(record["tasks_run"]) >> task & 1:
            stop_ns = min(begin_ns + int(record["task_us"][task]) * 1000, end_ns)
            yield name, begin_ns, stop_ns
            begin_ns = stop_ns


def _slice(trace: Trace, track: int, begin_ns: int, end_ns: int, name: str) -> None:
    trace.begin(track, begin_ns, name)
    trace.end(track, end_ns)


@cache
def _name(bus: int, identifier: int, flags: int) -> str:
    """Name of a frame's message, or its identifier where no message has it."""
    message = database.find(bus, identifier, bool(flags & Flag.EXTENDED))
    return message.name if message else f"0x{identifier:X}"


class _BusTracks:
    """A track per bus, made when its first frame comes, with the frames as moments."""

    def __init__(self, trace: Trace) -> None:
        self._trace = trace
        self._group: int | None = None
        self._tracks: dict[int, int] = {}

    def add(self, frames: NDArray[np.void], epoch_ns: int) -> None:
        """Add frames; times in us since the epoch."""
        for time_us, identifier, bus, dlc, flags, _, data in iterate(frames.tobytes()):
            self._trace.instant(
                self._track(bus),
                epoch_ns + time_us * 1000,
                _name(bus, identifier, flags),
                data=data[:dlc].hex(" "),
            )

    def _track(self, bus: int) -> int:
        if self._group is None:
            self._group = self._trace.track("CAN buses")
        if bus not in self._tracks:
            self._tracks[bus] = self._trace.track(Bus(bus).label, self._group)
        return self._tracks[bus]
