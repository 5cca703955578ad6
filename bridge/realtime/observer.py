"""The independent observer of a real-time run: hears every bus, sends nothing, keeps what it hears."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bridge.monitor import RunMonitor
from bridge.realtime.bus_load import BusLoad
from dbc.frames import FRAME_DTYPE

#: How long frames are kept back so that one of another bus which comes in later can still go before them. Far more than
#: the way from a sender to here takes.
HOLD_US = 50_000


class InOrder:
    """Puts the frames of several buses into order of time.

    Attributes
    ----------
    late : frames that came in after a later one had been given out; they come as soon as possible.
    """

    def __init__(self) -> None:
        self._kept = np.zeros(0, FRAME_DTYPE)
        self._given_us = 0
        self.late = 0

    def add(self, pieces: Sequence[NDArray[np.void]]) -> None:
        """Take frames, each piece in order of time; arrays of `FRAME_DTYPE`."""
        if any(piece.size for piece in pieces):
            frames = np.concatenate([self._kept, *pieces])
            self._kept = frames[np.argsort(frames["time_us"], kind="stable")]

    def take(self, until_us: int) -> NDArray[np.void]:
        """Give out the frames from before a time, in order."""
        count = int(np.searchsorted(self._kept["time_us"], until_us))
        frames, self._kept = self._kept[:count], self._kept[count:]
        if count:
            self.late += int(np.searchsorted(frames["time_us"], self._given_us))
            self._given_us = max(self._given_us, int(frames["time_us"][-1]))
        return frames

    def take_all(self) -> NDArray[np.void]:
        """Give out what is left."""
        frames, self._kept = self._kept, self._kept[:0]
        return frames


class Listener(Protocol):
    """A link to one bus."""

    def receive(self) -> NDArray[np.void]:
        """Frames that have come in, oldest first; array of `FRAME_DTYPE`, times since the epoch of the run."""
        ...


class Observer:
    """Reads links, and passes what it hears on in order of time.

    Parameters
    ----------
    links : one per bus, without filters.
    sink : takes the frames in order of time: a recorder.

    Attributes
    ----------
    monitor, load : what the frames say about the run, and how full the buses are.
    """

    def __init__(self, links: Sequence[Listener], sink: Callable[[NDArray[np.void]], None] | None = None) -> None:
        self._links = links
        self._sink = sink
        self._order = InOrder()
        self.monitor = RunMonitor()
        self.load = BusLoad()

    @property
    def late(self) -> int:
        """Frames that are out of order in the recording."""
        return self._order.late

    def poll(self, now_us: int) -> None:
        """Read all links; to be called often enough that no queue fills up. now_us: since the epoch of the run."""
        self._order.add([link.receive() for link in self._links])
        self._pass_on(self._order.take(max(now_us - HOLD_US, 0)))

    def finish(self) -> None:
        """Pass on what is left."""
        self._order.add([link.receive() for link in self._links])
        self._pass_on(self._order.take_all())

    def _pass_on(self, frames: NDArray[np.void]) -> None:
        if frames.size:
            self.monitor.update(frames)
            self.load.update(frames)
            if self._sink is not None:
                self._sink(frames)
