"""One simulated wire with its nodes, its clock and the frames that are sent by the clock."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

from can.exceptions import CanInitializationError, CanOperationError

from bridge._native import ffi, lib
from bridge.delays import MessageDelay, message_delays

#: Events taken out of the model at once: one, so that each node tells of an error with its counters of that moment.
_EVENTS = 1

#: Frames that a node holds for a program that does not read; what comes then is lost, as in a socket's buffer.
RECEIVE_MAX = 65_536

NEVER_NS = 2**64 - 1


class Clock(StrEnum):
    """What makes time pass on a channel."""

    WALL = "wall"
    """The computer's clock; whoever waits for a frame waits as long as it takes."""

    SIMULATED = "simulated"
    """Waiting itself: a program that waits for a frame has it at once, and time is then that frame's. Nothing sleeps,
    and a second run is the same. For programs of one thread."""


@dataclass(frozen=True)
class Disturbance:
    """A planned error: the next frames that match are destroyed on the wire.

    Attributes
    ----------
    count : frames.
    identifier : of the frames; None for any.
    bit : from the start of frame, at which a bit is wrong.
    sender : node whose frames are meant; None for any.
    receiver : node that alone takes the frame for broken; None: the bit is wrong for all.
    """

    count: int = 1
    identifier: int | None = None
    bit: int = 40
    sender: Node | None = None
    receiver: Node | None = None


@dataclass(eq=False)
class Node:
    """A node's place on the wire, and what it has received.

    Attributes
    ----------
    index : number on the wire.
    own : whether it hears its own frames.
    received : C structs `can_bus_frame`, oldest first.
    lost : frames that it did not hold.
    """

    index: int
    own: bool
    received: deque[Any]
    lost: int = 0


class Sender(Protocol):
    """Something that sends by the clock of a channel."""

    def due_ns(self) -> int:
        """When it sends next; `NEVER_NS` for never."""

    def send_due(self) -> None:
        """Send what is due, and plan the next one."""


