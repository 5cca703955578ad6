"""Follows a run from its frames: changes of state, faults, statistics of the executive."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from dbc.codec import Codec
from dbc.codec import database as car
from dbc.states import CtState, SsmState, SysState


@dataclass(frozen=True)
class Transition:
    """A state machine went from one state to another; `machine` is ssm, ct or sys."""

    time_us: int
    machine: str
    before: str
    after: str


@dataclass(frozen=True)
class FaultEvent:
    """One fault_event frame: a fault became active, or cleared."""

    time_us: int
    fault_id: int
    active: bool
    latched: bool
    reaction: int
    detail: int


@dataclass(frozen=True)
class _Machine:
    name: str
    message: str
    signal: str
    states: type[IntEnum]


class RunMonitor:
    """Digests frames in order of time, in chunks of any size.

    Parameters
    ----------
    database : messages of the profile that CAN1 has.

    Attributes
    ----------
    transitions, faults : what happened, in order.
    executive_frames, executive_overruns, executive_late_frames : newest figures of the onboard computer's executive.
    """

    def __init__(self, database: Codec = car) -> None:
        self._database = database
        self._machines = [
            _Machine("ssm", "ssm_status", "ssm_state", SsmState),
            _Machine("ct", "ct_report", "ct_state", CtState),
            _Machine("sys", "misc_report", "sys_state", SysState),
        ]
        names = ["fault_event", "executive_statistics", *(machine.message for machine in self._machines)]
        self._identifiers = [database.message(name).frame_id for name in names]
        self._state: dict[str, int] = {}
        self.transitions: list[Transition] = []
        self.faults: list[FaultEvent] = []
        self.executive_frames = 0
        self.executive_overruns = 0
        self.executive_late_frames = 0

    def update(self, frames: NDArray[np.void]) -> None:
        """Take the next frames; array of `FRAME_DTYPE`."""
        columns = self._database.decode_columns(frames[np.isin(frames["id"], self._identifiers)])
        for machine in self._machines:
            if machine.message in columns:
                self._follow(machine, *columns[machine.message][machine.signal])
        if "fault_event" in columns:
            times = columns["fault_event"]["fault_id"][0]
            for row in zip(times, *(values for _, values in columns["fault_event"].values()), strict=True):
                time_us, fault_id, active, latched, reaction, detail = (int(value) for value in row[:6])
                self.faults.append(FaultEvent(time_us, fault_id, bool(active), bool(latched), reaction, detail))
        if "executive_statistics" in columns:
            statistics = columns["executive_statistics"]
            self.executive_frames = int(statistics["executive_frames"][1][-1])
            self.executive_overruns = int(statistics["executive_overruns"][1][-1])
            self.executive_late_frames = int(statistics["executive_late_frames"][1][-1])

    def state(self, machine: str) -> str:
        """State of a machine as last seen; empty before the first."""
        states = {known.name: known.states for known in self._machines}[machine]
        return _name(states, self._state[machine]) if machine in self._state else ""

    def _follow(self, machine: _Machine, times: NDArray[np.uint64], values: NDArray[np.float64]) -> None:
        states = values.astype(np.int64)
        before = np.concatenate(([self._state.get(machine.name, -1)], states[:-1]))
        for place in np.flatnonzero(states != before):
            if before[place] >= 0:
                names = [_name(machine.states, int(code)) for code in (before[place], states[place])]
                self.transitions.append(Transition(int(times[place]), machine.name, *names))
        self._state[machine.name] = int(states[-1])


def _name(states: type[IntEnum], code: int) -> str:
    return states(code).name if code in states._value2member_map_ else str(code)
