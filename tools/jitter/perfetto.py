"""Perfetto's native trace format: a sequence of protobuf packets, written by hand.

Only what raceloop needs of it: tracks, slices, instants and counters, each with named values. Names are interned. Field
numbers are those of Perfetto's ``protos/perfetto/trace``; a test reads the files back with Perfetto's own classes.
"""

from __future__ import annotations

from functools import cache
from itertools import count
from pathlib import Path
from struct import Struct

from tools.output_files import write_bytes

#: A value beside an event.
Value = int | float | str

_DOUBLE = Struct("<d")
_SEQUENCE = 1
_NEEDS_INTERNED = 2
_CLEARS_INTERNED = 1

# Trace, TracePacket
_PACKET = 1
_TIMESTAMP, _SEQUENCE_ID, _TRACK_EVENT, _INTERNED_DATA, _SEQUENCE_FLAGS, _TRACK_DESCRIPTOR = 8, 10, 11, 12, 13, 60
# TrackEvent
_ANNOTATION, _TYPE, _NAME_IID, _TRACK_UUID, _DOUBLE_VALUE = 4, 9, 10, 11, 44
_SLICE_BEGIN, _SLICE_END, _INSTANT, _COUNTER = 1, 2, 3, 4
# TrackDescriptor, ProcessDescriptor, ThreadDescriptor, CounterDescriptor
_UUID, _TRACK_NAME, _PROCESS, _THREAD, _PARENT, _COUNTER_DESCRIPTOR = 1, 2, 3, 4, 5, 8
_PID, _PROCESS_NAME = 1, 6
_THREAD_PID, _TID, _THREAD_NAME = 1, 2, 5
_UNIT_NAME = 6
# InternedData and its entries, DebugAnnotation
_EVENT_NAMES, _ANNOTATION_NAMES = 2, 3
_IID, _INTERNED_NAME = 1, 2
_ANNOTATION_NAME_IID, _ANNOTATION_INT, _ANNOTATION_DOUBLE, _ANNOTATION_STRING = 1, 4, 5, 6