class Channel:
    """A wire. One lock guards it; its methods are for those who hold it, but for those that take it themselves.

    Parameters
    ----------
    name : that buses join it by.
    bit_rate, data_bit_rate : bit/s, the second of the fast part of FD frames.
    clock : what makes time pass.

    Attributes
    ----------
    model : C struct `can_bus_model`.
    changed : the lock, notified when something was sent.
    senders : called when they are due.
    """

    def __init__(self, name: str, bit_rate: int, data_bit_rate: int, clock: Clock) -> None:
        self.name = name
        self.bit_rate = bit_rate
        self.data_bit_rate = data_bit_rate
        self.clock = clock
        self.model: Any = ffi.new("can_bus_model *")
        lib.can_bus_init(self.model, bit_rate, data_bit_rate)
        if self.model.bit_ns == 0 or self.model.data_bit_ns != 10**9 // data_bit_rate:
            raise CanInitializationError(
                f"simcan {name}: bit rates {bit_rate} and {data_bit_rate} bit/s; allowed are divisors of 1e9, from 1000"
                " to 1000000, and up to 8000000 for the data of FD frames"
            )
        self.changed = threading.Condition(threading.RLock())
        self.senders: list[Sender] = []
        self._nodes: dict[int, Node] = {}
        self._events = ffi.new("can_bus_frame[]", _EVENTS)
        self._epoch_ns = time.time_ns() if clock is Clock.WALL else 0
        self._started_ns = time.monotonic_ns()
        self._now_ns = 0

    def join(self, mode: int, own: bool, restart_ns: int) -> Node:
        """Put a node on the wire.

        Parameters
        ----------
        mode : bits of the C enum `can_bus_mode`.
        own : whether it hears its own frames.
        restart_ns : pause after bus-off before it recovers; 0 for no recovery by itself.

        Raises
        ------
        CanInitializationError
            When there are too many.
        """
        for index in range(lib.CAN_BUS_NODES_MAX):
            if lib.can_bus_join(self.model, index, mode):
                self.model.nodes[index].restart_ns = restart_ns
                self._nodes[index] = Node(index, own, deque())
                return self._nodes[index]
        raise CanInitializationError(f"simcan {self.name}: {lib.CAN_BUS_NODES_MAX} nodes are on it, which is the most")

    def leave(self, node: Node) -> None:
        """Take a node off the wire."""
        del self._nodes[node.index]
        lib.can_bus_leave(self.model, node.index)

    @property
    def full(self) -> bool:
        """True when no frame can be queued."""
        return bool(self.model.free_count == 0)

    @property
    def empty(self) -> bool:
        """True when no node is left."""
        return not self._nodes

    def now_ns(self) -> int:
        """Time on the wire."""
        if self.clock is Clock.WALL:
            self._now_ns = time.monotonic_ns() - self._started_ns
        return self._now_ns

    def timestamp(self, time_us: int) -> float:
        """Time of a frame for a program: seconds since 1970, or since the channel began when time is simulated."""
        return (self._epoch_ns + time_us * 1000) / 1e9

    def advance(self, until_ns: int, stop_for: Node | None = None) -> None:
        """Let the wire work up to a time, frames into the nodes' hands; simulated time is then there.

        Parameters
        ----------
        stop_for : return as soon as this node has received something.
        """
        while stop_for is None or not stop_for.received:
            due_ns = min((sender.due_ns() for sender in self.senders), default=NEVER_NS)
            event_ns = lib.can_bus_next_ns(self.model)
            if min(due_ns, event_ns) > until_ns:
                break
            if self.clock is Clock.SIMULATED:
                self._now_ns = max(self._now_ns, min(due_ns, event_ns))
            if due_ns < event_ns:
                for sender in [one for one in self.senders if one.due_ns() == due_ns]:
                    sender.send_due()
            elif lib.can_bus_run(self.model, event_ns + 1, self._events, _EVENTS):
                self._hand_out(self._events[0])
        else:
            return
        if self.clock is Clock.SIMULATED and until_ns != NEVER_NS:
            self._now_ns = max(self._now_ns, until_ns)

    def submit(self, node: Node, frame: Any, at_ns: int) -> None:
        """Queue a C struct `can_bus_frame`; it is lost, and counted, when there is no room or the node is off."""
        lib.can_bus_submit(self.model, node.index, frame, at_ns)
        self.changed.notify_all()

    def is_off(self, node: Node) -> bool:
        """Whether a node has gone off the bus."""
        return bool(self.model.nodes[node.index].state == lib.CAN_BUS_OFF)

    def wait_for_frame(self, node: Node, timeout: float | None) -> Any | None:
        """The oldest frame that a node has received, C struct `can_bus_frame`, or None after `timeout` seconds.

        Takes the lock. With simulated time this is what makes time pass; a program that waits without a limit, for what
        only another thread can send, really waits.
        """
        with self.changed:
            deadline_ns = NEVER_NS if timeout is None else self.now_ns() + round(max(timeout, 0.0) * 1e9)
            while True:
                self.advance(self.now_ns() if self.clock is Clock.WALL else deadline_ns, stop_for=node)
                if node.received:
                    return node.received.popleft()
                now_ns = self.now_ns()
                if now_ns >= deadline_ns:
                    return None
                wake_ns = min(deadline_ns, lib.can_bus_next_ns(self.model), *(one.due_ns() for one in self.senders))
                self.changed.wait(None if wake_ns == NEVER_NS else max(wake_ns - now_ns, 0) / 1e9)

    @contextmanager
    def held(self) -> Iterator[int]:
        """Hold the lock, with all done that has happened before now; gives the time.

        What happens now is still open: frames that are sent at the same moment compete.
        """
        with self.changed:
            now_ns = self.now_ns()
            self.advance(now_ns - 1)
            yield now_ns

    def disturb(self, disturbance: Disturbance) -> None:
        """Plan an error. Takes the lock.

        Raises
        ------
        CanOperationError
            When too many are planned.
        """
        identifier = disturbance.identifier
        planned = {
            "id": 0 if identifier is None else identifier,
            "mask": 0 if identifier is None else 0xFFFF_FFFF,
            "count": disturbance.count,
            "bit": disturbance.bit,
            "sender": lib.CAN_BUS_NOBODY if disturbance.sender is None else disturbance.sender.index,
            "receiver": lib.CAN_BUS_NOBODY if disturbance.receiver is None else disturbance.receiver.index,
        }
        with self.held():
            if not lib.can_bus_disturb(self.model, ffi.new("can_bus_disturbance *", planned)):
                raise CanOperationError(
                    f"simcan {self.name}: {lib.CAN_BUS_DISTURBANCES_MAX} errors are planned already"
                )

    def set_bit_error_rate(self, rate: float, seed: int) -> None:
        """Let bits be wrong at random. Takes the lock.

        Parameters
        ----------
        rate : probability that a bit on the wire is wrong, 0 to below 1.
        seed : of the generator.

        Raises
        ------
        ValueError
            When the rate is out of range.
        """
        if not 0.0 <= rate < 1.0:
            raise ValueError(f"bit error rate {rate}; allowed is 0 to below 1")
        with self.held():
            lib.can_bus_set_bit_error_rate(self.model, rate, seed & NEVER_NS)

    def load(self) -> float:
        """Part of the time so far in which the wire was busy, 0..1. Takes the lock."""
        with self.held() as now_ns:
            return float(self.model.statistics.busy_ns / now_ns) if now_ns else 0.0

    def delays(self) -> list[MessageDelay]:
        """What every identifier had to wait so far, by identifier. Takes the lock."""
        with self.held():
            return message_delays(self.model)

    def _hand_out(self, event: Any) -> None:
        """Give a frame to all other nodes, an error to all."""
        error = bool(event.frame.flags & lib.CAN_FLAG_ERROR)
        for node in self._nodes.values():
            state = self.model.nodes[node.index].state
            own = node.index == event.frame.sender
            if (own and not node.own and not error) or (state == lib.CAN_BUS_OFF and not own):
                continue
            if len(node.received) >= RECEIVE_MAX:
                node.lost += 1
                continue
            frame = ffi.new("can_bus_frame *", event)
            if error and not own and event.frame.id & lib.CAN_BUS_ERROR_COUNTERS:
                kind = event.frame.id & (lib.CAN_BUS_ERROR_PROTOCOL | lib.CAN_BUS_ERROR_NO_ACK)
                if not event.frame.id & lib.CAN_BUS_ERROR_ON_WIRE:
                    continue  # another node has come back: nothing that can be heard
                lib.can_bus_report(
                    self.model, node.index, kind | lib.CAN_BUS_ERROR_ON_WIRE, event.frame.time_us * 1000, frame
                )
                frame.frame.sender = event.frame.sender
            node.received.append(frame)
        self.changed.notify_all()


