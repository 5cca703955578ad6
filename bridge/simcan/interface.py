"""python-can's face of a simulated wire: `can.Bus(interface="simcan", channel=NAME)`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import can
from can.broadcastmanager import (
    CyclicSendTaskABC,
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)
from can.exceptions import CanInitializationError, CanOperationError

from bridge._native import ffi, lib
from bridge.delays import MessageDelay
from bridge.simcan.channel import (
    NEVER_NS,
    Channel,
    Clock,
    Disturbance,
    Node,
    channel_names,
    close_channel,
    open_channel,
)

_QUEUES = {"fifo": lib.CAN_BUS_FIFO, "priority": 0}
_FIRST = 8
"""Data bytes in the classic part of the C struct."""


class SimCanBus(can.BusABC):
    """A node on a simulated wire.

    Parameters
    ----------
    channel : name of the wire; all buses of that name in this process are on it.
    bitrate, data_bitrate : bit/s; the second of the fast part of FD frames, `bitrate` by default.
    fd : send and accept CAN FD. A node without it destroys FD frames, as a classic controller does.
    clock : "wall" or "simulated", see `bridge.simcan.channel.Clock`; None: as those have it that are there, else wall.
    queue : "fifo", frames leave in order of sending, as SocketCAN's do, or "priority", by identifier.
    receive_own_messages : hear own frames, with `is_rx` False.
    restart_ms : pause after bus-off before the node recovers by itself; 0 for not.
    listen_only : neither send nor acknowledge.

    Attributes
    ----------
    wire, node : the channel, and this bus's place on it.

    Raises
    ------
    CanInitializationError
        When an option is not one of these values, or the channel runs with other bit rates or another clock.
    """

    def __init__(
        self,
        channel: Any = "simcan0",
        bitrate: int = 500_000,
        data_bitrate: int | None = None,
        fd: bool = False,
        clock: str | None = None,
        queue: str = "fifo",
        receive_own_messages: bool = False,
        restart_ms: float = 0,
        listen_only: bool = False,
        can_filters: can.typechecking.CanFilters | None = None,
        **kwargs: Any,
    ) -> None:
        if queue not in _QUEUES:
            raise CanInitializationError(f"simcan {channel}: queue {queue!r}; allowed are {', '.join(_QUEUES)}")
        if clock is not None and clock not in [str(one) for one in Clock]:
            raise CanInitializationError(f"simcan {channel}: clock {clock!r}; allowed are {', '.join(Clock)}")
        mode = _QUEUES[queue] | (0 if fd else lib.CAN_BUS_CLASSIC) | (lib.CAN_BUS_LISTEN_ONLY if listen_only else 0)
        self.wire: Channel = open_channel(
            str(channel), int(bitrate), int(data_bitrate or bitrate), None if clock is None else Clock(clock)
        )
        with self.wire.held():
            self.node: Node = self.wire.join(mode, bool(receive_own_messages), round(float(restart_ms) * 1e6))
        self.fd = bool(fd)
        self.channel_info = f"simcan channel {self.wire.name}, node {self.node.index}"
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue a message; it is on the wire when the bus is free and nobody has something more important.

        Parameters
        ----------
        timeout : seconds to wait for room in the queue; None for none.

        Raises
        ------
        CanOperationError
            When there is no room, the node is off the bus or only listens, or an FD message does not fit the bus.
        """
        self._must_be_open()
        if msg.is_fd and not self.fd:
            raise CanOperationError(f"{self.channel_info}: a CAN FD message on a bus that was opened without fd=True")
        frame = _to_frame(msg)
        with self.wire.held() as now_ns:
            if self.wire.is_off(self.node):
                raise CanOperationError(f"{self.channel_info}: off the bus after too many errors; see restart_ms")
            if self.state is can.BusState.PASSIVE:
                raise CanOperationError(f"{self.channel_info}: only listens")
            deadline_ns = now_ns + round(max(timeout or 0.0, 0.0) * 1e9)
            while self.wire.full:
                next_ns = lib.can_bus_next_ns(self.wire.model)
                if next_ns > deadline_ns:
                    raise CanOperationError(f"{self.channel_info}: the transmit queue is full")
                if self.wire.clock is Clock.WALL:
                    self.wire.changed.wait(max(next_ns - self.wire.now_ns(), 0) / 1e9)
                    next_ns = self.wire.now_ns()
                self.wire.advance(next_ns)
            self.wire.submit(self.node, frame, self.wire.now_ns())

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Wait for a message, see `can.BusABC.recv`; errors on the wire come as error frames, whatever the filters are.

        With simulated time this is what lets time pass: up to the message, or by `timeout` when there is none.
        """
        self._must_be_open()
        deadline_ns = None if timeout is None else self._now_ns() + round(max(timeout, 0.0) * 1e9)
        while True:
            left = None if deadline_ns is None else (deadline_ns - self._now_ns()) / 1e9
            frame = self.wire.wait_for_frame(self.node, left)
            if frame is None:
                return None
            message = self._to_message(frame)
            if message.is_error_frame or self._matches_filters(message):
                return message

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.recv(timeout), True

    def flush_tx_buffer(self) -> None:
        """Throw away what waits to be sent, but for what is on the wire."""
        with self.wire.held():
            lib.can_bus_flush(self.wire.model, self.node.index)

    def shutdown(self) -> None:
        """Leave the wire."""
        if not self._is_shutdown:
            super().shutdown()
            with self.wire.held():
                self.wire.leave(self.node)
                self.wire.changed.notify_all()
            close_channel(self.wire)

    @property
    def state(self) -> can.BusState:
        """ERROR when off the bus, PASSIVE when only listening, else ACTIVE."""
        with self.wire.held():
            if self.wire.is_off(self.node):
                return can.BusState.ERROR
            listens = self.wire.model.nodes[self.node.index].mode & lib.CAN_BUS_LISTEN_ONLY
            return can.BusState.PASSIVE if listens else can.BusState.ACTIVE

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        if new_state is can.BusState.ERROR:
            raise ValueError("a node goes off the bus by errors only; allowed are ACTIVE and PASSIVE")
        with self.wire.held():
            node = self.wire.model.nodes[self.node.index]
            if new_state is can.BusState.PASSIVE:
                node.mode |= lib.CAN_BUS_LISTEN_ONLY
            else:
                node.mode &= ~lib.CAN_BUS_LISTEN_ONLY & 0xFF

    @property
    def error_counters(self) -> tuple[int, int]:
        """Transmit and receive error counter; above 127 the node is error-passive, above 255 off the bus."""
        with self.wire.held():
            node = self.wire.model.nodes[self.node.index]
            return int(node.transmit_errors), int(node.receive_errors)

    def restart(self) -> None:
        """Come back after bus-off, when the wire has been quiet for 128 times 11 bits."""
        with self.wire.held() as now_ns:
            lib.can_bus_restart(self.wire.model, self.node.index, now_ns)
            self.wire.changed.notify_all()

    def disturb(self, disturbance: Disturbance) -> None:
        """Plan an error on the wire."""
        self.wire.disturb(disturbance)

    def load(self) -> float:
        """Part of the time so far in which the wire was busy, 0..1."""
        return self.wire.load()

    def delays(self) -> list[MessageDelay]:
        """What every identifier on the wire had to wait so far."""
        return self.wire.delays()

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> CyclicSendTaskABC:
        task = CyclicTask(self, msgs, period, duration, modifier_callback)
        if autostart:
            task.start()
        return task

    def _to_message(self, frame: Any) -> can.Message:
        head = frame.frame
        remote = bool(head.flags & lib.CAN_FLAG_REMOTE)
        fd = bool(head.flags & lib.CAN_WIRE_FLAG_FD)
        data = bytes(head.data)[: head.dlc] + bytes(frame.more)[: max(head.dlc - _FIRST, 0)]
        return can.Message(
            timestamp=self.wire.timestamp(head.time_us),
            arbitration_id=head.id,
            is_extended_id=bool(head.flags & lib.CAN_FLAG_EXTENDED),
            is_remote_frame=remote,
            is_error_frame=bool(head.flags & lib.CAN_FLAG_ERROR),
            is_fd=fd,
            bitrate_switch=bool(head.flags & lib.CAN_WIRE_FLAG_BRS),
            error_state_indicator=bool(head.flags & lib.CAN_WIRE_FLAG_ESI),
            channel=self.wire.name,
            dlc=head.dlc,
            data=None if remote else data,
            is_rx=head.sender != self.node.index,
        )

    def _now_ns(self) -> int:
        with self.wire.changed:
            return self.wire.now_ns()

    def _must_be_open(self) -> None:
        if self._is_shutdown:
            raise CanOperationError(f"{self.channel_info}: the bus is closed")

    @staticmethod
    def _detect_available_configs() -> list[can.typechecking.AutoDetectedConfig]:
        return [{"interface": "simcan", "channel": name} for name in channel_names()]


class CyclicTask(LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC):
    """Messages sent by the clock of the wire, to the nanosecond; a message that finds no room in the queue is left out.

    Parameters
    ----------
    bus : that sends.
    messages : sent in turns, one per period.
    period, duration : seconds; None for without end.
    modify : called with a message before it is sent.
    """

    def __init__(
        self,
        bus: SimCanBus,
        messages: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None,
        modify: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(messages, period, duration)
        if self.period_ns <= 0:
            raise ValueError(f"period {period} s; must be at least a nanosecond")
        self._bus = bus
        self._modify = modify
        self._next_ns = NEVER_NS
        self._end_ns = NEVER_NS
        self._turn = 0

    def start(self) -> None:
        """Send from now on."""
        wire = self._bus.wire
        with wire.held() as now_ns:
            self._next_ns = now_ns
            self._end_ns = NEVER_NS if self.duration is None else now_ns + round(self.duration * 1e9)
            if self not in wire.senders:
                wire.senders.append(self)
            wire.changed.notify_all()

    def stop(self) -> None:
        """Send no more."""
        wire = self._bus.wire
        with wire.held():
            self._next_ns = NEVER_NS
            if self in wire.senders:
                wire.senders.remove(self)

    def due_ns(self) -> int:
        """When the next message is sent."""
        return self._next_ns

    def send_due(self) -> None:
        """Send the message whose turn it is."""
        message = self.messages[self._turn]
        self._turn = (self._turn + 1) % len(self.messages)
        if self._modify is not None:
            self._modify(message)
        due_ns, self._next_ns = self._next_ns, self._next_ns + self.period_ns
        if self._next_ns >= self._end_ns:
            self._next_ns = NEVER_NS
        self._bus.wire.submit(self._bus.node, _to_frame(message), due_ns)


def _to_frame(message: can.Message) -> Any:
    """C struct `can_bus_frame` of a message."""
    frame = ffi.new("can_bus_frame *")
    head = frame.frame
    head.id, head.dlc = message.arbitration_id, message.dlc
    head.flags = (
        lib.CAN_FLAG_EXTENDED * message.is_extended_id
        | lib.CAN_FLAG_REMOTE * message.is_remote_frame
        | lib.CAN_FLAG_ERROR * message.is_error_frame
        | lib.CAN_WIRE_FLAG_FD * message.is_fd
        | lib.CAN_WIRE_FLAG_BRS * message.bitrate_switch
        | lib.CAN_WIRE_FLAG_ESI * message.error_state_indicator
    )
    data = bytes(message.data)
    ffi.memmove(head.data, data[:_FIRST], len(data[:_FIRST]))
    if len(data) > _FIRST:
        ffi.memmove(frame.more, data[_FIRST:], len(data) - _FIRST)
    return frame
