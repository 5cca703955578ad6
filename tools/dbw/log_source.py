"""Recordings as a stream of frames, whatever wrote them: candump, BLF, ASC, TRC, MF4."""

from __future__ import annotations

import gzip
import io
import logging
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO, TextIO, cast

import can
import numpy as np
from can.io.blf import BLFParseError, BLFReader
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.bus import CHANNELS
from bridge.tap import frame_of
from dbc.errors import ConfigurationError
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, FRAME_STRUCT, Bus, Flag, Station
from tools.dbw.frame_text import EXTENDED_MAX, STANDARD_MAX

#: Frames in one piece.
CHUNK = 1 << 16

SUFFIXES = (".asc", ".blf", ".log", ".mf4", ".trc")
"""Of what can be read; each may be followed by .gz."""

_NAMES = {
    **{name: bus for bus, name in CHANNELS.items()},
    **{bus.label: bus for bus in Bus},
    **{f"vcan{int(bus)}": bus for bus in Bus},
    **{f"can{int(bus)}": bus for bus in Bus},
    **{str(int(bus)): bus for bus in Bus},
}
"""What loggers call the buses: their names, or interfaces and channels numbered in their order."""

_CANDUMP = re.compile(
    r"\((\d+)\.(\d{6})\) +(\S+) +([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(R\d?|(?:[0-9A-Fa-f]{2}){0,8})(?: [TR])?\s*"
)
_PACKED = ".gz"
_ERROR_FRAME = 0x2000_0000
_STANDARD_DIGITS = 3

#: Bytes of a candump log read at once.
_BLOCK = 1 << 20

#: What python-can's readers raise on content that is not theirs.
_BROKEN = (ValueError, IndexError, KeyError, AttributeError, BLFParseError, struct.error, zlib.error, EOFError)

OnBroken = Callable[[int, str], None]
"""Takes the number of frames before, and what cannot be read there."""


def read_chunks(path: Path, bus: Bus | None, on_broken: OnBroken) -> Iterator[NDArray[np.void]]:
    """Read a recording piece by piece, so that memory does not grow with it.

    Parameters
    ----------
    path : with one of `SUFFIXES`.
    bus : on which all frames are, whatever their channel is called; None: by the channel.
    on_broken : called for each line of a candump log that is none, and once where another kind of log breaks off; what
        can be read is read.

    Yields
    ------
    array of `FRAME_DTYPE`
        At most twice `CHUNK` frames, times in microseconds as recorded.

    Raises
    ------
    ConfigurationError
        When the file cannot be opened, holds no frame at all, or has a channel that is no bus of the car.
    """
    packed, kind = path.suffix.lower() == _PACKED, _kind(path)
    if kind not in SUFFIXES:
        raise ConfigurationError(path, "", f"unknown kind of log; allowed are {', '.join(SUFFIXES)}, each also .gz")

    def bus_of_channel(channel: object) -> Bus:
        chosen = _NAMES.get(str(channel)) if bus is None else bus
        if chosen is None:
            allowed = f"{', '.join(CHANNELS.values())}, vcan0 to vcan3, 0 to 3; or say --bus"
            raise ConfigurationError(path, f"channel {channel}", f"unknown; allowed are {allowed}")
        return chosen

    first_reason = ""

    def broken(frame: int, text: str) -> None:
        nonlocal first_reason
        shown = "".join(character if character.isprintable() else "?" for character in text)
        first_reason = first_reason or f"; {shown}"
        on_broken(frame, shown)

    read = _candump if kind == ".log" else _through_python_can
    empty = True
    try:
        for frames in read(path, packed, bus_of_channel, broken):
            empty = False
            yield np.frombuffer(frames, dtype=FRAME_DTYPE)
    except OSError as error:
        raise ConfigurationError(path, "", error.strerror or f"cannot be read: {error}") from error
    if empty:
        raise ConfigurationError(path, "", f"holds no frame{first_reason}")


def _kind(path: Path) -> str:
    """Suffix of a recording, without that of gzip."""
    return Path(path.stem if path.suffix.lower() == _PACKED else path.name).suffix.lower()


def candump_line(line: str, bus_of: Callable[[str], Bus]) -> bytes | None:
    """A frame of 24 bytes out of a line of candump's log format (-L, -l); None when it holds none.

    Parameters
    ----------
    line : with or without its end.
    bus_of : gives the bus of a channel.
    """
    parts = _CANDUMP.fullmatch(line)
    if parts is None:
        return None
    seconds, micros, channel, identifier, content = parts.groups()
    frame_id, flags = int(identifier, 16), 0
    if len(identifier) == _STANDARD_DIGITS:
        largest = STANDARD_MAX
    elif frame_id & _ERROR_FRAME:
        flags, frame_id, largest = int(Flag.ERROR), frame_id & ~_ERROR_FRAME, EXTENDED_MAX
    else:
        flags, largest = int(Flag.EXTENDED), EXTENDED_MAX
    if frame_id > largest:
        return None
    if content.startswith("R"):
        flags |= Flag.REMOTE
        data, length = b"", int(content[1:] or 0)
    else:
        data = bytes.fromhex(content)
        length = len(data)
    time_us = int(seconds) * 1_000_000 + int(micros)
    return FRAME_STRUCT.pack(time_us, frame_id, bus_of(channel), length, flags, Station.NONE, data)


