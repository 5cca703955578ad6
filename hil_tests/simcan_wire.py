"""The bus model by itself, for tests that say what time it is."""

from __future__ import annotations

import random
from typing import Any

from bridge._native import ffi, lib

EVENTS_MAX = 64
NEVER_NS = 2**64 - 1


class Wire:
    """A bus with the events that came out of it, C structs `can_bus_frame`."""

    def __init__(self, bit_rate: int = 500_000, data_bit_rate: int | None = None) -> None:
        self.model: Any = ffi.new("can_bus_model *")
        lib.can_bus_init(self.model, bit_rate, bit_rate if data_bit_rate is None else data_bit_rate)
        self.bit_ns = self.model.bit_ns
        self.events: list[Any] = []
        self._nodes = 0

    def join(self, mode: int = 0) -> int:
        assert lib.can_bus_join(self.model, self._nodes, mode)
        self._nodes += 1
        return self._nodes - 1

    @staticmethod
    def frame(identifier: int, data: bytes = b"", flags: int = 0, dlc: int | None = None) -> Any:
        frame = ffi.new("can_bus_frame *")
        frame.frame.id, frame.frame.flags = identifier, flags
        frame.frame.dlc = len(data) if dlc is None else dlc
        ffi.memmove(frame.frame.data, data[:8], len(data[:8]))
        ffi.memmove(frame.more, data[8:], len(data[8:]))
        return frame

    def submit(self, node: int, frame: Any, at_ns: int = 0) -> bool:
        return bool(lib.can_bus_submit(self.model, node, frame, at_ns))

    def run(self, until_ns: int) -> list[Any]:
        """Events before a time; kept in `events` too."""
        found = []
        room = ffi.new("can_bus_frame[]", EVENTS_MAX)
        while count := lib.can_bus_run(self.model, until_ns, room, EVENTS_MAX):
            found += [ffi.new("can_bus_frame *", room[place]) for place in range(count)]
        self.events += found
        return found

    def worst_response_ns(self, identifier: int) -> int:
        return next(int(row.worst_response_ns) for row in self.model.messages if row.frames and row.id == identifier)

    def bits(self, frame: Any) -> int:
        """Of a classic frame, without intermission."""
        return int(
            lib.can_wire_bits(ffi.addressof(self.model, "wire"), ffi.addressof(frame, "frame"), ffi.new("uint32_t *"))
        )

    def node(self, index: int) -> Any:
        return self.model.nodes[index]


def frame_of_bits(identifier: int, bits: int, wire: Wire) -> Any:
    """A frame that takes so many bits on the wire, intermission included."""
    generator = random.Random(identifier)
    for _ in range(100_000):
        data = bytes(generator.choice((0x00, 0xFF, 0x0F, 0x83, generator.getrandbits(8))) for _ in range(8))
        frame = wire.frame(identifier, data)
        if wire.bits(frame) + 3 == bits:
            return frame
    raise AssertionError(f"no frame of {bits} bits found")
