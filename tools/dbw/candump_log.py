"""Reads the log format of candump (-L, -l): the usual lines in C, the others here."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from bridge._native import ffi, lib
from dbc.frames import FRAME_SIZE, FRAME_STRUCT, Bus, Flag, Station
from tools.dbw.channels import BusOf
from tools.dbw.chunk import CHUNK, OnBroken
from tools.dbw.frame_text import EXTENDED_MAX, STANDARD_MAX
from tools.dbw.text_log import Usual, read_text

_LINE = re.compile(
    r"\((\d+)\.(\d{6})\) +(\S+) +([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(R\d?|(?:[0-9A-Fa-f]{2}){0,8})(?: [TR])?\s*"
)
_ERROR_FRAME = 0x2000_0000
_STANDARD_DIGITS = 3


def candump_line(line: str, bus_of: Callable[[str], Bus]) -> bytes | None:
    """A frame of 24 bytes out of a line of candump's log format (-L, -l); None when it holds none.

    Parameters
    ----------
    line : with or without its end.
    bus_of : gives the bus of a channel.
    """
    parts = _LINE.fullmatch(line)
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


def read_candump(blocks: Iterable[bytes], bus_of: BusOf, on_broken: OnBroken) -> Iterator[bytes]:
    """Frames out of the text of a candump log.

    Parameters
    ----------
    blocks : the text, cut anywhere; its last line ends.
    bus_of : gives the bus of a channel.
    on_broken : called for each line that is none.
    """
    known: dict[str, Bus] = {}
    room, used = ffi.new("can_frame[]", CHUNK), ffi.new("uint32_t *")

    def learn(channel: str) -> Bus:
        return known.setdefault(channel, bus_of(channel))

    def usual(start: Any, length: int) -> Usual:
        channels = [(name.encode(), bus) for name, bus in known.items() if len(name) < lib.CANDUMP_NAME_SIZE]
        count = lib.candump_read(start, length, channels, len(channels), room, CHUNK, used)
        return Usual(bytes(ffi.buffer(room, count * FRAME_SIZE)), used[0])

    def other(line: str) -> bytes | None:
        return candump_line(line, learn) if line else b""

    yield from read_text(blocks, usual, other, on_broken)
