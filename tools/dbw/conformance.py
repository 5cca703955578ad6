"""Whether the traffic on the buses is what the DBC files say: checks that see each frame once, in order of time.

Frames come in pieces; what a check keeps does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from cantools.database.can import Signal
from numpy.typing import NDArray

from bridge._native import lib
from dbc.codec import Codec, MessageCodec
from dbc.codec import database as car
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Bus, Flag
from dbc.network import MessageFacts
from tools.dbw.sequences import Sequence, sequences


class Rule(StrEnum):
    """What is checked."""

    UNKNOWN = "unknown identifier"
    REMOTE = "remote frame"
    ERROR = "error frame"
    SHORT = "too short"
    LONG = "too long"
    CRC = "CRC"
    STUCK = "counter stuck"
    JUMP = "counter jump"
    RANGE = "range"
    SEQUENCE = "sequence"
    CYCLE = "cycle time"
    TIMEOUT = "time-out"
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


@dataclass
class Timing:
    """Times between the frames of one message, us.

    Attributes
    ----------
    count : intervals.
    total, squares : their sum, and that of their squares.
    shortest, longest : of them.
    first_frame, first_us : number in the recording, and time, of the first frame.
    last_us : time of the newest frame.
    """

    first_frame: int = 0
    first_us: int = 0
    count: int = 0
    total: float = 0.0
    squares: float = 0.0
    shortest: int = 0
    longest: int = 0
    last_us: int = 0

    @property
    def mean(self) -> float:
        """Mean interval, us; 0 when there is none."""
        return self.total / self.count if self.count else 0.0

    @property
    def jitter(self) -> float:
        """Standard deviation of the intervals, us."""
        return float(np.sqrt(max(self.squares / self.count - self.mean**2, 0.0))) if self.count else 0.0

    def add(self, intervals: NDArray[np.int64]) -> None:
        """Take in intervals; at least one."""
        self.shortest = min(self.shortest, int(intervals.min())) if self.count else int(intervals.min())
        self.longest = max(self.longest, int(intervals.max()))
        self.count += len(intervals)
        self.total += float(intervals.sum())
        self.squares += float((intervals.astype(np.float64) ** 2).sum())


@dataclass
class _Counter:
    """What is kept of a message counter.

    Attributes
    ----------
    last : newest value; None before the first frame.
    highest : largest value seen.
    jumps_to_0 : by the value before: how many, and the first one's frame and time. They may be where the sender wraps.
    """

    last: int | None = None
    highest: int = 0
    jumps_to_0: dict[int, tuple[int, int, int]] = field(default_factory=dict)


#: Public senders count up to these before they begin at 0 again, whatever the width of the field is.
_WRAPS = (7, 15, 255)

#: Part by which the mean of the times between frames may differ from the cycle time.
_CYCLE_TOLERANCE = 0.1

#: Intervals that make a mean.
_CYCLE_SAMPLES = 10

_STATUS_RULES = {
    lib.CODEC_UNKNOWN_ID: Rule.UNKNOWN,
    lib.CODEC_REMOTE_FRAME: Rule.REMOTE,
    lib.CODEC_ERROR_FRAME: Rule.ERROR,
    lib.CODEC_SHORT_FRAME: Rule.SHORT,
}


@dataclass(frozen=True)
class _Limits:
    """Declared range of a signal; `row` is that of the signal in decoded columns."""

    row: int
    name: str
    low: float
    high: float
    slack: float


@dataclass(frozen=True)
class _Plan:
    """What is checked in the frames of one message.

    Attributes
    ----------
    counter, crc : signals, if there are any.
    limits : of signals with a declared range.
    sequences : by row in decoded columns: name of the signal and order of its values.
    """

    counter: Signal | None
    crc: Signal | None
    limits: tuple[_Limits, ...]
    sequences: Mapping[int, tuple[str, Sequence]]

    @classmethod
    def of(cls, codec: MessageCodec, facts: MessageFacts, every_sequence: Mapping[tuple[str, str], Sequence]) -> _Plan:
        """The plan for a message."""
        limits, ordered = [], {}
        for row, signal in enumerate(codec.definition.signals):
            # Counter and CRC have rules of their own; public files declare ranges for them that no sender keeps to.
            declared = signal.minimum is not None or signal.maximum is not None
            if declared and signal not in (facts.counter, facts.crc):
                low = -np.inf if signal.minimum is None else float(signal.minimum)
                high = np.inf if signal.maximum is None else float(signal.maximum)
                # What a decimal scale loses in binary is no offence.
                limits.append(_Limits(row, signal.name, low, high, 1e-6 * abs(float(signal.scale))))
            if (sequence := every_sequence.get((codec.name, signal.name))) is not None:
                ordered[row] = (signal.name, sequence)
        return cls(facts.counter, facts.crc, tuple(limits), ordered)


class Conformance:
    """Checks of everything that one frame, or the frames of one message, can tell.

    Parameters
    ----------
    database : the messages that are allowed.

    Attributes
    ----------
    database : as above.
    frames : seen so far.
    timings : by message, of those that were seen.
    findings : so far, by place; complete after `finish`.
    """

    def __init__(self, database: Codec = car) -> None:
        self.database = database
        self.frames = 0
        self.timings: dict[str, Timing] = {}
        self.findings: dict[Place, Finding] = {}
        self._counters: dict[str, _Counter] = {}
        self._newest_us: dict[Bus, int] = {}
        every_sequence = sequences()
        self._plans = {codec.name: _Plan.of(codec, database.facts(codec.name), every_sequence) for codec in database}

    def update(self, frames: NDArray[np.void]) -> None:
        """Take in frames, array of `FRAME_DTYPE`."""
        numbers = np.arange(self.frames, self.frames + len(frames))
        self.frames += len(frames)
        self._check_clock(frames, numbers)
        index = self.database.identify(frames)
        self._check_acceptance(frames, numbers, index)
        order = np.argsort(index, kind="stable")
        bounds = np.searchsorted(index[order], np.arange(len(self.database) + 1))
        numbers = numbers[order]
        # As words, which numpy moves several times as fast as records.
        words = np.ascontiguousarray(frames).view(np.uint64).reshape(-1, FRAME_SIZE // 8)
        frames = words[order].view(FRAME_DTYPE)[:, 0]
        for codec, begin, end in zip(self.database, bounds[:-1], bounds[1:], strict=True):
            if begin < end:
                self._check_message(codec, frames[begin:end], numbers[begin:end])

    def finish(self) -> None:
        """Judge what only the whole recording tells."""
        for codec in self.database:
            if (timing := self.timings.get(codec.name)) is not None:
                self._judge_cycle(codec, timing)
            if (counter := self._counters.get(codec.name)) is not None:
                self._judge_jumps_to_0(codec, counter)

    def note(self, place: Place, count: int, frame: int, time_us: int, text: str) -> None:
        """Note frames that break a rule; the text of the first ones stays."""
        found = self.findings.setdefault(place, Finding(place, 0, frame, time_us, text))
        found.count += count

    def _check_clock(self, frames: NDArray[np.void], numbers: NDArray[np.int64]) -> None:
        for bus in Bus:
            mine = frames["bus"] == bus
            times = frames["time_us"][mine].astype(np.int64)
            if not times.size:
                continue
            before = np.concatenate([[self._newest_us.get(bus, int(times[0]))], times[:-1]])
            self._newest_us[bus] = int(times[-1])
            back = np.flatnonzero(times < before)
            if back.size:
                first = int(back[0])
                text = f"goes back by {(before[first] - times[first]) / 1000:.3f} ms"
                self._note(Place(Rule.CLOCK, bus), back, numbers[mine], times, text)

    def _check_acceptance(self, frames: NDArray[np.void], numbers: NDArray[np.int64], index: NDArray[np.int32]) -> None:
        refused = np.flatnonzero(index < 0)
        keys = np.stack([index[refused], frames["bus"][refused], frames["id"][refused]], axis=1).astype(np.int64)
        for key in np.unique(keys, axis=0):
            rows = refused[(keys == key).all(axis=1)]
            status, bus, frame_id = (int(part) for part in key)
            extended = bool(frames["flags"][rows[0]] & Flag.EXTENDED)
            codec = self.database.find(bus, frame_id, extended)
            rule = _STATUS_RULES[status]
            name = codec.name if codec is not None and rule is not Rule.ERROR else f"{frame_id:X}"
            text = {
                Rule.SHORT: f"{frames['dlc'][rows[0]]} data bytes; {0 if codec is None else codec.length} are needed",
                Rule.UNKNOWN: "no message of this bus has it",
            }.get(rule, "not sent by any station of the car")
            self._note(Place(rule, Bus(bus), name), rows, numbers, frames["time_us"], text)

    def _check_message(self, codec: MessageCodec, frames: NDArray[np.void], numbers: NDArray[np.int64]) -> None:
        times = frames["time_us"].astype(np.int64)
        self._check_intervals(codec, numbers, times)
        longer = np.flatnonzero(frames["dlc"] > codec.length)
        if longer.size:
            text = f"{frames['dlc'][longer[0]]} data bytes; the message has {codec.length}"
            self._note(Place(Rule.LONG, codec.bus, codec.name), longer, numbers, times, text)
        plan = self._plans[codec.name]
        if plan.crc is not None:
            valid = self._check_crc(codec, plan.crc, frames, numbers, times)
            frames, numbers, times = frames[valid], numbers[valid], times[valid]
            if not len(frames):
                return
        if plan.counter is not None:
            self._check_counter(codec, plan.counter, frames, numbers, times)
        if plan.limits or plan.sequences:
            columns = codec.columns(frames)
            self._check_ranges(codec, plan.limits, columns, numbers, times)
            self._check_sequences(codec, plan.sequences, columns, numbers, times)

    def _check_intervals(self, codec: MessageCodec, numbers: NDArray[np.int64], times: NDArray[np.int64]) -> None:
        timing = self.timings.get(codec.name)
        if timing is None:
            timing = self.timings[codec.name] = Timing(int(numbers[0]), int(times[0]), last_us=int(times[0]))
            times, numbers = times[1:], numbers[1:]
        if not times.size:
            return
        intervals = np.diff(times, prepend=timing.last_us)
        timing.last_us = int(times[-1])
        timing.add(intervals)
        if codec.timeout_us:
            late = np.flatnonzero(intervals > codec.timeout_us)
            if late.size:
                longest_ms = codec.timeout_us // 1000
                text = f"{intervals[late[0]] / 1000:.1f} ms since the frame before; the time-out is {longest_ms} ms"
                self._note(Place(Rule.TIMEOUT, codec.bus, codec.name), late, numbers, times, text)

    def _check_crc(
        self,
        codec: MessageCodec,
        crc: Signal,
        frames: NDArray[np.void],
        numbers: NDArray[np.int64],
        times: NDArray[np.int64],
    ) -> NDArray[np.bool_]:
        """Whether each frame's CRC is right."""
        first = crc.start // 8
        data = frames["data"]
        stored = data[:, first].astype(np.uint16) | data[:, first + 1].astype(np.uint16) << 8
        right = crc16(data[:, :first], codec.frame_id)
        wrong = np.flatnonzero(stored != right)
        if wrong.size:
            text = f"{stored[wrong[0]]:04X}; must be {right[wrong[0]]:04X}"
            self._note(Place(Rule.CRC, codec.bus, codec.name, crc.name), wrong, numbers, times, text)
        valid: NDArray[np.bool_] = stored == right
        return valid

    def _check_counter(
        self,
        codec: MessageCodec,
        signal: Signal,
        frames: NDArray[np.void],
        numbers: NDArray[np.int64],
        times: NDArray[np.int64],
    ) -> None:
        words = np.ascontiguousarray(frames["data"]).view("<u8")[:, 0]
        values = (words >> np.uint64(signal.start) & np.uint64((1 << signal.length) - 1)).astype(np.int64)
        state = self._counters.setdefault(codec.name, _Counter())
        before = np.concatenate([[values[0] - 1 if state.last is None else state.last], values[:-1]])
        state.last = int(values[-1])
        state.highest = max(state.highest, int(values.max()))
        stuck = np.flatnonzero(values == before)
        jump = np.flatnonzero((values != before) & (values != before + 1))
        if stuck.size:
            text = f"stays at {values[stuck[0]]}"
            self._note(Place(Rule.STUCK, codec.bus, codec.name, signal.name), stuck, numbers, times, text)
        to_0 = jump[values[jump] == 0]
        for value in np.unique(before[to_0]):
            rows = to_0[before[to_0] == value]
            count, frame, time_us = state.jumps_to_0.get(int(value), (0, int(numbers[rows[0]]), int(times[rows[0]])))
            state.jumps_to_0[int(value)] = (count + len(rows), frame, time_us)
        others = jump[values[jump] != 0]
        if others.size:
            text = f"{before[others[0]]} is followed by {values[others[0]]}"
            self._note(Place(Rule.JUMP, codec.bus, codec.name, signal.name), others, numbers, times, text)

    def _check_ranges(
        self,
        codec: MessageCodec,
        limits: tuple[_Limits, ...],
        columns: NDArray[np.float64],
        numbers: NDArray[np.int64],
        times: NDArray[np.int64],
    ) -> None:
        for one in limits:
            values = columns[one.row]
            outside = np.flatnonzero((values < one.low - one.slack) | (values > one.high + one.slack))
            if outside.size:
                text = f"{values[outside[0]]:g}; declared is {one.low:g} to {one.high:g}"
                self._note(Place(Rule.RANGE, codec.bus, codec.name, one.name), outside, numbers, times, text)

    def _check_sequences(
        self,
        codec: MessageCodec,
        ordered: Mapping[int, tuple[str, Sequence]],
        columns: NDArray[np.float64],
        numbers: NDArray[np.int64],
        times: NDArray[np.int64],
    ) -> None:
        for row, (name, sequence) in ordered.items():
            for place, text in sequence.update(columns[row], times):
                self.note(
                    Place(Rule.SEQUENCE, codec.bus, codec.name, name), 1, int(numbers[place]), int(times[place]), text
                )

    def _judge_cycle(self, codec: MessageCodec, timing: Timing) -> None:
        expected = codec.cycle_us / self.database.facts(codec.name).frames_per_cycle
        if not expected or timing.count < _CYCLE_SAMPLES:
            return
        if abs(timing.mean - expected) > _CYCLE_TOLERANCE * expected:
            text = f"{timing.mean / 1000:.2f} ms on average; must be {expected / 1000:g} ms"
            place = Place(Rule.CYCLE, codec.bus, codec.name)
            self.note(place, timing.count, timing.first_frame, timing.first_us, text)

    def _judge_jumps_to_0(self, codec: MessageCodec, counter: _Counter) -> None:
        """A jump to 0 from the highest value that the sender ever reaches is where it wraps, if that is a usual one."""
        signal = self._plans[codec.name].counter
        assert signal is not None
        for value, (count, frame, time_us) in counter.jumps_to_0.items():
            if value == counter.highest and value in (*_WRAPS, (1 << signal.length) - 1):
                continue
            place = Place(Rule.JUMP, codec.bus, codec.name, signal.name)
            self.note(place, count, frame, time_us, f"{value} is followed by 0")

    def _note(
        self,
        place: Place,
        rows: NDArray[np.intp],
        numbers: NDArray[np.int64],
        times: NDArray[np.int64],
        text: str,
    ) -> None:
        self.note(place, len(rows), int(numbers[rows[0]]), int(times[rows[0]]), text)


def crc16(data: NDArray[np.uint8], frame_id: int) -> NDArray[np.uint16]:
    """CRC of CAN3 over bytes and then the low and the high byte of the identifier, row by row.

    CRC-16/CCITT-FALSE, as `codec_frame_crc` of firmware/common/codec.h.

    Parameters
    ----------
    data : shape (n, bytes before the CRC).
    frame_id : identifier of all of them.
    """
    crc = np.full(len(data), 0xFFFF, dtype=np.uint16)
    for byte in (*data.T, np.uint8(frame_id & 0xFF), np.uint8(frame_id >> 8 & 0xFF)):
        crc = (crc << 8) ^ _CRC_TABLE[(crc >> 8) ^ byte]
    return crc


def _crc_rows() -> Iterator[int]:
    for value in range(256):
        crc = value << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        yield crc


_CRC_TABLE = np.fromiter(_crc_rows(), dtype=np.uint16, count=256)
