"""Whether the traffic on the buses is what the DBC files say: checks that see each frame once, in order of time.

Frames come in pieces; what a check keeps does not grow with their number.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from cantools.database.can import Message, Signal
from numpy.typing import NDArray

from bridge._native import lib
from dbc.codec import Codec, MessageCodec
from dbc.codec import database as car
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Bus, Flag
from dbc.network import MessageFacts
from tools.dbw.car_rules import MOVING, PAIRS, RELATIONS, SETTINGS, SLEW_LIMITS
from tools.dbw.counters import Counter, CounterMode
from tools.dbw.findings import Finding, Findings, Offence, Place, Rule
from tools.dbw.history import Histories, Piece
from tools.dbw.relations import Judgement, Likeness, Pair, Relation
from tools.dbw.sequences import Sequence, sequences
from tools.dbw.series import steps
from tools.dbw.signal_rules import Motion, NamedValues, Order, Resolution, Setting, SignalRule, Slew
from tools.dbw.timing import Timing

__all__ = ["Conformance", "CounterMode", "Finding", "Offence", "Place", "Rule", "Timing", "crc16"]

#: Part by which the mean of the times between frames may differ from the cycle time.
_CYCLE_TOLERANCE = 0.1

#: Identifiers that no message has, and that are told one by one.
_STRANGERS_MAX = 1000

#: Intervals that make a mean.
_CYCLE_SAMPLES = 10

#: Shortest recording of a sender of which a message can be missed, us, also in time-outs of the message.
_MISSED_US = 1_000_000
_MISSED_TIMEOUTS = 2

#: After all frames.
_END_US = 1 << 62

#: Units of clocks, whose steps are those of the sender's cycle.
_TIME_UNITS = ("s", "ms", "us")

_STATUS_RULES = {
    lib.CODEC_UNKNOWN_ID: Rule.UNKNOWN,
    lib.CODEC_REMOTE_FRAME: Rule.REMOTE,
    lib.CODEC_ERROR_FRAME: Rule.ERROR,
    lib.CODEC_SHORT_FRAME: Rule.SHORT,
}


@dataclass(frozen=True)
class _Ranges:
    """Declared ranges of the signals of a message; without limit where none is declared.

    Attributes
    ----------
    low, high : what is allowed, shape (signals,), with what a decimal scale loses in binary.
    declared : by row, what the DBC file says.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    declared: Mapping[int, tuple[float, float]]

    @classmethod
    def of(cls, codec: MessageCodec, facts: MessageFacts) -> _Ranges:
        """Those of a message."""
        low, high = np.full(len(codec.signals), -np.inf), np.full(len(codec.signals), np.inf)
        declared = {}
        for row, signal in enumerate(codec.definition.signals):
            # Counter and CRC have rules of their own; public files declare ranges for them that no sender keeps to.
            has_range = signal.minimum is not None or signal.maximum is not None
            if has_range and signal not in (facts.counter, facts.crc):
                slack = 1e-6 * abs(float(signal.scale))
                smallest = -np.inf if signal.minimum is None else float(signal.minimum)
                largest = np.inf if signal.maximum is None else float(signal.maximum)
                declared[row] = (smallest, largest)
                low[row], high[row] = smallest - slack, largest + slack
        return cls(low, high, declared)


@dataclass(frozen=True)
class _Plan:
    """What is checked in the frames of one message.

    Attributes
    ----------
    counter, crc : signals, if there are any.
    unused : bits that no signal has, as little-endian word.
    ranges : declared ones.
    rules : of signals, with the row in decoded columns.
    decoded : whether the values are looked at at all.
    """

    counter: Signal | None
    crc: Signal | None
    unused: np.uint64
    ranges: _Ranges
    rules: tuple[tuple[int, SignalRule], ...]
    decoded: bool

    @classmethod
    def of(
        cls,
        codec: MessageCodec,
        facts: MessageFacts,
        ordered: dict[tuple[str, str], Sequence],
        related: bool,
    ) -> _Plan:
        """The plan for a message."""
        rules = [
            (row, rule)
            for row, signal in enumerate(codec.definition.signals)
            if signal not in (facts.counter, facts.crc)
            for rule in _signal_rules(codec, signal, ordered)
        ]
        ranges = _Ranges.of(codec, facts)
        return cls(
            facts.counter,
            facts.crc,
            _unused_bits(codec.definition),
            ranges,
            tuple(rules),
            related or bool(rules) or bool(ranges.declared),
        )


