"""The kernel's wall-clock stamps on the monotonic clock: exact, bounded, and unmoved by a step of the wall clock."""

from __future__ import annotations

import random
import time

import pytest

from bridge._native import lib

SEED = 11
HOUR_NS = 3600 * 10**9


def test_a_look_lies_between_looks_of_our_own():
    before = time.time_ns() - time.monotonic_ns()
    first_ns = time.monotonic_ns()
    look = lib.look_at_clocks()
    last_ns = time.monotonic_ns()
    after = time.time_ns() - time.monotonic_ns()
    assert first_ns <= look.monotonic_ns <= last_ns
    # Our own pairs of readings may be torn apart by the machine, by no more than the whole test took.
    slack = time.monotonic_ns() - first_ns + 1_000_000
    assert min(before, after) - slack <= look.offset_ns <= max(before, after) + slack


def test_a_stamp_in_its_bounds_is_exact():
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    for _ in range(1000):
        offset = generator.randrange(-HOUR_NS, 10**18)
        earliest = generator.randrange(HOUR_NS, 10**15)
        latest = earliest + generator.randrange(10**9)
        at = generator.randint(earliest, latest)
        assert lib.kernel_stamp_to_monotonic(at + offset, offset, offset, earliest, latest) == at


@pytest.mark.parametrize("step", [-HOUR_NS, -1_000_000_000, 1_000_000_000, HOUR_NS])
def test_a_step_of_the_wall_clock_moves_no_stamp(step: int):
    offset = 1_700_000_000 * 10**9
    now, before, at = 5 * HOUR_NS, 5 * HOUR_NS - 10_000_000, 5 * HOUR_NS - 3_000_000
    assert lib.kernel_stamp_to_monotonic(at + offset, offset + step, offset, before, now) == at, "stamped, then set"
    assert lib.kernel_stamp_to_monotonic(at + offset + step, offset + step, offset, before, now) == at, "set first"


def test_what_no_offset_explains_stays_in_its_bounds():
    offset = 10**18
    assert lib.kernel_stamp_to_monotonic(offset + 99, offset, offset, 100, 200) == 100
    assert lib.kernel_stamp_to_monotonic(offset + 201, offset, offset, 100, 200) == 200
    assert lib.kernel_stamp_to_monotonic(offset - 5, offset, offset, 100, 200) == 100
    assert lib.kernel_stamp_to_monotonic(0, offset, offset, 100, 200) == 100
