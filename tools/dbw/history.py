"""The newest frames of messages, so that a frame can be looked at beside those of other messages."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dbc.codec import MessageCodec

#: How long frames are kept, us, and how many at most of one message.
HORIZON_US = 1_500_000
_FRAMES_MAX = 1024


@dataclass(frozen=True)
class Piece:
    """Frames of one message that came together.

    Attributes
    ----------
    codec : of the message.
    values : physical ones, shape (number of signals, n).
    times : us, shape (n,).
    numbers : of the frames in the recording, shape (n,).
    """

    codec: MessageCodec
    values: NDArray[np.float64]
    times: NDArray[np.int64]
    numbers: NDArray[np.int64]


class Window(NamedTuple):
    """For some moments: which rows of a history were in force within a time before them.

    Attributes
    ----------
    first, last : of the rows.
    known : whether there was a value at the beginning of that time, and there are few enough to look at.
    """

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    known: NDArray[np.bool_]


#: Rows of a window that are looked at one by one.
_ROWS_MAX = 256


class History:
    """Of one message: the frames of this piece behind the newest ones from before.

    Attributes
    ----------
    codec : of the message.
    values, times, numbers : as in `Piece`; times never go back.
    begin : first row of this piece.
    dropped : rows that were forgotten so far.
    """

    def __init__(self, codec: MessageCodec) -> None:
        self.codec = codec
        self.dropped = 0
        self.values = np.empty((len(codec.signals), 0))
        self.times = np.empty(0, dtype=np.int64)
        self.numbers = np.empty(0, dtype=np.int64)
        self.begin = 0

    def extend(self, piece: Piece) -> None:
        """Put new frames behind the others."""
        self.begin = len(self.times)
        self.values = np.concatenate([self.values, piece.values], axis=1)
        self.times = np.maximum.accumulate(np.concatenate([self.times, piece.times]))
        self.numbers = np.concatenate([self.numbers, piece.numbers])

    def trim(self) -> None:
        """Forget what is older than the horizon; what was in force there stays."""
        count = len(self.times)
        if count:
            in_force = int(np.searchsorted(self.times, self.times[-1] - HORIZON_US, side="right")) - 1
            first = min(max(in_force, count - _FRAMES_MAX, 0), count - 1)
            if first:
                self.values = self.values[:, first:].copy()
                self.times, self.numbers = self.times[first:].copy(), self.numbers[first:].copy()
                self.dropped += first
        self.begin = len(self.times)

    def signal(self, name: str) -> NDArray[np.float64]:
        """Values of a signal."""
        column: NDArray[np.float64] = self.values[self.codec.signals.index(name)]
        return column

    def newest(self, times: NDArray[np.int64]) -> NDArray[np.intp]:
        """Row that was in force at some moments; -1 before the first."""
        return np.searchsorted(self.times, times, side="right") - 1

    def window(self, times: NDArray[np.int64], before_us: int, after_us: int) -> Window:
        """Rows that were in force from a time before some moments to a time after them."""
        last, first = self.newest(times + after_us), self.newest(times - before_us)
        known = (first >= 0) & (last - first < _ROWS_MAX)
        return Window(np.where(known, first, 0), np.where(known, last, 0), known)


class Histories:
    """Those of some messages.

    Parameters
    ----------
    codecs : by name, those that are kept.
    """

    def __init__(self, codecs: Mapping[str, MessageCodec]) -> None:
        self._by_name = {name: History(codec) for name, codec in codecs.items()}

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def __getitem__(self, name: str) -> History:
        return self._by_name[name]

    def extend(self, piece: Piece) -> None:
        """Take in new frames of one of the messages."""
        self._by_name[piece.codec.name].extend(piece)

    def trim(self, names: Collection[str]) -> None:
        """Keep what the next pieces need."""
        for name in names:
            self._by_name[name].trim()
