"""Which value of a signal may follow which: states of the car's computers, and gears.

States follow the public stacks of 2021 and of 2023 and later, so that recordings of both are clean; what only one of
them allows is allowed. A computer that starts again during a recording is told.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dbc.states import CtState, SysState

_State = TypeVar("_State", bound=IntEnum)

_CT: Mapping[CtState, tuple[CtState, ...]] = {
    CtState.UNINITIALISED: (CtState.PWR_ON, CtState.DEFAULT),
    CtState.DEFAULT: (CtState.PWR_ON,),
    CtState.PWR_ON: (CtState.INITIALIZED,),
    CtState.INITIALIZED: (CtState.ACT_TEST,),
    CtState.ACT_TEST: (CtState.CRANKREADY,),
    CtState.CRANKREADY: (CtState.CRANKING,),
    CtState.CRANKING: (CtState.RACEREADY,),
    CtState.RACEREADY: (CtState.INIT_DRIVING,),
    CtState.INIT_DRIVING: (CtState.CAUTION,),
    CtState.CAUTION: (CtState.NOM_RACE, CtState.COORD_STOP, CtState.CNTRL_SHUTDOWN),
    CtState.NOM_RACE: (CtState.CAUTION, CtState.COORD_STOP),
    CtState.COORD_STOP: (CtState.CAUTION, CtState.NOM_RACE),
    CtState.CNTRL_SHUTDOWN: (CtState.CRANKING,),
}
_SYS: Mapping[SysState, tuple[SysState, ...]] = {
    SysState.NONE: (SysState.PWR_ON,),
    SysState.PWR_ON: (SysState.SUBSYS_CON,),
    SysState.SUBSYS_CON: (SysState.ACT_TESTING,),
    SysState.ACT_TESTING: (SysState.ACT_TEST_PASSED, SysState.ACT_TEST_FAIL, SysState.SUBSYS_CON),
    SysState.ACT_TEST_PASSED: (SysState.CRANKREADY, SysState.SUBSYS_CON),
    SysState.CRANKREADY: (SysState.CRANK_CHECK_INIT, SysState.CRANK_CHECKS_PASSED, SysState.SHUT_ENG),
    SysState.CRANK_CHECK_INIT: (SysState.CRANK_CHECKS_PASSED, SysState.CRANK_CHECKS_FAIL, SysState.SHUT_ENG),
    SysState.CRANK_CHECKS_PASSED: (
        SysState.CRANKING,
        SysState.CRANK_CHECKS_FAIL,
        SysState.STANDBY,
        SysState.SHUT_ENG,
    ),
    SysState.CRANKING: (SysState.ENG_IDLE, SysState.ENG_FAILED_TO_START, SysState.SHUT_ENG),
    SysState.ENG_IDLE: (SysState.DRIVING, SysState.ENG_FAILED_TO_START, SysState.SHUT_ENG),
    SysState.DRIVING: (SysState.SHUT_ENG, SysState.STANDBY),
    SysState.SHUT_ENG: (SysState.PWR_OFF,),
    SysState.PWR_OFF: (SysState.RAPTOR_OFF,),
    SysState.STANDBY: (SysState.CRANKING,),
    SysState.EMERGENCY_SHUTDOWN: (SysState.STANDBY,),
}
_SYS_FROM_ANYWHERE = (SysState.EMERGENCY_SHUTDOWN, SysState.CRITICAL_LIMIT_EXCEEDED)

#: A gear is asked for at least this long before another one is, us: a shift takes that long in public stacks.
GEAR_HOLD_US = 300_000


def ct_may_follow(before: int, after: int) -> bool:
    """Whether ct_state may go from one state to another one."""
    return _may_follow(_CT, (CtState.EMRG_SHUTDOWN,), before, after)


def sys_may_follow(before: int, after: int) -> bool:
    """Whether sys_state may go from one state to another one."""
    return _may_follow(_SYS, _SYS_FROM_ANYWHERE, before, after)


def gear_may_follow(before: int, after: int) -> bool:
    """The box has no way from a gear but to its neighbours."""
    return abs(after - before) <= 1


def _may_follow(
    table: Mapping[_State, tuple[_State, ...]], from_anywhere: tuple[_State, ...], before: int, after: int
) -> bool:
    following = {int(state): others for state, others in table.items()}
    return after in (*from_anywhere, *following.get(before, ()))


@dataclass
class Sequence:
    """The order of values of one signal.

    Attributes
    ----------
    may_follow : whether a value may follow another one.
    names : of the values, where they have some.
    hold_us : how long a value has to last before it changes again; 0 for no time.
    last : newest value; None before the first.
    changed_us : when it came; None when that is not known.
    """

    may_follow: Callable[[int, int], bool]
    names: type[IntEnum] | None = None
    hold_us: int = 0
    last: int | None = None
    changed_us: int | None = None

    def update(self, values: NDArray[np.float64], times: NDArray[np.int64]) -> Iterator[tuple[int, str]]:
        """Take in values; gives the places of those that may not follow, and why."""
        numbers = values.astype(np.int64)
        before = np.concatenate([[numbers[0] if self.last is None else self.last], numbers[:-1]])
        self.last = int(numbers[-1])
        for place in np.flatnonzero(numbers != before):
            one, other, time_us = int(before[place]), int(numbers[place]), int(times[place])
            if not self.may_follow(one, other):
                yield int(place), f"{self._word(one)} is followed by {self._word(other)}"
            elif self.changed_us is not None and time_us - self.changed_us < self.hold_us:
                held_ms = (time_us - self.changed_us) / 1000
                yield int(place), f"{self._word(one)} for {held_ms:.1f} ms; must be at least {self.hold_us / 1000:g} ms"
            self.changed_us = time_us

    def _word(self, value: int) -> str:
        known = self.names is not None and value in {int(name) for name in self.names}
        return self.names(value).name if known and self.names is not None else str(value)


def sequences() -> dict[tuple[str, str], Sequence]:
    """Fresh ones, by message and signal."""
    return {
        ("ct_report", "ct_state"): Sequence(ct_may_follow, CtState),
        ("misc_report", "sys_state"): Sequence(sys_may_follow, SysState),
        ("gear_shift_cmd", "desired_gear"): Sequence(gear_may_follow, hold_us=GEAR_HOLD_US),
    }
