"""What the frames of several messages tell together: values that are passed on, acknowledged, or measured twice."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dbc.buses import Bus
from tools.dbw.findings import Offence, Place, Rule
from tools.dbw.history import Histories, History, Window
from tools.dbw.series import steps
from tools.dbw.signal_rules import Runs

Convert = Callable[..., NDArray[np.float64]]


def _same(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values


@dataclass(frozen=True)
class Source:
    """Where a value comes from.

    Attributes
    ----------
    message, signals : of which it is made.
    convert : from the values of the signals to that of the target, all physical.
    """

    message: str
    signals: tuple[str, ...]
    convert: Convert = _same

    def values(self, histories: Histories) -> NDArray[np.float64]:
        """As the target has them, of each row."""
        history = histories[self.message]
        return self.convert(*(history.signal(name) for name in self.signals))


@dataclass(frozen=True)
class Condition:
    """A relation holds while a signal is and has been within limits, both allowed, and is still sent."""

    message: str
    signal: str
    low: float
    high: float


#: Age at which a condition or the other half of a pair is unknown, us.
_FRESH_US = 250_000
_SAME_CYCLE_US = 5_000

#: Age of a source, in its cycles, at which its value is unknown.
_AGE_CYCLES = 1.5

#: Part of a step by which a value may be beside the middle between two steps and still be rounded to either.
_TIE = 0.01


_NO_LIMITS = (-np.inf, np.inf)


@dataclass(frozen=True)
class Relation:
    """A signal and what it has to agree with.

    Attributes
    ----------
    rule : what a finding is called.
    message, signal : whose value is judged.
    says : what it has to be, in words.
    sources : of the values to compare with; none when `limits` alone count.
    window_us : time that the sender may take: each value in force within it is right.
    lead_us : time by which frames of other stations may be behind those that answer them: in lock step a station
        reads what others send in the same cycle, and the buses put their frames at times of their own.
    exact : the value is the one of a source, rounded to the steps of the signal; otherwise between the smallest and
        the largest of all sources.
    tolerance, share : by which it may be beside them: so much, and such a part of the source's value.
    limits : smallest and largest value allowed besides.
    conditions : that have to hold over the window.
    steady_us : how long they have to have held, if that is longer.
    at : message whose frames are the moments to judge, when it is sent behind the other ones in a cycle; empty for
        the judged message itself.
    least, lasting_us : frames in a row, and how long, that make an offence.
    """

    rule: Rule
    message: str
    signal: str
    says: str
    sources: tuple[Source, ...] = ()
    window_us: int = 0
    lead_us: int = 10_000
    exact: bool = False
    tolerance: float = 0.0
    share: float = 0.0
    limits: tuple[float, float] = _NO_LIMITS
    conditions: tuple[Condition, ...] = ()
    steady_us: int = 0
    at: str = ""
    least: int = 1
    lasting_us: int = 0

    @property
    def trigger(self) -> str:
        """Message whose frames are the moments to judge."""
        return self.at or self.message

    @property
    def needs(self) -> set[tuple[str, str]]:
        """All messages with signals."""
        own = {(self.message, self.signal), *((one.message, one.signal) for one in self.conditions)}
        return own | {(source.message, name) for source in self.sources for name in source.signals}

    @property
    def messages(self) -> set[str]:
        """All messages."""
        return {name for name, _ in self.needs} | {self.trigger}


@dataclass
class Judgement:
    """A relation over a recording.

    Attributes
    ----------
    relation : to judge.
    scale, offset : of the judged signal.
    bus : of the judged message.
    buses : of all its messages.
    """

    relation: Relation
    scale: float
    offset: float
    bus: Bus
    buses: frozenset[Bus]
    _next: int = field(default=0, init=False)
    _wrong: Runs = field(init=False)
    _cut: Runs = field(default_factory=lambda: Runs(least=3), init=False)

    def __post_init__(self) -> None:
        self._wrong = Runs(self.relation.least, self.relation.lasting_us)

    def update(self, histories: Histories, until_us: int) -> Iterator[tuple[Place, Offence]]:
        """Judge the frames up to a moment until which all buses are known, but for the lead."""
        relation = self.relation
        trigger = histories[relation.trigger]
        begin = max(self._next - trigger.dropped, 0)
        end = int(np.searchsorted(trigger.times, until_us - relation.lead_us, side="right"))
        if end <= begin:
            return
        self._next = trigger.dropped + end
        moments = trigger.times[begin:end]
        target = histories[relation.message]
        if not len(target.times) or not all(len(histories[source.message].times) for source in relation.sources):
            return
        rows = np.maximum(target.newest(moments), 0) if relation.at else np.arange(begin, end)
        values, numbers, times = target.signal(relation.signal)[rows], target.numbers[rows], target.times[rows]
        right = self._glance(values, histories, moments)
        wrong, cut = ~right, np.zeros(len(values), dtype=np.bool_)
        places = wrong.nonzero()[0]
        words: Callable[[int], str] = str
        if len(places):
            wrong[places], cut[places], sources = self._look(values[places], histories, moments[places], times[places])
            words = partial(self._words, values, sources, places)
            if relation.exact:
                # Only where rounding and cutting off differ.
                rounded = right & self._longer(values, histories, moments)
                telling = (cut | wrong | rounded).nonzero()[0]
                yield from self._tell(
                    self._cut,
                    Rule.ROUNDING,
                    cut[telling],
                    times[telling],
                    numbers[telling],
                    lambda row: f"{words(int(telling[row]))}, cut off and not rounded",
                )
        yield from self._tell(self._wrong, relation.rule, wrong, times, numbers, words)

    def _glance(
        self, values: NDArray[np.float64], histories: Histories, moments: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Which values the newest ones of the sources explain, as nearly always.

        Before the first value of a source it is its last one; such a frame is not judged anyway.
        """
        relation = self.relation
        newest = [self._newest(source, histories, moments) for source in relation.sources]
        right: NDArray[np.bool_]
        if len(newest) == 1:
            right = np.abs(values - newest[0]) <= self._slack(newest[0])
        elif newest:
            low = np.minimum.reduce([one - self._slack(one) for one in newest])
            high = np.maximum.reduce([one + self._slack(one) for one in newest])
            right = (values >= low) & (values <= high)
        if newest and relation.limits == _NO_LIMITS:
            return right
        inside: NDArray[np.bool_] = (values >= relation.limits[0]) & (values <= relation.limits[1])
        return inside & right if newest else inside

    def _newest(self, source: Source, histories: Histories, moments: NDArray[np.int64]) -> NDArray[np.float64]:
        """What a source has in the same cycle."""
        rows = histories[source.message].newest(moments + min(self.relation.lead_us, _SAME_CYCLE_US))
        newest: NDArray[np.float64] = source.values(histories)[rows]
        return newest

    def _longer(
        self, values: NDArray[np.float64], histories: Histories, moments: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Which values are rounded away from 0."""
        newest = self._newest(self.relation.sources[-1], histories, moments)
        longer: NDArray[np.bool_] = np.abs(values - self.offset) > np.abs(newest - self.offset) + _TIE * self.scale
        return longer

    def _slack(self, candidate: NDArray[np.float64]) -> NDArray[np.float64] | float:
        """By how much a value may be beside one of a source."""
        if self.relation.exact:
            return (0.5 + _TIE) * self.scale
        if not self.relation.share:
            return self.relation.tolerance + 1e-6 * self.scale
        return self.relation.tolerance + self.relation.share * np.abs(candidate) + 1e-6 * self.scale

    def _look(
        self,
        values: NDArray[np.float64],
        histories: Histories,
        moments: NDArray[np.int64],
        times: NDArray[np.int64],
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], list[_Candidates]]:
        """Of some values: which of them nothing explains, which are cut off, and what they were compared with."""
        judged = (times <= moments) & (moments - times <= _SAME_CYCLE_US)
        for condition in self.relation.conditions:
            judged &= self._holds(condition, histories[condition.message], moments)
        sources = [self._candidates(source, histories, moments, judged) for source in self.relation.sources]
        cut = np.zeros(len(values), dtype=np.bool_)
        if not judged.any() or not sources:
            return judged, cut, sources
        if self.relation.exact:
            right, cut = self._compare_exactly(values, judged, sources)
            cut &= ~right
        else:
            right = self._between(values, sources)
            right &= (values >= self.relation.limits[0]) & (values <= self.relation.limits[1])
        return judged & ~right & ~cut, cut, sources

    def _tell(
        self,
        runs: Runs,
        rule: Rule,
        wrong: NDArray[np.bool_],
        times: NDArray[np.int64],
        numbers: NDArray[np.int64],
        words: Callable[[int], str],
    ) -> Iterator[tuple[Place, Offence]]:
        place = Place(rule, self.bus, self.relation.message, self.relation.signal)
        for offence in runs.update(wrong, times, numbers, words):
            yield place, offence

    def _holds(self, condition: Condition, history: History, moments: NDArray[np.int64]) -> NDArray[np.bool_]:
        if not len(history.times):
            return np.zeros(len(moments), dtype=np.bool_)
        steady_us = max(self.relation.window_us, self.relation.steady_us)
        window = history.window(moments, steady_us, self.relation.lead_us)
        values = history.signal(condition.signal)
        broken = np.concatenate([[0], np.cumsum((values < condition.low) | (values > condition.high))])
        holds: NDArray[np.bool_] = window.known & (broken[window.last + 1] == broken[window.first])
        return holds & (moments - history.times[window.last] <= _FRESH_US)

    def _candidates(
        self, source: Source, histories: Histories, moments: NDArray[np.int64], judged: NDArray[np.bool_]
    ) -> _Candidates:
        """What a source has in force at some moments; takes those out at which it is unknown."""
        history = histories[source.message]
        window = history.window(moments, self.relation.window_us, self.relation.lead_us)
        judged &= window.known
        limit_us = _AGE_CYCLES * history.codec.cycle_us
        if len(history.times) and limit_us:
            # A frame that the recording has lost may have told what is passed on.
            judged &= moments - history.times[window.last] <= limit_us
            if self.relation.exact:
                gaps = np.cumsum(np.diff(history.times, prepend=history.times[0]) > limit_us)
                judged &= gaps[window.last] == gaps[window.first]
        return _Candidates(source.values(histories), window)

    def _compare_exactly(
        self, values: NDArray[np.float64], judged: NDArray[np.bool_], sources: list[_Candidates]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which values are a rounded one of the sources, and which are one that is cut off; of those judged."""
        raw = (values - self.offset) / self.scale
        right = np.zeros(len(values), dtype=np.bool_)
        for candidates in sources:
            for places, candidate in candidates.each((judged & ~right).nonzero()[0], right):
                right[places] = np.abs(raw[places] - (candidate - self.offset) / self.scale) <= 0.5 + _TIE
        cut = np.zeros(len(values), dtype=np.bool_)
        for candidates in sources:
            for places, candidate in candidates.each((judged & ~right).nonzero()[0], cut):
                wanted = (candidate - self.offset) / self.scale
                shorter = np.abs(wanted) - np.abs(raw[places])
                cut[places] = (shorter > 0.5 + _TIE) & (shorter < 1.0) & (raw[places] * wanted >= 0.0)
        return right, cut

    def _between(self, values: NDArray[np.float64], sources: list[_Candidates]) -> NDArray[np.bool_]:
        """Which values are within what the sources had, give or take the tolerance."""
        low, high = np.full(len(values), np.inf), np.full(len(values), -np.inf)
        for candidates in sources:
            slack = self._slack(candidates.values)
            np.minimum(low, -_largest(slack - candidates.values, candidates.window), out=low)
            np.maximum(high, _largest(slack + candidates.values, candidates.window), out=high)
        return (values >= low) & (values <= high)

    def _words(
        self, values: NDArray[np.float64], sources: list[_Candidates], places: NDArray[np.intp], row: int
    ) -> str:
        """For a row of the values, which is one of the places that the sources are for."""
        place = int(np.searchsorted(places, row))
        wanted = "".join(f" {one.values[one.window.last[place]]:g}" for one in sources[-1:])
        return f"{values[row]:g}; {self.relation.says}{wanted}"


@dataclass(frozen=True)
class _Candidates:
    """Values of a source, and which of them were in force at some moments."""

    values: NDArray[np.float64]
    window: Window

    def each(
        self, places: NDArray[np.intp], done: NDArray[np.bool_]
    ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.float64]]]:
        """For some moments: all values in force, one after the other, until they are done."""
        step = 0
        while len(places):
            rows = self.window.last[places] - step
            yield places, self.values[np.maximum(rows, self.window.first[places])]
            places = places[~done[places] & (rows > self.window.first[places])]
            step += 1


