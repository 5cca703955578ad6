"""Every bus that raceloop can run on, behind one small interface for the contract test."""

from __future__ import annotations

import select
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable
from enum import Enum, auto
from pathlib import Path

import can
from hub_process import BOUND_S, Hub

from bridge.bus import CHANNELS, Network
from bridge.realtime.link import CanLink, Filter
from bridge.tap import frame_of
from dbc.frames import Bus, Flag, Frame, Station, iterate

TICK_US = 10_000


class Loss(Enum):
    """How a station learns that frames did not fit into its queue."""

    COUNTED = auto()
    ERROR_FRAME = auto()
    """That there was a loss, but not how many frames."""
    UNTOLD = auto()


class Member(ABC):
    """A station on one bus.

    Attributes
    ----------
    loss : how it learns of frames that it lost.
    """

    loss: Loss

    @abstractmethod
    def send(self, *frames: Frame) -> int:
        """Send in order; returns how many went onto the bus."""

    @abstractmethod
    def take(self, wait_s: float) -> list[Frame]:
        """What has come in, error frames included; waits for the first at most so long."""

    @abstractmethod
    def now_us(self) -> int:
        """Time on the clock of the stamps, microseconds."""

    @abstractmethod
    def leave(self) -> None:
        """Leave the bus."""

    def lost(self) -> int:
        """Frames lost for this station; only where losses are counted."""
        raise NotImplementedError


class Backend(ABC):
    """A bus to test.

    Attributes
    ----------
    arbitrates : of frames that wait together, the lowest identifier goes first; else in order of sending.
    filters : stations can choose what they hear.
    remote : remote frames travel.
    clock_slack_us : what stamps may be off the clock of a station, because clocks are converted.
    """

    arbitrates = False
    filters = True
    remote = True
    clock_slack_us = 1000

    @abstractmethod
    def join(self, bus: Bus, filters: Iterable[Filter] | None = None, sends: bool = False) -> Member:
        """A new station. sends: the one whose frames the test is about."""

    @abstractmethod
    def has_lost(self, member: Member, sent: int) -> bool:
        """Whether a station that does not read has lost frames, after so many were sent."""


# --- the network of the lock-step bench ---


class InProcess(Backend):
    """`bridge.bus.Network`; the test is its clock."""

    arbitrates = True
    filters = False
    clock_slack_us = 0

    def __init__(self) -> None:
        self.network = Network()
        self.now_us = 0
        self.free = [station for station in Station if station is not Station.NONE]
        for bus in Bus:
            self.network.handle.members[bus] = 0

    def tick(self) -> None:
        self.network.begin_tick(self.now_us, self.now_us + TICK_US)
        self.network.transmit(*Bus)
        self.network.end_tick()
        self.network.clear_log()
        self.now_us += TICK_US

    def join(self, bus: Bus, filters: Iterable[Filter] | None = None, sends: bool = False) -> Member:  # noqa: ARG002
        return InProcessMember(self, bus, self.free.pop(0))

    def has_lost(self, member: Member, sent: int) -> bool:  # noqa: ARG002
        return member.lost() > 0


class InProcessMember(Member):
    loss = Loss.COUNTED

    def __init__(self, backend: InProcess, bus: Bus, station: Station) -> None:
        self.backend, self.bus, self.station = backend, bus, station
        self.inbox = backend.network.handle.inboxes[station]
        self.lost_before = self.inbox.lost
        backend.network.handle.members[bus] |= 1 << station
        backend.network.take(station)

    def send(self, *frames: Frame) -> int:
        refused = self.backend.network.handle.buses[self.bus].statistics.lost
        self.backend.network.submit(self.station, b"".join(frame.pack() for frame in frames))
        return len(frames) - (self.backend.network.handle.buses[self.bus].statistics.lost - refused)

    def take(self, wait_s: float) -> list[Frame]:
        for _ in range(100 if wait_s else 1):
            self.backend.tick()
            if frames := list(iterate(self.backend.network.take(self.station))):
                return [frame._replace(sender=0) for frame in frames]
        return []

    def now_us(self) -> int:
        return self.backend.now_us

    def lost(self) -> int:
        return self.inbox.lost - self.lost_before

    def leave(self) -> None:
        self.backend.network.handle.members[self.bus] &= ~(1 << self.station)
        self.backend.free.append(self.station)


# --- stations of the real-time run ---


class LinkMember(Member):
    """By `CanLink`."""

    loss = Loss.COUNTED

    def __init__(self, address: str, bus: Bus, filters: Iterable[Filter] | None) -> None:
        self.epoch_ns = time.monotonic_ns() - 10**9
        self.link = CanLink(address, bus, self.epoch_ns, filters)

    def send(self, *frames: Frame) -> int:
        rest = b"".join(frame.pack() for frame in frames)
        end = time.monotonic() + BOUND_S
        while True:
            rest = rest[24 * self.link.send(rest) :]
            if not rest:
                return len(frames)
            assert time.monotonic() < end, "no room in the send queue"
            select.select([], [self.link], [], BOUND_S)

    def take(self, wait_s: float) -> list[Frame]:
        select.select([self.link], [], [], wait_s)
        return list(iterate(self.link.receive().tobytes()))

    def now_us(self) -> int:
        return (time.monotonic_ns() - self.epoch_ns) // 1000

    def lost(self) -> int:
        return self.link.statistics.overflows

    def leave(self) -> None:
        self.link.close()


