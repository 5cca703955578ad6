"""Follows a run from its frames: changes of state, faults, statistics of the executive."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from bridge.states import CtState, SsmState, SysState
from dbc.codec import MessageCodec, database
from dbc.frames import iterate


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
    message: MessageCodec
    signal: int
    states: type[IntEnum]


def _machine(name: str, message: str, signal: str, states: type[IntEnum]) -> _Machine:
    codec = database.message(message)
    return _Machine(name, codec, codec.signals.index(signal), states)


class RunMonitor:
    """Digests frames in order of time, in chunks of any size.

    Attributes
    ----------
    transitions, faults : what happened, in order.
    executive_overruns, executive_late_frames : newest figures of the onboard computer's executive.
    """

    def __init__(self) -> None:
        self._machines = [
            _machine("ssm", "ssm_status", "ssm_state", SsmState),
            _machine("ct", "ct_report", "ct_state", CtState),
            _machine("sys", "misc_report", "sys_state", SysState),
        ]
        self._fault = database.message("fault_event")
        self._executive = database.message("executive_statistics")
        self._state: dict[str, int] = {}
        self.transitions: list[Transition] = []
        self.faults: list[FaultEvent] = []
        self.executive_overruns = 0
        self.executive_late_frames = 0

    def update(self, frames: NDArray[np.void]) -> None:
        """Take the next frames; array of `FRAME_DTYPE`."""
        for machine in self._machines:
            self._follow(machine, _of(frames, machine.message))
        for frame in iterate(_of(frames, self._fault).tobytes()):
            fault_id, active, latched, reaction, detail = (int(value) for value in self._fault.decode(frame.data)[:5])
            self.faults.append(FaultEvent(frame.time_us, fault_id, bool(active), bool(latched), reaction, detail))
        statistics = _of(frames, self._executive)
        if len(statistics):
            values = self._executive.decode(statistics["data"][-1].tobytes())
            self.executive_overruns, self.executive_late_frames = int(values[1]), int(values[2])

    def _follow(self, machine: _Machine, frames: NDArray[np.void]) -> None:
        if not len(frames):
            return
        signals = database.decode_columns(frames).get(machine.message.name)
        if signals is None:
            return
        times, values = signals[machine.message.signals[machine.signal]]
        states = values.astype(np.int64)
        before = np.concatenate(([self._state.get(machine.name, -1)], states[:-1]))
        for place in np.flatnonzero(states != before):
            if before[place] >= 0:
                names = [_name(machine.states, int(code)) for code in (before[place], states[place])]
                self.transitions.append(Transition(int(times[place]), machine.name, *names))
        self._state[machine.name] = int(states[-1])


def _of(frames: NDArray[np.void], message: MessageCodec) -> NDArray[np.void]:
    chosen: NDArray[np.void] = frames[(frames["id"] == message.frame_id) & (frames["bus"] == message.bus)]
    return chosen


def _name(states: type[IntEnum], code: int) -> str:
    return states(code).name if code in states._value2member_map_ else str(code)
