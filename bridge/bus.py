"""In-process CAN buses: the car's network of stations, with bus timing, load and delays, and a frame log.

The model is C (``bridge/native/network.h``); this is its one Python face. Frames cross it as buffers of 24-byte
records (:mod:`dbc.frames`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.delays import MessageDelay, message_delays
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Bus, Station

#: Bit rate of each bus in bit/s, as the DBC files state it (a contract test compares).
BIT_RATES: Mapping[Bus, int] = MappingProxyType(
    {Bus.CAN1: 500_000, Bus.CAN3: 500_000, Bus.CAN_A: 1_000_000, Bus.CAN_S: 500_000, Bus.CAN_R: 500_000}
)

#: Names of the buses as channels of log files and taps.
CHANNELS: Mapping[Bus, str] = MappingProxyType(
    {Bus.CAN1: "CAN1", Bus.CAN3: "CAN3", Bus.CAN_A: "CANA", Bus.CAN_S: "CANS", Bus.CAN_R: "CANR"}
)


@dataclass(frozen=True)
class BusStatistics:
    """What one bus carried since the start.

    Attributes
    ----------
    frames, lost, deferred : frames transmitted; refused because the queue was full; waits for the next tick.
    load, load_peak : share of the time that the bus was busy, on average and in the busiest tick, 0..1.
    bits, stuff_bits : bits on the wire, intermission included, and how many of them are stuff bits.
    """

    frames: int
    lost: int
    deferred: int
    load: float
    load_peak: float
    bits: int
    stuff_bits: int


class Network:
    """The buses and the stations that sit on them.

    Parameters
    ----------
    bit_rates : bit/s per bus.
    """

    def __init__(self, bit_rates: Mapping[Bus, int] = BIT_RATES) -> None:
        self.handle: Any = ffi.new("network *")
        lib.network_init(self.handle, [bit_rates[bus] for bus in Bus])
        self._alter: Callable[[bytes], bytes] | None = None
        self._tick_us = 0
        self._elapsed_us = 0

    def save_state(self) -> tuple[bytes, Callable[[bytes], bytes] | None, int, int]:
        """Inboxes, queues, watches and counts between two ticks, see `bridge.saved_state`.

        Raises
        ------
        ValueError
            When there are frames in the log: to be drained before.
        """
        if self.handle.log_count or self.handle.diverted_count:
            raise ValueError("the network can be saved between two ticks only, and when its log is drained")
        return bytes(self._lasting()), self._alter, self._tick_us, self._elapsed_us

    def restore_state(self, state: tuple[bytes, Callable[[bytes], bytes] | None, int, int]) -> None:
        """Go on from there."""
        self._lasting()[:], self._alter, self._tick_us, self._elapsed_us = state

    def _lasting(self) -> Any:
        """Memory of the network up to what lasts for a tick only, or until the log is drained."""
        return ffi.buffer(self.handle, ffi.offsetof("network", "log"))

    def begin_tick(self, start_us: int, end_us: int) -> None:
        """Start the tick [start_us, end_us); what is transmitted from now on is stamped inside it."""
        lib.network_begin_slot(self.handle, start_us, end_us)
        self._tick_us = end_us - start_us
        self._elapsed_us += self._tick_us

    def end_tick(self) -> None:
        """End the tick: what is still pending waits for the next one."""
        lib.network_end_slot(self.handle)

    def submit(self, station: Station, frames: bytes) -> None:
        """Queue frames of a station on the buses that they name.

        Parameters
        ----------
        frames : whole 24-byte frames, one after the other.

        Raises
        ------
        ValueError
            When the buffer does not hold whole frames.
        """
        if not frames:
            return
        count, rest = divmod(len(frames), FRAME_SIZE)
        if rest:
            raise ValueError(f"{len(frames)} bytes are not whole frames of {FRAME_SIZE}")
        lib.network_submit(self.handle, station, ffi.from_buffer("can_frame[]", frames), count)

    def divert(self, alter: Callable[[bytes], bytes] | None) -> None:
        """Let a function change what stations send, before it gets to the buses.

        Parameters
        ----------
        alter : takes the frames that were submitted since the last transmission, in order, and returns those that are
            to be queued, each with its sender; None for none.
        """
        self._alter = alter
        self.handle.diverting = alter is not None

    def forward(self, frames: bytes) -> None:
        """Queue frames, each at the station that is its sender; they are not diverted."""
        lib.network_forward(self.handle, ffi.from_buffer("can_frame[]", frames), len(frames) // FRAME_SIZE)

    def transmit(self, *buses: Bus) -> None:
        """Send what is pending on these buses into the inboxes of their stations, by arbitration."""
        if self._alter is not None:
            diverted = bytes(ffi.buffer(self.handle.diverted, self.handle.diverted_count * FRAME_SIZE))
            self.handle.diverted_count = 0
            if diverted:
                self.forward(self._alter(diverted))
        for bus in buses:
            lib.network_transmit(self.handle, bus)

    def take(self, station: Station) -> bytes:
        """Frames that a station has received since it last took them, in the order of their arrival."""
        inbox = self.handle.inboxes[station]
        frames = bytes(ffi.buffer(inbox.frames, inbox.count * FRAME_SIZE))
        inbox.count = 0
        return frames

    def logged(self) -> int:
        """Frames in the log."""
        return int(self.handle.log_count)

    def log_view(self, first: int = 0) -> NDArray[np.void]:
        """Frames of the log from place `first` on, per bus in order of time; valid until the log is drained."""
        count = self.handle.log_count
        log: NDArray[np.void] = np.frombuffer(ffi.buffer(self.handle.log, count * FRAME_SIZE), dtype=FRAME_DTYPE)
        return log[first:]

    def drain_log(self) -> NDArray[np.void]:
        """Take all frames out of the log, in order of time over all buses.

        To be called between ticks, often enough for `log_half_full` to stay false.
        """
        log = self.log_view()
        # Rows of three words move several times as fast as records.
        words = log.view(np.uint64).reshape(-1, FRAME_SIZE // 8)
        ordered: NDArray[np.void] = words[np.argsort(log["time_us"], kind="stable")].reshape(-1).view(FRAME_DTYPE)
        self.clear_log()
        return ordered

    def clear_log(self) -> None:
        """Forget the frames of the log."""
        self.handle.log_count = 0

    @property
    def log_half_full(self) -> bool:
        """True when the log should be drained: what is left holds more than one tick of full buses."""
        return bool(self.handle.log_count > lib.NETWORK_LOG_MAX // 2)

    def watch(self, bus: Bus, identifier: int) -> Any:
        """Keep the newest frame of an 11-bit identifier; returns the C struct `network_watch`."""
        place = lib.network_add_watch(self.handle, bus, identifier)
        if place == lib.NETWORK_WATCH_MAX:
            raise ValueError(f"only {lib.NETWORK_WATCH_MAX} identifiers can be watched")
        return self.handle.watches[place]

    def losses(self) -> int:
        """Frames lost for want of room anywhere: queues, inboxes, log, or a bus that does not exist."""
        handle = self.handle
        queues = sum(handle.buses[bus].statistics.lost for bus in Bus)
        inboxes = sum(handle.inboxes[station].lost for station in Station)
        return int(queues + inboxes + handle.log_lost + handle.misaddressed + handle.diverted_lost)

    def statistics(self) -> dict[Bus, BusStatistics]:
        """Counts of every bus."""
        elapsed_ns = max(self._elapsed_us * 1000, 1)
        tick_ns = max(self._tick_us * 1000, 1)
        result = {}
        for bus in Bus:
            counts = self.handle.buses[bus].statistics
            result[bus] = BusStatistics(
                frames=counts.frames,
                lost=counts.lost,
                deferred=counts.deferred,
                load=counts.busy_ns / elapsed_ns,
                load_peak=counts.busiest_slot_ns / tick_ns,
                bits=counts.bits,
                stuff_bits=counts.stuff_bits,
            )
        return result

    def delays(self) -> dict[Bus, list[MessageDelay]]:
        """What the frames of every identifier had to wait, in order of identifiers."""
        return {bus: message_delays(self.handle.buses[bus]) for bus in Bus}
