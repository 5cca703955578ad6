"""The independent observer of a real-time run: hears every bus, sends nothing, keeps what it hears."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bridge.monitor import RunMonitor
from bridge.realtime.bus_load import BusLoad
from dbc.codec import Codec
from dbc.codec import database as car
from dbc.frames import FRAME_DTYPE

#: How long frames are kept back so that one of another bus which comes in later can still go before them. Far more than
#: the way from a sender to here takes.
HOLD_US = 50_000

#: Frames are passed on this often: together they cost less.
PASS_ON_US = 100_000


class InOrder:
    """Puts the frames of several buses into order of time.

    Attributes
    ----------
    late : frames that came in after a later one had been given out; they come as soon as possible.
    """

    def __init__(self) -> None:
        self._pieces: list[NDArray[np.void]] = [np.zeros(0, FRAME_DTYPE)]
        self._given_us = 0
        self.late = 0

    def add(self, frames: NDArray[np.void]) -> None:
        """Take frames; array of `FRAME_DTYPE`. Those of one time must be in order."""
        if frames.size:
            self._pieces.append(frames)

    def take(self, until_us: int | None = None) -> NDArray[np.void]:
        """Give out the frames from before a time, or all of them, in order."""
        frames = np.concatenate(self._pieces)
        times = frames["time_us"]
        order = np.argsort(times, kind="stable")
        count = times.size if until_us is None else int(np.searchsorted(times, max(until_us, 0), sorter=order))
        given = frames[order[:count]]
        self._pieces = [frames[order[count:]]]
        if count:
            self.late += int(np.searchsorted(given["time_us"], self._given_us))
            self._given_us = max(self._given_us, int(given["time_us"][-1]))
        return given


class Listener(Protocol):
    """A link to one bus."""

    def receive(self) -> NDArray[np.void]:
        """Frames that have come in, oldest first; array of `FRAME_DTYPE`, times since the epoch of the run."""
        ...


class Observer:
    """Reads links, and passes on what it hears in order of time.

    Parameters
    ----------
    links : one per bus, without filters.
    sink : takes the frames in order of time: a recorder.
    slower : how many times slower than real time the car lives; frames get the car's time.
    database : messages of the profile that CAN1 has.

    Attributes
    ----------
    monitor, load : what the frames say about the run, and how full the buses are.
    """

    def __init__(
        self,
        links: Sequence[Listener],
        sink: Callable[[NDArray[np.void]], None] | None = None,
        slower: int = 1,
        database: Codec = car,
    ) -> None:
        self._links = links
        self._slower = slower
        self._sink = sink
        self._order = InOrder()
        self._next_us = 0
        self.monitor = RunMonitor(database)
        self.load = BusLoad()

    @property
    def late(self) -> int:
        """Frames that are out of order in the recording."""
        return self._order.late

    def poll(self, now_us: int) -> None:
        """Read all links; to be called often enough that no queue fills up.

        Parameters
        ----------
        now_us : the car's time.
        """
        self._listen()
        if now_us >= self._next_us:
            self._next_us = now_us + PASS_ON_US
            self._pass_on(self._order.take(now_us - HOLD_US))

    def finish(self) -> None:
        """Read all links for the last time and pass on everything."""
        self._listen()
        self._pass_on(self._order.take())

    def _listen(self) -> None:
        for link in self._links:
            frames = link.receive()
            if self._slower != 1:
                frames = frames.copy()
                frames["time_us"] //= self._slower
            self._order.add(frames)

    def _pass_on(self, frames: NDArray[np.void]) -> None:
        if frames.size:
            self.monitor.update(frames)
            self.load.update(frames)
            if self._sink is not None:
                self._sink(frames)
