"""Times between the frames of one message, in memory that does not grow with their number."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

#: The histogram begins at 1 us and ends at `_OCTAVES` doublings of it, 134 s. Each of them has bins of equal width, so
#: that the exponent and the first bits of the mantissa of an interval are its bin.
_MANTISSA_BITS = 52
_BIN_BITS = 6
_BINS_PER_OCTAVE = 1 << _BIN_BITS
_OCTAVES = 27
_FIRST_BIN = 1023 << _BIN_BITS
_END_US = 1 << _OCTAVES

#: Part by which a percentile may be off: half a bin where it is widest.
RESOLUTION = 0.5 / _BINS_PER_OCTAVE


def _no_counts() -> NDArray[np.int64]:
    return np.zeros(_BINS_PER_OCTAVE * _OCTAVES, dtype=np.int64)


@dataclass
class Timing:
    """Times between the frames of one message, us.

    Attributes
    ----------
    first_frame, first_us : number in the recording, and time, of the first frame.
    count : intervals.
    total, squares : their sum, and that of their squares.
    shortest, longest : of them.
    last_frame, last_us : number and time of the newest frame.
    """

    first_frame: int = 0
    first_us: int = 0
    count: int = 0
    total: float = 0.0
    squares: float = 0.0
    shortest: int = 0
    longest: int = 0
    last_frame: int = 0
    last_us: int = 0
    _counts: NDArray[np.int64] = field(default_factory=_no_counts, repr=False)

    @property
    def mean(self) -> float:
        """Mean interval, us; 0 when there is none."""
        return self.total / self.count if self.count else 0.0

    @property
    def jitter(self) -> float:
        """Standard deviation of the intervals, us."""
        return float(np.sqrt(max(self.squares / self.count - self.mean**2, 0.0))) if self.count else 0.0

    def percentile(self, percent: float) -> float:
        """Interval that so many of a hundred do not exceed, us; 0 when there is none.

        Off by at most the part `RESOLUTION`, for intervals from 1 us to 134 s.
        """
        if not self.count:
            return 0.0
        rank = max(int(np.ceil(percent / 100.0 * self.count)), 1)
        place = int(np.searchsorted(np.cumsum(self._counts), rank))
        octave, part = divmod(place, _BINS_PER_OCTAVE)
        middle = 2.0**octave * (1.0 + (part + 0.5) / _BINS_PER_OCTAVE)
        return float(min(max(middle, self.shortest), self.longest))

    def add(self, intervals: NDArray[np.int64]) -> None:
        """Take in intervals; at least one."""
        shortest, longest = int(np.minimum.reduce(intervals)), int(np.maximum.reduce(intervals))
        self.shortest = min(self.shortest, shortest) if self.count else shortest
        self.longest = max(self.longest, longest) if self.count else longest
        self.count += len(intervals)
        exact = intervals.astype(np.float64)
        self.total += float(np.add.reduce(exact))
        self.squares += float(exact @ exact)
        places = (np.maximum(exact, 1.0).view(np.int64) >> (_MANTISSA_BITS - _BIN_BITS)) - _FIRST_BIN
        if longest >= _END_US:
            np.minimum(places, len(self._counts) - 1, out=places)
        counts = np.bincount(places)
        self._counts[: len(counts)] += counts
