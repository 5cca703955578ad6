"""What the safety properties allow, from the files that say so.

Operation parameters, the fault table, the DBC files and the vehicle file are read; only what no file states is here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from bridge.scenario import Scenario, load_vehicle
from dbc.errors import ConfigurationError
from firmware.parameters import load_operation
from firmware.tables import CYCLE_MS, Parameter, own_faults, own_parameters

#: One minor frame, and what a value may take from one station to the next one's frame: two of them.
CYCLE_US = 1000 * CYCLE_MS
PASSING_US = 2 * CYCLE_US

#: Frames of one tick on two buses may end in either order, by so much.
WITHIN_TICK_US = 1_000

#: Accelerator and brake together: so much of each, and so long.
PEDAL_THROTTLE_PERCENT = 10.0
PEDAL_BRAKE_KPA = 500.0
PEDAL_US = 500_000

#: What Raptor and Space Drive brake with by themselves: while nobody steers, and while somebody does.
FULL_BRAKE_KPA = 4500.0
STEERED_BRAKE_KPA = 3500.0

#: Position counts on CAN3: straight ahead or no brake; the middle of the scale, whose lower end is full brake.
NEUTRAL_COUNTS = 0x4000

#: The steering follows its requests when it is so near to one of the last requests, and has not for less than this.
STEERING_LAG_US = 150_000
STEERING_COUNTS = 64
STEERING_ASTRAY_US = 100_000

#: Time constants after which a first-order lag has settled, and what is then left of a step.
_SETTLED_CONSTANTS = 4.0
_SETTLED_REST = math.exp(-_SETTLED_CONSTANTS)


@dataclass(frozen=True)
class BrakeLines:
    """The brake hydraulics, from the vehicle file.

    Attributes
    ----------
    full_kpa : largest pressure, what count 0 on CAN3 asks for.
    settled_us : from a request on CAN3 until the lines have it: two cycles, dead time, lag and rate limit.
    tolerance_kpa : what is left of the largest step by then.
    front_share, rear_share : of the request, in the front and in the rear line.
    """

    full_kpa: float
    settled_us: int
    tolerance_kpa: float
    front_share: float
    rear_share: float

    @classmethod
    def of_vehicle(cls, path: Path, vehicle: Mapping[str, float]) -> BrakeLines:
        """Those of a vehicle file with its content.

        Raises
        ------
        ConfigurationError
            When it lacks one of the plant's parameters of the brakes, or that is out of range.
        """

        def value(key: str) -> float:
            if key not in vehicle:
                raise ConfigurationError(path, key, "is missing; the safety properties need it")
            return vehicle[key]

        def positive(key: str) -> float:
            if not value(key) > 0.0:
                raise ConfigurationError(path, key, f"is {value(key):g}; must be above 0")
            return value(key)

        full, front = positive("brake_pressure_max"), positive("brake_front_share")
        if not front < 1.0:
            raise ConfigurationError(path, "brake_front_share", f"is {front:g}; must be below 1")
        lag_s = 1.0 / (2.0 * math.pi * positive("brake_bandwidth"))
        rate_s = full / positive("brake_pressure_rate_limit")
        rise_s = value("brake_delay") + _SETTLED_CONSTANTS * lag_s + rate_s
        return cls(
            full_kpa=full / 1000.0,
            settled_us=PASSING_US + math.ceil(rise_s * 1e6),
            tolerance_kpa=_SETTLED_REST * full / 1000.0,
            front_share=min(1.0, front / (1.0 - front)),
            rear_share=min(1.0, (1.0 - front) / front),
        )


@dataclass(frozen=True)
class SafetyLimits:
    """Everything that is allowed, in the units of the wire.

    Attributes
    ----------
    full_brake_kpa : what a full brake must command at least while no controller steers.
    steered_brake_kpa : what any full brake must.
    steering_deg, steering_slew_deg : at the motor, to either side, and per cycle.
    throttle_percent : largest command.
    gears : number of forward gears.
    max_speed, max_acceleration, max_deceleration : what the SSM may allow, m/s and m/s2.
    degraded_max_speed, degraded_max_acceleration : while degraded.
    degraded_shares : by the id of each fault that degrades: what it leaves of these two, as fractions.
    standstill_speed : below, the car stands, m/s.
    full_brake_faults : by the id of each fault whose reaction is a full brake: time from its fault_event, us.
    brakes : see `BrakeLines`.
    """

    full_brake_kpa: float
    steered_brake_kpa: float
    steering_deg: float
    steering_slew_deg: float
    throttle_percent: float
    gears: int
    max_speed: float
    max_acceleration: float
    max_deceleration: float
    degraded_max_speed: float
    degraded_max_acceleration: float
    degraded_shares: Mapping[int, tuple[float, float]]
    standstill_speed: float
    full_brake_faults: Mapping[int, int]
    brakes: BrakeLines

    @classmethod
    def of_scenario(cls, scenario: Scenario) -> SafetyLimits:
        """Those of a scenario's operation file and vehicle file.

        Raises
        ------
        ConfigurationError
            When one of the files cannot be read, or the vehicle's brakes are not described.
        """
        written = dict(load_operation(scenario.operation))
        vehicle = load_vehicle(scenario.vehicle)
        schema = _parameters()

        def both(name: str) -> tuple[float, float]:
            """The default, which is in force until the configuration is accepted, and what the file says."""
            parameter = schema[name]
            return float(parameter.default), _accepted(parameter, written.get(name))

        def most(name: str) -> float:
            return max(both(name))

        return cls(
            full_brake_kpa=min(both("full_brake_pressure")) / 1000.0,
            steered_brake_kpa=min(both("steered_brake_pressure")) / 1000.0,
            steering_deg=math.degrees(most("steering_limit") * most("steering_ratio")),
            steering_slew_deg=math.degrees(most("steering_slew") * most("steering_ratio")) * CYCLE_US * 1e-6,
            throttle_percent=100.0 * most("throttle_limit"),
            gears=sum(name.startswith("gear_ratio_") for name in vehicle),
            max_speed=most("max_speed"),
            max_acceleration=most("max_acceleration"),
            max_deceleration=most("max_deceleration"),
            degraded_max_speed=most("degraded_max_speed"),
            degraded_max_acceleration=most("degraded_max_acceleration"),
            degraded_shares=_degraded_shares(),
            standstill_speed=most("standstill_speed"),
            full_brake_faults=_full_brake_faults(),
            brakes=BrakeLines.of_vehicle(scenario.vehicle, vehicle),
        )


def _accepted(parameter: Parameter, value: object) -> float:
    """A value that the firmware may accept; else the default, which then stays in force."""
    if isinstance(value, int | float) and math.isfinite(value) and parameter.min <= value <= parameter.max:
        return float(value)
    return float(parameter.default)


@cache
def _parameters() -> Mapping[str, Parameter]:
    return {parameter.name: parameter for parameter in own_parameters().parameters}


@cache
def _degraded_shares() -> Mapping[int, tuple[float, float]]:
    return {
        fault.id: (fault.speed_percent / 100.0, fault.acceleration_percent / 100.0)
        for fault in own_faults()
        if fault.speed_percent is not None and fault.acceleration_percent is not None
    }


@cache
def _full_brake_faults() -> Mapping[int, int]:
    """The deadline counts from the condition; a fault_event comes when the debounce time is over."""
    faults: Iterable[tuple[int, int]] = (
        (fault.id, 1000 * max(fault.deadline_ms - fault.debounce_ms, CYCLE_MS))
        for fault in own_faults()
        if fault.reaction == "full_brake"
    )
    return dict(faults)
