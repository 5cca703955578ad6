"""Reads BLF, Vector's binary log: the containers of the file here, the objects in them in C.

What python-can's `BLFReader` reads is read, and the same of it; after a damage reading goes on where the next object
begins.
"""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from dbc.frames import FRAME_DTYPE
from tools.dbw.channels import BusOf
from tools.dbw.chunk import CHUNK, OnBroken

#: "LOGG", size of the header, of the file as it is and unpacked, number of objects, SYSTEMTIME of begin and end.
_FILE_HEADER = struct.Struct("<4sL8xQQLL8H8H")

#: "LOBJ", size and version of the header, size and type of the object.
_OBJECT_HEADER = struct.Struct("<4sHHLL")

#: Method of compression, size of what comes out.
_CONTAINER_HEADER = struct.Struct("<H6xL4x")

_SIGNATURE = b"LOBJ"
_CONTAINER = 10
_PLAIN, _ZLIB = 0, 2

#: Containers hold 128 KiB as a rule. One that says it is larger than this is damaged.
_OBJECT_MAX = 1 << 24

#: Bytes looked through at once for the next object.
_BLOCK = 1 << 16

#: Containers that are unpacked, on another core, while the frames of one are looked at.
_AHEAD = 2


class _Damaged(Exception):  # noqa: N818
    """What cannot be read of a container, or instead of one."""


class _Container(NamedTuple):
    """Place in the file, method of compression, content; what is wrong when there is none."""

    offset: int
    method: int
    content: bytes
    problem: str = ""

    def unpack(self) -> bytes:
        """Its content, as far as it is there.

        Raises
        ------
        _Damaged
            Says what is wrong.
        """
        if self.problem:
            raise _Damaged(self.problem)
        if self.method == _PLAIN:
            return self.content
        if self.method != _ZLIB:
            raise _Damaged(f"container at byte {self.offset}: compression {self.method}; known are 0 and 2")
        try:
            return zlib.decompressobj().decompress(self.content, _OBJECT_MAX)
        except zlib.error as error:
            raise _Damaged(f"container at byte {self.offset}: {error}") from error


class _File:
    """The objects of a file, one after the other.

    Parameters
    ----------
    binary : behind the header of the file.
    offset : of that place.
    """

    def __init__(self, binary: IO[bytes], offset: int) -> None:
        self._binary = binary
        self._ahead = b""
        self.offset = offset

    def containers(self) -> Iterator[_Container]:
        """Those that are there, and a damaged one where there is something else; the last one as far as it goes."""
        while header := self._take(_OBJECT_HEADER.size):
            offset = self.offset - len(header)
            if len(header) < _OBJECT_HEADER.size:
                return  # nothing that could be missed
            signature, _, _, size, kind = _OBJECT_HEADER.unpack(header)
            if signature != _SIGNATURE or not _OBJECT_HEADER.size <= size <= _OBJECT_MAX:
                yield _Container(offset, _PLAIN, b"", f"no object at byte {offset}")
                self._ahead = header[1:] + self._ahead
                self.offset = offset + 1
                self._skip_to_object()
                continue
            content = self._take(size - _OBJECT_HEADER.size)
            self._take(size % 4)
            if kind == _CONTAINER and len(content) >= _CONTAINER_HEADER.size:
                method, _ = _CONTAINER_HEADER.unpack_from(content)
                yield _Container(offset, method, content[_CONTAINER_HEADER.size :])

    def _take(self, count: int) -> bytes:
        """The next bytes; fewer only at the end of the file."""
        taken, self._ahead = self._ahead[:count], self._ahead[count:]
        if len(taken) < count:
            taken += self._binary.read(count - len(taken))
        self.offset += len(taken)
        return taken

    def _skip_to_object(self) -> None:
        """Go on to the next signature, or to the end."""
        while (place := self._ahead.find(_SIGNATURE)) < 0:
            block = self._binary.read(_BLOCK)
            if not block:
                self.offset += len(self._ahead)
                self._ahead = b""
                return
            passed = max(len(self._ahead) - len(_SIGNATURE) + 1, 0)
            self.offset += passed
            self._ahead = self._ahead[passed:] + block
        self.offset += place
        self._ahead = self._ahead[place:]


