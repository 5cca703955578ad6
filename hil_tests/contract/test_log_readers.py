"""Our readers of BLF, ASC and TRC beside python-can's, on the same files, whole and broken."""

from __future__ import annotations

import io
import random
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

import can
import numpy as np
import pytest
from can.io.blf import BLFParseError

from bridge.tap import frame_of
from dbc.errors import ConfigurationError
from dbc.frames import FRAME_SIZE, Bus
from tools.dbw.log_source import read_chunks

SEED = 20221103
COUNT = 6000
START_S = 1_700_000_000.0

Told = list[tuple[int, str]]
Reader = Callable[[BinaryIO], Iterable[can.Message]]


def blf(file: BinaryIO) -> Iterable[can.Message]:
    return can.BLFReader(file)


def asc(file: BinaryIO) -> Iterable[can.Message]:
    return can.ASCReader(io.StringIO(file.read().decode()))


def trc(file: BinaryIO) -> Iterable[can.Message]:
    """Its buses count from 1, and python-can leaves it at that."""
    for message in can.TRCReader(io.StringIO(file.read().decode())):
        message.channel = int(str(message.channel)) - 1
        yield message


def messages(count: int = COUNT) -> list[can.Message]:
    """Of all kinds, on four channels."""
    source = random.Random(SEED)
    made = []
    for number in range(count):
        kind, size = source.randrange(8), source.randrange(9)
        options = {
            "timestamp": START_S + number * 1e-3,
            "arbitration_id": source.randrange(0x800),
            "is_extended_id": False,
            "data": source.randbytes(size),
            "channel": source.randrange(4),
        }
        if kind == 0:
            options |= {"is_extended_id": True, "arbitration_id": source.randrange(1 << 29)}
        elif kind == 1:
            options |= {"is_remote_frame": True, "dlc": size, "data": None}
        elif kind == 2:
            options |= {"is_error_frame": True}
        elif kind == 3:
            options |= {"is_fd": True, "data": source.randbytes(source.choice([0, 8, 12, 16, 20, 24, 32, 48, 64]))}
        made.append(can.Message(**options))
    return made


def written(path: Path, **options: object) -> Path:
    with can.Logger(path, **options) as logger:
        for message in messages():
            logger.on_message_received(message)
    return path


def ours(path: Path) -> tuple[list[bytes], Told]:
    """Frames, and what could not be read."""
    told: Told = []
    frames = b""
    try:
        frames = b"".join(piece.tobytes() for piece in read_chunks(path, None, lambda *what: told.append(what)))
    except ConfigurationError as error:  # no frame at all
        told.append((0, str(error)))
    return [frames[place : place + FRAME_SIZE] for place in range(0, len(frames), FRAME_SIZE)], told


def theirs(path: Path, reader: Reader) -> tuple[list[bytes], bool]:
    """Frames, and whether python-can came to the end."""
    frames = []
    try:
        with path.open("rb") as file:
            for message in reader(file):
                bus = Bus(int(message.channel or 0))
                frames.append(frame_of(message, bus, max(round(message.timestamp * 1e6), 0)))
    except (BLFParseError, ValueError, IndexError, struct.error, zlib.error):
        return frames, False
    return frames, True


@pytest.mark.parametrize(
    ("name", "reader", "options"),
    [
        ("drive.blf", blf, {}),
        ("drive.blf", blf, {"compression_level": 0}),
        ("drive.blf", blf, {"max_container_size": 1000}),
        ("drive.asc", asc, {}),
        ("drive.trc", trc, {}),
    ],
)
def test_the_same_frames(tmp_path: Path, name: str, reader: Reader, options: dict[str, int]):
    path = written(tmp_path / name, **options)
    frames, told = ours(path)
    expected, whole = theirs(path, reader)
    assert whole
    assert content(frames) == content(expected)
    # Of a TRC log, python-can adds up seconds as floating-point numbers.
    np.testing.assert_allclose(times_us(frames), times_us(expected), rtol=0, atol=reader is trc)
    assert len(frames) == COUNT or (reader is trc and len(frames) > COUNT / 2)  # which has data frames only
    assert told == []


def content(frames: list[bytes]) -> list[bytes]:
    """All but their times."""
    return [frame[8:] for frame in frames]


def times_us(frames: list[bytes]) -> list[int]:
    return [int.from_bytes(frame[:8], "little") for frame in frames]


@pytest.mark.parametrize(("name", "reader"), [("drive.blf", blf), ("drive.asc", asc)])
def test_cut_anywhere(tmp_path: Path, name: str, reader: Reader):
    """Nothing is lost of what is there, and that it breaks off is told."""
    print(f"seed {SEED}")
    source = random.Random(SEED)
    whole = written(tmp_path / name).read_bytes()
    path = tmp_path / f"cut{Path(name).suffix}"
    for size in sorted(source.randrange(500, len(whole)) for _ in range(20 if reader is blf else 5)):
        path.write_bytes(whole[:size])
        frames, told = ours(path)
        expected, _ = theirs(path, reader)
        # Half a line may be a frame of its own, of which python-can makes one with fewer bytes than it says.
        assert frames[: len(expected) - 1] == expected[:-1], size
        assert len(frames) >= len(expected) - 1
        if reader is blf:
            assert frames == expected, size
            assert [text for _, text in told] == [f"breaks off: {size} of {len(whole)} bytes are there"]