def _largest(values: NDArray[np.float64], window: Window) -> NDArray[np.float64]:
    """Of the values in each window: the larger of those of two overlapping blocks whose length is a power of two."""
    lengths = window.last - window.first + 1
    largest = np.empty(len(lengths))
    blocks, length = values, 1
    while True:
        mine = ((lengths >= length) & (lengths < 2 * length)).nonzero()[0]
        if len(mine):
            first, last = blocks[window.first[mine]], blocks[window.last[mine] + 1 - length]
            largest[mine] = np.maximum(first, last)
        if 2 * length > lengths.max():
            return largest
        blocks = np.maximum(blocks[:-length], blocks[length:])
        length *= 2


@dataclass(frozen=True)
class Pair:
    """Two signals that measure different things and are never the same for long: one of them would be a copy."""

    message: str
    signal: str
    other_message: str
    other_signal: str

    @property
    def needs(self) -> set[tuple[str, str]]:
        """Both messages with their signals."""
        return {(self.message, self.signal), (self.other_message, self.other_signal)}

    @property
    def messages(self) -> set[str]:
        """Both messages."""
        return {self.message, self.other_message}


#: Changes of a signal, and steps that it has to have gone, before it is called a copy.
_COPY_CHANGES = 20
_COPY_STEPS = 10