class _Objects:
    """Frames out of the contents of containers, in which objects follow each other without regard to their ends.

    Parameters
    ----------
    start_us : time of the log's beginning.
    bus_of : gives the bus of a channel.

    Attributes
    ----------
    damaged : whether there is something else behind the frames that were given last; once for each such place.
    """

    def __init__(self, start_us: int, bus_of: BusOf) -> None:
        self._start_us = start_us
        self._bus_of = bus_of
        self._buses: dict[int, int] = {}
        self._frames = np.zeros(CHUNK, FRAME_DTYPE)
        self._channels = np.zeros(CHUNK, np.uint16)
        self._frame_room = ffi.from_buffer("can_frame[]", self._frames, require_writable=True)
        self._channel_room = ffi.from_buffer("uint16_t[]", self._channels, require_writable=True)
        self._lost = self.damaged = False
        self._rest = b""

    def read(self, content: bytes, last: bool = False) -> Iterator[NDArray[np.void]]:
        """Frames out of the next piece, which may be none; the array is good until the next one.

        Parameters
        ----------
        content : of a container.
        last : there is none after it, in which an object could go on.
        """
        data, begin = self._rest + content, 0
        start = ffi.from_buffer("uint8_t[]", data)
        more = True
        while more:
            got = lib.blf_read(
                start + begin, len(data) - begin, self._start_us, self._frame_room, self._channel_room, CHUNK
            )
            begin += got.used
            self._lost = self._lost and got.used == 0
            following = data.find(_SIGNATURE, begin + 1) if got.end != lib.BLF_FULL else begin
            damaged = got.end == lib.BLF_DAMAGED or (last and got.end == lib.BLF_INCOMPLETE and following >= 0)
            self.damaged = damaged and not self._lost
            yield self._frames_on_buses(got.count)
            if damaged:
                self._lost = True
                begin = following if following >= 0 else max(len(data) - len(_SIGNATURE) + 1, begin)
            more = got.end == lib.BLF_FULL or (damaged and following >= 0)
        self._rest = data[begin:]

    def lose(self) -> None:
        """Forget the object that a container begins which cannot be read."""
        self._rest, self._lost = b"", True

    def _frames_on_buses(self, count: int) -> NDArray[np.void]:
        frames, channels = self._frames[:count], self._channels[:count]
        for channel in np.unique(channels).tolist():
            if channel not in self._buses:
                self._buses[channel] = int(self._bus_of(channel - 1))
        table = np.zeros(max(self._buses, default=0) + 1, np.uint8)
        table[list(self._buses)] = list(self._buses.values())
        frames["bus"] = table[channels]
        return frames


def read_blf(binary: IO[bytes], bus_of: BusOf, on_broken: OnBroken) -> Iterator[bytes]:
    """Frames out of a BLF log.

    Parameters
    ----------
    binary : the file, at its beginning.
    bus_of : gives the bus of a channel, which counts from 0.
    on_broken : called for each place that cannot be read, and when the file is shorter than it says.
    """
    header = binary.read(_FILE_HEADER.size)
    if len(header) < _FILE_HEADER.size or not header.startswith(b"LOGG"):
        on_broken(0, "no header of a BLF log")
        return
    _, header_size, file_size, *fields = _FILE_HEADER.unpack(header)
    offset = len(header) + len(binary.read(max(min(header_size, _BLOCK) - len(header), 0)))
    objects = _Objects(_time_us(fields[3:11]), bus_of)
    file = _File(binary, offset)
    count = 0
    with ThreadPoolExecutor(1) as pool:
        for offset, unpacked in _unpacked(file.containers(), pool):
            try:
                content = unpacked.result()
            except _Damaged as damage:
                on_broken(count, str(damage))
                objects.lose()
                continue
            for frames in objects.read(content):
                count += len(frames)
                yield frames.tobytes()
                if objects.damaged:
                    on_broken(count, f"container at byte {offset}: no object where one must be")
    for frames in objects.read(b"", last=True):
        count += len(frames)
        yield frames.tobytes()
        if objects.damaged:
            on_broken(count, "an object goes on behind the end of the file")
    if file.offset < file_size:
        on_broken(count, f"breaks off: {file.offset} of {file_size} bytes are there")


def _unpacked(containers: Iterable[_Container], pool: ThreadPoolExecutor) -> Iterator[tuple[int, Future[bytes]]]:
    """Offset and content of each; some are unpacked ahead."""
    waiting: deque[tuple[int, Future[bytes]]] = deque()
    for container in containers:
        waiting.append((container.offset, pool.submit(container.unpack)))
        if len(waiting) > _AHEAD:
            yield waiting.popleft()
    yield from waiting


def _time_us(fields: list[int]) -> int:
    """Microseconds since 1970 of a SYSTEMTIME in UTC; 0 when it is none."""
    year, month, _, day, hour, minute, second, milliseconds = fields
    try:
        moment = datetime(year, month, day, hour, minute, second, milliseconds * 1000, tzinfo=UTC)
    except ValueError:
        return 0
    return max(round(moment.timestamp() * 1000) * 1000, 0)
