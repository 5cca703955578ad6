"""Fault mechanism: every row of the fault table, through debounce, reaction, latch and scope."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from bridge._native import ffi, lib
from firmware.tables import CONTROLLERS, LATCHES, REACTIONS, SCOPES, Fault, own_faults

FAULTS = own_faults()
TICK_US = 10_000
BY_NAME = {fault.name: fault for fault in FAULTS}


class Monitor:
    """A fault monitor with its conditions and a clock."""

    def __init__(self) -> None:
        self.c = ffi.new("fault_monitor *")
        self.conditions = ffi.new("fault_conditions *")
        self.now_us = 0

    def step(self, *present: int, scope: int = lib.FAULT_SCOPE_DRIVING, reset: bool = False, detail: int = 0) -> None:
        for index in range(lib.FAULT_COUNT):
            self.conditions.present[index] = index in present
            self.conditions.detail[index] = detail
        lib.fault_monitor_step(self.c, self.conditions, scope, reset, self.now_us)
        self.now_us += TICK_US

    def active(self, fault: int) -> bool:
        return bool(self.c.faults[fault].active)

    def events(self) -> list[tuple[int, bool, int, int]]:
        event, found = ffi.new("fault_event *"), []
        while lib.fault_monitor_next_event(self.c, event):
            found.append((event.id, bool(event.active), event.detail, event.time_ms))
            assert len(found) <= lib.FAULT_EVENTS_MAX
        return found


def activate(monitor: Monitor, fault: Fault) -> None:
    for _ in range(fault.debounce_cycles):
        assert not monitor.active(fault.id)
        monitor.step(fault.id, detail=7)
    assert monitor.active(fault.id)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_row_matches_source(fault: Fault) -> None:
    row = lib.fault_table[fault.id]
    assert getattr(lib, f"FAULT_{fault.name.upper()}") == fault.id
    assert (row.reaction, row.latch, row.scope) == (
        REACTIONS.index(fault.reaction),
        LATCHES.index(fault.latch),
        SCOPES.index(fault.supervised),
    )
    assert (row.debounce_cycles, row.clear_cycles) == (fault.debounce_cycles, fault.clear_cycles)
    assert (row.disables, bool(row.blocks_launch)) == (CONTROLLERS.index(fault.disables), fault.blocks_launch)
    expected: tuple[int | None, int | None] = (fault.speed_percent, fault.acceleration_percent)
    if fault.reaction in ("none", "warn"):
        expected = (100, 100)
    elif fault.reaction in ("safe_stop", "emergency_stop", "full_brake"):
        expected = (0, 0)
    assert (row.share.speed, row.share.acceleration) == expected


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_debounce_deadline_and_events(fault: Fault) -> None:
    monitor = Monitor()
    if fault.debounce_cycles > 1:  # a gap starts the debounce anew
        for _ in range(fault.debounce_cycles - 1):
            monitor.step(fault.id)
        monitor.step()
        assert not monitor.active(fault.id)
        assert monitor.events() == []
    began_us = monitor.now_us
    activate(monitor, fault)
    last_us = monitor.now_us - TICK_US
    assert (last_us - began_us) // 1000 <= fault.deadline_ms
    assert monitor.events() == [(fault.id, True, 7, last_us // 1000)]
    assert lib.fault_monitor_worst(monitor.c) == (fault.id if fault.reaction != "none" else 0)
    assert lib.fault_monitor_active_count(monitor.c) == 1


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_latch(fault: Fault) -> None:
    monitor = Monitor()
    activate(monitor, fault)
    monitor.step(fault.id, reset=True)
    assert monitor.active(fault.id), "a reset never clears a fault whose condition is present"
    for _ in range(fault.clear_cycles - 1):
        monitor.step(reset=True)
        assert monitor.active(fault.id), "cleared before the clear time"
    monitor.step()
    assert monitor.active(fault.id) == (fault.latch != "while_present")
    monitor.step(reset=True)
    assert monitor.active(fault.id) == (fault.latch == "until_restart")
    cleared = [event for event in monitor.events() if not event[1]]
    assert [event[0] for event in cleared] == ([] if fault.latch == "until_restart" else [fault.id])


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_cycles_are_counted_up_to_their_limit(fault: Fault) -> None:
    monitor = Monitor()
    state = monitor.c.faults[fault.id]
    for cycle in range(1, fault.debounce_cycles + 3):
        monitor.step(fault.id)
        assert (state.present_cycles, state.absent_cycles) == (min(cycle, fault.debounce_cycles), 0)
    for cycle in range(1, fault.clear_cycles + 3):
        monitor.step()
        assert (state.present_cycles, state.absent_cycles) == (0, min(cycle, fault.clear_cycles))


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_alone_leaves_its_own_share(fault: Fault) -> None:
    monitor = Monitor()
    monitor.c.faults[fault.id].active = True
    share, row = lib.fault_monitor_share(monitor.c), lib.fault_table[fault.id]
    assert (share.speed, share.acceleration) == (row.share.speed, row.share.acceleration)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_demands_its_own_reaction_and_of_equals_the_first_is_the_worst(fault: Fault) -> None:
    monitor = Monitor()
    monitor.c.faults[fault.id].active = True
    demanded = [reaction for reaction in range(len(REACTIONS)) if lib.fault_monitor_demands(monitor.c, reaction)]
    assert demanded == [REACTIONS.index(fault.reaction)]
    for other in FAULTS:
        if other.reaction == fault.reaction != "none":
            monitor.c.faults[other.id].active = True
            assert lib.fault_monitor_worst(monitor.c) == min(fault.id, other.id)
            monitor.c.faults[other.id].active = other.id == fault.id


def test_events_that_wait_are_no_faults() -> None:
    monitor = Monitor()
    ffi.buffer(monitor.c.events)[:] = b"\x01" * ffi.sizeof(monitor.c.events)
    share = lib.fault_monitor_share(monitor.c)
    assert (share.speed, share.acceleration) == (100, 100)
    assert all(lib.fault_monitor_allows(monitor.c, controller) for controller in range(1, 256))
    assert lib.fault_monitor_worst(monitor.c) == lib.FAULT_NONE
    assert lib.fault_monitor_active_count(monitor.c) == 0


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_scope(fault: Fault) -> None:
    needed = SCOPES.index(fault.supervised)
    for scope in range(3):
        monitor = Monitor()
        for _ in range(fault.debounce_cycles + 1):
            monitor.step(fault.id, scope=scope)
        assert monitor.active(fault.id) == (scope >= needed)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_launch_block_and_controller(fault: Fault) -> None:
    monitor = Monitor()
    activate(monitor, fault)
    assert lib.fault_monitor_launch_clear(monitor.conditions) == (not fault.blocks_launch)
    for controller in (lib.CONTROL_LQR, lib.CONTROL_STANLEY, lib.CONTROL_PURE_PURSUIT):
        assert lib.fault_monitor_allows(monitor.c, controller) == (controller != CONTROLLERS.index(fault.disables))


def test_most_severe_wins_and_first_of_equals() -> None:
    monitor = Monitor()
    warn, degrade, stop = (BY_NAME[n].id for n in ("gnss_a_wrong_size", "gnss_b_timeout", "imu_timeout"))
    later_stop = BY_NAME["race_control_lost"].id
    monitor.step(warn)
    assert lib.fault_monitor_worst(monitor.c) == warn
    monitor.step(warn, degrade)
    assert lib.fault_monitor_worst(monitor.c) == degrade
    monitor.step(warn, degrade, later_stop)
    assert lib.fault_monitor_worst(monitor.c) == later_stop
    monitor.step(warn, degrade, later_stop, stop)
    assert lib.fault_monitor_worst(monitor.c) == stop
    assert lib.fault_monitor_active_count(monitor.c) == 4


def test_least_share_of_every_pair_of_faults() -> None:
    none = lib.fault_monitor_share(Monitor().c)
    assert (none.speed, none.acceleration) == (100, 100)
    shares = {fault.id: (fault.speed_percent or 100, fault.acceleration_percent or 100) for fault in FAULTS}
    driving_on = [fault.id for fault in FAULTS if fault.reaction in ("warn", "degrade", "switch_controller")]
    assert len({shares[fault] for fault in driving_on}) > 5
    for one, other in itertools.product(driving_on, repeat=2):
        monitor = Monitor()
        monitor.c.faults[one].active = monitor.c.faults[other].active = True
        least = lib.fault_monitor_share(monitor.c)
        assert least.speed == min(shares[one][0], shares[other][0])
        assert least.acceleration == min(shares[one][1], shares[other][1])


def test_event_queue_is_bounded_and_keeps_order() -> None:
    monitor = Monitor()
    fault = BY_NAME["gnss_a_wrong_size"]
    cycles = 0
    while monitor.c.events_lost == 0:
        monitor.step(fault.id)
        for _ in range(fault.clear_cycles):
            monitor.step()
        cycles += 1
        assert cycles <= lib.FAULT_EVENTS_MAX
    assert monitor.c.events_lost == 2, "the first that found it full, and its end"
    events = monitor.events()
    assert len(events) == lib.FAULT_EVENTS_MAX
    assert [event[1] for event in events] == [True, False] * (len(events) // 2)
    assert [event[3] for event in events] == sorted(event[3] for event in events)
    monitor.step(fault.id)
    assert len(monitor.events()) == 1, "the queue works again once it was emptied"


def test_all_at_once_fit_the_event_queue() -> None:
    monitor = Monitor()
    everything: Any = range(1, lib.FAULT_COUNT)
    for _ in range(max(fault.debounce_cycles for fault in FAULTS)):
        monitor.step(*everything)
    assert monitor.c.events_lost == 0
    assert {event[0] for event in monitor.events()} == set(everything)
    assert lib.fault_monitor_active_count(monitor.c) == len(FAULTS)
