"""The 10 ms cycle of a station: absolute deadlines on CLOCK_MONOTONIC (``firmware/ports/linux/deadline_timer.h``)."""

from __future__ import annotations

from typing import Any

from bridge._native import ffi, lib


class DeadlineTimer:
    """Slot n is due at epoch + phase + n * period; slots that passed while the caller was late are skipped.

    Parameters
    ----------
    epoch_ns : of the run, CLOCK_MONOTONIC.
    phase_ns : of the station within the period.
    period_ns : 1..10^9.
    """

    def __init__(self, epoch_ns: int, phase_ns: int = 0, period_ns: int = 1000 * lib.EXECUTIVE_FRAME_US) -> None:
        if not 0 < period_ns <= 1_000_000_000:
            raise ValueError(f"period of {period_ns} ns; allowed are 1 to 1000000000")
        self._timer: Any = ffi.new("deadline_timer *")
        self.epoch_ns = epoch_ns
        self.phase_ns = phase_ns
        self.period_ns = period_ns
        self.start()

    def start(self) -> None:
        """Begin with the first slot from now on, or slot 0; those before it do not count as skipped."""
        lib.deadline_timer_init(self._timer, self.epoch_ns, self.phase_ns, self.period_ns)

    def wait(self) -> bool:
        """Sleep until the next slot, without the interpreter's lock. False: a signal came first, no slot was used."""
        return bool(lib.deadline_timer_wait(self._timer) == lib.DEADLINE_REACHED)

    @property
    def slot(self) -> int:
        """Number of the slot that the last wait reached."""
        return int(self._timer.slot)

    @property
    def deadline_ns(self) -> int:
        """When that slot was due, CLOCK_MONOTONIC."""
        return int(self._timer.deadline_ns)

    @property
    def wake_ns(self) -> int:
        """When its wait returned, CLOCK_MONOTONIC."""
        return int(self._timer.wake_ns)

    @property
    def skipped(self) -> int:
        """Slots that passed unused, in all."""
        return int(self._timer.skipped)
