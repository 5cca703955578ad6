"""Reads ASC, Vector's text log: the usual lines in C, the others by python-can's reader."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator
from typing import Any

import can
import numpy as np

from bridge._native import ffi, lib
from bridge.tap import frame_of
from dbc.frames import FRAME_DTYPE
from tools.dbw.channels import BusOf
from tools.dbw.chunk import CHUNK, OnBroken
from tools.dbw.text_log import Usual, read_text

_BASE = re.compile(r"base\s+(hex|dec)", re.IGNORECASE)

#: What a line with a frame looks like at least; most others are events of other kinds, of which there may be many.
_FRAME = re.compile(r"\d+\.\d+\s.*(?:[RT]x|ErrorFrame|CANFD)", re.IGNORECASE)


class _Reader:
    """Lines of one log.

    Parameters
    ----------
    bus_of : gives the bus of a channel, which counts from 0.
    """

    def __init__(self, bus_of: BusOf) -> None:
        self._bus_of = bus_of
        self._base = "hex"
        self._frames = np.zeros(CHUNK, FRAME_DTYPE)
        self._channels = np.zeros(CHUNK, np.uint16)
        self._frame_room = ffi.from_buffer("can_frame[]", self._frames, require_writable=True)
        self._channel_room = ffi.from_buffer("uint16_t[]", self._channels, require_writable=True)
        self._used = ffi.new("uint32_t *")

    def usual(self, start: Any, length: int) -> Usual:
        """Lines with classic data frames; none of a log with decimal numbers."""
        if self._base != "hex":
            return Usual(b"", 0)
        count = lib.asc_read(start, length, self._frame_room, self._channel_room, CHUNK, self._used)
        frames, channels = self._frames[:count], self._channels[:count]
        for channel in np.unique(channels).tolist():
            frames["bus"][channels == channel] = self._bus_of(channel - 1)
        return Usual(frames.tobytes(), self._used[0])

    def other(self, line: str) -> bytes | None:
        """Any other line."""
        if base := _BASE.match(line):
            self._base = base[1].lower()
        if not _FRAME.match(line):
            return b""
        # The reader takes the lines before the first event for a header.
        text = io.StringIO(f"base {self._base}  timestamps absolute\ninternal events logged\n{line}\n")
        try:
            return b"".join(
                frame_of(message, self._bus_of(message.channel), round(message.timestamp * 1e6))
                for message in can.ASCReader(text)
            )
        except (ValueError, IndexError):
            return None


def read_asc(blocks: Iterable[bytes], bus_of: BusOf, on_broken: OnBroken) -> Iterator[bytes]:
    """Frames out of the text of an ASC log.

    Parameters
    ----------
    blocks : the text, cut anywhere; its last line ends.
    bus_of : gives the bus of a channel, which counts from 0.
    on_broken : called for each line that should be a frame and is not.
    """
    reader = _Reader(bus_of)
    yield from read_text(blocks, reader.usual, reader.other, on_broken)
