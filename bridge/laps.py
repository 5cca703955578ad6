"""Counts and times laps from the true position."""

from __future__ import annotations


class LapTimer:
    """Line crossings in the direction of travel, timed between ticks by linear interpolation.

    Parameters
    ----------
    length_m : length of the lap; the line is at station 0.
    """

    def __init__(self, length_m: float) -> None:
        self._length = length_m
        self._last: tuple[float, int] | None = None
        self.crossings_us: list[float] = []

    def update(self, time_us: int, station_m: float) -> None:
        """Take the station at a time, m in [0, length)."""
        if self._last is not None:
            before, before_us = self._last
            if station_m - before < -0.5 * self._length:
                to_line = self._length - before
                fraction = to_line / (to_line + station_m)
                self.crossings_us.append(before_us + fraction * (time_us - before_us))
            elif station_m - before > 0.5 * self._length and self.crossings_us:
                self.crossings_us.pop()  # rolled back over the line
        self._last = (station_m, time_us)

    @property
    def count(self) -> int:
        """Full laps, line to line."""
        return max(len(self.crossings_us) - 1, 0)

    @property
    def laps_s(self) -> list[float]:
        """Time of each full lap, s."""
        return [(end - start) * 1e-6 for start, end in zip(self.crossings_us, self.crossings_us[1:], strict=False)]
