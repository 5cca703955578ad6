"""A station's link to one CAN bus, SocketCAN or the hub (``firmware/ports/linux/can_link.h``)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.bus import CHANNELS
from dbc.errors import BusError
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Buffer, Bus

#: Frames that one `receive` takes at most; the rest waits for the next.
RECEIVE_MAX = 4096


class Filter(NamedTuple):
    """One identifier that a link lets through, for data frames.

    Attributes
    ----------
    id : without flag bits.
    extended : of 29 bits.
    """

    id: int
    extended: bool = False


class LinkState(IntEnum):
    """State of a link; ``enum can_link_state``."""

    CLOSED = lib.CAN_LINK_CLOSED
    UP = lib.CAN_LINK_UP
    DOWN = lib.CAN_LINK_DOWN
    """The interface is down or gone, or the hub has ended; receive and send try again by themselves."""


@dataclass(frozen=True)
class LinkStatistics:
    """Counts since the opening of a link; ``can_link_statistics``.

    Attributes
    ----------
    received, sent : frames.
    refused : frames dropped because the send queue was full.
    undelivered : frames dropped because the link was down.
    overflows : frames lost in the receive queue of the kernel or the hub, as far as it tells.
    error_frames : error frames among those received.
    outages : times the link went down.
    clock_steps : steps of the wall clock seen.
    """

    received: int
    sent: int
    refused: int
    undelivered: int
    overflows: int
    error_frames: int
    outages: int
    clock_steps: int


class CanLink:
    """An attachment to one bus that never blocks; a context manager. It does not hear its own frames.

    Parameters
    ----------
    address : ``socketcan:INTERFACE`` or ``hub:PATH``.
    bus : which of the car's buses this is.
    epoch_ns : of the run, CLOCK_MONOTONIC; frames carry the microseconds since then.
    filters : what to receive; None for everything. Error frames come in any case.

    Raises
    ------
    BusError
        When there is no such bus, or more than 128 filters.
    """

    def __init__(self, address: str, bus: Bus, epoch_ns: int = 0, filters: Iterable[Filter] | None = None) -> None:
        self._link: Any = ffi.new("can_link *")
        self._room: Any = ffi.new("can_frame[]", RECEIVE_MAX)
        self.address = address
        self.bus = bus
        chosen = None if filters is None else [(wanted.id, wanted.extended) for wanted in filters]
        if chosen is not None and len(chosen) > lib.CAN_LINK_FILTERS_MAX:
            raise BusError(f"{CHANNELS[bus]}: {len(chosen)} filters; at most {lib.CAN_LINK_FILTERS_MAX} are allowed")
        error = lib.can_link_open(
            self._link,
            address.encode(errors="surrogateescape"),
            bus,
            epoch_ns,
            ffi.new("can_link_filter[]", chosen or []),
            lib.CAN_LINK_EVERYTHING if chosen is None else len(chosen),
        )
        if error != 0:
            raise BusError(f"{CHANNELS[bus]} at {address}: {_error_text(error)}")

    def receive(self) -> NDArray[np.void]:
        """Take the frames that have come in, oldest first; never blocks.

        Returns
        -------
        array of `FRAME_DTYPE`
            At most `RECEIVE_MAX` frames; none while the link is down.
        """
        count = lib.can_link_receive(self._link, self._room, RECEIVE_MAX)
        return np.frombuffer(bytes(ffi.buffer(self._room, count * FRAME_SIZE)), dtype=FRAME_DTYPE)

    def send(self, frames: Buffer) -> int:
        """Hand frames to the bus in order, those of other buses skipped; never blocks.

        Parameters
        ----------
        frames : whole 24-byte frames, one after the other.

        Returns
        -------
        int
            How many were taken; the others are counted in `statistics`.

        Raises
        ------
        ValueError
            When the buffer does not hold whole frames.
        """
        count, rest = divmod(len(frames), FRAME_SIZE)
        if rest:
            raise ValueError(f"{len(frames)} bytes are not whole frames of {FRAME_SIZE}")
        return int(lib.can_link_send(self._link, ffi.from_buffer("can_frame[]", frames), count))

    @property
    def statistics(self) -> LinkStatistics:
        """Counts since the opening."""
        counts = self._link.statistics
        return LinkStatistics(**{name: int(getattr(counts, name)) for name in LinkStatistics.__dataclass_fields__})

    @property
    def state(self) -> LinkState:
        """Whether the link is up."""
        return LinkState(self._link.state)

    @property
    def problem(self) -> str:
        """What went wrong last, in one line; empty when nothing ever did."""
        return _error_text(self._link.last_error) if self._link.last_error else ""

    def fileno(self) -> int:
        """File descriptor to wait on for frames; -1 when the link is not up."""
        return int(self._link.fd) if self.state is LinkState.UP else -1

    def close(self) -> None:
        """Detach; the statistics stay readable. Safe to call twice."""
        lib.can_link_close(self._link)

    def __enter__(self) -> CanLink:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _error_text(error: int) -> str:
    return str(ffi.string(lib.can_link_error_text(error)).decode())
