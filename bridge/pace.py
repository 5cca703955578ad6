"""Slaves a lock-step run to the wall clock. The one place in the bench that reads a clock; no logic depends on it."""

from __future__ import annotations

import time

from dbc.errors import ConfigurationError


class WallClockPace:
    """Waits before each tick until the wall clock has caught up with simulated time.

    Parameters
    ----------
    rt_ratio : simulated seconds per second of the wall clock; 1.0 is real time.

    Attributes
    ----------
    late_ticks, worst_lateness_s : ticks that began after their time although the one before had been waited for.
    """

    def __init__(self, rt_ratio: float) -> None:
        if not rt_ratio > 0.0:
            raise ConfigurationError("pace", "rt_ratio", f"is {rt_ratio}; must be more than 0")
        self._ratio = rt_ratio
        self._start_s: float | None = None
        self.late_ticks = 0
        self.worst_lateness_s = 0.0

    def wait(self, now_us: int) -> None:
        """Sleep until simulated time `now_us` is due."""
        now_s = time.perf_counter()
        if self._start_s is None:
            self._start_s = now_s - now_us * 1e-6 / self._ratio
        ahead_s = self._start_s + now_us * 1e-6 / self._ratio - now_s
        if ahead_s > 0.0:
            time.sleep(ahead_s)
        elif ahead_s < 0.0:
            self.late_ticks += 1
            self.worst_lateness_s = max(self.worst_lateness_s, -ahead_s)
