"""A Python station of a real-time run: pure logic inside, clock, links and cycle log around it."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable, Sequence
from types import FrameType, TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bridge._native import lib
from bridge.bus import CHANNELS
from bridge.collector import collector_paused
from bridge.realtime.cycle_log import CycleLogWriter
from bridge.realtime.link import CanLink, LinkState
from bridge.realtime.timer import DeadlineTimer
from dbc.frames import FRAME_SIZE

_TICK_US: int = lib.EXECUTIVE_FRAME_US


class Station(Protocol):
    """The logic of a station. It reads no clock and does no I/O on the buses."""

    @property
    def over(self) -> bool:
        """True when there is nothing more to do."""
        ...

    def step(self, now_us: int, received: bytes) -> bytes:
        """One cycle.

        Parameters
        ----------
        now_us : start of the slot, 10 ms per slot since the epoch. More than 10 ms after the last call when slots
            passed unused.
        received : frames since the last call in order of arrival, 24 bytes each.

        Returns
        -------
        bytes
            Frames to send; each names its bus.
        """
        ...

    def end(self) -> bytes:
        """Frames to send when the station is asked to stop."""
        ...


class StopRequest:
    """True once SIGTERM or SIGINT has come; a context manager, to be used in the main thread."""

    def __init__(self) -> None:
        self._requested = False
        self._before: list[tuple[int, object]] = []

    def __bool__(self) -> bool:
        return self._requested

    def __enter__(self) -> StopRequest:
        for number in (signal.SIGTERM, signal.SIGINT):
            self._before.append((number, signal.signal(number, self._ask)))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, handler in self._before:
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _ask(self, _number: int, _frame: FrameType | None) -> None:
        self._requested = True


def in_order_of_arrival(pieces: Sequence[NDArray[np.void]]) -> bytes:
    """Frames of several buses, each in order of time, as one buffer in order of time."""
    filled = [piece for piece in pieces if piece.size]
    if len(filled) < 2:
        return filled[0].tobytes() if filled else b""
    frames: NDArray[np.void] = np.concatenate(filled)
    return frames[np.argsort(frames["time_us"], kind="stable")].tobytes()


def run_station(
    station: Station,
    links: Sequence[CanLink],
    timer: DeadlineTimer,
    log: CycleLogWriter,
    stop: StopRequest,
    say: Callable[[str], None],
) -> None:
    """Step a station once per slot until it is over, or asked to stop.

    Parameters
    ----------
    station : the logic.
    links : one per bus.
    timer : its cycle; slot n is time n * 10 ms for the station, whatever the period.
    log : gets a record per cycle.
    stop : looked at once per cycle.
    say : takes a line for people: buses that went down and came up again.
    """
    states = [link.state for link in links]
    gc.collect()
    timer.start()
    with collector_paused():
        while not (stop or station.over):
            if not timer.wait():
                continue
            log.wake()
            pieces = [link.receive() for link in links]
            received = in_order_of_arrival(pieces)
            received_ns = lib.monotonic_ns()
            frames = station.step(timer.slot * _TICK_US, received)
            ticked_ns = lib.monotonic_ns()
            taken = _send(links, frames)
            sent_ns = lib.monotonic_ns()
            count = len(frames) // FRAME_SIZE
            log.write(
                received_ns,
                ticked_ns,
                sent_ns,
                frames_in=len(received) // FRAME_SIZE,
                frames_out=count,
                refused=count - taken,
                newest_ns=_newest(pieces, timer.epoch_ns),
            )
            for place, link in enumerate(links):
                if link.state is not states[place]:
                    states[place] = link.state
                    _tell_state(link, say)
    if stop:
        _send(links, station.end())


def _tell_state(link: CanLink, say: Callable[[str], None]) -> None:
    what = "up again" if link.state is LinkState.UP else f"down: {link.problem}"
    say(f"{CHANNELS[link.bus]} at {link.address} is {what}")


def _send(links: Sequence[CanLink], frames: bytes) -> int:
    return sum(link.send(frames) for link in links) if frames else 0


def _newest(pieces: Sequence[NDArray[np.void]], epoch_ns: int) -> dict[int, int]:
    """When the newest frame of each bus was on it, CLOCK_MONOTONIC."""
    return {int(piece["bus"][-1]): epoch_ns + 1000 * int(piece["time_us"][-1]) for piece in pieces if piece.size}
