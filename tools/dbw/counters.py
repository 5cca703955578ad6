"""Message counters: whether each frame counts on from the one before."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from tools.dbw.findings import Offence, Rule
from tools.dbw.series import steps


class CounterMode(StrEnum):
    """What a counter has to do from frame to frame.

    AUTOMATIC: count up by one; where it begins at 0 again is found out from the recording: public senders do so at 7,
    at 15 or at the end of the field.
    PLUS_ONE: count up by one, to the end of the field.
    CHANGED: change, as compatible receivers want it.
    """

    AUTOMATIC = "automatic"
    PLUS_ONE = "plus-one"
    CHANGED = "changed"


#: Public senders count up to these before they begin at 0 again, whatever the width of the field is.
_WRAPS = (7, 15, 255)


@dataclass
class Counter:
    """One message's counter.

    Attributes
    ----------
    largest : value of the field.
    mode : what it has to do.
    last : newest value; None before the first frame.
    highest : largest value seen.
    jumps_to_0 : by the value before: all of them. They may be where the sender wraps.
    """

    largest: int
    mode: CounterMode = CounterMode.AUTOMATIC
    last: int | None = None
    highest: int = 0
    jumps_to_0: dict[int, Offence] = field(default_factory=dict)

    def update(
        self, values: NDArray[np.int64], times: NDArray[np.int64], numbers: NDArray[np.int64]
    ) -> Iterator[tuple[Rule, Offence]]:
        """Take in values; at least one."""
        before = int(values[0]) - 1 if self.last is None else self.last
        changes = steps(values, before)
        self.last = int(values[-1])
        self.highest = max(self.highest, int(np.maximum.reduce(values)))
        # Few frames are of interest: those at which the counter does not go up by one.
        rows = (changes != 1).nonzero()[0]
        stuck = rows[changes[rows] == 0]
        if stuck.size:
            yield Rule.STUCK, Offence.of(stuck, numbers, times, f"stays at {values[stuck[0]]}")
        jump = rows[changes[rows] != 0]
        if self.mode is CounterMode.CHANGED or not jump.size:
            return
        to_0 = jump[values[jump] == 0]
        before_0 = (values - changes)[to_0]
        for value in np.unique(before_0):
            new = Offence.of(to_0[before_0 == value], numbers, times, f"{value} is followed by 0")
            old = self.jumps_to_0.get(int(value))
            self.jumps_to_0[int(value)] = new if old is None else replace(old, count=old.count + new.count)
        others = jump[values[jump] != 0]
        if others.size:
            row = others[0]
            text = f"{values[row] - changes[row]} is followed by {values[row]}"
            yield Rule.JUMP, Offence.of(others, numbers, times, text)

    def finish(self) -> Iterator[tuple[Rule, Offence]]:
        """A jump to 0 from the highest value that the sender ever reaches is where it wraps, if that is a usual one."""
        usual = (self.largest,) if self.mode is CounterMode.PLUS_ONE else (*_WRAPS, self.largest)
        for value, offence in self.jumps_to_0.items():
            if value != self.highest or value not in usual:
                yield Rule.JUMP, offence
