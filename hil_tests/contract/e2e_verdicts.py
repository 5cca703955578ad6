"""What a receiver's protocol makes of each communication fault: the table that the tests hold the firmware to.

A verdict is a set: why frames are dropped, and whether the receiver misses the message afterwards. The empty set says
that the fault is not noticed by counter, CRC, length or age; what else may notice it is in docs/e2e.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

import e2e_faults as faults
from e2e_faults import Stream, Traffic, is_heartbeat

from dbc.network import MessageFacts

Verdict = frozenset[str]

COUNTER, CRC, SHORT, REMOTE, MISSED = "counter", "CRC", "short", "remote", "missed"


class Protection(Enum):
    """What a message carries for its receiver to check."""

    CRC = "counter and CRC"
    COUNTER = "counter"
    HEARTBEAT = "heartbeat"
    NONE = "nothing"


def protection(facts: MessageFacts) -> Protection:
    if facts.crc is not None:
        return Protection.CRC
    if facts.counter is not None:
        return Protection.COUNTER
    if any(is_heartbeat(signal.name) for signal in facts.message.signals):
        return Protection.HEARTBEAT
    return Protection.NONE


@dataclass(frozen=True)
class Row:
    """One way in which one class of fault shows."""

    fault: str
    shape: str
    inject: Callable[[Traffic, Stream], Traffic]
    verdicts: Mapping[Protection, Verdict]


def _verdicts(crc: str, counter: str, heartbeat: str, none: str) -> Mapping[Protection, Verdict]:
    cells = (crc, counter, heartbeat, none)
    return {kind: frozenset(cell.split()) for kind, cell in zip(Protection, cells, strict=True)}


def _alike(cell: str) -> Mapping[Protection, Verdict]:
    return _verdicts(cell, cell, cell, cell)


ROWS = (
    Row(
        "repetition",
        "each frame comes twice",
        faults.every_frame_twice,
        _verdicts("counter", "counter", "", ""),
    ),
    Row(
        "repetition",
        "one old frame again and again",
        faults.one_frame_for_ever,
        _verdicts("counter missed", "counter missed", "missed", ""),
    ),
    Row("loss", "of one frame", faults.one_frame_lost, _alike("")),
    Row("loss", "of all frames", faults.all_frames_lost, _alike("missed")),
    Row("delay", "up to the time-out", faults.within_the_limit, _alike("")),
    Row("delay", "beyond the time-out", faults.beyond_the_limit, _alike("missed")),
    Row(
        "insertion",
        "by a sender that leaves the CRC 0",
        faults.foreign_frames_between,
        _verdicts("CRC", "", "", ""),
    ),
    Row("insertion", "by a sender that knows the CRC", faults.forged_frames_between, _alike("")),
    Row(
        "masquerade",
        "by a sender that leaves the CRC 0",
        faults.foreign_frames_instead,
        _verdicts("CRC missed", "", "", ""),
    ),
    Row("masquerade", "by a sender that knows the CRC", faults.forged_frames_instead, _alike("")),
    Row(
        "wrong addressing",
        "another message's content under this id",
        faults.another_message_under_this_id,
        _verdicts("CRC missed", "", "", ""),
    ),
    Row("wrong addressing", "on another bus", faults.on_another_bus, _alike("missed")),
    Row("wrong addressing", "id in the other format", faults.in_the_other_format, _alike("missed")),
    Row("wrong sequence", "every two frames swapped", faults.every_two_frames_swapped, _alike("")),
    Row(
        "corruption",
        "of one bit of the content",
        faults.one_bit_flipped,
        _verdicts("CRC missed", "", "", ""),
    ),
    Row("corruption", "one byte too short", faults.one_byte_short, _alike("short missed")),
    Row("corruption", "remote frame instead of data", faults.remote_frames, _alike("remote missed")),
    Row("blocked channel", "nothing comes on this bus", faults.bus_silent, _alike("missed")),
)

#: What can become of a command with one wrong bit.
OUTCOMES = ("stops the car", "followed", "no effect")

#: Bits of the content of each command by outcome, while the car drives at 30 % throttle, 12 degrees and 100 kPa in
#: neutral. A pressure above 500 kPa contradicts the throttle; a throttle above 100 % or below 0 is none; a step of more
#: than 90 degrees is too wide; there is no gear above 6; of the states one bit beside CAUTION two go with DRIVING.
PLAUSIBILITY = {
    "brake_pressure_cmd": (4, 9, 0),
    "accelerator_cmd": (3, 13, 0),
    "steering_cmd": (3, 8, 0),
    "gear_shift_cmd": (5, 3, 0),
    "ct_report": (14, 2, 32),
    "dash_switches_cmd": (0, 8, 0),
}