OBJECTS = 144 + 32
"""Where the objects begin of a BLF log that python-can has written without compression."""
OBJECT = 48
"""Bytes of a CAN message there."""
LENGTH, CHANNEL = range(8, 12), range(32, 34)
"""Places in it."""


def plain_blf(path: Path, count: int = 200) -> tuple[bytes, list[bytes]]:
    """An uncompressed log of one container, and its frames."""
    with can.Logger(path, compression_level=0) as logger:
        for number in range(count):
            logger.on_message_received(
                can.Message(
                    timestamp=START_S + number * 1e-3,
                    arbitration_id=number,
                    is_extended_id=False,
                    data=[number % 256] * 8,
                    channel=0,
                )
            )
    return path.read_bytes(), ours(path)[0]


def test_what_follows_a_damage_is_read(tmp_path: Path):
    """A byte of an object is changed at random: only this frame may be lost or be another."""
    print(f"seed {SEED}")
    source = random.Random(SEED)
    path = tmp_path / "drive.blf"
    whole, frames = plain_blf(path)
    lost = 0
    for _ in range(300):
        number = source.randrange(1, len(frames) - 2)
        place = source.choice([place for place in range(OBJECT) if place not in CHANNEL])  # which may be no bus
        broken = bytearray(whole)
        at = OBJECTS + OBJECT * number + place
        broken[at] ^= 1 << source.randrange(8)
        path.write_bytes(broken)
        got, told = ours(path)
        assert got[:number] == frames[:number]
        if place not in LENGTH:  # with a wrong length, the next ones may lie within it
            assert got[-(len(frames) - number - 1) :] == frames[number + 1 :], place
            assert len(got) in (len(frames) - 1, len(frames))
        elif got[-1] != frames[-1]:
            assert told, place
        lost += len(got) < len(frames)
    assert 0 < lost < 300


@pytest.mark.parametrize("length", [0, 15, 49, 1 << 20, (1 << 20) + 1, 0xFFFFFFFF])
def test_an_object_of_a_wrong_length_hides_nothing_for_good(tmp_path: Path, length: int):
    """python-can reads the first for ever, and nothing behind the last."""
    path = tmp_path / "drive.blf"
    whole, frames = plain_blf(path, 23_000)
    broken = bytearray(whole)
    at = OBJECTS + OBJECT * 100
    broken[at + 8 : at + 12] = length.to_bytes(4, "little")
    path.write_bytes(broken)
    got, told = ours(path)
    assert got[:100] == frames[:100]
    assert got[-1] == frames[-1]
    assert len(got) >= len(frames) - (1 << 20) // OBJECT - 2
    assert len(told) == 1


def test_a_damaged_container_is_told_with_its_place(tmp_path: Path):
    path = written(tmp_path / "drive.blf", max_container_size=10_000)
    whole, (frames, _) = path.read_bytes(), ours(path)
    second = whole.index(b"LOBJ", OBJECTS)
    for change in (second + 40, second):  # in what is compressed; in its signature
        broken = bytearray(whole)
        broken[change] ^= 0xFF
        path.write_bytes(broken)
        got, told = ours(path)
        assert len(told) == 1
        assert f"at byte {second}" in told[0][1]
        assert got[: told[0][0]] == frames[: told[0][0]]
        assert 0 < told[0][0] < len(got) < len(frames)
        rest = len(got) - told[0][0]
        assert got[-rest:] == frames[-rest:]


@pytest.mark.parametrize(
    "line",
    [
        "1.0 1  5ZA             Rx   d 8 2D 07 05 00 00 00 00 00",
        "1.0 1  57A             Rx   d 8 2D 07 0G 00 00 00 00 00",
        "1.0 1  57A             Rx   d Z 2D",
    ],
)
def test_a_broken_line_of_asc_is_told_and_the_rest_is_read(tmp_path: Path, line: str):
    path = written(tmp_path / "drive.asc")
    whole, (frames, _) = path.read_text().splitlines(), ours(path)
    path.write_text("\n".join([*whole[:100], line, *whole[100:]]))
    got, ((before, text),) = ours(path)
    assert got == frames
    assert text == f"line 101 is no frame: {line[:40]}"
    assert 80 < before <= 100


