"""Faults of frames: lost, late, repeated, damaged, misaddressed; and of the bus that carries them.

The vocabulary is that of AUTOSAR E2E and ISO 26262-5 (table D.1): loss, delay, repetition, corruption, masquerade, and
blocking of the channel by a babbling node.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.faults.fault import (
    BenchFault,
    FrameFault,
    Memory,
    Selection,
    check_range,
    frames_from,
    frames_of,
    parameter,
    with_values,
)
from dbc.buses import Bus, Station
from dbc.codec import Codec
from dbc.errors import CodecError
from dbc.frames import Frame

if TYPE_CHECKING:
    from bridge.bench import Bench

_WORD_BITS = 64


@dataclass(frozen=True, kw_only=True)
class _StreamFault(FrameFault):
    """Befalls the frames of one message, or all that one station sends."""

    message: str | None = None
    station: Station | None = None

    def check(self, database: Codec) -> None:
        if (self.message is None) == (self.station is None):
            raise CodecError(f"{self.kind} needs either a message or a station")
        self.selection(database)

    def selection(self, database: Codec) -> Selection:
        if self.message is not None:
            return frames_of(database, [self.message])
        assert self.station is not None
        return frames_from(self.station)


@dataclass(frozen=True, kw_only=True)
class Drop(_StreamFault):
    """Frames are lost, each with a probability."""

    kind = "drop"
    probability: float = parameter(default=1.0, exclusiveMinimum=0, maximum=1)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return [] if memory.random.random() < self.probability else [frame]


@dataclass(frozen=True, kw_only=True)
class Delay(_StreamFault):
    """Frames come a number of ticks late; what is on its way when the fault ends still comes."""

    kind = "delay"
    ticks: int = parameter(minimum=1, maximum=1000)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return [frame]

    @property
    def late_ticks(self) -> int:
        return self.ticks


@dataclass(frozen=True, kw_only=True)
class Duplicate(_StreamFault):
    """Every frame is sent again, a number of times."""

    kind = "duplicate"
    copies: int = parameter(default=1, minimum=1, maximum=8)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return [frame] * (1 + self.copies)


@dataclass(frozen=True, kw_only=True)
class Corrupt(_StreamFault):
    """Bits of the data are flipped behind the sender's CRC: some that are named, or some at random.

    Attributes
    ----------
    bits : places, bit 0 is the lowest of the first byte.
    random_bits : how many others, anew in every frame, among those that are sent.
    """

    kind = "corrupt"
    bits: tuple[int, ...] = parameter(default=(), minimum=0, maximum=_WORD_BITS - 1)
    random_bits: int = parameter(default=0, minimum=0, maximum=_WORD_BITS)

    def check(self, database: Codec) -> None:
        super().check(database)
        if not self.bits and not self.random_bits:
            raise CodecError("corrupt needs bits or random_bits")

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        sent = range(8 * min(frame.dlc, 8))
        flips = {bit for bit in self.bits if bit in sent}
        flips ^= set(memory.random.sample(sent, min(self.random_bits, len(sent))))
        word = int.from_bytes(frame.data, "little") ^ sum(1 << bit for bit in flips)
        return [frame._replace(data=word.to_bytes(8, "little"))]


@dataclass(frozen=True, kw_only=True)
class Replay(_StreamFault):
    """Old frames come again: each is replaced by the one that was sent a number of frames before it.

    The first frames, which have no such predecessor since the fault began, pass.
    """

    kind = "replay"
    age: int = parameter(minimum=1, maximum=1000)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        past: list[Frame] = memory.kept.setdefault((frame.bus, frame.id), [])
        past.append(frame)
        return [past.pop(0) if len(past) > self.age else frame]


@dataclass(frozen=True, kw_only=True)
class Reorder(_StreamFault):
    """Every frame waits for the next one of its message and goes out behind it."""

    kind = "reorder"

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        waiting = memory.kept.pop((frame.bus, frame.id), None)
        if waiting is not None:
            return [frame, waiting]
        memory.kept[frame.bus, frame.id] = frame
        return []

    def release(self, memory: Memory) -> list[Frame]:
        waiting = list(memory.kept.values())
        memory.kept.clear()
        return waiting


@dataclass(frozen=True, kw_only=True)
class WrongLength(_StreamFault):
    """Frames have another number of data bytes; bytes that are added are 0."""

    kind = "wrong_length"
    length: int = parameter(minimum=0, maximum=8)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return [frame._replace(dlc=self.length, data=frame.data[: self.length].ljust(8, b"\0"))]


@dataclass(frozen=True, kw_only=True)
class WrongIdentifier(_StreamFault):
    """Frames go out under another 11-bit identifier."""

    kind = "wrong_identifier"
    identifier: int = parameter(minimum=0, maximum=0x7FF)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return [frame._replace(id=self.identifier, flags=frame.flags & ~1)]


@dataclass(frozen=True, kw_only=True)
class Masquerade(FrameFault, BenchFault):
    """Another station sends a message in the place of its owner, with a counter that moves and a CRC that fits.

    Attributes
    ----------
    station : that sends it, whenever the owner would.
    signal, value : what it says otherwise than the owner, in the unit of the message; the rest is the owner's.
    owner_heard : the owner's frames go out too, and the other's a tick behind each, with the counter that follows:
        ahead of the owner's next one, which has the same.
    """

    kind = "masquerade"
    message: str
    station: Station
    signal: str | None = parameter(default=None)
    value: float | None = parameter(default=None)
    owner_heard: bool = parameter(default=False)

    def check(self, database: Codec) -> None:
        message = database.message(self.message)
        if self.station == message.sender:
            raise CodecError(f"masquerade: {self.station.name} is the owner of {self.message}; name another station")
        if (self.signal is None) != (self.value is None):
            raise CodecError("masquerade needs both signal and value, or neither")
        if self.signal is not None and self.value is not None:
            check_range(f"{self.message}.{self.signal}", self.value, *message.limits(self.signal))

    def selection(self, database: Codec) -> Selection:
        return frames_of(database, [self.message])

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        codec = memory.database.message(self.message)
        if frame.dlc < codec.length:
            return [frame]
        counter = codec.facts.counter

        def change(values: dict[str, float]) -> None:
            if self.owner_heard and counter is not None:
                values[counter.name] = (values[counter.name] + 1) % (codec.limits(counter.name)[1] + 1)
            if self.signal is not None and self.value is not None:
                values[self.signal] = self.value

        forged = with_values(codec, frame, change)._replace(sender=self.station)
        if not self.owner_heard:
            return [forged]
        memory.kept.setdefault("forged", []).append(forged)
        return [frame]

    def tick(self, bench: Bench, memory: Memory) -> int:
        forged: list[Frame] = memory.kept.pop("forged", [])
        for frame in forged:
            bench.network.forward(frame.pack())
            bench.network.transmit(Bus(frame.bus))  # at once: two that begin together destroy each other
        return len(forged)


@dataclass(frozen=True, kw_only=True)
class Partition(FrameFault, BenchFault):
    """A bus is cut: a station neither hears the others nor is heard; with no station, nobody hears anybody.

    Counted are the frames that are lost; no controller repeats them.
    """

    kind = "partition"
    bus: Bus
    station: Station | None = None

    def selection(self, database: Codec) -> Selection:
        def select(frames: NDArray[np.void]) -> NDArray[np.bool_]:
            chosen: NDArray[np.bool_] = frames["bus"] == self.bus
            return chosen if self.station is None else chosen & (frames["sender"] == self.station)

        return select

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return []

    def begin(self, bench: Bench, memory: Memory) -> None:
        apart = 0 if self.station is None else 1 << self.station
        members = bench.network.handle.members
        memory.kept["members"] = members[self.bus] & apart
        members[self.bus] &= ~apart

    def tick(self, bench: Bench, memory: Memory) -> int:
        return 0

    def end(self, bench: Bench, memory: Memory) -> None:
        bench.network.handle.members[self.bus] |= memory.kept["members"]


@dataclass(frozen=True, kw_only=True)
class Silent(FrameFault):
    """A station works and hears, but none of its frames gets out."""

    kind = "silent"
    station: Station

    def selection(self, database: Codec) -> Selection:
        return frames_from(self.station)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return []


@dataclass(frozen=True, kw_only=True)
class Deaf(BenchFault):
    """A station works and sends, but no frame gets to it; together with `Silent` it is cut off."""

    kind = "deaf"
    station: Station

    def begin(self, bench: Bench, memory: Memory) -> None:
        members = bench.network.handle.members
        for bus in Bus:
            memory.kept[bus] = members[bus] & 1 << self.station
            members[bus] &= ~memory.kept[bus]
        bench.network.take(self.station)

    def tick(self, bench: Bench, memory: Memory) -> int:
        return 1

    def end(self, bench: Bench, memory: Memory) -> None:
        for bus, member in memory.kept.items():
            bench.network.handle.members[bus] |= member


@dataclass(frozen=True, kw_only=True)
class Late(FrameFault):
    """All that a station sends comes a number of ticks late."""

    kind = "late"
    station: Station
    ticks: int = parameter(minimum=1, maximum=1000)

    def selection(self, database: Codec) -> Selection:
        return frames_from(self.station)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return [frame]

    @property
    def late_ticks(self) -> int:
        return self.ticks


@dataclass(frozen=True, kw_only=True)
class BusError(BenchFault):
    """Frames of a message are destroyed on the wire and sent again, as often as the sender's error counter allows.

    Attributes
    ----------
    errors : frames to destroy, repetitions included; as many as there are by default.
    bit : from the start of frame, at which the error is.
    """

    kind = "bus_error"
    ends_by_itself = True
    message: str
    errors: int = parameter(default=0xFFFF_FFFF, minimum=1, maximum=0xFFFF_FFFF)
    bit: int = parameter(default=40, minimum=1, maximum=130)

    def check(self, database: Codec) -> None:
        database.message(self.message)

    def begin(self, bench: Bench, memory: Memory) -> None:
        message, model = self._place(bench, memory)
        planned = {
            "id": message.frame_id,
            "mask": 0xFFFF_FFFF,
            "count": self.errors,
            "bit": self.bit,
            "sender": message.sender,
            "receiver": lib.CAN_BUS_NOBODY,
        }
        if not lib.can_bus_disturb(model, ffi.new("can_bus_disturbance *", planned)):
            raise CodecError(f"only {lib.CAN_BUS_DISTURBANCES_MAX} bus errors can be planned at once")
        memory.kept["left"] = self.errors

    def tick(self, bench: Bench, memory: Memory) -> int:
        message, model = self._place(bench, memory)
        planned = model.disturbances[0 : model.disturbance_count]
        left = sum(one.count for one in planned if (one.id, one.sender) == (message.frame_id, message.sender))
        destroyed: int = memory.kept["left"] - left
        memory.kept["left"] = left
        return destroyed

    def is_over(self, memory: Memory) -> bool:
        return bool(memory.kept["left"] == 0)

    def end(self, bench: Bench, memory: Memory) -> None:
        message, model = self._place(bench, memory)
        lib.can_bus_calm(model, message.frame_id, message.sender)

    def _place(self, bench: Bench, memory: Memory) -> tuple[Any, Any]:
        message = memory.database.message(self.message)
        return message, ffi.addressof(bench.network.handle.buses, message.bus)


@dataclass(frozen=True, kw_only=True)
class Babble(BenchFault):
    """A station floods a bus with frames of eight zeros under an identifier that wins every arbitration."""

    kind = "babble"
    station: Station
    bus: Bus
    identifier: int = parameter(default=0, minimum=0, maximum=0x7FF)
    frames_per_tick: int = parameter(default=40, minimum=1, maximum=100)

    def tick(self, bench: Bench, memory: Memory) -> int:
        frame = Frame(0, self.identifier, self.bus, 8, 0, self.station, bytes(8))
        bench.network.forward(frame.pack() * self.frames_per_tick)
        return self.frames_per_tick
