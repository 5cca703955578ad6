"""The absolute-deadline cycle: slots lie on one grid, lost ones are skipped and counted, none is served twice."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from bridge._native import ffi, lib

PERIOD_NS = 10_000_000


def started(epoch_ns: int, phase_ns: int = 0, period_ns: int = PERIOD_NS):
    timer = ffi.new("deadline_timer *")
    lib.deadline_timer_init(timer, epoch_ns, phase_ns, period_ns)
    return timer


def test_clock_is_the_monotonic_one():
    before = time.monotonic_ns()
    assert before <= lib.monotonic_ns() <= time.monotonic_ns()


def test_slots_lie_on_the_grid_of_the_epoch_and_no_wait_ends_early():
    epoch_ns = lib.monotonic_ns() + 5_000_000
    timer = started(epoch_ns, phase_ns=1_500_000)
    for _ in range(3):
        before = timer.next_slot
        assert lib.deadline_timer_wait(timer) == lib.DEADLINE_REACHED
        assert timer.deadline_ns == epoch_ns + 1_500_000 + timer.slot * PERIOD_NS
        assert timer.wake_ns >= timer.deadline_ns
        assert timer.slot >= before
        assert timer.next_slot == timer.slot + 1


def test_an_epoch_in_the_future_starts_with_slot_0():
    timer = started(lib.monotonic_ns() + 2_000_000, period_ns=1_000_000_000)
    assert lib.deadline_timer_wait(timer) == lib.DEADLINE_REACHED
    assert (timer.slot, timer.skipped) == (0, 0)


def test_slots_before_the_start_are_not_skipped_ones():
    now_ns = lib.monotonic_ns()
    timer = started(now_ns - 1000 * PERIOD_NS)
    assert timer.next_slot in (1001, 1002)
    assert timer.skipped == 0


def ten_slots_ago(next_slot: int):
    """A timer half a period after the beginning of slot 10.

    The period is as long as the time since the machine's start allows, so that noise of the machine does not matter.
    """
    now_ns = lib.monotonic_ns()
    period_ns = now_ns // 11
    timer = started(now_ns - 10 * period_ns - period_ns // 2, period_ns=period_ns)
    timer.next_slot = next_slot
    return timer


@pytest.mark.parametrize("lost", [1, 2, 7])
def test_lost_slots_are_skipped_and_counted(lost: int):
    timer = ten_slots_ago(next_slot=10 - lost)
    assert lib.deadline_timer_wait(timer) == lib.DEADLINE_REACHED
    assert (timer.slot, timer.skipped, timer.next_slot) == (10, lost, 11)
    assert timer.wake_ns - timer.deadline_ns == pytest.approx(timer.period_ns / 2, abs=timer.period_ns / 4)


def test_a_caller_less_than_a_period_late_gets_the_slot_at_once():
    timer = ten_slots_ago(next_slot=10)
    assert lib.deadline_timer_wait(timer) == lib.DEADLINE_REACHED
    assert (timer.slot, timer.skipped) == (10, 0)


def test_a_signal_interrupts_without_using_up_a_slot():
    timer = started(lib.monotonic_ns() + 3_600_000_000_000)  # due in an hour
    woken = threading.Event()
    before = signal.signal(signal.SIGUSR1, lambda *_: woken.set())
    main = threading.main_thread().ident
    stop = threading.Event()

    def knock() -> None:
        while not stop.wait(0.01):  # the first knock may come before the wait
            signal.pthread_kill(main, signal.SIGUSR1)

    knocker = threading.Thread(target=knock)
    try:
        knocker.start()
        assert lib.deadline_timer_wait(timer) == lib.DEADLINE_INTERRUPTED
    finally:
        stop.set()
        knocker.join()
        signal.signal(signal.SIGUSR1, before)
    assert woken.is_set()
    assert (timer.slot, timer.next_slot, timer.skipped) == (0, 0, 0)


def test_a_process_that_was_stopped_skips():
    """SIGSTOP in the middle of a wait: afterwards the cycle goes on where time is."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        timer = started(lib.monotonic_ns(), period_ns=1_000_000)
        os.write(writer, b"!")
        while timer.skipped < 50:
            lib.deadline_timer_wait(timer)
        late_ns = timer.wake_ns - timer.deadline_ns
        os.write(writer, f"{timer.slot} {timer.skipped} {late_ns}".encode())
        os._exit(0)
    try:
        assert os.read(reader, 1) == b"!"
        os.kill(child, signal.SIGSTOP)
        os.waitpid(child, os.WUNTRACED)
        stopped_ns = lib.monotonic_ns()
        while lib.monotonic_ns() < stopped_ns + 120_000_000:
            time.sleep(0.01)
        os.kill(child, signal.SIGCONT)
        os.waitpid(child, 0)
        slot, skipped, late_ns = map(int, os.read(reader, 100).split())
    finally:
        os.close(reader)
        os.close(writer)
    assert slot >= 100
    assert skipped >= 50
    assert 0 <= late_ns < 1_000_000  # the slot that is served is the one that is due
