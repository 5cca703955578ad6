"""The provocations of perception's faults, injected into the frames that the onboard computer hears on CAN-A.

Condition, debounce, reaction and end are held to provocations.yaml and the fault table, as in the reaction matrix.
"""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest
from obc_harness import OPERATIONS, TICK_US, ObcHarness

import scenarios
from bridge._native import lib
from bridge.faults.fault import FrameFault, Memory
from bridge.faults.plan import FaultPlan
from bridge.faults.provocations import Duration, Provoker, load_provocations
from dbc.codec import database
from dbc.frames import frame_array, iterate
from firmware.tables import REACTIONS, load_faults

FAULTS = {fault.name: fault for fault in load_faults()}
PROVOCATIONS = {
    name: one
    for name, one in load_provocations(scenarios.DIRECTORY / "campaigns" / "provocations.yaml", database)["ssm"].items()
    if one.perception
}
PROVOKER = Provoker(OPERATIONS / "perception.yaml", database)


class Injected:
    """A plan that befalls the frames of a harness, from its making on."""

    def __init__(self, harness: ObcHarness, plan: FaultPlan) -> None:
        assert isinstance(plan.fault, FrameFault)
        self.harness, self.plan, self.fault = harness, plan, plan.fault
        self.selection = plan.fault.selection(database)
        self.begun_us = self.next_us = harness.now_us
        self.times = 0
        self.left = 0
        self.memory = Memory(database, random.Random(1))
        self.first_us: int | None = None
        self.last_us: int | None = None
        harness.filters.append(self)

    @property
    def over(self) -> bool:
        return not self.left and self.times == self.plan.times

    def __call__(self, frames: bytes) -> bytes:
        return b"".join(self.altered(frames))

    def altered(self, frames: bytes) -> Iterator[bytes]:
        now_us = self.harness.now_us
        for frame, selected in zip(iterate(frames), self.selection(frame_array(frames)), strict=True):
            if not self.left and self.times < self.plan.times and now_us >= self.next_us:
                self.times += 1
                self.next_us = now_us + self.plan.every_us
                self.left = self.plan.for_frames or 1 << 40
                self.memory = Memory(database, random.Random(1))
            if not selected or not self.left:
                yield frame.pack()
                continue
            changed = self.fault.alter(frame, self.memory)
            if changed != [frame]:
                self.first_us = now_us if self.first_us is None else self.first_us
                self.last_us = now_us
                self.left -= 1
            yield from (each.pack() for each in changed)


def driven() -> ObcHarness:
    """At 20 m/s among others; detections work on 20 scans a second, tracking and prediction put out 50 times."""
    harness = ObcHarness(perception=True)
    harness.node_periods |= {
        lib.NODE_LIDAR_DETECTION: 50_000, lib.NODE_RADAR_DETECTION: 50_000,
        lib.NODE_TRACKING: 20_000, lib.NODE_PREDICTION: 20_000,
    }  # fmt: skip
    harness.plan_speed = 30.0
    harness.drive()
    harness.set_speed(20.0)
    harness.signals["pt_report_1"] |= {"current_gear": 2, "engine_speed_rpm": 5000}
    harness.run(30)
    assert (harness.state, harness.active_faults()) == (lib.SSM_NOMINAL, set())
    return harness


@pytest.mark.parametrize("duration", Duration)
@pytest.mark.parametrize("name", PROVOCATIONS)
@pytest.mark.parametrize("phase", [0, 3])
def test_reaction(name: str, duration: Duration, phase: int) -> None:
    one, fault = PROVOCATIONS[name], FAULTS[name]
    plans = PROVOKER.plans(one, duration, fault.debounce_cycles)
    if plans is None:
        assert duration is Duration.BELOW
        assert fault.debounce_cycles <= 5, "there is nothing shorter than a sample"
        return
    harness = driven()
    harness.run(phase)
    (injected,) = [Injected(harness, plan) for plan in plans]
    allowed = {fault.id, *(FAULTS[companion].id for companion in one.companions)}
    begun: int | None = None
    ended: int | None = None
    end_us = harness.now_us + 3_500_000
    while harness.now_us < end_us:
        now_us = harness.now_us
        harness.tick()
        active = harness.active_faults()
        assert active <= allowed
        if begun is None and fault.id in active:
            begun = now_us
            assert harness.value("ssm_status", "ssm_reaction") >= REACTIONS.index(fault.reaction)
        if begun is not None and ended is None and fault.id not in active:
            ended = now_us
    assert injected.first_us is not None
    if duration is Duration.BELOW:
        assert begun is None
        return
    earliest_us, latest_us = PROVOKER.condition_us(one, injected.first_us)
    held_us = (fault.debounce_cycles - 1) * TICK_US
    assert begun is not None
    assert earliest_us + held_us <= begun <= latest_us + held_us
    assert begun - latest_us <= fault.deadline_ms * 1000
    if duration is Duration.PERMANENT or fault.latch != "while_present":
        assert ended is None
        return
    assert injected.over
    assert injected.last_us is not None
    gone_us, gone_latest_us = PROVOKER.end_us(one, injected.last_us)
    cleared_us = (fault.clear_cycles - 1) * TICK_US
    assert ended is not None
    assert gone_us + cleared_us <= ended <= gone_latest_us + cleared_us
