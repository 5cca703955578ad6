"""What is known of every message on the buses at some moment: the state behind `raceloop dbw monitor`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dbc.codec import Codec, MessageCodec
from dbc.codec import database as car
from dbc.frames import Bus, Flag
from tools.dbw.conformance import Conformance
from tools.dbw.findings import Finding

#: Rows of messages that nobody knows: who sends any identifier must not fill the memory.
UNKNOWN_MAX = 64


class Address(NamedTuple):
    """Of a message."""

    bus: Bus
    extended: bool
    frame_id: int


@dataclass
class Row:
    """One message.

    Attributes
    ----------
    codec : None when nobody knows the message.
    count : frames so far.
    first_us, last_us : times of the first and of the newest frame.
    period_us : between the two newest frames; None when there is one only.
    heard_us : when the newest came in, by the clock of whoever looks at the table.
    data : its data bytes.
    """

    codec: MessageCodec | None
    count: int
    first_us: int
    last_us: int
    period_us: int | None
    heard_us: int
    data: bytes

    @property
    def mean_us(self) -> float | None:
        """Between two frames, on average; None when there is one only."""
        return (self.last_us - self.first_us) / (self.count - 1) if self.count > 1 else None

    def age_us(self, now_us: int) -> int:
        """How old the newest frame is."""
        return max(now_us - self.heard_us, 0)

    def stale(self, now_us: int) -> bool:
        """Whether that is past the message's time-out."""
        return self.codec is not None and 0 < self.codec.timeout_us < self.age_us(now_us)


class MessageTable:
    """All messages that were seen, and what is wrong with them.

    Parameters
    ----------
    database : the messages that are allowed.

    Attributes
    ----------
    conformance : what was found wrong.
    rows : by address, unsorted.
    """

    def __init__(self, database: Codec = car) -> None:
        self.conformance = Conformance(database)
        self.rows: dict[Address, Row] = {}
        self._unknown = 0

    def update(self, frames: NDArray[np.void], now_us: int) -> None:
        """Take in frames.

        Parameters
        ----------
        frames : array of `FRAME_DTYPE`, which may be empty.
        now_us : time by any clock that does not go back, at which the newest of them has come in.
        """
        self.conformance.update(frames)
        data = frames[frames["flags"] & (Flag.REMOTE | Flag.ERROR) == 0]
        if not len(data):
            return
        newest_us = int(data["time_us"].max())
        keys = (data["bus"].astype(np.uint64) << np.uint64(40)) | (
            (data["flags"].astype(np.uint64) & np.uint64(Flag.EXTENDED)) << np.uint64(32) | data["id"]
        )
        order = np.argsort(keys, kind="stable")
        ends = np.append(np.flatnonzero(np.diff(keys[order])), len(order) - 1)
        begins = np.append(0, ends[:-1] + 1)
        for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
            self._update_row(data[order[begin]], data[order[max(begin, end - 1) : end + 1]], end - begin + 1)
            row = self.rows.get(_address(data[order[end]]))
            if row is not None:
                row.heard_us = now_us - (newest_us - row.last_us)

    def _update_row(self, first: np.void, newest: NDArray[np.void], count: int) -> None:
        """Take in frames of one message: the first, the newest two or one, and how many there are."""
        last = newest[-1]
        address, time_us = _address(last), int(last["time_us"])
        row = self.rows.get(address)
        if row is None:
            codec = self.conformance.database.find(*_find(address))
            if codec is None:
                if self._unknown == UNKNOWN_MAX:
                    return
                self._unknown += 1
            row = self.rows[address] = Row(codec, 0, int(first["time_us"]), time_us, None, 0, b"")
        if count > 1:
            row.period_us = time_us - int(newest[0]["time_us"])
        elif row.count:
            row.period_us = time_us - row.last_us
        row.count += count
        row.last_us = time_us
        row.data = bytes(last["data"])[: int(last["dlc"])]

    def sorted(self) -> Iterator[tuple[Address, Row]]:
        """By bus and identifier."""
        return iter(sorted(self.rows.items()))

    def findings(self) -> dict[tuple[Bus | None, str], list[Finding]]:
        """What is wrong, by bus and message."""
        found: dict[tuple[Bus | None, str], list[Finding]] = {}
        for place, finding in self.conformance.findings.items():
            found.setdefault((place.bus, place.message), []).append(finding)
        return found


def _address(frame: np.void) -> Address:
    return Address(Bus(int(frame["bus"])), bool(frame["flags"] & Flag.EXTENDED), int(frame["id"]))


def _find(address: Address) -> tuple[int, int, bool]:
    return int(address.bus), address.frame_id, address.extended