def _candump(path: Path, packed: bool, bus_of: Callable[[object], Bus], on_broken: OnBroken) -> Iterator[bytes]:
    """Frames out of the log format of candump: the usual lines are read in C, the others by `candump_line`."""
    known: dict[str, Bus] = {}
    room, used = ffi.new("can_frame[]", CHUNK), ffi.new("uint32_t *")
    count = number = begin = 0
    text, chunk = b"", bytearray()

    def learn(channel: str) -> Bus:
        return known.setdefault(channel, bus_of(channel))

    def broken_off(reason: str) -> None:
        on_broken(count, reason)

    for block in _blocks(path, packed, broken_off):
        text, begin = text[begin:] + block, 0
        start = ffi.from_buffer("char[]", text)
        while begin < len(text):
            channels = [(name.encode(), bus) for name, bus in known.items() if len(name) < lib.CANDUMP_NAME_SIZE]
            got = lib.candump_read(start + begin, len(text) - begin, channels, len(channels), room, CHUNK, used)
            count, number, begin = count + got, number + got, begin + used[0]
            chunk += ffi.buffer(room, got * FRAME_SIZE)
            if len(chunk) >= CHUNK * FRAME_SIZE:
                yield bytes(chunk)
                chunk.clear()
            end = text.find(b"\n", begin)
            if end < 0:
                break
            line, number, begin = text[begin:end].decode("ascii", "replace"), number + 1, end + 1
            frame = candump_line(line, learn)
            if frame is not None:
                count += 1
                chunk += frame
            elif line.strip():
                on_broken(count, f"line {number} is no frame: {line.strip()[:40]}")
    if chunk:
        yield bytes(chunk)


def _blocks(path: Path, packed: bool, on_broken: Callable[[str], None]) -> Iterator[bytes]:
    """A file piece by piece, the last of which ends with a line end."""
    try:
        with _opened(path, packed) as binary:
            while block := binary.read1(_BLOCK):  # read would keep what comes before a break to itself
                yield block
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        on_broken(f"breaks off: {error}")
    yield b"\n"


def _opened(path: Path, packed: bool) -> gzip.GzipFile | io.BufferedReader:
    return gzip.open(path) if packed else path.open("rb")


def _through_python_can(
    path: Path, packed: bool, bus_of: Callable[[object], Bus], on_broken: OnBroken
) -> Iterator[bytes]:
    """Frames out of what python-can has a reader for."""
    count = 0
    chunk = bytearray()
    try:
        # Opened here: a reader that does not like what it reads leaves the file open.
        with _complaints(lambda text: on_broken(count, text)), _opened(path, packed) as binary:
            reader = _READERS[_kind(path)](cast("IO[bytes]", binary))
            for message in reader:
                chunk += frame_of(message, bus_of(message.channel), max(round(message.timestamp * 1e6), 0))
                count += 1
                if count % CHUNK == 0:
                    yield bytes(chunk)
                    chunk.clear()
            if isinstance(reader, BLFReader) and not packed and reader.file_size > (size := path.stat().st_size):
                on_broken(count, f"breaks off: {size} of {reader.file_size} bytes are there")
    except NotImplementedError as error:  # python-can's MF4 reader without its package
        raise ConfigurationError(path, "", "needs a package for this kind of log: pip install asammdf") from error
    except _BROKEN as error:
        on_broken(count, f"breaks off: {' '.join(str(error).split()) or type(error).__name__}")
    if chunk:
        yield bytes(chunk)


@contextmanager
def _complaints(take: Callable[[str], None]) -> Iterator[None]:
    """Take what python-can's readers log of lines that they skip, instead of having it on standard error."""

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            take(" ".join(record.getMessage().split())[:80])

    handler, logger = Handler(logging.WARNING), logging.getLogger("can")
    before, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = before


def _text(binary: IO[bytes]) -> IO[str]:
    return io.TextIOWrapper(binary, encoding="utf-8", errors="replace")


_READERS: Mapping[str, Callable[[IO[bytes]], Iterable[can.Message]]] = {
    ".asc": lambda binary: can.ASCReader(cast("TextIO", _text(binary))),
    ".blf": lambda binary: BLFReader(cast("BinaryIO", binary)),
    ".mf4": lambda binary: can.MF4Reader(cast("BinaryIO", binary)),
    ".trc": lambda binary: can.TRCReader(cast("TextIO", _text(binary))),
}
