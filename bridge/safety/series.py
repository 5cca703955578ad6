"""Rows in order of time: what is new, and enough of what was before to judge it by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]
Column = NDArray[np.float64]


class Series:
    """The frames of one message, decoded, or rows of the plant's truth.

    Parameters
    ----------
    signals : names of the columns.

    Attributes
    ----------
    times, numbers : of the rows: microseconds, and number of the frame in the recording; shape (n,).
    fresh : row from which on they are new.
    """

    def __init__(self, signals: Sequence[str]) -> None:
        self._places = {name: place for place, name in enumerate(signals)}
        self.times: Times = np.empty(0, np.int64)
        self.numbers: Times = np.empty(0, np.int64)
        self._values: NDArray[np.float64] = np.empty((len(signals), 0))
        self.fresh = 0

    def __getitem__(self, signal: str) -> Column:
        column: Column = self._values[self._places[signal]]
        return column

    def add(self, times: Times, numbers: Times, values: NDArray[np.float64], keep_us: int) -> None:
        """Take new rows; of the old ones those from the last `keep_us` stay, and at least one.

        Parameters
        ----------
        values : shape (columns, new rows).
        """
        old = len(self.times)
        begin = min(int(np.searchsorted(self.times, self.times[-1] - keep_us)), old - 1) if old else 0
        self.fresh = old - begin
        # Frames of a bus that was late come after later ones; for the properties they come then.
        self.times = np.maximum.accumulate(np.concatenate((self.times[begin:], times)))
        self.numbers = np.concatenate((self.numbers[begin:], numbers))
        self._values = np.concatenate((self._values[:, begin:], values), axis=1)

    def places(self, at: Times) -> NDArray[np.intp]:
        """Newest row at each time; -1 before the first."""
        return np.searchsorted(self.times, at, side="right") - 1

    def held(self, signal: str, at: Times) -> Column:
        """Newest value at each time; not a number before the first."""
        return self._picked(self[signal], self.places(at))

    def age(self, at: Times) -> Column:
        """Time since the newest row, us; not a number before the first."""
        places = self.places(at)
        return at - self._picked(self.times.astype(np.float64), places)

    def lowest(self, signal: str, at: Times, span_us: int) -> Column:
        """Lowest value in force within the span before each time; not a number when it begins before the first."""
        return self._over(np.minimum, signal, at, span_us)

    def highest(self, signal: str, at: Times, span_us: int) -> Column:
        """Highest value, see `lowest`."""
        return self._over(np.maximum, signal, at, span_us)

    def _over(self, function: np.ufunc, signal: str, at: Times, span_us: int) -> Column:
        column, first, last = self[signal], self.places(at - span_us), self.places(at)
        result = self._picked(column, first)
        for step in range(1, int((last - first).max(initial=0)) + 1):
            result = function(result, column[np.minimum(first + step, last)])
        return result

    @staticmethod
    def _picked(column: Column, places: NDArray[np.intp]) -> Column:
        if not column.size:
            return np.full(len(places), np.nan)
        return np.where(places >= 0, column[places], np.nan)


def lasting(condition: NDArray[np.bool_], times: Times) -> Times:
    """For how long a condition has held without a break at each row, us; 0 where it does not hold."""
    broken = np.maximum.accumulate(np.where(condition, -1, np.arange(len(times))))
    begin = np.minimum(broken + 1, len(times) - 1)
    return np.where(condition, times - times[begin], 0)