@pytest.mark.parametrize(
    "line",
    [
        "1.000000 1  57A             Rx   d 8 2D 07 05 00 00 00 00 00  Length = 240000 BitCount = 124 ID = 1402",
        "   1.0000009   2   1FFFFFFFx  Tx d 1 ff",
        "1.25 3 7ff Rx d 0",
        "1.25 3 7ff Rx d 0 ",
        "1.25 1 800 Rx d 1 00",
        "1.25 1 57A Rx d 8 01 02",
        "1.25 1 57A Rx d 2 01 02 03",
        "1.25 1 57A Rx d 9 01 02 03 04 05 06 07 08",
        "1.25 1 57A Rx r 3",
        "1.25 1 ErrorFrame",
        "1.25 1 57a rx d 1 00",
        "1.25 1 Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%",
        "// 1.25 1 57A Rx d 1 00",
        "1.25 CANFD 1 Rx 57A 1 0 8 8 01 02 03 04 05 06 07 08 0 0 1000 0 0 0 0 0",
        "",
    ],
)
@pytest.mark.parametrize("base", ["hex", "dec"])
def test_lines_of_asc_as_other_programs_write_them(tmp_path: Path, base: str, line: str):
    path = tmp_path / "drive.asc"
    header = f"date Fri Nov 3 10:00:00.000 2023\nbase {base}  timestamps absolute\ninternal events logged\n"
    usual = "0.5 1  100  Rx   d 2 11 12\n"
    path.write_text(f"{header}{usual}{line}\n{usual}")
    expected, whole = theirs(path, asc)
    frames, told = ours(path)
    assert len(frames) >= 2
    if whole:
        assert (frames, told) == (expected, [])
    else:
        assert len(told) == 1


TRC_HEADERS = {
    "1.0": ";  PCAN\n",
    "1.1": ";$FILEVERSION=1.1\n;$STARTTIME=45000.5\n;\n",
    "1.3": ";$FILEVERSION=1.3\n;$STARTTIME=45000.5\n",
    "2.0": ";$FILEVERSION=2.0\n;$STARTTIME=45000.5\n;$COLUMNS=N,O,T,I,d,l,D\n",
    "2.1": ";$FILEVERSION=2.1\n;$STARTTIME=45000.5\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n",
}
TRC_LINES = {
    "1.0": [
        "  1)   1059 0300 8 00 00 00 00 04 00 00 00",
        " 2) 7 00000123 2 01 02",
        " 3) 8 0300 4 RTR",
        " 4) 9 FFFFFFFF 4 00 00 00 00",
    ],
    "1.1": [
        "  1)  1059.9 Rx 0300 8 00 00 00 00 04 00 00 00",
        " 2) 7 Tx 1FFFFFFF 1 FF",
        " 3) 9 Warng FFFFFFFF 1 00",
        " 4) 9 Rx 0300 3 RTR",
    ],
    "1.3": [
        "  1)  1059.9 1 Rx 0300 - 8 00 00 00 00 04 00 00 00",
        " 2) 7.25 2 Tx 0100 - 0",
        " 3) 9 4 Rx 0100 - 3 RTR",
    ],
    "2.0": [
        "  1  1059.900 DT 0300 Rx 8 00 00 00 00 04 00 00 00",
        " 2 7.25 DT 0100 Tx 0 ",
        " 3 9 RR 0100 Rx 3",
        " 4 9 FD 0100 Rx 12 00 11 22 33 44 55 66 77 88 99 AA BB",
    ],
    "2.1": [
        "  1  1059.900 DT 1 0300 Rx - 8 00 00 00 00 04 00 00 00",
        " 2 7.25 DT 4 0100 Tx - 1 0a",
        " 3 9 RR 2 0100 Rx - 3",
        " 4 9 FB 2 0100 Rx - 9 00 11 22 33 44 55 66 77 88 99 AA BB",
        " 5 9 ST 1 - Rx - 4 00 00 00 08",
    ],
}
"""Lines of each, the first of the usual kind."""


@pytest.mark.parametrize("version", TRC_HEADERS)
def test_versions_of_trc(tmp_path: Path, version: str):
    path = tmp_path / "drive.trc"
    lines = TRC_LINES[version]
    path.write_text(TRC_HEADERS[version] + "\n".join([*lines, *lines, ";", "", lines[0]]) + "\r\n")
    expected, whole = theirs(path, trc)
    frames, told = ours(path)
    assert whole
    assert told == []
    assert content(frames) == content(expected)
    np.testing.assert_allclose(times_us(frames), times_us(expected), rtol=0, atol=1)
    assert len(frames) >= 2 * 3 + 1


@pytest.mark.parametrize("version", TRC_HEADERS)
@pytest.mark.parametrize(("old", "new"), [("0300", "03Z0"), ("1059", "1O59"), ("04 00", "04 0G")])
def test_a_broken_line_of_trc_is_told_and_the_rest_is_read(tmp_path: Path, version: str, old: str, new: str):
    path = tmp_path / "drive.trc"
    usual = TRC_LINES[version][0]
    broken = usual.replace(old, new)
    path.write_text(TRC_HEADERS[version] + "\n".join([usual, broken, usual, ""]))
    frames, told = ours(path)
    assert len(frames) == 2
    number = TRC_HEADERS[version].count("\n") + 2
    assert told == [(1, f"line {number} is no frame: {broken.strip()[:40]}")]
