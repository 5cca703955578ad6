"""candump's log format in C: the same frames as the slow reader in Python, and no line that is none."""

from __future__ import annotations

import random

import pytest

from bridge._native import ffi, lib
from dbc.frames import FRAME_SIZE, Bus, Flag, Frame, iterate
from tools.dbw.candump_log import candump_line

SEED = 20221103
ROOM = 64
BUSES = {"CAN1": Bus.CAN1, "vcan1": Bus.CAN3, "can2": Bus.CAN_A}


def bus_of(channel: str) -> Bus:
    return BUSES[channel]


def read(text: bytes, capacity: int = ROOM) -> tuple[list[Frame], int]:
    """Frames, and how many bytes of the text they take."""
    channels = [(name.encode(), bus) for name, bus in BUSES.items()]
    room, used = ffi.new("can_frame[]", capacity), ffi.new("uint32_t *")
    start = ffi.from_buffer("char[]", text)
    count = lib.candump_read(start, len(text), channels, len(channels), room, capacity, used)
    return list(iterate(bytes(ffi.buffer(room, count * FRAME_SIZE)))), used[0]


def test_lines_one_after_the_other():
    text = b"(1.000000) CAN1 57A#2D07\n(1700000000.123456) vcan1 1FFFFFFF# R\n(0.000001) can2 7ff#0011223344556677 T\n"
    assert read(text) == (
        [
            Frame(1_000_000, 0x57A, Bus.CAN1, 2, 0, 0, b"\x2d\x07" + bytes(6)),
            Frame(1_700_000_000_123_456, 0x1FFFFFFF, Bus.CAN3, 0, Flag.EXTENDED, 0, bytes(8)),
            Frame(1, 0x7FF, Bus.CAN_A, 8, 0, 0, bytes.fromhex("0011223344556677")),
        ],
        len(text),
    )


def test_no_more_than_there_is_room_for():
    text = b"(1.000000) CAN1 57A#2D07\n" * 5
    frames, used = read(text, 3)
    assert len(frames) == 3
    assert used == 3 * len(text) // 5


@pytest.mark.parametrize(
    "line",
    [
        b"(1.000000) CAN1 57A#2D07",  # no end
        b"(1.000000) CAN1 57A#2D0\n",
        b"(1.000000) CAN1 57A#2D0G\n",
        b"(1.000000) CAN1 57A#001122334455667788\n",
        b"(1.000000) CAN1 57A#R\n",
        b"(1.000000) CAN1 57A##100\n",
        b"(1.000000) CAN1 800#\n",
        b"(1.000000) CAN1 57#00\n",
        b"(1.000000) CAN1 057A#00\n",
        b"(1.000000) CAN1 20000004#00\n",
        b"(1.000000) CAN11 57A#00\n",
        b"(1.000000) CAN 57A#00\n",
        b"(1.000000) can7 57A#00\n",
        b"(1.00000) CAN1 57A#00\n",
        b"(1.0000000) CAN1 57A#00\n",
        b"(.000000) CAN1 57A#00\n",
        b"(1234567890123.000000) CAN1 57A#00\n",
        b"(1.000000)  CAN1 57A#00\n",
        b"(1.000000) CAN1 57A#00 X\n",
        b"(1.000000) CAN1 57A#00 \n",
        b"\n",
        b"(",
    ],
)
def test_reading_ends_before_what_is_something_else(line: bytes):
    good = b"(1.000000) CAN1 57A#2D07\n"
    frames, used = read(good + line + good)
    assert (len(frames), used) == (1, len(good))


def test_spoiled_lines_are_read_as_the_slow_reader_reads_them():
    """Whatever C takes for a frame, Python takes for the same frame."""
    generator = random.Random(SEED)
    taken = 0
    for _ in range(20_000):
        data = generator.randbytes(generator.randrange(9)).hex()
        short, long = f"{generator.randrange(0x900):03X}", f"{generator.getrandbits(30):08x}"
        identifier = short if generator.random() < 0.7 else long
        seconds, micros = generator.randrange(10**10), generator.randrange(10**6)
        line = f"({seconds}.{micros:06d}) {generator.choice([*BUSES])} {identifier}#{data}"
        text = bytearray(line.encode() + generator.choice([b"\n", b" R\n", b" T\n"]))
        if generator.random() < 0.5:
            place, length = generator.randrange(len(text) - 1), generator.randrange(2)
            text[place : place + length] = generator.choice([b"0", b" ", b"#", b"R", b"", b"F", b"\xff"])
        try:
            slow = candump_line(bytes(text).decode("ascii", "replace"), bus_of)
        except KeyError:
            slow = None  # a channel that is none
        frames, used = read(bytes(text))
        if frames:
            taken += 1
            assert slow is not None, (SEED, text)
            assert (frames, used) == (list(iterate(slow)), len(text)), (SEED, text)
    assert taken > 8_000