_channels: dict[str, Channel] = {}
_lock = threading.Lock()


def open_channel(name: str, bit_rate: int, data_bit_rate: int, clock: Clock | None) -> Channel:
    """The channel of a name; a new one, by the wall clock if nothing is said, when there is none.

    Raises
    ------
    CanInitializationError
        When it exists with another bit rate or clock: on a real bus such a node destroys every frame.
    """
    with _lock:
        channel = _channels.get(name)
        if channel is None:
            channel = _channels[name] = Channel(name, bit_rate, data_bit_rate, clock or Clock.WALL)
        there = (channel.bit_rate, channel.data_bit_rate, channel.clock)
        if (bit_rate, data_bit_rate, clock or channel.clock) != there:
            raise CanInitializationError(
                f"simcan {name}: runs at {there[0]} bit/s, data at {there[1]} bit/s, by the {there[2]} clock;"
                f" {bit_rate}, {data_bit_rate}{f', {clock}' if clock else ''} was asked for"
            )
        return channel


def find_channel(name: str) -> Channel:
    """The channel of a name, on which at least one bus is.

    Raises
    ------
    CanOperationError
        When there is none.
    """
    with _lock:
        if name not in _channels:
            there = f"; there are {', '.join(sorted(_channels))}" if _channels else ""
            raise CanOperationError(f"simcan {name}: no bus is on this channel{there}")
        return _channels[name]


def close_channel(channel: Channel) -> None:
    """Forget a channel that nobody is on."""
    with _lock:
        if channel.empty and _channels.get(channel.name) is channel:
            del _channels[channel.name]


def channel_names() -> list[str]:
    """Names of the channels that somebody is on."""
    with _lock:
        return sorted(_channels)
