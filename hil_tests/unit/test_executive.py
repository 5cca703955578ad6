"""firmware/common/executive.c and debounce.c: schedule, budgets, late and missed frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from bridge._native import ffi, lib

FRAME_US = 10_000
BUDGET_US = 9_000


class Tasks:
    """A schedule table whose tasks note when they run, and a clock that moves as the tasks cost."""

    def __init__(self, *rows: tuple[int, int, int], cost_us: int = 0) -> None:
        self.log: list[tuple[int, int]] = []
        self.clock_us = 0
        self.cost_us = cost_us
        self.executive = ffi.new("executive *")
        self.count = len(rows)
        self._callbacks = [self._callback(index) for index in range(self.count)]
        self.table = ffi.new("executive_task[]", max(self.count, 1))
        for index, (period, offset, budget_us) in enumerate(rows):
            self.table[index] = {
                "run": self._callbacks[index],
                "period": period,
                "offset": offset,
                "budget_us": budget_us,
            }
        self._clock = ffi.callback("uint64_t(void *)", lambda _: self.clock_us)

    def _callback(self, index: int) -> Any:
        def run(_: Any) -> None:
            self.log.append((self.executive.frame, index))
            self.clock_us += self.cost_us

        return ffi.callback("void(void *)", run)

    def use_clock(self) -> None:
        self.executive.clock = self._clock

    def run(self, now_us: int) -> None:
        lib.executive_run(self.executive, self.table, self.count, ffi.NULL, now_us)

    def run_frames(self, frames: int) -> None:
        for frame in range(frames):
            self.run(frame * FRAME_US)

    def valid(self, budget_us: int = BUDGET_US) -> bool:
        return bool(lib.executive_table_valid(self.table, self.count, budget_us))


def test_tasks_run_in_their_frames_and_in_table_order() -> None:
    tasks = Tasks((1, 0, 100), (2, 1, 100), (5, 3, 100))
    tasks.run_frames(20)
    expected = [
        (frame, index)
        for frame in range(20)
        for index, (period, offset) in enumerate([(1, 0), (2, 1), (5, 3)])
        if frame % period == offset
    ]
    assert tasks.log == expected
    assert [tasks.executive.records[i].runs for i in range(3)] == [20, 10, 4]
    assert tasks.executive.frame == 20


def test_without_a_clock_only_the_injected_cost_counts() -> None:
    tasks = Tasks((1, 0, 100), (1, 0, 100), cost_us=5_000)
    tasks.run_frames(3)
    assert tasks.executive.worst_frame_us == 0
    tasks.executive.records[1].injected_cost_us = 101
    tasks.run(3 * FRAME_US)
    assert [tasks.executive.records[i].overruns for i in range(2)] == [0, 1]
    assert (tasks.executive.worst_frame_us, tasks.executive.overruns) == (101, 0)


@pytest.mark.parametrize(
    ("cost_us", "injected_us", "task_overruns", "frame_overruns"),
    [(100, 0, 0, 0), (101, 0, 1, 0), (100, 1, 1, 0), (10_000, 0, 1, 0), (10_001, 0, 1, 1), (0, 2**32 - 1, 1, 1)],
)
def test_costs_are_measured_and_judged(cost_us: int, injected_us: int, task_overruns: int, frame_overruns: int) -> None:
    tasks = Tasks((1, 0, 100), cost_us=cost_us)
    tasks.use_clock()
    tasks.executive.records[0].injected_cost_us = injected_us
    tasks.run(0)
    record = tasks.executive.records[0]
    assert (record.overruns, tasks.executive.overruns) == (task_overruns, frame_overruns)
    assert record.last_us == record.worst_us == tasks.executive.worst_frame_us == cost_us + injected_us


def test_a_cost_beyond_32_bits_saturates() -> None:
    tasks = Tasks((1, 0, 100), cost_us=2**33)
    tasks.use_clock()
    tasks.run(0)
    assert tasks.executive.records[0].worst_us == 2**32 - 1


@pytest.mark.parametrize(
    ("starts_us", "late", "missed"),
    [
        ([0, 10_000, 20_000], 0, 0),
        ([0, 15_000, 20_000], 0, 0),
        ([0, 15_001, 20_000], 1, 0),
        ([0, 20_000, 30_000], 0, 1),
        ([0, 32_000, 40_000], 0, 2),
        ([0, 36_000, 40_000], 1, 2),
        ([0, 9_000, 20_000], 0, 0),
        ([500_000, 510_000, 520_000], 0, 0),
        ([500_000, 510_000, 100_000, 110_000], 0, 0),
    ],
    ids=["on time", "half a frame", "late", "one missed", "two missed", "both", "early", "starts later", "set back"],
)
def test_late_and_missed_frames(starts_us: list[int], late: int, missed: int) -> None:
    tasks = Tasks((1, 0, 100))
    for start_us in starts_us:
        tasks.run(start_us)
    assert (tasks.executive.late_frames, tasks.executive.missed_frames) == (late, missed)


@pytest.mark.parametrize(
    ("rows", "valid"),
    [
        ([(1, 0, 100)], True),
        ([], True),
        ([(10, 9, 100)], True),
        ([(0, 0, 100)], False),
        ([(11, 0, 100)], False),
        ([(2, 2, 100)], False),
        ([(1, 0, 0)], False),
        ([(1, 0, BUDGET_US)], True),
        ([(1, 0, BUDGET_US + 1)], False),
        ([(2, 0, 8_000), (2, 1, 8_000)], True),
        ([(2, 0, 8_000), (3, 1, 8_000)], False),
        ([(7, 0, 5_000), (9, 8, 5_000)], False),
        ([(1, 0, 1)] * 16, True),
        ([(1, 0, 1)] * 17, False),
    ],
)
def test_table_validation(rows: list[tuple[int, int, int]], valid: bool) -> None:
    assert Tasks(*rows).valid() is valid


def test_a_table_without_a_function_is_not_valid_and_does_not_crash() -> None:
    tasks = Tasks((1, 0, 100), (1, 0, 100))
    tasks.table[0].run = ffi.NULL
    assert not tasks.valid()
    tasks.run(0)
    assert tasks.log == [(0, 1)]
    tasks.table[1].period = 0
    tasks.run(FRAME_US)
    assert tasks.log == [(0, 1)]


@pytest.mark.parametrize("schedule", [lib.raptor_schedule, lib.space_drive_schedule], ids=["raptor", "space_drive"])
def test_ecu_schedules_fit_their_frame(schedule: Callable[[Any], Any]) -> None:
    count = ffi.new("uint32_t *")
    table = schedule(count)
    assert count[0] > 0
    assert lib.executive_table_valid(table, count[0], FRAME_US // 2)


def test_debounce_needs_an_unbroken_time() -> None:
    debounce = ffi.new("debounce *")
    conditions = [(0, True), (10, True), (20, False), (30, True), (40, True), (60, True), (61, True)]
    held = [lib.debounce_step(debounce, condition, 30, now) for now, condition in conditions]
    assert held == [False, False, False, False, False, True, True]
    assert lib.debounce_step(ffi.new("debounce *"), True, 0, 5)