class Trace:
    """A trace in the making. Times are ns on CLOCK_MONOTONIC.

    Within a track, events have to come in order of time, and what encloses a slice before it.
    """

    def __init__(self) -> None:
        self._packets = bytearray()
        self._uuids = count(1)
        self._names: dict[tuple[int, str], int] = {}
        self._heads: dict[tuple[int, int, str], bytes] = {}  # how events of a kind, track and name begin
        first = _number(_SEQUENCE_ID, _SEQUENCE) + _number(_SEQUENCE_FLAGS, _CLEARS_INTERNED | _NEEDS_INTERNED)
        self._packets += _bytes(_PACKET, first)

    def process(self, pid: int, name: str) -> int:
        """Add a process; returns the number of its track."""
        return self._descriptor(_bytes(_PROCESS, _number(_PID, pid) + _text(_PROCESS_NAME, name)))

    def thread(self, pid: int, name: str) -> int:
        """Add the main thread of a process, for its slices; returns the number of its track."""
        thread = _number(_THREAD_PID, pid) + _number(_TID, pid) + _text(_THREAD_NAME, name)
        return self._descriptor(_bytes(_THREAD, thread))

    def track(self, name: str, parent: int = 0) -> int:
        """Add a track below another one, or at the top; returns its number."""
        return self._descriptor(_text(_TRACK_NAME, name) + _number(_PARENT, parent))

    def counter(self, name: str, unit: str, parent: int) -> int:
        """Add a track of values over time; returns its number."""
        kind = _bytes(_COUNTER_DESCRIPTOR, _text(_UNIT_NAME, unit))
        return self._descriptor(_text(_TRACK_NAME, name) + _number(_PARENT, parent) + kind)

    def begin(self, track: int, time_ns: int, name: str, **values: Value) -> None:
        """Begin a slice."""
        self._event(_SLICE_BEGIN, track, time_ns, name, values)

    def end(self, track: int, time_ns: int) -> None:
        """End the innermost slice of a track that has not ended."""
        head = self._heads.get((_SLICE_END, track, ""))
        if head is None:
            head = self._heads[_SLICE_END, track, ""] = _number(_TYPE, _SLICE_END) + _number(_TRACK_UUID, track)
        self._packet(time_ns, head)

    def instant(self, track: int, time_ns: int, name: str, **values: Value) -> None:
        """Add a moment."""
        self._event(_INSTANT, track, time_ns, name, values)

    def value(self, track: int, time_ns: int, value: float) -> None:
        """Add a value to a counter's track."""
        head = _number(_TYPE, _COUNTER) + _number(_TRACK_UUID, track)
        self._packet(time_ns, head + _double(_DOUBLE_VALUE, value))

    def to_bytes(self) -> bytes:
        """The whole file."""
        return bytes(self._packets)

    def write(self, path: Path) -> None:
        """Write the file; under a temporary name first.

        Raises
        ------
        RaceloopError
            When it cannot be written.
        """
        write_bytes(path, self.to_bytes())

    def _descriptor(self, content: bytes) -> int:
        uuid = next(self._uuids)
        self._add(_bytes(_TRACK_DESCRIPTOR, _number(_UUID, uuid) + content))
        return uuid

    def _event(self, kind: int, track: int, time_ns: int, name: str, values: dict[str, Value]) -> None:
        interned = bytearray()
        event = self._heads.get((kind, track, name))
        if event is None:
            event = _number(_TYPE, kind) + _number(_TRACK_UUID, track)
            event += _number(_NAME_IID, self._intern(_EVENT_NAMES, name, interned))
            self._heads[kind, track, name] = event
        for key, value in values.items():
            annotation = _number(_ANNOTATION_NAME_IID, self._intern(_ANNOTATION_NAMES, key, interned))
            if isinstance(value, str):
                annotation += _text(_ANNOTATION_STRING, value)
            elif isinstance(value, float):
                annotation += _double(_ANNOTATION_DOUBLE, value)
            else:
                annotation += _number(_ANNOTATION_INT, value)
            event += _bytes(_ANNOTATION, annotation)
        self._packet(time_ns, event, _bytes(_INTERNED_DATA, bytes(interned)) if interned else b"")

    def _packet(self, time_ns: int, event: bytes, interned: bytes = b"") -> None:
        self._add(_number(_TIMESTAMP, time_ns) + _bytes(_TRACK_EVENT, event) + interned)

    def _intern(self, kind: int, name: str, new: bytearray) -> int:
        """Number of a name; one not used before is added to `new`, for the packet that uses it first."""
        key = (kind, name)
        number = self._names.get(key)
        if number is None:
            number = self._names[key] = len(self._names) + 1
            new += _bytes(kind, _number(_IID, number) + _text(_INTERNED_NAME, name))
        return number

    def _add(self, content: bytes) -> None:
        self._packets += _bytes(_PACKET, content + _PACKET_END)


def _varint(value: int) -> bytes:
    """Seven bits a byte, the low ones first, each byte but the last marked."""
    if 0 <= value < 0x80:
        return _ONE_BYTE[value]
    value &= (1 << 64) - 1  # negative numbers in two's complement
    out = b""
    while value >= 0x4000:  # two bytes at a time: most of what is written are times of seven bytes
        out += _TWO_BYTES[value & 0x3FFF]
        value >>= 14
    return out + (_ONE_BYTE[value] if value < 0x80 else _ONE_BYTE[value & 0x7F | 0x80] + _ONE_BYTE[value >> 7])


_ONE_BYTE = [bytes([value]) for value in range(256)]
_TWO_BYTES = [bytes([value & 0x7F | 0x80, value >> 7 | 0x80]) for value in range(1 << 14)]


@cache
def _tag(field: int, wire_type: int) -> bytes:
    return _varint(field << 3 | wire_type)


def _number(field: int, value: int) -> bytes:
    return _tag(field, 0) + _varint(value)


def _bytes(field: int, value: bytes) -> bytes:
    return _tag(field, 2) + _varint(len(value)) + value


def _text(field: int, value: str) -> bytes:
    return _bytes(field, value.encode())


def _double(field: int, value: float) -> bytes:
    return _tag(field, 1) + _DOUBLE.pack(value)


_PACKET_END = _number(_SEQUENCE_ID, _SEQUENCE) + _number(_SEQUENCE_FLAGS, _NEEDS_INTERNED)
