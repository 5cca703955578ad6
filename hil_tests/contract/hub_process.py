"""A real hub in a folder of the test, and stations that speak its wire byte by byte."""

from __future__ import annotations

import re
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import can

from bridge._native import lib
from bridge.realtime.programs import program
from dbc.frames import FRAME_SIZE, Bus, Frame, iterate

BOUND_S = 30.0
"""Generous: waits end as soon as what they wait for has happened."""

EVERYTHING = 0xFFFFFFFF


def until(condition: Callable[[], object], what: str) -> None:
    """Wait until the condition holds."""
    end = time.monotonic() + BOUND_S
    while not condition():
        assert time.monotonic() < end, f"waited {BOUND_S} s for {what}"
        time.sleep(0.001)


class Hub:
    """A running hub.

    Attributes
    ----------
    local : path of its local socket.
    port : its TCP port.
    ready : the line with which it said so.
    """

    def __init__(self, folder: Path, *options: str) -> None:
        folder.mkdir(exist_ok=True)
        self.local = folder / "hub"
        self._log = folder / "hub.log"
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                [program("raceloop-hub"), "--local", self.local, "--port", "0", *options],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        assert self.process.stdout is not None
        self.ready = self.process.stdout.readline()
        match = re.fullmatch(r"raceloop-hub: local (.+), socketcand 127\.0\.0\.1:(\d+)\n", self.ready)
        assert match, (self.ready, self.log())
        self.port = int(match[2])

    def log(self) -> list[str]:
        """Lines on its standard error so far."""
        return self._log.read_text().splitlines()

    def wait_for_line(self, words: str) -> str:
        """The first line of the log that holds the words."""
        until(lambda: any(words in line for line in self.log()), f"a line with {words!r}")
        return next(line for line in self.log() if words in line)

    def stop(self, with_signal: int = signal.SIGTERM) -> int:
        """End it; returns its status."""
        if self.process.poll() is None:
            self.process.send_signal(with_signal)
        status = self.process.wait(BOUND_S)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return status

    def client(self, channel: str = "CAN1", **options: object) -> can.BusABC:
        """A python-can program on the hub."""
        return can.Bus(interface="socketcand", host="127.0.0.1", port=self.port, channel=channel, **options)

    def __enter__(self) -> Hub:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def hello(bus: int, filters: list[tuple[int, bool]] | None = None, version: int = lib.HUB_VERSION) -> bytes:
    """First packet of a station."""
    count = EVERYTHING if filters is None else len(filters)
    items = b"".join(struct.pack("<IB3x", number, extended) for number, extended in filters or [])
    return struct.pack("<IIII", lib.HUB_MAGIC, version, bus, count) + items


class RawStation:
    """A station on the local socket whose packets the test writes itself."""

    def __init__(self, hub: Hub) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.settimeout(BOUND_S)
        self.socket.connect(str(hub.local))

    def join(self, bus: int, filters: list[tuple[int, bool]] | None = None) -> RawStation:
        """Say hello and expect a welcome."""
        self.socket.send(hello(bus, filters))
        assert self.answer() == (lib.HUB_MAGIC, lib.HUB_VERSION, 0)
        return self

    def answer(self) -> tuple[int, int, int]:
        """The hub's welcome: magic, version, error."""
        return struct.unpack("<IIi", self.socket.recv(100))

    def send(self, *frames: Frame) -> None:
        """One packet."""
        self.socket.send(b"".join(frame.pack() for frame in frames))

    def packet(self) -> bytes:
        """Whatever comes next."""
        return self.socket.recv(lib.HUB_BATCH_MAX * FRAME_SIZE + 1)

    def frames(self) -> list[Frame]:
        """The frames of the next packet."""
        return list(iterate(self.packet()))

    def is_sent_away(self) -> bool:
        """Wait for the end of the connection."""
        try:
            return self.packet() == b""
        except ConnectionResetError:
            return True

    def close(self) -> None:
        self.socket.close()


@contextmanager
def stations(hub: Hub, *buses: Bus) -> Iterator[list[RawStation]]:
    """Stations that hear everything on their buses."""
    joined = [RawStation(hub).join(bus) for bus in buses]
    try:
        yield joined
    finally:
        for station in joined:
            station.close()


def data_frame(bus: Bus, number: int, data: bytes = b"", flags: int = 0) -> Frame:
    """A frame to send."""
    return Frame(0, number, bus, len(data), flags, 0, data.ljust(8, b"\0"))