def _signal_rules(
    codec: MessageCodec, signal: Signal, ordered: dict[tuple[str, str], Sequence]
) -> Iterator[SignalRule]:
    key, unit, scale = (codec.name, signal.name), signal.unit or "", abs(float(signal.scale))
    if (sequence := ordered.get(key)) is not None:
        yield Order(sequence)
    if signal.choices and 0 in signal.choices and len(signal.choices) > 1:
        # A table that leaves 0 out names some values of many.
        yield NamedValues({int(value): str(name) for value, name in signal.choices.items()})
    if (limit := SLEW_LIMITS.get(key)) is not None:
        yield Slew(limit, 1.01 * scale, codec.cycle_us, unit)
    if (limit_us := MOVING.get(key)) is not None:
        yield Motion(limit_us)
    if key in SETTINGS:
        yield Setting()
    if scale != 1.0 and unit not in _TIME_UNITS:
        yield Resolution(scale, float(signal.offset), unit)


def _unused_bits(message: Message) -> np.uint64:
    """Bits of a message that no signal has."""
    unused = (1 << 8 * message.length) - 1
    for signal in message.signals:
        place = signal.start
        for _ in range(signal.length):
            unused &= ~(1 << place)
            if signal.byte_order == "little_endian":
                place += 1
            else:
                place += 15 if place % 8 == 0 else -1
    return np.uint64(unused)


