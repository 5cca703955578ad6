"""What the way to the hub costs: our local socket beside socketcand, and the transports alone.

::

    python -m tools.link_bench

All ways take turns in short blocks, so that what else the machine does hits each of them alike. Sender and receiver are
this process, in Python, on every way; the hub, or the echo of a transport alone, is another process.

- Round trip: a frame from one station to another and one back, the second sent when the first has come.
- Tick: 5500 frames a second on the buses of a car without radar as stations send them, so 55 frames every 10 ms, from
  the first send to the last frame received. In packets: one per bus; single: one per frame.
- Hub: processor time of the hub per frame in these ticks.
- Rate: frames a second on one bus in packets of 14, as fast as this process sends and receives.
- Kept: frames, one per packet, that the kernel keeps for a receiver that does not read, in buffers of its own size.
"""

from __future__ import annotations

import argparse
import logging
import select
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import can
import numpy as np
from rich.console import Console
from rich.table import Table

from bridge._native import lib
from bridge.bus import CHANNELS
from bridge.realtime.link import CanLink
from bridge.realtime.programs import program
from bridge.realtime.timer import DeadlineTimer
from dbc.errors import RaceloopError
from dbc.frames import FRAME_SIZE, FRAME_STRUCT, Bus, Frame, iterate
from tools.exit_status import ExitStatus

#: Frames per bus and tick: 55 in all.
TICK_FRAMES = {Bus.CAN1: 14, Bus.CAN3: 14, Bus.CAN_A: 14, Bus.CAN_S: 13}
PACKET = 14
#: Packets on their way in the measurement of the rate.
WINDOW = 8
TIMEOUT_S = 10.0


@dataclass
class End:
    """A station on one bus.

    Attributes
    ----------
    send : sends 24-byte frames at once, as far as the way can.
    take : waits for frames and returns how many came.
    close : leaves the bus.
    """

    send: Callable[[bytes], object]
    take: Callable[[], int]
    close: Callable[[], None]
    ahead: int = 0

    def receive(self, count: int) -> None:
        """Wait until so many frames more have come in."""
        self.ahead -= count
        while self.ahead < 0:
            self.ahead += self.take()


def link_end(hub: HubRun, bus: Bus) -> End:
    """`CanLink`: what the stations of a run use."""
    link = CanLink(f"hub:{hub.path}", bus)

    def take() -> int:
        if not select.select([link], [], [], TIMEOUT_S)[0]:
            raise TimeoutError(f"nothing within {TIMEOUT_S:g} s")
        return link.receive().size

    return End(link.send, take, link.close)


