"""Scans of the front radar out of its frames on CAN-R: whole ones are handed out, of others it is told what they lack.

A scan is 64 frames, one per track, with one rolling count. The count has one bit, so halves of two scans with a lost
one between them would look like one; what belongs together is told by time too.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from dbc.radar_tracks import FIRST_ID, TRACK_DTYPE, TRACKS, Tracks, rolling_counts, unpack

#: Frames of one scan come within this time of the first. 64 frames of the greatest length take 17.3 ms at 500 kbit/s;
#: a scan is due every 50 ms.
SCAN_US = 30_000

_LENGTH = 8


class ScanStatus(IntEnum):
    """What has become of a scan."""

    COMPLETE = 0
    INCOMPLETE = 1
    """Frames are missing."""
    MIXED = 2
    """Its frames have different rolling counts: they are of different scans."""


class ReceivedScan(NamedTuple):
    """One scan.

    Attributes
    ----------
    status : see `ScanStatus`.
    time_us : when its first frame came.
    frames : how many of the 64 came, repeated ones once.
    tracks : TRACK_DTYPE, shape (n,), n up to 64; empty unless the scan is COMPLETE.
    """

    status: ScanStatus
    time_us: int
    frames: int
    tracks: Tracks


class RadarInbox:
    """Gathers scans; nothing that comes in raises an exception.

    Attributes
    ----------
    counts : scans so far, by status.
    """

    def __init__(self) -> None:
        self.counts = dict.fromkeys(ScanStatus, 0)
        self._first_us = 0
        self._rows: dict[int, bytes] = {}  # data by track, of the scan that is coming in
        self._told = False  # that scan is complete, and later frames of it are repeated ones
        self._newest: ReceivedScan | None = None

    def receive(self, time_us: int, identifier: int, length: int, flags: int, data: bytes) -> None:
        """Take a frame of CAN-R.

        Parameters
        ----------
        time_us : of the frame; not before that of the one before.
        identifier, length, flags, data : of the frame, see `dbc.frames.Frame`. What is no data frame of a track, or is
            too short for one, is ignored.
        """
        track = identifier - FIRST_ID
        if flags or length < _LENGTH or not 0 <= track < TRACKS:
            return
        if not self._rows or not 0 <= time_us - self._first_us < SCAN_US:
            self._close()
            self._first_us = time_us
        self._rows[track] = bytes(data[:_LENGTH])
        if len(self._rows) == TRACKS and not self._told:
            rows = np.frombuffer(b"".join(self._rows[place] for place in range(TRACKS)), np.uint8).reshape(TRACKS, -1)
            counts = rolling_counts(rows)
            if (counts == counts[0]).all():
                self._tell(ScanStatus.COMPLETE, unpack(rows))
            else:
                self._tell(ScanStatus.MIXED)

    def take(self, now_us: int) -> ReceivedScan | None:
        """The newest scan that has come to its end since the last call, or None.

        Parameters
        ----------
        now_us : a scan whose time is over by now is INCOMPLETE.
        """
        if self._rows and now_us - self._first_us >= SCAN_US:
            self._close()
        newest, self._newest = self._newest, None
        return newest

    def _close(self) -> None:
        """End the scan that is coming in."""
        if self._rows and not self._told:
            self._tell(ScanStatus.INCOMPLETE)
        self._rows, self._told = {}, False

    def _tell(self, status: ScanStatus, tracks: Tracks | None = None) -> None:
        if tracks is None:
            tracks = np.zeros(0, dtype=TRACK_DTYPE)
        self._newest = ReceivedScan(status, self._first_us, len(self._rows), tracks)
        self.counts[status] += 1
        self._told = True