# --- any python-can program ---


class PythonCanMember(Member):
    """By a python-can interface, unchanged."""

    def __init__(self, interface: can.BusABC, bus: Bus, loss: Loss) -> None:
        self.interface, self.bus, self.loss = interface, bus, loss

    def send(self, *frames: Frame) -> int:
        for frame in frames:
            remote = bool(frame.flags & Flag.REMOTE)
            self.interface.send(
                can.Message(
                    arbitration_id=frame.id,
                    is_extended_id=bool(frame.flags & Flag.EXTENDED),
                    is_remote_frame=remote,
                    dlc=frame.dlc,
                    data=None if remote else frame.data[: frame.dlc],
                )
            )
        return len(frames)

    def take(self, wait_s: float) -> list[Frame]:
        frames = []
        message = self.interface.recv(wait_s)
        while message is not None:
            frames.append(Frame._make(next(iterate(frame_of(message, self.bus, round(message.timestamp * 1e6))))))
            message = self.interface.recv(0.0)
        return frames

    def now_us(self) -> int:
        return time.time_ns() // 1000

    def leave(self) -> None:
        self.interface.shutdown()


def can_filters(filters: Iterable[Filter] | None) -> list[dict[str, object]] | None:
    """As python-can states them."""
    if filters is None:
        return None
    return [
        {"can_id": one.id, "can_mask": 0x1FFFFFFF if one.extended else 0x7FF, "extended": one.extended}
        for one in filters
    ]


# --- the hub ---


class HubBackend(Backend):
    """A running hub; its log tells when somebody has lost frames."""

    def __init__(self, folder: Path) -> None:
        self.hub = Hub(folder)

    def link(self, bus: Bus, filters: Iterable[Filter] | None) -> Member:
        return LinkMember(f"hub:{self.hub.local}", bus, filters)

    def python_can(self, bus: Bus, filters: Iterable[Filter] | None) -> Member:
        interface = self.hub.client(CHANNELS[bus], can_filters=can_filters(filters))
        return PythonCanMember(interface, bus, Loss.ERROR_FRAME)

    def has_lost(self, member: Member, sent: int) -> bool:  # noqa: ARG002
        return any("too slowly" in line for line in self.hub.log())

    def close(self) -> None:
        assert self.hub.stop() == 0


class HubLinks(HubBackend):
    """Our stations among themselves."""

    def join(self, bus: Bus, filters: Iterable[Filter] | None = None, sends: bool = False) -> Member:  # noqa: ARG002
        return self.link(bus, filters)


class HubPythonCan(HubBackend):
    """Foreign stations among themselves. The socketcand protocol has no text for a remote frame."""

    remote = False

    def join(self, bus: Bus, filters: Iterable[Filter] | None = None, sends: bool = False) -> Member:  # noqa: ARG002
        return self.python_can(bus, filters)


class HubToPythonCan(HubBackend):
    """Our station sends, foreign ones listen."""

    remote = False

    def join(self, bus: Bus, filters: Iterable[Filter] | None = None, sends: bool = False) -> Member:
        return self.link(bus, filters) if sends else self.python_can(bus, filters)


class HubFromPythonCan(HubBackend):
    """A foreign station sends, ours listen."""

    remote = False

    def join(self, bus: Bus, filters: Iterable[Filter] | None = None, sends: bool = False) -> Member:
        return self.python_can(bus, filters) if sends else self.link(bus, filters)


# --- SocketCAN ---


class SocketCanBackend(Backend):
    """The kernel's virtual CAN, vcan0 to vcan4."""

    #: Frames; more than the receive queue of a raw socket holds, also that of a link.
    FLOOD = 8_000

    def interface(self, bus: Bus) -> str:
        return f"vcan{int(bus)}"

    def link(self, bus: Bus, filters: Iterable[Filter] | None) -> Member:
        return LinkMember(f"socketcan:{self.interface(bus)}", bus, filters)

    def python_can(self, bus: Bus, filters: Iterable[Filter] | None) -> Member:
        interface = can.Bus(interface="socketcan", channel=self.interface(bus), can_filters=can_filters(filters))
        return PythonCanMember(interface, bus, Loss.UNTOLD)

    def has_lost(self, member: Member, sent: int) -> bool:  # noqa: ARG002
        return sent >= self.FLOOD


class SocketCanLinks(SocketCanBackend):
    """Our stations among themselves."""

    def join(self, bus: Bus, filters: Iterable[Filter] | None = None, sends: bool = False) -> Member:  # noqa: ARG002
        return self.link(bus, filters)


class SocketCanToPythonCan(SocketCanBackend):
    """Our station sends, foreign ones listen."""

    def join(self, bus: Bus, filters: Iterable[Filter] | None = None, sends: bool = False) -> Member:
        return self.link(bus, filters) if sends else self.python_can(bus, filters)


class SocketCanFromPythonCan(SocketCanBackend):
    """A foreign station sends, ours listen."""

    def join(self, bus: Bus, filters: Iterable[Filter] | None = None, sends: bool = False) -> Member:
        return self.python_can(bus, filters) if sends else self.link(bus, filters)
