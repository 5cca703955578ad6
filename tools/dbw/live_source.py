"""Buses in use as a stream of frames, in the pieces that recordings come in."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dbc.errors import BusError
from dbc.frames import FRAME_DTYPE, Bus
from tools.dbw.bus_option import bus_of as bus_of_label
from tools.dbw.channels import bus_of
from tools.dbw.chunk import CHUNK, OnBroken
from tools.dbw.listeners import Listener, listen, require_interface

#: Frames are passed on this often: together they cost less.
PIECE_S = 0.1

#: Between looks at the buses, which hold what comes in meanwhile: on a full one at 1 Mbit/s some 40 frames.
POLL_S = 0.005


class Address(NamedTuple):
    """Where a bus is heard: ``[BUS=]INTERFACE:CHANNEL``.

    Attributes
    ----------
    text : as the user gave it.
    interface, channel : of it.
    bus : which of the car's this is.
    """

    text: str
    interface: str
    channel: str
    bus: Bus


def looks_live(text: str) -> bool:
    """Whether this is meant as an address."""
    return _ADDRESS.fullmatch(text) is not None


def parse(text: str, bus: Bus | None) -> Address:
    """Read an address that looks like one.

    Parameters
    ----------
    text : as above.
    bus : which of the car's this is when the address does not say so; None: by the name of the channel.

    Raises
    ------
    BusError
        When there is no such kind of interface.
    CodecError
        When there is no such bus.
    ConfigurationError
        When the channel does not tell which bus it is.
    """
    parts = _ADDRESS.fullmatch(text)
    assert parts is not None
    label, interface, channel = parts.groups()
    require_interface(interface)
    chosen = bus if label is None else bus_of_label(label)
    # socketcand has host and port before the channel.
    return Address(text, interface, channel, bus_of(channel.rsplit("/", 1)[-1], chosen, text))


_ADDRESS = re.compile(r"(?:([A-Za-z0-9-]+)=)?([a-z][a-z0-9_]*):(.+)")


class Clock(Protocol):
    """What a source needs of the time: `time` itself has it."""

    def monotonic(self) -> float:
        """Seconds since some moment."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait."""
        ...


@dataclass
class _Ear:
    """A bus that is heard; `lost` frames have been told so far."""

    name: str
    listener: Listener
    lost: int = field(default=0)


class LiveSource:
    """Several buses; a context manager.

    Parameters
    ----------
    addresses : of the buses, each of which is there once.
    on_broken : takes how many frames there were before, and what went wrong: a bus that ends, frames that were lost.
    clock : for waiting.

    Raises
    ------
    BusError
        When one of them cannot be heard.
    """

    def __init__(self, addresses: Sequence[Address], on_broken: OnBroken, clock: Clock = time) -> None:
        self._on_broken = on_broken
        self._clock = clock
        self._count = 0
        self._problem = ""
        self._ears: list[_Ear] = []
        self._names = ", ".join(address.text for address in addresses)
        with ExitStack() as stack:
            for address in addresses:
                listener = listen(address.interface, address.channel, address.bus)
                stack.callback(listener.close)
                self._ears.append(_Ear(address.text, listener))
            self._stack = stack.pop_all()

    def __enter__(self) -> LiveSource:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def chunks(self, seconds: float | None, stopped: Callable[[], bool]) -> Iterator[NDArray[np.void]]:
        """Frames as they come in, in the order in which they do.

        Parameters
        ----------
        seconds : how long; None: until something else ends it.
        stopped : tells that the user has had enough.

        Yields
        ------
        array of `FRAME_DTYPE`
            Every `PIECE_S` or sooner; empty when nothing has come in. It ends also when every bus has.

        Raises
        ------
        BusError
            At the end, when nothing was heard at all.
        """
        begin = self._clock.monotonic()
        end = None if seconds is None else begin + seconds
        over = False
        while not over:
            pieces: list[NDArray[np.void]] = [np.zeros(0, FRAME_DTYPE)]
            size, piece_end = 0, self._clock.monotonic() + PIECE_S
            while not over and size < CHUNK and (now := self._clock.monotonic()) < piece_end:
                over = stopped() or not self._ears or (end is not None and now >= end)
                heard = self._listen()
                pieces += heard
                got = sum(map(len, heard))
                size += got
                if not got and not over:
                    self._clock.sleep(POLL_S)
            self._count += size
            yield np.concatenate(pieces)
        if not self._count:
            raise BusError(f"{self._names}: no frame in {self._clock.monotonic() - begin:.1f} s{self._problem}")

    def _listen(self) -> list[NDArray[np.void]]:
        heard = []
        for ear in list(self._ears):
            try:
                heard.append(ear.listener.receive())
            except BusError as error:
                self._problem = f"; {error}"
                self._on_broken(self._count, f"{ear.name}: {error}")
                self._ears.remove(ear)
            if (lost := ear.listener.lost) > ear.lost:
                self._on_broken(self._count, f"{ear.name}: {lost - ear.lost} frames lost before they got here")
                ear.lost = lost
        return heard