class Conformance:
    """Checks of everything that frames can tell: each by itself, those of one message, and those of several.

    Parameters
    ----------
    database : the messages that are allowed.
    counter_mode : what a message counter has to do.

    Attributes
    ----------
    database : as above.
    frames : seen so far.
    timings : by message, of those that were seen.
    findings : so far, by place; complete after `finish`.
    """

    def __init__(self, database: Codec = car, counter_mode: CounterMode = CounterMode.AUTOMATIC) -> None:
        self.database = database
        self.frames = 0
        self.timings: dict[str, Timing] = {}
        self.findings = Findings()
        self._newest_us: dict[Bus, int] = {}
        self._disordered: set[Bus] = set()
        self._strangers = 0
        codecs = {codec.name: codec for codec in database}
        known = {(codec.name, signal) for codec in database for signal in codec.signals}
        relations = [relation for relation in RELATIONS if relation.needs <= known]
        pairs = [pair for pair in PAIRS if pair.needs <= known]
        self._judgements = [self._judgement(relation) for relation in relations]
        self._likenesses = [self._likeness(pair) for pair in pairs]
        related = set[str]().union(*(one.messages for one in relations), *(one.messages for one in pairs))
        self._histories = Histories({name: codecs[name] for name in related})
        ordered = sequences()
        self._plans = {
            codec.name: _Plan.of(codec, database.facts(codec.name), ordered, codec.name in related)
            for codec in database
        }
        self._counters = {
            name: Counter((1 << plan.counter.length) - 1, counter_mode)
            for name, plan in self._plans.items()
            if plan.counter is not None
        }

    def _judgement(self, relation: Relation) -> Judgement:
        codec = self.database.message(relation.message)
        signal = codec.definition.get_signal_by_name(relation.signal)
        buses = frozenset(self.database.message(name).bus for name in relation.messages)
        return Judgement(relation, float(signal.scale), float(signal.offset), codec.bus, buses)

    def _likeness(self, pair: Pair) -> Likeness:
        codec = self.database.message(pair.message)
        return Likeness(pair, float(codec.definition.get_signal_by_name(pair.signal).scale), codec.bus)

    def update(self, frames: NDArray[np.void]) -> None:
        """Take in frames, array of `FRAME_DTYPE`."""
        numbers = np.arange(self.frames, self.frames + len(frames))
        self.frames += len(frames)
        self._check_clock(frames, numbers)
        index = self.database.identify(frames)
        self._check_acceptance(frames, numbers, index)
        # Short integers, which numpy sorts in linear time.
        order = np.argsort(index.astype(np.int16), kind="stable")
        bounds = np.searchsorted(index[order], np.arange(len(self.database) + 1))
        numbers = numbers[order]
        # As words, which numpy moves several times as fast as records.
        words = np.ascontiguousarray(frames).view(np.uint64).reshape(-1, FRAME_SIZE // 8)
        frames = words[order].view(FRAME_DTYPE)[:, 0]
        seen = set()
        for codec, begin, end in zip(self.database, bounds[:-1], bounds[1:], strict=True):
            if begin < end:
                piece = self._check_message(codec, frames[begin:end], numbers[begin:end])
                if piece is not None and codec.name in self._histories:
                    self._histories.extend(piece)
                    seen.add(codec.name)
        self._check_relations(seen)

    def finish(self) -> None:
        """Judge what only the whole recording tells."""
        for codec in self.database:
            if (timing := self.timings.get(codec.name)) is None:
                continue
            self._judge_cycle(codec, timing)
            if (counter := self._counters.get(codec.name)) is not None:
                self._note_counter(codec, counter.finish())
            for row, rule in self._plans[codec.name].rules:
                self._note_signal(codec, row, rule, rule.finish())
        for judgement in self._judgements:
            self._judge_relation(judgement, _END_US)
        for likeness in self._likenesses:
            for place, offence in likeness.finish():
                self.findings.note(place, offence)
        self._judge_silence()

    def note(self, place: Place, count: int, frame: int, time_us: int, text: str) -> None:
        """Note frames that break a rule."""
        self.findings.note(place, Offence(count, frame, time_us, text))

    def _check_clock(self, frames: NDArray[np.void], numbers: NDArray[np.int64]) -> None:
        times = frames["time_us"].astype(np.int64)
        buses = np.ascontiguousarray(frames["bus"])
        if len(times) and times[0] >= max(self._newest_us.values(), default=0) and (times[1:] >= times[:-1]).all():
            for bus in Bus:
                last = (buses == bus).nonzero()[0][-1:]
                if last.size:
                    self._newest_us[bus] = int(times[last[0]])
            return
        self._check_clocks(times, buses, numbers)

    def _check_clocks(self, all_times: NDArray[np.int64], buses: NDArray[np.uint8], numbers: NDArray[np.int64]) -> None:
        """Of each bus by itself: the logger may have written them one behind the other."""
        for bus in Bus:
            mine = buses == bus
            times = all_times[mine]
            if not times.size:
                continue
            before = np.concatenate([[self._newest_us.get(bus, int(times[0]))], times[:-1]])
            self._newest_us[bus] = int(times[-1])
            back = np.flatnonzero(times < before)
            if back.size:
                first = int(back[0])
                text = f"goes back by {(before[first] - times[first]) / 1000:.3f} ms"
                self.findings.note(Place(Rule.CLOCK, bus), Offence.of(back, numbers[mine], times, text))
                self._disordered.add(bus)

    def _check_acceptance(self, frames: NDArray[np.void], numbers: NDArray[np.int64], index: NDArray[np.int32]) -> None:
        refused = np.flatnonzero(index < 0)
        if not refused.size:
            return
        some = frames[refused]
        extended = (some["flags"] & Flag.EXTENDED).astype(np.int64)
        keys = (-index[refused].astype(np.int64) << 40) | (some["bus"].astype(np.int64) << 32) | some["id"]
        keys |= extended << 31
        for key, first, count in zip(*np.unique(keys, return_index=True, return_counts=True), strict=True):
            self._note_refused(-(int(key) >> 40), some[first], int(numbers[refused[first]]), int(count))

    def _note_refused(self, status: int, frame: np.void, number: int, count: int) -> None:
        bus, frame_id, extended = Bus(int(frame["bus"])), int(frame["id"]), bool(frame["flags"] & Flag.EXTENDED)
        codec = self.database.find(bus, frame_id, extended)
        rule = _STATUS_RULES[status]
        name = codec.name if codec is not None and rule is not Rule.ERROR else f"{frame_id:0{8 if extended else 1}X}"
        text = {
            Rule.SHORT: f"{frame['dlc']} data bytes; {0 if codec is None else codec.length} are needed",
            Rule.UNKNOWN: "no message of this bus has it",
        }.get(rule, "not sent by any station of the car")
        place = Place(rule, bus, name)
        # Noise on a bus may have any of half a billion identifiers.
        if codec is None and place not in self.findings:
            if self._strangers >= _STRANGERS_MAX:
                place, text = Place(rule, bus), f"more than {_STRANGERS_MAX} others are known already"
            else:
                self._strangers += 1
        self.findings.note(place, Offence(count, number, int(frame["time_us"]), text))

    def _check_message(self, codec: MessageCodec, frames: NDArray[np.void], numbers: NDArray[np.int64]) -> Piece | None:
        """Check frames of a message; gives those that a receiver takes, decoded, if their values are of interest."""
        times = frames["time_us"].astype(np.int64)
        self._check_intervals(codec, numbers, times)
        too_long = frames["dlc"] > codec.length
        if np.count_nonzero(too_long):
            longer = np.flatnonzero(too_long)
            text = f"{frames['dlc'][longer[0]]} data bytes; the message has {codec.length}"
            self.findings.note(Place(Rule.LONG, codec.bus, codec.name), Offence.of(longer, numbers, times, text))
        plan = self._plans[codec.name]
        if plan.crc is not None:
            valid = self._check_crc(codec, plan.crc, frames, numbers, times)
            if not valid.all():
                frames, numbers, times = frames[valid], numbers[valid], times[valid]
            if not len(frames):
                return None
        words = np.ascontiguousarray(frames["data"]).view("<u8")[:, 0]
        self._check_unused(codec, plan.unused, words, numbers, times)
        if plan.counter is not None:
            mask = np.uint64((1 << plan.counter.length) - 1)
            values = (words >> np.uint64(plan.counter.start) & mask).astype(np.int64)
            self._note_counter(codec, self._counters[codec.name].update(values, times, numbers))
        if not plan.decoded:
            return None
        piece = Piece(codec, codec.columns(frames), times, numbers)
        self._check_ranges(piece, plan.ranges)
        for row, rule in plan.rules:
            self._note_signal(codec, row, rule, rule.update(piece.values[row], times, numbers))
        return piece

    def _note_counter(self, codec: MessageCodec, offences: Iterator[tuple[Rule, Offence]]) -> None:
        counter = self._plans[codec.name].counter
        assert counter is not None
        for rule, offence in offences:
            self.findings.note(Place(rule, codec.bus, codec.name, counter.name), offence)

    def _note_signal(self, codec: MessageCodec, row: int, rule: SignalRule, offences: Iterator[Offence]) -> None:
        for offence in offences:
            self.findings.note(Place(rule.rule, codec.bus, codec.name, codec.signals[row]), offence)

    def _check_intervals(self, codec: MessageCodec, numbers: NDArray[np.int64], times: NDArray[np.int64]) -> None:
        timing = self.timings.get(codec.name)
        if timing is None:
            timing = self.timings[codec.name] = Timing(int(numbers[0]), int(times[0]), last_us=int(times[0]))
            timing.last_frame = int(numbers[0])
            times, numbers = times[1:], numbers[1:]
        if not times.size:
            return
        intervals = steps(times, timing.last_us)
        timing.last_frame, timing.last_us = int(numbers[-1]), int(times[-1])
        timing.add(intervals)
        if codec.timeout_us:
            too_late = intervals > codec.timeout_us
            if np.count_nonzero(too_late):
                late = np.flatnonzero(too_late)
                longest_ms = codec.timeout_us // 1000
                text = f"{intervals[late[0]] / 1000:.1f} ms since the frame before; the time-out is {longest_ms} ms"
                self.findings.note(Place(Rule.TIMEOUT, codec.bus, codec.name), Offence.of(late, numbers, times, text))

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
            self.findings.note(
                Place(Rule.CRC, codec.bus, codec.name, crc.name), Offence.of(wrong, numbers, times, text)
            )
        valid: NDArray[np.bool_] = stored == right
        return valid

    def _check_unused(
        self,
        codec: MessageCodec,
        unused: np.uint64,
        words: NDArray[np.uint64],
        numbers: NDArray[np.int64],
        times: NDArray[np.int64],
    ) -> None:
        if np.bitwise_or.reduce(words) & unused:
            stray = np.flatnonzero(words & unused)
            bits = int(words[stray[0]] & unused)
            places = [str(place) for place in range(64) if bits >> place & 1]
            one = len(places) == 1
            text = f"{'bit' if one else 'bits'} {', '.join(places)} {'is' if one else 'are'} set; no signal has "
            text += "it" if one else "them"
            self.findings.note(Place(Rule.UNUSED, codec.bus, codec.name), Offence.of(stray, numbers, times, text))

    def _check_ranges(self, piece: Piece, ranges: _Ranges) -> None:
        if not ranges.declared:
            return
        below = np.minimum.reduce(piece.values, axis=1) < ranges.low
        above = np.maximum.reduce(piece.values, axis=1) > ranges.high
        for row in (below | above).nonzero()[0].tolist():
            values = piece.values[row]
            outside = np.flatnonzero((values < ranges.low[row]) | (values > ranges.high[row]))
            low, high = ranges.declared[row]
            text = f"{values[outside[0]]:g}; declared is {low:g} to {high:g}"
            place = Place(Rule.RANGE, piece.codec.bus, piece.codec.name, piece.codec.signals[row])
            self.findings.note(place, Offence.of(outside, piece.numbers, piece.times, text))

    def _check_relations(self, seen: set[str]) -> None:
        for judgement in self._judgements:
            until_us = min(self._newest_us.get(bus, -1) for bus in judgement.buses)
            self._judge_relation(judgement, until_us)
        for likeness in self._likenesses:
            if likeness.alike and likeness.pair.message in seen:
                likeness.update(self._histories)
        self._histories.trim(seen)

    def _judge_relation(self, judgement: Judgement, until_us: int) -> None:
        # Clocks that went back cannot be compared with those of other buses any more.
        if len(judgement.buses) == 1 or not judgement.buses & self._disordered:
            for place, offence in judgement.update(self._histories, until_us):
                self.findings.note(place, offence)

    def _judge_cycle(self, codec: MessageCodec, timing: Timing) -> None:
        expected = codec.cycle_us / self.database.facts(codec.name).frames_per_cycle
        if not expected or timing.count < _CYCLE_SAMPLES:
            return
        if abs(timing.mean - expected) > _CYCLE_TOLERANCE * expected:
            text = f"{timing.mean / 1000:.2f} ms on average; must be {expected / 1000:g} ms"
            self.note(Place(Rule.CYCLE, codec.bus, codec.name), timing.count, timing.first_frame, timing.first_us, text)

    def _judge_silence(self) -> None:
        """Messages that never come, or come no more, of senders that go on."""
        senders: dict[tuple[Bus, str], list[MessageCodec]] = defaultdict(list)
        for codec in self.database:
            senders[codec.bus, codec.definition.senders[0]].append(codec)
        for (_, sender), codecs in senders.items():
            seen = [self.timings[codec.name] for codec in codecs if codec.name in self.timings]
            if not seen:
                continue
            first = min(seen, key=lambda timing: timing.first_us)
            end_us = max(timing.last_us for timing in seen)
            # Only messages that somebody waits for. Of a recording that lacks more than a quarter of them, they were
            # left out on purpose.
            watched = [codec for codec in codecs if codec.timeout_us]
            whole = 4 * sum(codec.name in self.timings for codec in watched) >= 3 * len(watched)
            for codec in watched:
                timing = self.timings.get(codec.name)
                if timing is None:
                    seen_us = end_us - first.first_us
                    if whole and seen_us >= max(_MISSED_US, _MISSED_TIMEOUTS * codec.timeout_us):
                        text = (
                            f"never in {seen_us / 1e6:.1f} s of {sender}; must come every {codec.cycle_us / 1000:g} ms"
                        )
                        place = Place(Rule.MISSING, codec.bus, codec.name)
                        self.note(place, 0, first.first_frame, first.first_us, text)
                elif end_us - timing.last_us > codec.timeout_us:
                    text = f"the last frame; {sender} goes on for {(end_us - timing.last_us) / 1000:.1f} ms"
                    place = Place(Rule.TIMEOUT, codec.bus, codec.name)
                    self.note(place, 1, timing.last_frame, timing.last_us, text)


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
