"""What one measurement found, and the quantities that tables, pictures and files show of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bridge.realtime.cycle_log import CycleLog
from dbc.codec import database
from dbc.frames import Bus, Station
from tools.jitter.figures import (
    CycleTimes,
    Distribution,
    Stamps,
    Times,
    age_at_output,
    cycle_times,
    newest_input,
    output_of_cycle,
    overruns,
    skipped_cycles,
    source_of,
    spacing,
    spacing_error,
    worst_cycles,
)
from tools.jitter.stimulus import Ecu

#: Worst cycles that are named.
WORST = 5

#: Cause of a late cycle: not the program, and nothing else that had the core.
TIMER = "the timer"

#: Linux hands out a quota of processor time anew every 100 ms (CFS bandwidth control), to virtual machines too.
_QUOTA_PERIOD_US = 100_000

#: Station and message between sensors and onboard computer.
AUTONOMY, ESTIMATE = "autonomy", "estimate_position"


@dataclass(frozen=True)
class Row:
    """A line of a table: what was measured, of whom.

    Attributes
    ----------
    label : whose.
    distribution : microseconds.
    part : of the row above, not a row of its own right.
    """

    label: str
    distribution: Distribution
    part: bool = False


@dataclass(frozen=True)
class Quantity:
    """Rows of one kind.

    Attributes
    ----------
    title : what is measured.
    rows : of whom.
    pictured : what a histogram shows of it: title and rows.
    """

    title: str
    rows: tuple[Row, ...]
    pictured: tuple[str, tuple[Row, ...]] | None


@dataclass(frozen=True)
class WorstCycle:
    """A cycle that ended late. Microseconds, but `time_s`, its deadline since the epoch.

    Attributes
    ----------
    cause : what took most of the time from the deadline to the end.
    tasks : execution time of each task that ran.
    """

    slot: int
    time_s: float
    response: float
    timer: float
    queued: float
    processor: float
    preempted: float
    preemptions: int
    page_faults: int
    cpu: int
    cause: str
    tasks: Mapping[str, int]


@dataclass(frozen=True)
class Cycles:
    """The cycles of one station."""

    log: CycleLog

    @cached_property
    def times(self) -> CycleTimes:
        """Where the time of every cycle went."""
        return cycle_times(self.log.records, self.log.period_ns)

    @cached_property
    def lateness(self) -> Distribution:
        """Wake-up lateness."""
        return Distribution.of(self.times.lateness)

    @cached_property
    def execution(self) -> Distribution:
        """Execution time."""
        return Distribution.of(self.times.execution)

    @cached_property
    def period(self) -> Distribution:
        """From wake-up to wake-up."""
        return Distribution.of(self.times.period)

    @property
    def count(self) -> int:
        """Cycles that ran."""
        return len(self.log.records)

    @property
    def skipped(self) -> int:
        """Slots that passed unused."""
        return skipped_cycles(self.log.records)

    @property
    def overruns(self) -> int:
        """Cycles that had not ended when the next one was due."""
        return overruns(self.log.records, self.log.period_ns)

    @property
    def refused(self) -> int:
        """Frames that the kernel did not take."""
        return int(self.log.records["refused"].sum())


@dataclass(frozen=True)
class Measurement:
    """One measurement: an ECU under one condition.

    Attributes
    ----------
    condition : idle, or the load beside it.
    ecu : what was measured.
    cycles : its cycles.
    frames : all that the independent receiver saw, `FRAME_DTYPE`; times in us since the epoch.
    machine : cyclictest's wake-up lateness at the same time, or None.
    peers : stamps of the same frame sent by others, one after the other on the same bus, by their names, ns.
    stations : the other stations of a whole loop, by name.
    notes : what a reader of the figures has to know.
    """

    condition: str
    ecu: Ecu
    cycles: Cycles
    frames: NDArray[np.void]
    machine: Distribution | None
    peers: Mapping[str, Stamps] = field(default_factory=dict)
    stations: Mapping[str, Cycles] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def program(self) -> str:
        """Name of the ECU's executable."""
        return f"raceloop-{self.ecu.name}"

    @cached_property
    def command_ns(self) -> Stamps:
        """When each of the command's frames was on the bus, CLOCK_MONOTONIC."""
        return stamps_of(self.ecu.command, self.frames, self.cycles.log.epoch_ns)

    @cached_property
    def spacing_error(self) -> Distribution:
        """How far the command's frames are from one period apart."""
        return Distribution.of(spacing_error(self.command_ns, self.cycles.log.period_ns))

    @cached_property
    def ages(self) -> dict[str, Times]:
        """Age of inputs when the command that follows from them is on the bus, by input."""
        records = self.cycles.log.records
        output = output_of_cycle(records, self.command_ns)
        ages = {name: age_at_output(newest_input(records, bus), output) for bus, name in self.ecu.inputs.items()}
        if self.ecu.station == Station.OBC and AUTONOMY in self.stations:
            autonomy = self.stations[AUTONOMY].log.records
            estimate_ns = stamps_of(ESTIMATE, self.frames, self.cycles.log.epoch_ns)
            estimates = output_of_cycle(autonomy, estimate_ns)
            sensed = newest_input(autonomy, Bus.CAN_S)
            behind = source_of(newest_input(records, Bus.CAN_A), estimates, sensed)
            ages["sensors, by the estimate"] = age_at_output(behind, output)
        return ages

    def quantities(self) -> list[Quantity]:
        """Everything that is a time."""
        times, program, command = self.cycles.times, self.program, self.ecu.command
        period_ns = self.cycles.log.period_ns
        lateness, execution = Row(program, self.cycles.lateness), Row(program, self.cycles.execution)
        machine = [] if self.machine is None else [Row("cyclictest", self.machine)]
        senders = {program: self.command_ns, **self.peers}
        spacings = tuple(Row(name, Distribution.of(spacing(stamps))) for name, stamps in senders.items())
        errors = tuple(Row(name, Distribution.of(spacing_error(stamps, period_ns))) for name, stamps in senders.items())
        ages = tuple(Row(name, Distribution.of(age)) for name, age in self.ages.items())
        distance = Row(program, Distribution.of(np.abs(times.period - period_ns / 1000.0)))
        return [
            Quantity(
                "Wake-up lateness",
                (lateness, Row("waiting for the core", Distribution.of(times.queued), part=True), *machine),
                ("Wake-up lateness", (lateness, *machine)),
            ),
            Quantity(
                "Execution time",
                (
                    execution,
                    Row("on the core", Distribution.of(times.processor), part=True),
                    Row("off the core", Distribution.of(times.preempted), part=True),
                ),
                ("Execution time", (execution,)),
            ),
            Quantity(
                "Period",
                (Row(program, self.cycles.period),),
                (f"Period, distance from {period_ns / 1e6:g} ms", (distance,)),
            ),
            Quantity(f"Spacing of {command} on the bus", spacings, None),
            Quantity(f"Spacing error of {command}", errors, (f"Spacing error of {command}", errors)),
            Quantity(f"Age of input when {command} is sent", ages, (f"Age of input at {command}", ages)),
        ]

    def worst(self) -> list[WorstCycle]:
        """The cycles that ended last after their deadline, worst first."""
        times, log = self.cycles.times, self.cycles.log
        cycles = []
        for place in worst_cycles(times, WORST):
            record = log.records[place]
            parts = {
                TIMER: float(times.lateness[place] - times.queued[place]),
                "waiting for the core": float(times.queued[place]),
                "off the core": float(times.preempted[place]),
                "the program": float(times.processor[place]),
            }
            cycles.append(
                WorstCycle(
                    slot=int(record["slot"]),
                    time_s=(int(record["deadline_ns"]) - log.epoch_ns) / 1e9,
                    response=float(times.response[place]),
                    timer=parts[TIMER],
                    queued=parts["waiting for the core"],
                    processor=parts["the program"],
                    preempted=parts["off the core"],
                    preemptions=int(record["preemptions"]),
                    page_faults=int(record["page_faults"]),
                    cpu=int(record["cpu"]),
                    cause=max(parts, key=lambda part: parts[part]),
                    tasks={
                        name: int(record["task_us"][task])
                        for task, name in enumerate(log.task_names)
                        if int(record["tasks_run"]) >> task & 1
                    },
                )
            )
        return cycles


def rationed_at_ms(worst: Sequence[WorstCycle]) -> float | None:
    """Where in every 100 ms the worst cycles lie, if all of them waited for the timer and share one place.

    By chance that happens once in ten thousand measurements at 100 Hz; a host that rations the processors of a virtual
    machine stops it at such a place.
    """
    places = {round(cycle.time_s * 1e6) % _QUOTA_PERIOD_US for cycle in worst}
    if len(worst) < WORST or len(places) != 1 or any(cycle.cause != TIMER for cycle in worst):
        return None
    return places.pop() / 1000.0


def stamps_of(message: str, frames: NDArray[np.void], epoch_ns: int) -> Stamps:
    """When the frames of a message were on their bus, ns on CLOCK_MONOTONIC."""
    codec = database.message(message)
    mine = (frames["bus"] == codec.bus) & (frames["id"] == codec.frame_id)
    stamps: Stamps = frames["time_us"][mine].astype(np.int64) * 1000 + epoch_ns
    return stamps
