"""Bits on the wire: length with stuffing, CRC-15 and arbitration against plain references."""

from __future__ import annotations

import random
import re

import pytest
from crccheck.crc import Crc15

from bridge._native import ffi, lib

SEED = 20221103
WIRE = ffi.new("can_wire *")
lib.can_wire_init(WIRE)


def make_frame(
    identifier: int, data: bytes = b"", extended: bool = False, remote: bool = False, dlc: int | None = None
):
    frame = ffi.new("can_frame *")
    frame.id = identifier
    frame.dlc = len(data) if dlc is None else dlc
    frame.flags = extended * lib.CAN_FLAG_EXTENDED | remote * lib.CAN_FLAG_REMOTE
    ffi.memmove(frame.data, data, len(data))
    return frame


def bits_of(frame) -> tuple[int, int]:
    stuff = ffi.new("uint32_t *")
    return lib.can_wire_bits(WIRE, frame, stuff), stuff[0]


def reference(identifier: int, data: bytes, extended: bool, remote: bool, dlc: int) -> tuple[int, int]:
    """Length and stuff bits by writing the frame down as text (ISO 11898-1, 10.4 and 10.5)."""
    if extended:
        header = f"0{identifier >> 18:011b}11{identifier & 0x3FFFF:018b}{remote:d}00{dlc:04b}"
    else:
        header = f"0{identifier:011b}{remote:d}00{dlc:04b}"
    stream = header + ("" if remote else "".join(f"{byte:08b}" for byte in data[: min(dlc, 8)]))
    remainder = 0
    for bit in stream:
        remainder = ((remainder << 1) ^ (0x4599 if (remainder >> 14 & 1) != int(bit) else 0)) & 0x7FFF
    stream += f"{remainder:015b}"
    # A stuff bit counts towards the next run, so each run must be looked for behind the last one inserted.
    stuffed, position = stream, 0
    while match := re.compile("00000|11111").search(stuffed, position):
        inserted = "1" if match.group()[0] == "0" else "0"
        stuffed = stuffed[: match.end()] + inserted + stuffed[match.end() :]
        position = match.end()
    return len(stuffed) + 10, len(stuffed) - len(stream)


def test_crc15_is_the_catalogued_one():
    text = b"123456789"
    assert lib.can_wire_crc15(WIRE, text, len(text)) == Crc15.calc(text) == 0x059E  # CRC-15/CAN


def test_crc15_of_random_bytes():
    generator = random.Random(SEED)
    for length in range(16):
        data = generator.randbytes(length)
        assert lib.can_wire_crc15(WIRE, data, length) == Crc15.calc(data), data.hex()


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("remote", [False, True])
def test_random_frames_have_the_length_of_the_written_down_frame(extended: bool, remote: bool):
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    for _ in range(400):
        identifier = generator.getrandbits(29 if extended else 11)
        data = bytes(generator.choice((0x00, 0xFF, generator.getrandbits(8))) for _ in range(generator.randrange(9)))
        frame = make_frame(identifier, data, extended, remote)
        assert bits_of(frame) == reference(identifier, data, extended, remote, len(data)), (identifier, data.hex())


@pytest.mark.parametrize("fill", [0x00, 0xFF, 0x55, 0x0F])
def test_all_standard_identifiers_with_extreme_data(fill: int):
    data = bytes([fill] * 8)
    for identifier in range(0x800):
        assert bits_of(make_frame(identifier, data)) == reference(identifier, data, False, False, 8), hex(identifier)


def test_length_stays_inside_the_classic_bounds():
    for count in range(9):
        for fill in (0x00, 0xFF, 0xAA, 0x1F):
            total, stuff = bits_of(make_frame(0, bytes([fill] * count)))
            assert 44 + 8 * count <= total <= 44 + 8 * count + (34 + 8 * count - 1) // 4
            assert total - stuff == 44 + 8 * count


def test_dlc_above_eight_carries_eight_bytes():
    data = bytes(range(8))
    assert bits_of(make_frame(0x123, data, dlc=15)) == reference(0x123, data, False, False, 15)


def test_error_frame_has_no_data_and_wins():
    frame = make_frame(0x7FF, bytes(8))
    frame.flags = lib.CAN_FLAG_ERROR
    assert bits_of(frame) == (20, 0)
    assert lib.can_wire_arbitration(frame) == 0


def test_arbitration_orders_as_the_wire_does():
    # Dominant (0) wins bit by bit: id, then data before remote, then standard before extended of the same base.
    ordered = [
        make_frame(0x000),
        make_frame(0x0FF),
        make_frame(0x100),
        make_frame(0x100, remote=True),
        make_frame(0x100 << 18, extended=True),
        make_frame(0x100 << 18, extended=True, remote=True),
        make_frame(0x100 << 18 | 1, extended=True),
        make_frame(0x101),
        make_frame(0x7FF << 18 | 0x3FFFF, extended=True),
    ]
    keys = [lib.can_wire_arbitration(frame) for frame in ordered]
    assert keys == sorted(keys)
    assert len(set(keys)) == len(keys)
