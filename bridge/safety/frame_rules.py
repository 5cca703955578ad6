"""The safety properties of whole frames: counters, and who sends what."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bridge.safety.statement import Statement
from dbc.codec import Codec
from dbc.frames import FRAME_SIZE, Flag, Station

#: More than there are reasons for which a frame is none of the messages.
_STATUSES = 16

#: A message without a time-out of its own may be away for so many cycles, and still has to count on.
_AWAY_CYCLES = 5


@dataclass(frozen=True)
class FrameBlock:
    """Frames in order of time.

    Attributes
    ----------
    frames : array of `FRAME_DTYPE`.
    times : of the frames, us.
    index : row of each in the table of messages, negative for none.
    order : places of the frames by message, and then by time.
    words : of the frames in that order, little-endian; shape (n, 3), the last one is the data.
    bounds : where each message begins in that order, and where the last one ends.
    """

    frames: NDArray[np.void]
    times: NDArray[np.int64]
    index: NDArray[np.int16]
    order: NDArray[np.intp]
    words: NDArray[np.uint64]
    bounds: NDArray[np.intp]

    @classmethod
    def of(cls, frames: NDArray[np.void], database: Codec) -> FrameBlock:
        """Sort frames that are in order of time by message."""
        index = database.identify(frames).astype(np.int16)  # sorted by digits, which is the fastest
        order = np.argsort(index, kind="stable")
        words = np.ascontiguousarray(frames).view(np.uint64).reshape(-1, FRAME_SIZE // 8)
        times = words[:, 0].astype(np.int64)
        bounds = np.searchsorted(index[order], np.arange(len(database) + 1, dtype=np.int16))
        return cls(frames, times, index, order, np.take(words, order, axis=0), bounds)

    def of_message(self, row: int) -> slice:
        """Where the frames of a message are in `order` and `words`."""
        return slice(int(self.bounds[row]), int(self.bounds[row + 1]))


@dataclass(frozen=True)
class FrameBreach:
    """A frame that breaks a rule.

    Attributes
    ----------
    place : of the frame in its block.
    seen, allowed : in words.
    """

    place: int
    seen: str
    allowed: str


class FrameRule(Statement):
    """What must be true of every frame."""

    @abstractmethod
    def check(self, block: FrameBlock) -> list[FrameBreach]:
        """Give the frames that break it, in order of time."""


@dataclass
class _Counter:
    name: str
    row: int
    shift: np.uint64
    mask: np.uint64
    away_us: int
    """Having been away for longer, the message may begin anywhere."""
    last: int = -1
    last_us: int = 0


class CountersAdvance(FrameRule):
    """Every counter moves."""

    id = "SAFE-16"
    text = "The counter of every message that has one differs from frame to frame."
    source = "CounterSignal and GenMsgTimeout in the DBC files; a message that was away for longer may begin again"

    def __init__(self, database: Codec) -> None:
        self._counters = [
            _Counter(
                codec.name,
                codec.index,
                np.uint64(counter.start),
                np.uint64((1 << counter.length) - 1),
                codec.timeout_us or _AWAY_CYCLES * codec.cycle_us,
            )
            for codec in database
            if (counter := codec.facts.counter) is not None
        ]

    def check(self, block: FrameBlock) -> list[FrameBreach]:
        """See `FrameRule`."""
        breaches = []
        for counter in self._counters:
            mine = block.of_message(counter.row)
            if mine.start == mine.stop:
                continue
            values = block.words[mine, 2] >> counter.shift & counter.mask
            places = block.order[mine]
            stuck = (np.flatnonzero(values[1:] == values[:-1]) + 1).tolist()
            if int(values[0]) == counter.last:
                stuck.insert(0, 0)
            for row in stuck:
                before_us = int(block.times[places[row - 1]]) if row else counter.last_us
                if int(block.times[places[row]]) - before_us <= counter.away_us:
                    seen = f"the counter of {counter.name} stays at {values[row]}"
                    breaches.append(FrameBreach(int(places[row]), seen, "another value than in the frame before"))
            counter.last, counter.last_us = int(values[-1]), int(block.times[places[-1]])
        return sorted(breaches, key=lambda one: one.place)


class SentByOwner(FrameRule):
    """Nobody speaks for somebody else."""

    id = "SAFE-17"
    text = "Every identifier is sent by the station that owns it, and by no other one."
    source = "the senders of the messages in the DBC files"

    def __init__(self, database: Codec, senders_known: bool) -> None:
        # Negative rows count from the end: what no message has, no station of the car sends.
        self._owner = np.full(len(database) + _STATUSES, Station.NONE, np.uint8)
        self._owner[: len(database)] = [codec.sender for codec in database]
        self._names = [codec.name for codec in database]
        self._senders_known = senders_known

    def check(self, block: FrameBlock) -> list[FrameBreach]:
        """See `FrameRule`."""
        breaches = []
        senders = block.frames["sender"]
        strange = senders != self._owner[block.index]
        if not self._senders_known:
            strange &= senders != Station.NONE
        for place in np.flatnonzero(strange).tolist():
            frame, row = block.frames[place], int(block.index[place])
            sender = Station(int(frame["sender"]))
            if int(frame["flags"]) & Flag.ERROR:
                continue  # the sender's own frame follows
            what = self._names[row] if row >= 0 else f"identifier {int(frame['id']):X}, which nobody owns,"
            whom = "outside of the car" if sender is Station.NONE else sender.name
            breaches.append(FrameBreach(place, f"{what} comes from {whom}", "from its owner"))
        return breaches
