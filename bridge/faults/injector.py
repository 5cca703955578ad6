"""Injects faults into a bench: begins and ends them, and knows what was injected when."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.condition import Trigger
from bridge.faults.fault import BenchFault, CloudFault, Fault, FrameFault, InputFault, Memory, Selection
from bridge.faults.plan import FaultPlan
from bridge.plant import REQUIRED_INPUTS
from bridge.sensors.lidar import Cloud
from bridge.wiring import NOMINAL_FRICTION, PLACE_OF_FRICTION
from dbc.codec import MessageCodec, profile
from dbc.errors import CodecError
from dbc.frames import FRAME_SIZE, Frame, frame_array, iterate

if TYPE_CHECKING:
    from bridge.bench import Bench


class Injection:
    """A fault that was handed to a bench; times in simulated microseconds.

    Attributes
    ----------
    plan : the fault and its times.
    seed : of its randomness.
    active : it is there now.
    done : it will not begin again.
    count : frames that were befallen, bus errors, frames of a babbling node, or ticks: whatever the fault is about.
    first_us, last_us : when it first and last befell something; None when never. Frames: when they were sent.
    ended_us : when it was over for good, or was cancelled; None before.
    """

    def __init__(self, plan: FaultPlan, seed: int, onset: Callable[[], bool], bench: Bench) -> None:
        self.plan = plan
        self.seed = seed
        self.active = False
        self.done = False
        self.count = 0
        self.first_us: int | None = None
        self.last_us: int | None = None
        self.ended_us: int | None = None
        self._bench = bench
        self._onset = onset
        self._begun = 0
        self._begun_us = 0
        self._count_at_begin = 0
        self._database = database = profile(bench.scenario.profile)
        self._random = random.Random(seed)
        self._memory = Memory(database, self._random)
        self.selection: Selection | None = (
            plan.fault.selection(database) if isinstance(plan.fault, FrameFault) else None
        )

    def __str__(self) -> str:
        """What was injected, when and how often, for people."""
        if self.first_us is None:
            return f"never: {self.fault}"
        ended = "to the end" if self.ended_us is None else f"ended {self.ended_us * 1e-6:.3f} s"
        times = "once" if self.count == 1 else f"{self.count} times"
        return f"{self.first_us * 1e-6:.3f} s: {self.fault}; {times}, {ended}"

    @property
    def fault(self) -> Fault:
        """What goes wrong."""
        return self.plan.fault

    def cancel(self) -> None:
        """Take the fault away for good, from the next tick on; safe at any time."""
        if not self.done:
            self._end(self._bench.now_us, for_good=True)

    def begin_tick(self, now_us: int) -> None:
        """End what is over, begin what is due, inject what is not about frames or inputs."""
        plan, fault = self.plan, self.plan.fault
        if self.active and plan.for_us is not None and now_us - self._begun_us >= plan.for_us:
            self._end(now_us, for_good=self._begun >= plan.times)
        if not self.active and not self.done and self._is_due(now_us):
            self.active = True
            self._begun += 1
            self._begun_us = now_us
            self._count_at_begin = self.count
            self._memory = Memory(self._database, self._random)
            if isinstance(fault, BenchFault):
                fault.begin(self._bench, self._memory)
        if self.active and isinstance(fault, BenchFault):
            self._note(now_us, fault.tick(self._bench, self._memory))
            self._memory.number += 1
            if fault.is_over(self._memory):
                self._end(now_us, for_good=self._begun >= plan.times)

    def sense(self) -> None:
        """Change what the plant's sensors have put on the ECUs' wires."""
        if self.active and isinstance(self.plan.fault, BenchFault):
            self.plan.fault.sense(self._bench, self._memory)

    def alter(self, frame: Frame, now_us: int) -> list[Frame]:
        """What goes to the bus instead of a frame that is selected."""
        fault = self.plan.fault
        assert isinstance(fault, FrameFault)
        altered = fault.alter(frame, self._memory)
        if altered != [frame] or fault.late_ticks:
            self._note(now_us, 1)
        self._memory.number += 1
        if self.plan.for_frames is not None and self.count - self._count_at_begin >= self.plan.for_frames:
            self._end(now_us, for_good=self._begun >= self.plan.times)
        return altered

    def scan(self, cloud: Cloud, now_us: int) -> Cloud | None:
        """What comes instead of a scan of the LiDARs."""
        fault = self.plan.fault
        if not self.active or not isinstance(fault, CloudFault):
            return cloud
        self._note(now_us, 1)
        changed = fault.scan(cloud, self._memory)
        self._memory.number += 1
        return changed

    def drive(self, inputs: NDArray[np.float64], now_us: int) -> None:
        """Change the inputs of the plant."""
        if self.active and isinstance(self.plan.fault, InputFault):
            self.plan.fault.drive(inputs, self._memory)
            self._memory.number += 1
            self._note(now_us, 1)

    def _is_due(self, now_us: int) -> bool:
        if self._begun:
            return now_us - self._begun_us >= self.plan.every_us
        return self._onset()

    def _end(self, now_us: int, for_good: bool) -> None:
        fault = self.plan.fault
        if self.active and isinstance(fault, BenchFault):
            fault.end(self._bench, self._memory)
        elif self.active and isinstance(fault, FrameFault):
            for frame in fault.release(self._memory):
                self._bench.network.forward(frame.pack())
        self.active = False
        if for_good:
            self.done = True
            self.ended_us = now_us

    def _note(self, now_us: int, count: int) -> None:
        if count:
            self.count += count
            self.first_us = now_us if self.first_us is None else self.first_us
            self.last_us = now_us


class Injector:
    """All injections of one bench, in the order in which they were handed in; each gets what the one before it left.

    Parameters
    ----------
    bench : that they befall.
    """

    def __init__(self, bench: Bench) -> None:
        self.injections: list[Injection] = []
        self._bench = bench
        self._now_us = 0
        self._late: list[tuple[int, bytes]] = []
        self._database = profile(bench.scenario.profile)
        self._watches: dict[str, Any] = {}
        self._ssm = self._database.message("ssm_status")
        self._ssm_place = self._ssm.signals.index("ssm_state")

    def add(self, plan: FaultPlan) -> Injection:
        """Take a fault in; it can begin in the next tick.

        Raises
        ------
        CodecError
            When the fault does not fit the messages of the profile, or the plant.
        """
        plan.check(self._database)
        if isinstance(plan.fault, InputFault):
            for name in plan.fault.needed_inputs:
                if name not in self._bench.plant.input_names:
                    raise CodecError(f"{plan.fault.kind}: the plant has no input {name!r}")
        seed = self._bench.scenario.seed + len(self.injections) if plan.seed is None else plan.seed
        injection = Injection(plan, seed, self._onset(plan), self._bench)
        self.injections.append(injection)
        return injection

    def begin_tick(self, now_us: int) -> None:
        """Begin and end what is due, before anybody acts; frames that are late enough go to their bus."""
        self._now_us = now_us
        due = b"".join(frame for due_us, frame in self._late if due_us <= now_us)
        if due:
            self._late = [(due_us, frame) for due_us, frame in self._late if due_us > now_us]
            self._bench.network.forward(due)
        for injection in self.injections:
            injection.begin_tick(now_us)
        altering = any(injection.active and injection.selection is not None for injection in self.injections)
        self._bench.network.divert(self._alter if altering else None)

    def sense(self) -> None:
        """Change what the ECUs read from their wires in this tick."""
        for injection in self.injections:
            injection.sense()

    def scan(self, cloud: Cloud | None) -> Cloud | None:
        """Change what gets from the LiDARs to autonomy in this tick."""
        for injection in self.injections:
            cloud = None if cloud is None else injection.scan(cloud, self._now_us)
        return cloud

    def drive(self, inputs: NDArray[np.float64]) -> None:
        """Change what gets to the plant at the end of the tick."""
        inputs[PLACE_OF_FRICTION] = NOMINAL_FRICTION  # nothing else sets it, nor the grip under each wheel
        inputs[len(REQUIRED_INPUTS) :] = NOMINAL_FRICTION
        for injection in self.injections:
            injection.drive(inputs, self._now_us)

    def _alter(self, frames: bytes) -> bytes:
        for injection in self.injections:
            if injection.active and injection.selection is not None:
                selected = injection.selection(frame_array(frames))
                if selected.any():
                    frames = self._altered(injection, frames, selected)
        return frames

    def _altered(self, injection: Injection, frames: bytes, selected: NDArray[np.bool_]) -> bytes:
        """Frames with those that are selected replaced, until the fault is over."""
        fault = injection.fault
        assert isinstance(fault, FrameFault)
        due_us = self._now_us + fault.late_ticks * lib.EXECUTIVE_FRAME_US
        result = []
        for place, frame in enumerate(iterate(frames)):
            if not (selected[place] and injection.active):
                result.append(frames[place * FRAME_SIZE : (place + 1) * FRAME_SIZE])
            elif fault.late_ticks:
                self._late += [(due_us, altered.pack()) for altered in injection.alter(frame, self._now_us)]
            else:
                result += [altered.pack() for altered in injection.alter(frame, self._now_us)]
        return b"".join(result)

    def _onset(self, plan: FaultPlan) -> Callable[[], bool]:
        """Tells, once per tick, whether a fault is due."""
        onset, bench = plan.onset, self._bench
        trigger = Trigger(onset.condition)
        message = None if onset.message is None else self._watch(self._database.message(onset.message))
        ssm = None if onset.ssm_state is None else self._watch(self._ssm)

        def holds() -> bool:
            held = trigger.update(bench.situation)
            return (
                held
                and (onset.station_m is None or bench.station >= onset.station_m)
                and (message is None or message.updates >= onset.frames)
                and (ssm is None or (ssm.updates > 0 and self._ssm_state(ssm) == onset.ssm_state))
            )

        return holds

    def _watch(self, message: MessageCodec) -> Any:
        if message.extended:
            raise CodecError(f"{message.name} has a 29-bit identifier; only those of 11 bits can be waited for")
        if message.name not in self._watches:
            self._watches[message.name] = self._bench.network.watch(message.bus, message.frame_id)
        return self._watches[message.name]

    def _ssm_state(self, watch: Any) -> int:
        return int(self._ssm.decode(ffi.buffer(watch.frame.data))[self._ssm_place])
