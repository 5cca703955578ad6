"""What a bus of the hub carries, how it stamps, and what a filter lets through: against plain references."""

from __future__ import annotations

import random

import pytest

from bridge._native import ffi, lib
from dbc.frames import FRAME_SIZE, Bus, Flag, Frame, iterate

SEED = 31


def carry(bus_state, bus: int, stamp_ns: int, frames: list[Frame]) -> list[Frame]:
    raw = b"".join(frame.pack() for frame in frames)
    out = ffi.new("can_frame[]", len(frames))
    count = lib.hub_carry(bus_state, bus, stamp_ns, ffi.from_buffer("can_frame[]", raw), len(frames), out)
    return list(iterate(bytes(ffi.buffer(out))[: count * FRAME_SIZE]))


def random_frame(generator: random.Random, bus: int) -> Frame:
    flags = generator.choice([0, 0, 0, 1, 1, 2, 3, 4, 5, 8, 255])
    bits = generator.choice([11, 11, 12, 29, 29, 30, 32])
    return Frame(
        generator.getrandbits(64),
        generator.getrandbits(bits),
        generator.choice([bus] * 9 + [255]),
        generator.choice([*range(9), *range(9), 9, 255]),
        flags,
        generator.randrange(8),
        generator.randbytes(8),
    )


@pytest.mark.parametrize("bus", list(Bus))
def test_carries_what_a_can_bus_can_and_nothing_else(bus: Bus):
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    state = ffi.new("hub_bus *")
    total = refused = newest_us = 0
    for _ in range(500):
        frames = [random_frame(generator, bus) for _ in range(generator.randrange(1, 65))]
        stamp_ns = generator.randrange(10**15)
        newest_us = max(newest_us, stamp_ns // 1000)
        expected = []
        for frame in frames:
            wide = frame.flags & (Flag.EXTENDED | Flag.ERROR)
            if frame.bus == bus and frame.dlc <= 8 and frame.flags < 8 and frame.id < (1 << (29 if wide else 11)):
                used = 0 if frame.flags & Flag.REMOTE else frame.dlc
                expected.append(frame._replace(time_us=newest_us, sender=0, data=frame.data[:used].ljust(8, b"\0")))
        assert carry(state, bus, stamp_ns, frames) == expected
        total += len(expected)
        refused += len(frames) - len(expected)
    assert state.frames == total > 0
    assert refused > 0


def test_stamps_never_go_back():
    state = ffi.new("hub_bus *")
    frame = Frame(0, 1, 0, 0, 0, 0, bytes(8))
    stamps = [5_000, 9_000, 7_000, 9_999, 10_000, 1]
    assert [carry(state, 0, stamp, [frame])[0].time_us for stamp in stamps] == [5, 9, 9, 9, 10, 10]


def test_stamps_on_the_wall_clock_move_when_it_was_set_and_not_by_the_noise_of_a_look():
    offset = 1_700_000_000_000_000
    for noise in (-999, -1, 0, 1, 999):
        assert lib.hub_wall_offset_us(offset, offset + noise) == offset
    for step in (-3_600_000_000, -1000, 1000, 3_600_000_000):
        assert lib.hub_wall_offset_us(offset, offset + step) == offset + step
    assert lib.hub_wall_offset_us(0, offset) == offset  # the first look


def test_filters_let_through_what_they_name():
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    passed = stopped = 0
    for _ in range(500):
        frames = [
            Frame(0, generator.randrange(40), 0, 0, generator.choice([0, 0, 1, 1, 2, 3, 4]), 0, bytes(8))
            for _ in range(64)
        ]
        wanted = {(generator.randrange(40), generator.random() < 0.5) for _ in range(generator.choice([0, 1, 10, 60]))}
        filters = ffi.new("can_link_filter[]", [(number, extended) for number, extended in wanted])
        out = ffi.new("can_frame[]", len(frames))
        raw = ffi.from_buffer("can_frame[]", b"".join(frame.pack() for frame in frames))
        count = lib.hub_select(filters, len(wanted), raw, len(frames), out)
        heard = list(iterate(bytes(ffi.buffer(out))[: count * FRAME_SIZE]))
        assert heard == [
            frame
            for frame in frames
            if frame.flags & Flag.ERROR
            or (not frame.flags & Flag.REMOTE and (frame.id, bool(frame.flags & Flag.EXTENDED)) in wanted)
        ]
        passed += count
        stopped += len(frames) - count
        assert lib.hub_select(ffi.NULL, lib.CAN_LINK_EVERYTHING, raw, len(frames), out) == len(frames)
    assert passed > 1000
    assert stopped > 1000