def local_end(hub: HubRun, bus: Bus) -> End:
    """The local socket by Python's own module."""
    plain = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    plain.settimeout(TIMEOUT_S)
    plain.connect(str(hub.path))
    plain.send(struct.pack("<IIII", lib.HUB_MAGIC, lib.HUB_VERSION, bus, lib.CAN_LINK_EVERYTHING))
    plain.recv(100)
    return End(plain.send, lambda: len(plain.recv(lib.HUB_BATCH_MAX * FRAME_SIZE)) // FRAME_SIZE, plain.close)


def text_end(hub: HubRun, bus: Bus) -> End:
    """Text of socketcand by Python's own module: it is made beforehand, and only counted when it comes."""
    plain = socket.create_connection(("127.0.0.1", hub.port), TIMEOUT_S)
    plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @cache
    def text(frames: bytes) -> bytes:
        return b"".join(
            f"< send {frame.id:03X} {frame.dlc} {frame.data[: frame.dlc].hex(' ')} >".encode()
            for frame in iterate(frames)
        )

    end = End(lambda frames: plain.sendall(text(frames)), lambda: plain.recv(1 << 16).count(b">"), plain.close)
    end.receive(1)
    for request in (f"< open {CHANNELS[bus]} >", "< rawmode >", "< echo >"):
        plain.sendall(request.encode())
        end.receive(1)
    return end


def python_can_end(hub: HubRun, bus: Bus) -> End:
    """python-can's socketcand interface: what a user's program has."""
    interface = can.Bus(interface="socketcand", host="127.0.0.1", port=hub.port, channel=CHANNELS[bus], tcp_tune=True)

    @cache
    def messages(frames: bytes) -> list[can.Message]:
        return [
            can.Message(arbitration_id=frame.id, is_extended_id=False, data=frame.data[: frame.dlc])
            for frame in iterate(frames)
        ]

    def send(frames: bytes) -> None:
        for message in messages(frames):
            interface.send(message)

    return End(send, lambda: int(interface.recv(TIMEOUT_S) is not None), interface.shutdown)


class HubRun:
    """A hub of this measurement."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.process = subprocess.Popen(
            [program("raceloop-hub"), "--local", self.path, "--port", "0"], stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.port = int(self.process.stdout.readline().rpartition(":")[2])

    def cpu_ns(self) -> int:
        """Processor time of the hub so far."""
        return int(Path(f"/proc/{self.process.pid}/schedstat").read_text().split()[0])

    def close(self) -> None:
        """End it."""
        self.process.terminate()
        self.process.communicate()


@dataclass
class Way:
    """A hub with a pair of stations on each bus, and what was measured on it.

    Attributes
    ----------
    trips_us, packets_us, singles_us : times of round trips, and of ticks in packets and single frames.
    packets_ns, singles_ns : processor time of the hub per frame in each block of these ticks.
    rates : frames a second, per block.
    """

    name: str
    hub: HubRun
    pairs: dict[Bus, tuple[End, End]] = field(default_factory=dict)
    trips_us: list[float] = field(default_factory=list)
    packets_us: list[float] = field(default_factory=list)
    singles_us: list[float] = field(default_factory=list)
    packets_ns: list[float] = field(default_factory=list)
    singles_ns: list[float] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)

    def warm_up(self) -> None:
        """Exchange a frame on each bus: the hub holds back what is for a socketcand client that has just come."""
        for bus, (one, other) in self.pairs.items():
            for sender, receiver in ((one, other), (other, one)):
                sender.send(_frames(bus, 1))
                receiver.receive(1)

    def round_trips(self, count: int) -> None:
        """There and back, on CAN1."""
        one, other = self.pairs[Bus.CAN1]
        raw = _frames(Bus.CAN1, 1)
        for _ in range(count):
            begin = time.perf_counter_ns()
            one.send(raw)
            other.receive(1)
            other.send(raw)
            one.receive(1)
            self.trips_us.append((time.perf_counter_ns() - begin) * 1e-3)

    def ticks(self, count: int, single: bool) -> None:
        """Ticks of 10 ms with 55 frames each."""
        times_us = self.singles_us if single else self.packets_us
        size = {bus: 1 if single else frames for bus, frames in TICK_FRAMES.items()}
        timer = DeadlineTimer(time.monotonic_ns())
        cpu_ns = self.hub.cpu_ns()
        for _ in range(count):
            timer.wait()
            begin = time.perf_counter_ns()
            for bus, frames in TICK_FRAMES.items():
                for _ in range(frames // size[bus]):
                    self.pairs[bus][0].send(_frames(bus, size[bus]))
            for bus, frames in TICK_FRAMES.items():
                self.pairs[bus][1].receive(frames)
            times_us.append((time.perf_counter_ns() - begin) * 1e-3)
        used_ns = self.hub.cpu_ns() - cpu_ns
        (self.singles_ns if single else self.packets_ns).append(used_ns / (count * sum(TICK_FRAMES.values())))

    def rate(self, packets: int) -> None:
        """As fast as it goes, with a window of packets on their way."""
        one, other = self.pairs[Bus.CAN1]
        raw = _frames(Bus.CAN1, PACKET)
        begin = time.perf_counter_ns()
        for number in range(packets + WINDOW):
            if number < packets:
                one.send(raw)
            if number >= WINDOW:
                other.receive(PACKET)
        self.rates.append(packets * PACKET * 1e9 / (time.perf_counter_ns() - begin))

    def close(self) -> None:
        """Leave all buses."""
        for pair in self.pairs.values():
            for end in pair:
                end.close()
        self.hub.close()


def _frames(bus: Bus, count: int) -> bytes:
    return Frame(0, 0x123, bus, 8, 0, 0, bytes(range(8))).pack() * count


# --- transports alone ---


@dataclass
class Transport:
    """A socket to an echo in another process."""

    name: str
    socket: socket.socket
    kept: int
    trips_us: list[float] = field(default_factory=list)

    def round_trips(self, count: int) -> None:
        """There and back."""
        raw = bytes(FRAME_STRUCT.size)
        for _ in range(count):
            begin = time.perf_counter_ns()
            self.socket.send(raw)
            self.socket.recv(100)
            self.trips_us.append((time.perf_counter_ns() - begin) * 1e-3)


_ECHO = """
import socket, sys
end = socket.socket(fileno=int(sys.argv[1]))
while raw := end.recv(100):
    end.send(raw)
"""


def _echo(end: socket.socket) -> subprocess.Popen[bytes]:
    """Start a process that sends back what comes."""
    with end:
        return subprocess.Popen([sys.executable, "-I", "-S", "-c", _ECHO, str(end.fileno())], pass_fds=[end.fileno()])


def _frames_kept(one: socket.socket, other: socket.socket) -> int:
    """How many packets of one frame wait for a receiver that does not read, with the system's own buffer sizes."""
    one.setblocking(False)
    count = 0
    try:
        while True:
            one.send(bytes(FRAME_SIZE))
            count += 1
    except BlockingIOError:
        pass
    finally:
        one.close()
        other.close()
    return count


def _unix_pair(kind: socket.SocketKind) -> tuple[socket.socket, socket.socket]:
    return socket.socketpair(socket.AF_UNIX, kind)


def _datagram_pair(folder: Path, name: str) -> tuple[socket.socket, socket.socket]:
    """As the hub would have them: its one socket gets from all, so it is connected to none."""
    hub, station = (socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in range(2))
    hub.bind(str(folder / f"{name}-hub"))
    station.bind(str(folder / f"{name}-station"))
    hub.connect(str(folder / f"{name}-station"))
    return hub, station


def _tcp_pair() -> tuple[socket.socket, socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        one = socket.create_connection(listener.getsockname())
        other = listener.accept()[0]
    for end in (one, other):
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return one, other


@contextmanager
def _transports(folder: Path) -> Iterator[list[Transport]]:
    kept = {
        "local, packets": _frames_kept(*_unix_pair(socket.SOCK_SEQPACKET)),
        "local, datagrams": _frames_kept(*_datagram_pair(folder, "kept")),
        "TCP": _frames_kept(*_tcp_pair()),
    }
    made: list[Transport] = []
    echoes: list[subprocess.Popen[bytes]] = []
    for name, (one, other) in (
        ("local, packets", _unix_pair(socket.SOCK_SEQPACKET)),
        ("local, datagrams", _unix_pair(socket.SOCK_DGRAM)),
        ("TCP", _tcp_pair()),
    ):
        echoes.append(_echo(other))
        made.append(Transport(name, one, kept[name]))
        made[-1].round_trips(1)  # until the echo has started
        made[-1].trips_us.clear()
    try:
        yield made
    finally:
        for transport in made:
            transport.socket.close()
        for echo in echoes:
            echo.kill()  # a socket without connection does not tell its end
            echo.wait()


# --- all of it ---

WAYS = {
    "local socket, CanLink": link_end,
    "local socket, plain": local_end,
    "socketcand, plain": text_end,
    "socketcand, python-can": python_can_end,
}


def measure(rounds: int) -> tuple[list[Way], list[Transport]]:
    """Measure all ways in turns.

    Parameters
    ----------
    rounds : blocks per way: each of 100 round trips, 30 ticks in packets, 30 in single frames, and 200 packets at once.
    """
    with tempfile.TemporaryDirectory() as name, ExitStack() as exits:
        transports = exits.enter_context(_transports(Path(name)))
        ways = []
        for number, (title, end) in enumerate(WAYS.items()):
            hub = HubRun(Path(name) / f"hub-{number}")
            ways.append(exits.enter_context(closing(Way(title, hub))))
            ways[-1].pairs.update((bus, (end(hub, bus), end(hub, bus))) for bus in TICK_FRAMES)
            ways[-1].warm_up()
        for _ in range(rounds):
            for way in ways:
                way.round_trips(100)
            for transport in transports:
                transport.round_trips(100)
            for way in ways:
                way.ticks(30, single=False)
            for way in ways:
                way.ticks(30, single=True)
            for way in ways:
                way.rate(200)
        return ways, transports


def show(console: Console, ways: Sequence[Way], transports: Sequence[Transport]) -> None:
    """Print the tables."""
    for title, times in (
        ("round trip through the hub, us", [(way.name, way.trips_us) for way in ways]),
        ("tick of 55 frames in packets, us", [(way.name, way.packets_us) for way in ways]),
        ("tick of 55 single frames, us", [(way.name, way.singles_us) for way in ways]),
        ("round trip of the transport alone, us", [(each.name, each.trips_us) for each in transports]),
    ):
        table = Table(title, "min", "median", "p99", "max")
        for name, values in times:
            table.add_row(name, *(f"{value:.0f}" for value in np.percentile(values, [0, 50, 99, 100])))
        _print(console, table)
    table = Table("hub, medians", "us/frame, packets", "us/frame, single", "frames/s")
    for way in ways:
        table.add_row(
            way.name,
            f"{statistics.median(way.packets_ns) * 1e-3:.2f}",
            f"{statistics.median(way.singles_ns) * 1e-3:.2f}",
            f"{statistics.median(way.rates):.0f}",
        )
    _print(console, table)
    table = Table("frames kept for one who does not read", "frames")
    for each in transports:
        table.add_row(each.name, str(each.kept))
    _print(console, table)


def _print(console: Console, table: Table) -> None:
    for column in table.columns[1:]:
        column.justify = "right"
    console.print(table)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=20, metavar="N", help="blocks per way (default: 20)")
    options = parser.parse_args(arguments)
    if options.rounds < 1:
        parser.error(f"--rounds is {options.rounds}; must be at least 1")
    logging.getLogger("can").setLevel(logging.ERROR)  # python-can warns of every message that comes in two pieces
    try:
        ways, transports = measure(options.rounds)
    except RaceloopError as error:
        print(f"link_bench: {error}", file=sys.stderr)
        return ExitStatus.USER_ERROR
    show(Console(highlight=False), ways, transports)
    return ExitStatus.DONE


if __name__ == "__main__":
    sys.exit(main())
