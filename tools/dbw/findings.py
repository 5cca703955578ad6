"""What a check finds: which rule is broken, where, how often, and in which frame first."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dbc.frames import Bus


class Rule(StrEnum):
    """What is checked."""

    UNKNOWN = "unknown identifier"
    REMOTE = "remote frame"
    ERROR = "error frame"
    SHORT = "too short"
    LONG = "too long"
    CRC = "CRC"
    UNUSED = "unused bits"
    STUCK = "counter stuck"
    JUMP = "counter jump"
    RANGE = "range"
    VALUE = "no such value"
    SEQUENCE = "sequence"
    SLEW = "slew"
    FROZEN = "standstill"
    NEVER_SET = "never set"
    RESOLUTION = "resolution"
    ROUNDING = "rounding"
    RELAY = "relay"
    ACKNOWLEDGEMENT = "acknowledgement"
    AGREEMENT = "disagreement"
    PEDALS = "accelerator and brake"
    COPY = "copy"
    CYCLE = "cycle time"
    TIMEOUT = "time-out"
    MISSING = "missing message"
    CLOCK = "clock"
    BROKEN = "unreadable"


class Place(NamedTuple):
    """What a finding is about.

    Attributes
    ----------
    rule : that is broken.
    bus : of the frame; None for the recording as a whole.
    message : name, or identifier in hexadecimal digits when nothing is known of it; empty for a bus as a whole.
    signal : empty for the message as a whole.
    """

    rule: Rule
    bus: Bus | None = None
    message: str = ""
    signal: str = ""

    @property
    def subject(self) -> str:
        """Bus, message and signal in words."""
        bus = "recording" if self.bus is None else self.bus.label
        return f"{bus} {self.message}{'.' if self.signal else ''}{self.signal}".rstrip()


@dataclass(frozen=True)
class Offence:
    """Frames that break a rule.

    Attributes
    ----------
    count : frames.
    frame, time_us : number in the recording, from 0, and time of the first of them.
    text : of the first: what was seen, and what should be.
    """

    count: int
    frame: int
    time_us: int
    text: str

    @classmethod
    def of(cls, rows: NDArray[np.intp], numbers: NDArray[np.int64], times: NDArray[np.int64], text: str) -> Offence:
        """That of frames in some rows, at least one."""
        return cls(len(rows), int(numbers[rows[0]]), int(times[rows[0]]), text)


@dataclass
class Finding:
    """Frames that break one rule in one place.

    Attributes
    ----------
    place : what and where.
    count : frames.
    first_frame, first_us : number in the recording, from 0, and time of the first of them.
    text : of the first: what was seen, and what should be.
    """

    place: Place
    count: int
    first_frame: int
    first_us: int
    text: str


class Findings(dict[Place, Finding]):
    """All of them, by place."""

    def note(self, place: Place, offence: Offence) -> None:
        """Note frames that break a rule; the words are those of the first frame."""
        found = self.setdefault(place, Finding(place, 0, offence.frame, offence.time_us, offence.text))
        found.count += offence.count
        if offence.frame < found.first_frame:
            found.first_frame, found.first_us, found.text = offence.frame, offence.time_us, offence.text
