"""Who hears a bus in use: a link of this project, a client of socketcand, or an interface of python-can."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Protocol

import can
import numpy as np
from can.interfaces import BACKENDS
from numpy.typing import NDArray

from bridge.realtime.link import CanLink, LinkState
from bridge.tap import frame_of
from dbc.errors import BusError
from dbc.frames import FRAME_DTYPE, FRAME_STRUCT, Bus, Flag, Station
from tools.dbw.python_can_log import complaints

#: Frames taken at once, so that a flood does not keep the others from being heard.
RECEIVE_MAX = 4096

#: How long a server may take to answer.
_PATIENCE_S = 5.0


class Listener(Protocol):
    """Hears one bus and says nothing."""

    @property
    def lost(self) -> int:
        """Frames that did not get here, as far as that is told."""
        ...

    def receive(self) -> NDArray[np.void]:
        """Frames that have come in, oldest first, array of `FRAME_DTYPE`; never waits.

        Raises
        ------
        BusError
            When no more can come in.
        """
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...


def listen(interface: str, channel: str, bus: Bus) -> Listener:
    """Begin to hear a bus.

    Parameters
    ----------
    interface : socketcan, hub, socketcand, or the name of any other interface of python-can.
    channel : of it.
    bus : which of the car's this is.

    Raises
    ------
    BusError
        When it cannot be heard; says why.
    """
    opened = _OWN.get(interface)
    return PythonCanListener(interface, channel, bus) if opened is None else opened(channel, bus)


def require_interface(name: str) -> None:
    """Check that there is such a kind of interface.

    Raises
    ------
    BusError
        When there is none; says which there are.
    """
    if name not in _OWN and name not in BACKENDS:
        raise BusError(f"{name}: no such file or interface; there are {', '.join(sorted({*_OWN, *BACKENDS}))}")


class LinkListener:
    """A bus over SocketCAN or the hub's local socket, with the kernel's times and losses.

    Parameters
    ----------
    address : ``socketcan:INTERFACE`` or ``hub:PATH``.
    bus : which of the car's this is.
    """

    def __init__(self, address: str, bus: Bus) -> None:
        # The link counts from its epoch on the monotonic clock; others tell the time of day.
        epoch_ns = time.monotonic_ns()
        self._epoch_us = np.uint64((time.time_ns() - time.monotonic_ns() + epoch_ns) // 1000)
        self._link = CanLink(address, bus, epoch_ns)

    @property
    def lost(self) -> int:
        """As the kernel or the hub counts them."""
        return self._link.statistics.overflows

    def receive(self) -> NDArray[np.void]:
        """See `Listener`."""
        frames = self._link.receive().copy()
        if not len(frames) and self._link.state is not LinkState.UP:
            raise BusError(self._link.problem)
        frames["time_us"] += self._epoch_us
        return frames

    def close(self) -> None:
        """See `Listener`."""
        self._link.close()


class SocketcandListener:
    """A bus of a socketcand server; python-can's client does not notice when the server ends.

    Parameters
    ----------
    channel : ``HOST:PORT/CHANNEL``.
    bus : which of the car's this is.
    """

    lost = 0
    """The protocol does not tell."""

    def __init__(self, channel: str, bus: Bus) -> None:
        parts = re.fullmatch(r"(.+):(\d{1,5})/([^\s<>/]+)", channel)
        if parts is None:
            raise BusError(f"socketcand:{channel}: must be like socketcand:127.0.0.1:29536/can0")
        host, port, name = parts.groups()
        self._bus = bus
        self._text = b""
        try:
            self._socket = socket.create_connection((host.strip("[]"), int(port)), _PATIENCE_S)
        except (OSError, OverflowError) as error:
            raise BusError(f"{host}:{port}: no connection: {getattr(error, 'strerror', None) or error}") from error
        try:
            self._expect(b"hi")
            for request in (f"< open {name} >", "< rawmode >"):
                self._socket.sendall(request.encode())
                self._expect(b"ok")
        except (OSError, BusError) as error:
            self.close()
            raise BusError(f"{host}:{port}: {error}") from error
        self._socket.setblocking(False)

    def _expect(self, word: bytes) -> None:
        while b">" not in self._text:
            got = self._socket.recv(4096)
            if not got or len(self._text) > _LINE_MAX:
                raise BusError("no server of socketcand")
            self._text += got
        answer, self._text = self._text.split(b">", 1)
        if answer.strip(b"< \r\n") != word:
            shown = answer.strip(b"< \r\n")[:80].decode("ascii", "replace")
            raise BusError(f"the server answers {shown!r} instead of {word.decode()!r}")

    def receive(self) -> NDArray[np.void]:
        """See `Listener`."""
        try:
            got = self._socket.recv(1 << 16)
        except BlockingIOError:
            return np.zeros(0, FRAME_DTYPE)
        except OSError as error:
            raise BusError(error.strerror or "the connection is broken") from error
        if not got:
            raise BusError("the server has ended the connection")
        *lines, self._text = (self._text + got).split(b">")
        if len(self._text) > _LINE_MAX:
            raise BusError("the server does not talk as socketcand does")
        return np.frombuffer(b"".join(socketcand_frame(line, self._bus) for line in lines), FRAME_DTYPE)

    def close(self) -> None:
        """See `Listener`."""
        self._socket.close()


#: Characters of a frame of socketcand, generously.
_LINE_MAX = 512

_FRAME = re.compile(rb"\s*< (frame|error) ([0-9A-Fa-f]{1,8}) (\d{1,12})\.(\d{1,9})(?: ((?:[0-9A-Fa-f]{2})*))? *")
_STANDARD_DIGITS = 3
_IDENTIFIER = 0x1FFF_FFFF


def socketcand_frame(text: bytes, bus: Bus) -> bytes:
    """The frame of 24 bytes that a server of socketcand writes; nothing when it writes something else.

    Parameters
    ----------
    text : up to the closing bracket, which is left out.
    bus : where it is from.
    """
    parts = _FRAME.fullmatch(text)
    if parts is None:
        return b""
    kind, identifier, seconds, fraction, digits = parts.groups()
    data = bytes.fromhex((digits or b"").decode())[:64]
    flags = Flag.EXTENDED * (len(identifier) > _STANDARD_DIGITS) | Flag.ERROR * (kind == b"error")
    time_us = int(seconds) * 1_000_000 + int(fraction[:6].ljust(6, b"0"))
    frame_id = int(identifier, 16) & _IDENTIFIER
    return FRAME_STRUCT.pack(time_us, frame_id, bus, len(data), flags, Station.NONE, data[:8])


class PythonCanListener:
    """A bus of any interface that python-can knows.

    Parameters
    ----------
    interface, channel : as `can.Bus` takes them; what else it needs, it takes from its own files and environment.
    bus : which of the car's this is.
    """

    lost = 0
    """python-can does not tell."""

    def __init__(self, interface: str, channel: str, bus: Bus) -> None:
        self._bus = bus
        reason = ""
        with ExitStack() as stack:
            stack.enter_context(complaints(lambda _text: None))
            try:
                self._interface = can.Bus(interface=interface, channel=channel)
            # Drivers of many makers are behind this, and each raises what it likes.
            except Exception as error:
                reason = " ".join(str(error).split()) or type(error).__name__
            # Not above: with the error goes the half-made interface, which complains.
            if reason:
                raise BusError(f"{interface}:{channel}: cannot be opened: {reason}")
            self._stack = stack.pop_all()

    def receive(self) -> NDArray[np.void]:
        """See `Listener`."""
        frames: list[bytes] = []
        try:
            while len(frames) < RECEIVE_MAX and (message := self._interface.recv(timeout=0.0)) is not None:
                frames.append(frame_of(message, self._bus, max(round(message.timestamp * 1e6), 0)))
        except (can.CanError, OSError) as error:
            raise BusError(" ".join(str(error).split()) or type(error).__name__) from error
        return np.frombuffer(b"".join(frames), FRAME_DTYPE)

    def close(self) -> None:
        """See `Listener`."""
        self._interface.shutdown()
        self._stack.close()


_OWN: Mapping[str, Callable[[str, Bus], Listener]] = {
    "hub": lambda channel, bus: LinkListener(f"hub:{channel}", bus),
    "socketcan": lambda channel, bus: LinkListener(f"socketcan:{channel}", bus),
    "socketcand": SocketcandListener,
}
