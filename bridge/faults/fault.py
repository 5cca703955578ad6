"""What goes wrong: the forms that a fault can have. When it does is in `bridge.faults.plan`."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bridge.sensors.lidar import Cloud
from dbc.codec import Codec, MessageCodec
from dbc.errors import CodecError
from dbc.frames import FRAME_STRUCT, Frame

if TYPE_CHECKING:
    from bridge.bench import Bench

#: Tells which frames of an array of `FRAME_DTYPE` a fault is about.
Selection = Callable[[NDArray[np.void]], NDArray[np.bool_]]


@dataclass
class Memory:
    """What a fault remembers from its begin on: it is new each time the fault begins.

    Attributes
    ----------
    database : messages of the profile.
    random : seeded.
    number : frames or ticks befallen before this one.
    kept : what the fault has kept.
    """

    database: Codec
    random: random.Random
    number: int = 0
    kept: dict[Any, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong; its fields are the keys of a `faults` entry in a scenario file.

    Attributes
    ----------
    kind : name of the fault in files.
    ends_by_itself : it needs no duration to come to an end.
    """

    kind: ClassVar[str] = ""
    ends_by_itself: ClassVar[bool] = False

    def __str__(self) -> str:
        given = [f"{item.name}={_show(getattr(self, item.name))}" for item in fields(self)]
        return " ".join([self.kind, *(text for text in given if not text.endswith("=None"))])

    def check(self, database: Codec) -> None:
        """See whether the fault makes sense with the messages of a profile.

        Raises
        ------
        CodecError
            When not: says what is allowed.
        """


@dataclass(frozen=True)
class FrameFault(Fault):
    """Changes frames between their sender and the bus: the frame log shows them as they were on the wire."""

    def selection(self, database: Codec) -> Selection:
        """Which frames it is about."""
        raise NotImplementedError

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        """Frames that go to the bus instead of this one; exactly the frame itself when it is not befallen."""
        raise NotImplementedError

    def release(self, memory: Memory) -> list[Frame]:
        """Frames that `alter` has held back and that go to the bus when the fault ends."""
        return []

    @property
    def late_ticks(self) -> int:
        """Ticks by which what `alter` returns comes late."""
        return 0


@dataclass(frozen=True)
class InputFault(Fault):
    """Changes what gets to the plant."""

    @property
    def needed_inputs(self) -> tuple[str, ...]:
        """Inputs that the plant must have besides those that every one has."""
        return ()

    def drive(self, inputs: NDArray[np.float64], memory: Memory) -> None:
        """Change the plant's inputs, in the order of ``enum plant_input``, as the wires have set them."""
        raise NotImplementedError


@dataclass(frozen=True)
class CloudFault(Fault):
    """Changes the scans of the LiDARs; each that is due counts as befallen."""

    def scan(self, cloud: Cloud, memory: Memory) -> Cloud | None:
        """What comes instead of a scan; None for nothing."""
        raise NotImplementedError


@dataclass(frozen=True)
class BenchFault(Fault):
    """Changes who ticks, or what happens on a bus."""

    def begin(self, bench: Bench, memory: Memory) -> None:
        """The fault sets in, before anybody acts in this tick."""

    def tick(self, bench: Bench, memory: Memory) -> int:
        """Every tick from the first on; returns how often it was injected in it."""
        raise NotImplementedError

    def sense(self, bench: Bench, memory: Memory) -> None:
        """Every tick, once the plant was sampled for the ECUs' wires."""

    def is_over(self, memory: Memory) -> bool:
        """It has ended by itself; asked after each tick."""
        return False

    def end(self, bench: Bench, memory: Memory) -> None:
        """The fault is over, before anybody acts in this tick."""


def parameter(**allowed: Any) -> Any:
    """A field of a fault with what JSON schema says of its values; a `default` makes it optional."""
    if "default" in allowed:
        return field(default=allowed.pop("default"), metadata=allowed)
    return field(metadata=allowed)


def frames_of(database: Codec, names: Mapping[str, Any] | list[str] | tuple[str, ...]) -> Selection:
    """Select frames of messages by their address.

    Raises
    ------
    CodecError
        When there is no such message.
    """
    messages = [database.message(name) for name in names]
    addresses = np.array([_address(m.bus, m.frame_id, m.extended) for m in messages], dtype=np.uint64)

    def select(frames: NDArray[np.void]) -> NDArray[np.bool_]:
        found = _address(frames["bus"].astype(np.uint64), frames["id"].astype(np.uint64), frames["flags"] & 1)
        chosen: NDArray[np.bool_] = np.isin(found, addresses) & (frames["flags"] < 2)
        return chosen

    return select


def frames_from(station: int) -> Selection:
    """Select all frames that a station sends."""

    def select(frames: NDArray[np.void]) -> NDArray[np.bool_]:
        chosen: NDArray[np.bool_] = frames["sender"] == station
        return chosen

    return select


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Refuse a value that is not in a range.

    Raises
    ------
    CodecError
        Names the range.
    """
    if not low <= value <= high:
        raise CodecError(f"{name}: {value:g} is out of range; allowed is {low:.10g} to {high:.10g}")


def _address(bus: Any, identifier: Any, extended: Any) -> Any:
    return bus * (1 << 32) + identifier * 2 + extended


def _show(value: object) -> str:
    if isinstance(value, Enum):
        return value.name
    return f"{value:g}" if isinstance(value, float) else str(value)


def with_values(codec: MessageCodec, frame: Frame, change: Callable[[dict[str, float]], None]) -> Frame:
    """A frame of a message with other values, its counter as it was or as changed, its CRC right."""
    values = dict(zip(codec.signals, codec.decode(frame.data), strict=True))
    change(values)
    limited = []
    for name, value in values.items():
        low, high = codec.limits(name)
        limited.append(min(max(value, low), high))
    altered = frame._replace(data=codec.encode(*limited))
    return Frame._make(FRAME_STRUCT.unpack(codec.seal(altered.pack())))
