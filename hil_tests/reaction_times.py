"""How soon the car must brake after one of its processes is gone: worked out, not measured.

A station is gone from the moment of the fault, and its newest frames may have left just before it. From there on a
reaction is a chain of steps, each as long as parameters, tables and phases allow it to be at most:

- `reached`: the newest frame waits for the cycle of its receiver. The phases say how long.
- `overdue`: the receiver looks at the age every 10 ms, and only an age above the time-out counts.
- `held`: the condition has to last, in cycles of the SSM or as a time of the Raptor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bridge._native import lib
from bridge.scenario import load_scenario
from bridge.surroundings import TICK_US
from firmware.parameters import load_operation
from firmware.tables import own_faults
from tools.realtime_run import PHASES_US
from tools.run import find_scenario

PARTS = ("obc", "raptor", "space-drive", "autonomy", "plant", "hub")

EMERGENCY_STOP = "ssm"
"""The onboard computer's emergency stop, which comes before its full brake while the last look at the wall holds."""


@dataclass(frozen=True)
class Step:
    """One step of a reaction.

    Attributes
    ----------
    why : for people.
    us : how long it takes at most.
    """

    why: str
    us: int


@dataclass(frozen=True)
class Reaction:
    """What one station does about a fault.

    Attributes
    ----------
    gone : the part.
    by : who reacts; a witness of `hil_tests/realtime_rig.py`.
    steps : from the fault to the frame that shows the reaction.
    """

    gone: str
    by: str
    steps: tuple[Step, ...]

    @property
    def deadline_us(self) -> int:
        """From the fault to the frame, at most, on a machine that is never late."""
        return sum(step.us for step in self.steps)


def _reached(sender: str, receiver: str) -> Step:
    return Step(f"{sender} to {receiver}", (PHASES_US[receiver] - PHASES_US[sender]) % TICK_US)


def _overdue(name: str, timeout_us: int) -> Step:
    return Step(f"{name} {timeout_us // 1000} ms passed", (timeout_us // TICK_US + 1) * TICK_US)


def _operation() -> Mapping[str, object]:
    return dict(load_operation(load_scenario(find_scenario("short_drive")).operation))


def _parameter(name: str) -> Step:
    value = _operation()[name]
    assert isinstance(value, int)
    return _overdue(name, 1000 * value)


def _held(fault: str) -> Step:
    cycles = next(one.debounce_cycles for one in own_faults() if one.name == fault)
    return Step(f"{fault} in {cycles} cycle" + "s" * (cycles > 1), (cycles - 1) * TICK_US)


def _held_for(name: str, hold_us: int) -> Step:
    # Two cycles may lie a little less than their distance apart, and then it takes one more.
    return Step(f"{name} for {hold_us // 1000} ms", (hold_us // TICK_US + 1) * TICK_US)


def _reactions() -> tuple[Reaction, ...]:
    raptor, brake_axis = lib.raptor_config_default, lib.space_drive_config_default.brake
    commands_missing = (_reached("obc", "raptor"), _overdue("command_timeout", 1000 * raptor.command_timeout_ms))
    requests_missing = (_reached("raptor", "space-drive"), _overdue("request timeout", brake_axis.timeout_us))
    space_drive_lost = (
        _reached("space-drive", "raptor"),
        _overdue("position_timeout", 1000 * raptor.position_timeout_ms),
        _held_for("space_drive_lost", raptor.space_drive_lost_us),
    )
    wall_held_us = 1000 * (lib.wall_receiver_timeout_ms() + lib.EMERGENCY_HOLD_MS)
    wall_lost = (_reached("autonomy", "obc"), _overdue("wall time-out and hold", wall_held_us))
    estimate_missing = (_reached("autonomy", "obc"), _parameter("estimate_timeout"), _held("estimate_lost"))
    return (
        Reaction("obc", "raptor", commands_missing),
        Reaction("raptor", "space-drive", requests_missing),
        Reaction(
            "raptor",
            "obc",
            (_reached("raptor", "obc"), _parameter("misc_report_timeout"), _held("misc_report_missing")),
        ),
        Reaction("space-drive", "raptor", space_drive_lost),
        Reaction("space-drive", "obc", (*space_drive_lost, _reached("raptor", "obc"), _held("raptor_emergency"))),
        Reaction("autonomy", EMERGENCY_STOP, estimate_missing),
        Reaction("autonomy", "obc", wall_lost),
        Reaction("plant", EMERGENCY_STOP, (_reached("plant", "obc"), _parameter("imu_timeout"), _held("imu_timeout"))),
        Reaction("plant", "obc", (_reached("plant", "autonomy"), *wall_lost)),
        Reaction("hub", "space-drive", requests_missing),
        Reaction("hub", "obc", wall_lost),
        Reaction("hub", "raptor", commands_missing),
    )


REACTIONS = _reactions()


def reactions_to(gone: str) -> tuple[Reaction, ...]:
    """The reactions to the loss of a part, soonest first."""
    return tuple(sorted((one for one in REACTIONS if one.gone == gone), key=lambda one: one.deadline_us))
