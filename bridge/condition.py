"""Conditions on the situation of the car: what scenarios wait for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from dbc.states import CtState, SysState


class Situation(NamedTuple):
    """What conditions look at, once per tick.

    Attributes
    ----------
    time_us : simulated time.
    sys_state, ct_state : as last sent on CAN1.
    distance_m : driven since power-on.
    laps : full laps, line to line.
    standstill : the car stands.
    """

    time_us: int
    sys_state: int
    ct_state: int
    distance_m: float
    laps: int
    standstill: bool


@dataclass(frozen=True)
class Condition:
    """All that is given must hold at once; times and distances are lower bounds.

    `for_us` is how long the rest must have held without a break: see `Trigger`.
    """

    time_us: int | None = None
    sys_state: SysState | None = None
    ct_state: CtState | None = None
    distance_m: float | None = None
    laps: int | None = None
    standstill: bool | None = None
    for_us: int = 0

    def holds(self, now: Situation) -> bool:
        """True when all that is given holds now, whatever `for_us` asks."""
        return (
            (self.time_us is None or now.time_us >= self.time_us)
            and (self.sys_state is None or now.sys_state == self.sys_state)
            and (self.ct_state is None or now.ct_state == self.ct_state)
            and (self.distance_m is None or now.distance_m >= self.distance_m)
            and (self.laps is None or now.laps >= self.laps)
            and (self.standstill is None or now.standstill == self.standstill)
        )


class Trigger:
    """Watches one condition over time.

    Parameters
    ----------
    condition : what to wait for.
    """

    def __init__(self, condition: Condition) -> None:
        self._condition = condition
        self._since_us: int | None = None

    def update(self, now: Situation) -> bool:
        """True when the condition holds and has held for as long as it asks; to be called every tick."""
        if not self._condition.holds(now):
            self._since_us = None
            return False
        if self._since_us is None:
            self._since_us = now.time_us
        return now.time_us - self._since_us >= self._condition.for_us


def condition_of(when: Mapping[str, Any]) -> Condition:
    """The condition that a `when` or `finish` of a scenario file states; it was checked against the schema."""
    return Condition(
        time_us=microseconds(when["time_s"]) if "time_s" in when else None,
        sys_state=SysState[when["sys_state"]] if "sys_state" in when else None,
        ct_state=CtState[when["ct_state"]] if "ct_state" in when else None,
        distance_m=when.get("distance_m"),
        laps=when.get("laps"),
        standstill=when.get("standstill"),
        for_us=microseconds(when.get("for_s", 0.0)),
    )


def microseconds(seconds: float) -> int:
    """Whole microseconds of a time in s."""
    return round(seconds * 1e6)
