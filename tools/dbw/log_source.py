"""Recordings as a stream of frames, whatever wrote them: candump, BLF, ASC, TRC, MF4."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dbc.errors import ConfigurationError
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Bus
from tools.dbw.asc_log import read_asc
from tools.dbw.blf_log import read_blf
from tools.dbw.candump_log import read_candump
from tools.dbw.channels import BusOf, bus_of
from tools.dbw.chunk import CHUNK, OnBroken
from tools.dbw.python_can_log import read_mf4
from tools.dbw.trc_log import read_trc

Reader = Callable[[IO[bytes], BusOf, OnBroken], Iterator[bytes]]
"""Takes a file at its beginning; gives frames in pieces of any size up to `CHUNK`."""

_PACKED = ".gz"

#: Bytes of a text read at once.
_BLOCK = 1 << 20


def read_chunks(path: Path, bus: Bus | None, on_broken: OnBroken) -> Iterator[NDArray[np.void]]:
    """Read a recording piece by piece, so that memory does not grow with it.

    Parameters
    ----------
    path : with one of `SUFFIXES`.
    bus : on which all frames are, whatever their channel is called; None: by the channel.
    on_broken : called for each line or place that cannot be read, and where the log breaks off; what can be read is
        read.

    Yields
    ------
    array of `FRAME_DTYPE`
        At most twice `CHUNK` frames, times in microseconds as recorded.

    Raises
    ------
    ConfigurationError
        When the file cannot be opened, holds no frame at all, or has a channel that is no bus of the car.
    """
    packed = path.suffix.lower() == _PACKED
    read = _READERS.get(Path(path.stem if packed else path.name).suffix.lower())
    if read is None:
        raise ConfigurationError(path, "", f"unknown kind of log; allowed are {', '.join(SUFFIXES)}, each also .gz")
    first_reason = ""
    count = 0

    def broken(frame: int, text: str) -> None:
        nonlocal first_reason
        shown = "".join(character if character.isprintable() else "?" for character in text)
        first_reason = first_reason or f"; {shown}"
        on_broken(frame, shown)

    try:
        with path.open("rb") as file:
            unpacked = _Unpacked(file) if packed else None
            binary = file if unpacked is None else io.BufferedReader(unpacked)
            pieces = read(binary, lambda channel: bus_of(channel, bus, path), broken)
            for frames in _gathered(pieces):
                count += len(frames)
                yield frames
            if unpacked is not None and unpacked.problem:
                broken(count, f"breaks off: {unpacked.problem}")
    except NotImplementedError as error:  # python-can's MF4 reader without its package
        raise ConfigurationError(path, "", "needs a package for this kind of log: pip install asammdf") from error
    except OSError as error:
        raise ConfigurationError(path, "", error.strerror or f"cannot be read: {error}") from error
    if not count:
        raise ConfigurationError(path, "", f"holds no frame{first_reason}")


def _gathered(pieces: Iterable[bytes]) -> Iterator[NDArray[np.void]]:
    """Pieces of any size as some of about `CHUNK` frames: what takes them spends much on each, whatever its size."""
    together = bytearray()
    for piece in pieces:
        together += piece
        if len(together) >= CHUNK * FRAME_SIZE:
            yield np.frombuffer(bytes(together), dtype=FRAME_DTYPE)
            together.clear()
    if together:
        yield np.frombuffer(bytes(together), dtype=FRAME_DTYPE)


class _Unpacked(io.RawIOBase):
    """What gzip has packed, up to where it breaks off.

    Attributes
    ----------
    problem : why it breaks off; empty when it does not.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._gzip = gzip.GzipFile(fileobj=file)
        self.problem = ""

    def readable(self) -> bool:
        """Always."""
        return True

    def readinto(self, room: Any) -> int:
        """Fill some of the room; 0 bytes at the end."""
        view = memoryview(room)
        if self.problem:
            return 0
        try:
            content = self._gzip.read1(len(view))  # read would keep what comes before a break to itself
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            self.problem = str(error)
            return 0
        view[: len(content)] = content
        return len(content)


def _by_lines(read: Callable[[Iterable[bytes], BusOf, OnBroken], Iterator[bytes]]) -> Reader:
    """A reader of a text, made from one of its pieces."""

    def blocks(binary: IO[bytes]) -> Iterator[bytes]:
        while block := binary.read(_BLOCK):
            yield block
        yield b"\n"

    return lambda binary, bus_of, on_broken: read(blocks(binary), bus_of, on_broken)


_READERS: Mapping[str, Reader] = {
    ".asc": _by_lines(read_asc),
    ".blf": read_blf,
    ".log": _by_lines(read_candump),
    ".mf4": read_mf4,
    ".trc": _by_lines(read_trc),
}

SUFFIXES = tuple(_READERS)
"""Of what can be read; each may be followed by .gz."""
