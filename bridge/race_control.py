"""Race control and the person at the car: they watch the situation and act by the scenario's steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Generic, Protocol, TypeVar

from bridge.scenario import Condition, FlagStep, Situation, SwitchStep, Trigger
from dbc.states import TrackFlag, VehicleFlag

#: The base station sends a telegram every 100 ms (MyLaps 2021/22, 10 Hz).
TELEGRAM_PERIOD_US = 100_000


class _Conditional(Protocol):
    @property
    def when(self) -> Condition: ...


_Step = TypeVar("_Step", bound=_Conditional)


class StepSequence(Generic[_Step]):
    """Steps taken in order, each when its condition holds, at most one per tick.

    Parameters
    ----------
    steps : in order.

    Attributes
    ----------
    waiting_for : the step whose condition does not hold yet, or None after the last.
    """

    def __init__(self, steps: Sequence[_Step]) -> None:
        self._steps = tuple(steps)
        self._taken = 0
        self._await_next()

    def advance(self, now: Situation) -> _Step | None:
        """Take the next step if its condition holds."""
        step = self.waiting_for
        if step is None or not self._trigger.update(now):
            return None
        self._taken += 1
        self._await_next()
        return step

    def _await_next(self) -> None:
        self.waiting_for = self._steps[self._taken] if self._taken < len(self._steps) else None
        if self.waiting_for is not None:
            self._trigger = Trigger(self.waiting_for.when)


class SafetySwitch:
    """The person at the car who turns the safety switch.

    Parameters
    ----------
    steps : positions with their conditions.
    """

    def __init__(self, steps: Sequence[SwitchStep]) -> None:
        self._sequence = StepSequence(steps)

    def tick(self, now: Situation, wired: Any) -> None:
        """Turn the switch of `raptor_wired_in` when it is time."""
        step = self._sequence.advance(now)
        if step is not None:
            wired.safety_switch = step.position


class RaceControl:
    """Shows flags by the scenario's steps and sends telegrams to the car's radio.

    Parameters
    ----------
    steps : flags with their conditions.
    """

    def __init__(self, steps: Sequence[FlagStep]) -> None:
        self._sequence = StepSequence(steps)
        self._heartbeat = 0
        self.track_flag = TrackFlag.UNKNOWN
        self.vehicle_flag = VehicleFlag.NONE
        self.round_target_speed_mph = 0

    def tick(self, now: Situation, lap_distance_m: float, last_lap_s: float, radio: Any) -> None:
        """Watch, and send what is due into the radio's struct `raptor_race_control`."""
        step = self._sequence.advance(now)
        if step is not None:
            self._show(step)
        if now.time_us % TELEGRAM_PERIOD_US == 0:
            self._send(now, lap_distance_m, last_lap_s, radio)

    @property
    def waiting_for(self) -> FlagStep | None:
        """The step whose condition does not hold yet."""
        return self._sequence.waiting_for

    def _show(self, step: FlagStep) -> None:
        if step.track_flag is not None:
            self.track_flag = step.track_flag
        if step.vehicle_flag is not None:
            self.vehicle_flag = step.vehicle_flag
        if step.round_target_speed_mph is not None:
            self.round_target_speed_mph = step.round_target_speed_mph

    def _send(self, now: Situation, lap_distance_m: float, last_lap_s: float, radio: Any) -> None:
        self._heartbeat = (self._heartbeat + 1) & 0xF
        radio.linked = True
        radio.heartbeat = self._heartbeat
        radio.track_flag = self.track_flag
        radio.vehicle_flag = self.vehicle_flag
        radio.round_target_speed = self.round_target_speed_mph
        radio.rank = 1
        radio.lap_count = min(now.laps, 0xFF)
        radio.lap_distance = min(max(int(lap_distance_m), 0), 0xFFFF)
        radio.lap_time = last_lap_s
