"""Reads TRC, PEAK's text log: the usual lines in C, the others by python-can's reader."""

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
from tools.dbw.python_can_log import complaints
from tools.dbw.text_log import Usual, read_text

#: Columns of the versions that do not name them, by the letters of those that do; 1.0 does not even name itself.
_COLUMNS = {"1.0": "NOILD", "1.1": "NOdILD", "1.3": "NOBdIRLD"}

#: Lines of a header, generously.
_HEADER_MAX = 1000

_VERSION = re.compile(r"^;\$FILEVERSION=(1\.1|1\.3|2\.0|2\.1)$", re.MULTILINE)
_NAMED = re.compile(r"^;\$COLUMNS=([A-Za-z](?:,[A-Za-z])*)$", re.MULTILINE)
_START = re.compile(r"^;\$STARTTIME=(\d+(?:\.\d+)?)$", re.MULTILINE)

#: Days from the beginning of the format's calendar, in 1899, to 1970.
_DAYS_TO_1970 = 25_569
_DAY_US = 86_400_000_000


class _Reader:
    """Lines of one log.

    Parameters
    ----------
    bus_of : gives the bus of a channel, which counts from 0.
    """

    def __init__(self, bus_of: BusOf) -> None:
        self._bus_of = bus_of
        self._header: list[str] = []
        self._columns: bytes | None = None
        self._start_us = 0
        self._frames = np.zeros(CHUNK, FRAME_DTYPE)
        self._channels = np.zeros(CHUNK, np.uint16)
        self._frame_room = ffi.from_buffer("can_frame[]", self._frames, require_writable=True)
        self._channel_room = ffi.from_buffer("uint16_t[]", self._channels, require_writable=True)
        self._used = ffi.new("uint32_t *")

    def usual(self, start: Any, length: int) -> Usual:
        """Lines with classic data frames; none before the header has said what stands where."""
        if not self._columns:
            return Usual(b"", 0)
        count = lib.trc_read(start, length, self._columns, self._frame_room, self._channel_room, CHUNK, self._used)
        frames, channels = self._frames[:count], self._channels[:count]
        frames["time_us"] += np.uint64(self._start_us)
        for channel in np.unique(channels).tolist():
            frames["bus"][channels == channel] = self._bus_of(channel - 1)
        return Usual(frames.tobytes(), self._used[0])

    def other(self, line: str) -> bytes | None:
        """Any other line."""
        if line.startswith(";"):
            if self._columns is None and len(self._header) < _HEADER_MAX:
                self._header.append(line)
            return b""
        if not line:
            return b""
        if self._columns is None:
            self._end_header()
        text = io.StringIO("\n".join([*self._header, line, ""]))
        skipped: list[str] = []
        try:
            with complaints(skipped.append):
                frames = b"".join(map(self._frame_of, can.TRCReader(text)))
        except (ValueError, KeyError):  # no number, no such column
            return None
        return None if skipped else frames

    def _frame_of(self, message: can.Message) -> bytes:
        bus = self._bus_of(int(str(message.channel)) - 1)
        return frame_of(message, bus, max(round(message.timestamp * 1e6), 0))

    def _end_header(self) -> None:
        """Understand it, as far as usual lines need it."""
        text = "\n".join(self._header)
        version, named, start = (pattern.search(text) for pattern in (_VERSION, _NAMED, _START))
        number = "1.0" if version is None else version[1]
        columns = _COLUMNS.get(number, "" if named is None else named[1].replace(",", ""))
        if number != "1.0":
            if start is None:
                columns = ""
            else:
                self._start_us = max(round((float(start[1]) - _DAYS_TO_1970) * _DAY_US), 0)
        if number.startswith("2") and not {"O", "T", "I", "d"} <= set(columns):
            columns = ""
        # Data are last, behind their length; otherwise no line is usual.
        self._columns = columns.encode() if re.search("[Ll].*D$", columns) else b""


def read_trc(blocks: Iterable[bytes], bus_of: BusOf, on_broken: OnBroken) -> Iterator[bytes]:
    """Frames out of the text of a TRC log.

    Parameters
    ----------
    blocks : the text, cut anywhere; its last line ends.
    bus_of : gives the bus of a channel; they count from 0 here, from 1 in such a log.
    on_broken : called for each line that should be a frame and is not.
    """
    reader = _Reader(bus_of)
    yield from read_text(blocks, reader.usual, reader.other, on_broken)