@dataclass
class Likeness:
    """A pair over a recording.

    Attributes
    ----------
    pair : to judge.
    scale : of the signals.
    bus : of the judged message.
    alike : as long as no frame has shown the contrary.
    """

    pair: Pair
    scale: float
    bus: Bus
    alike: bool = True
    changes: int = 0
    count: int = 0
    low: float = np.inf
    high: float = -np.inf
    last: float = np.nan
    first: Offence | None = None

    def update(self, histories: Histories) -> None:
        """Compare the frames of this piece."""
        mine, other = histories[self.pair.message], histories[self.pair.other_message]
        values, numbers = mine.signal(self.pair.signal)[mine.begin :], mine.numbers[mine.begin :]
        rows = other.newest(mine.times[mine.begin :])
        known = rows >= 0
        if not self.alike or not known.any():
            return
        values, times, numbers = values[known], mine.times[mine.begin :][known], numbers[known]
        # Of two messages, one may have been sent before the change and one after it.
        allowed = 0.0 if mine is other else self.scale
        apart = np.abs(values - other.signal(self.pair.other_signal)[rows[known]])
        self.alike = bool((apart <= allowed + 1e-6 * self.scale).all())
        if self.first is None:
            self.first, self.last = Offence(0, int(numbers[0]), int(times[0]), ""), float(values[0])
        self.count += len(values)
        self.changes += int(np.count_nonzero(steps(values, self.last)))
        self.last = float(values[-1])
        self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))

    def finish(self) -> Iterator[tuple[Place, Offence]]:
        """Judge the whole recording."""
        moved = self.changes >= _COPY_CHANGES and self.high - self.low >= _COPY_STEPS * self.scale
        if self.alike and moved and self.first is not None:
            pair = self.pair
            other = (
                pair.other_signal if pair.other_message == pair.message else f"{pair.other_message}.{pair.other_signal}"
            )
            text = f"always what {other} is, in {self.changes} changes; one of them is a copy"
            yield (
                Place(Rule.COPY, self.bus, pair.message, pair.signal),
                replace(self.first, count=self.count, text=text),
            )
