"""What the values of one signal tell: the ones it may have, how fast they change, whether they change at all.

Each rule sees the values of a signal in order, piece by piece, and gives the frames that break it. What it keeps does
not grow with their number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tools.dbw.findings import Offence, Rule
from tools.dbw.sequences import Sequence
from tools.dbw.series import steps

Values = NDArray[np.float64]
Times = NDArray[np.int64]
Numbers = NDArray[np.int64]


class SignalRule(Protocol):
    """A rule for one signal.

    Attributes
    ----------
    rule : what a finding is called.
    """

    @property
    def rule(self) -> Rule:
        """See above."""

    def update(self, values: Values, times: Times, numbers: Numbers) -> Iterator[Offence]:
        """Take in physical values, at least one, with times in us and numbers of their frames."""

    def finish(self) -> Iterator[Offence]:
        """Judge what only the whole recording tells."""


class _AtOnce:
    """A rule that has nothing left to judge at the end."""

    def finish(self) -> Iterator[Offence]:
        """Nothing."""
        return iter(())


@dataclass
class Order(_AtOnce):
    """Which value may follow which."""

    sequence: Sequence
    rule: Rule = Rule.SEQUENCE

    def update(self, values: Values, times: Times, numbers: Numbers) -> Iterator[Offence]:
        """See `SignalRule`."""
        for place, text in self.sequence.update(values, times):
            yield Offence(1, int(numbers[place]), int(times[place]), text)


@dataclass
class NamedValues(_AtOnce):
    """Only values that the DBC file has a name for.

    Attributes
    ----------
    names : by value.
    """

    names: Mapping[int, str]
    rule: Rule = Rule.VALUE

    def __post_init__(self) -> None:
        self._allowed = np.array(sorted(self.names), dtype=np.float64)

    def update(self, values: Values, times: Times, numbers: Numbers) -> Iterator[Offence]:
        """See `SignalRule`."""
        if np.minimum.reduce(values) == np.maximum.reduce(values) and values[0] in self._allowed:
            return
        unknown = np.flatnonzero(~np.isin(values, self._allowed))
        if unknown.size:
            text = f"{values[unknown[0]]:g} has no name; named are {', '.join(f'{value:g}' for value in self._allowed)}"
            yield Offence.of(unknown, numbers, times, text)


@dataclass
class Slew(_AtOnce):
    """A change that is faster than what the signal stands for.

    Attributes
    ----------
    limit : per second.
    slack : on top, for the steps of the signal.
    cycle_us : least time that counts between two frames: of two that a bus has pushed together, each has its value
        from the cycle that it was sent in.
    unit : of the values.
    """

    limit: float
    slack: float
    cycle_us: int
    unit: str = ""
    rule: Rule = Rule.SLEW
    last: float | None = None
    last_us: int = 0

    def update(self, values: Values, times: Times, numbers: Numbers) -> Iterator[Offence]:
        """See `SignalRule`."""
        if self.last is None:
            self.last, self.last_us = float(values[0]), int(times[0])
        last, last_us = self.last, self.last_us
        self.last, self.last_us = float(values[-1]), int(times[-1])
        low, high = min(last, np.minimum.reduce(values)), max(last, np.maximum.reduce(values))
        if high - low <= self.limit * 1e-6 * self.cycle_us + self.slack:
            return
        changes = steps(values, last)
        elapsed = np.maximum(steps(times, last_us), self.cycle_us)
        too_fast = np.abs(changes) > self.limit * 1e-6 * elapsed + self.slack
        if np.count_nonzero(too_fast):
            fast = np.flatnonzero(too_fast)
            row = fast[0]
            text = (
                f"from {values[row] - changes[row]:g} to {values[row]:g} {self.unit}".rstrip()
                + f" in {elapsed[row] / 1000:.1f} ms; at most {self.limit:g} {self.unit}/s".replace(
                    " /s", " per second"
                )
            )
            yield Offence.of(fast, numbers, times, text)


@dataclass
class Motion(_AtOnce):
    """A signal that counts or beats, and may not stand still.

    Attributes
    ----------
    limit_us : time after which it has to have changed.
    last : newest value; None before the first.
    changed_us : when it last changed.
    """

    limit_us: int
    rule: Rule = Rule.FROZEN
    last: float | None = None
    changed_us: int = 0

    def update(self, values: Values, times: Times, numbers: Numbers) -> Iterator[Offence]:
        """See `SignalRule`."""
        if self.last is None:
            self.last, self.changed_us = float(values[0]), int(times[0])
        changed = steps(values, self.last) != 0.0
        since = np.maximum.accumulate(np.where(changed, times, self.changed_us))
        self.last, self.changed_us = float(values[-1]), int(since[-1])
        still = np.flatnonzero(times - since > self.limit_us)
        if still.size:
            row = still[0]
            text = f"{values[row]:g} for {(times[row] - since[row]) / 1000:.0f} ms; must change within"
            yield Offence.of(still, numbers, times, f"{text} {self.limit_us // 1000} ms")


#: Frames after which a value that is always 0 was never set.
_NEVER_SET_FRAMES = 10


@dataclass
class Setting:
    """A value that its sender has to fill in: 0 is none."""

    rule: Rule = Rule.NEVER_SET
    first: Offence | None = None
    count: int = 0
    set: bool = False

    def update(self, values: Values, times: Times, numbers: Numbers) -> Iterator[Offence]:
        """See `SignalRule`."""
        if self.first is None:
            self.first = Offence(0, int(numbers[0]), int(times[0]), "always 0, which is no value")
        self.set = self.set or bool(values.any())
        self.count += len(values)
        return iter(())

    def finish(self) -> Iterator[Offence]:
        """See `SignalRule`."""
        if self.first is not None and not self.set and self.count >= _NEVER_SET_FRAMES:
            yield replace(self.first, count=self.count)


#: Changes of a signal by another step than the one before, and distance that it has to have gone in the steps that it
#: uses, before its steps are judged. A sender that rounds to the steps of the signal gives only even ones so often by
#: chance once in 2^32 recordings. A ramp, whose steps are all the same, tells nothing.
_CHANGES_TO_JUDGE = 32
_STEPS_TO_JUDGE = 4


@dataclass
class Resolution:
    """A signal of which only every second, fifth or tenth step is ever used: its sender has rounded too much.

    Attributes
    ----------
    scale, offset : of the signal.
    step : largest one that all raw values are multiples of; 0 before anything but 0.
    changes : of the value, each by another step than the one before.
    """

    scale: float
    offset: float
    unit: str = ""
    rule: Rule = Rule.RESOLUTION
    step: int = 0
    changes: int = 0
    count: int = 0
    value: float = np.nan
    last: int | None = None
    last_change: int = 0
    low: int = 0
    high: int = 0
    first: Offence | None = None

    def update(self, values: Values, times: Times, numbers: Numbers) -> Iterator[Offence]:
        """See `SignalRule`."""
        if self.step == 1:
            return iter(())
        self.count += len(values)
        if np.minimum.reduce(values) == np.maximum.reduce(values) == self.value:
            return iter(())
        self.value = float(values[-1])
        raw = np.rint((values - self.offset) / self.scale).astype(np.int64)
        if self.first is None or self.last is None:
            self.first = Offence(0, int(numbers[0]), int(times[0]), "")
            self.last = self.low = self.high = int(raw[0])
        changes = steps(raw, self.last)
        changes = changes[changes != 0]
        if changes.size:
            self.changes += int(np.count_nonzero(steps(changes, self.last_change)))
            self.last_change = int(changes[-1])
        self.last = int(raw[-1])
        self.low, self.high = min(self.low, int(raw.min())), max(self.high, int(raw.max()))
        self.step = int(np.gcd.reduce(raw, initial=self.step))
        return iter(())

    def finish(self) -> Iterator[Offence]:
        """See `SignalRule`."""
        judged = self.changes >= _CHANGES_TO_JUDGE and self.high - self.low >= _STEPS_TO_JUDGE * max(self.step, 1)
        if self.first is not None and self.step > 1 and judged:
            used = f"{self.step * self.scale:g} {self.unit}".rstrip()
            text = f"only multiples of {used} in {self.changes} changes; the signal has steps of {self.scale:g}"
            yield replace(self.first, count=self.count, text=text)


@dataclass
class Runs:
    """Offences in a row, told as soon as there are enough of them.

    Attributes
    ----------
    least : frames in a row.
    lasting_us : time from the first to the newest of them.
    """

    least: int = 1
    lasting_us: int = 0
    _open: Offence | None = field(default=None, init=False)
    _told: int = field(default=0, init=False)

    def update(self, wrong: NDArray[np.bool_], times: Times, numbers: Numbers, describe: Describe) -> Iterator[Offence]:
        """Take in whether frames are wrong; `describe` gives the words for the one in a row."""
        if len(wrong) == 0:
            return
        if not wrong[0]:
            self._open = None
        if not np.count_nonzero(wrong):
            return
        edges = np.flatnonzero(np.diff(wrong.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
        for start, stop in edges.tolist():
            if self._open is None or start > 0:
                self._open, self._told = Offence(0, int(numbers[start]), int(times[start]), describe(start)), 0
            self._open = replace(self._open, count=self._open.count + stop - start)
            lasted_us = int(times[stop - 1]) - self._open.time_us
            if self._open.count >= self.least and lasted_us >= self.lasting_us:
                yield replace(self._open, count=self._open.count - self._told)
                self._told = self._open.count
            if stop < len(wrong):
                self._open = None


class Describe(Protocol):
    """Words for the frame in a row."""

    def __call__(self, row: int, /) -> str:
        """Give them."""
