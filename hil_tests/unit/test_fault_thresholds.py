"""Faults with a threshold of their own: nothing below it, active exactly after the debounce above it, and gone again.

The car drives at 20 m/s and obeys, except for the one value under test. Thresholds are those of the solo lap.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import pytest
from obc_harness import EARTH_RADIUS, OPERATION, ObcHarness

from bridge._native import lib
from firmware.parameters import load_operation
from firmware.tables import own_faults

FAULTS = {fault.name: fault for fault in own_faults()}
LIMITS: dict[str, float] = {
    name: float(value) for name, value in load_operation(OPERATION) if isinstance(value, int | float)
}
SPEED = 20.0
MOTOR_DEGREES = math.degrees(LIMITS["steering_ratio"])  # per rad at the road wheel

Provoke = Callable[[ObcHarness, float], None]


class Case(NamedTuple):
    """One fault: how a value comes about, and one just below and one just above the threshold on the wire."""

    fault: str
    provoke: Provoke
    below: float
    above: float


def report(message: str, signal: str, scale: float, command: str, commanded: str) -> Provoke:
    """A report that lies off what is commanded, tick by tick."""

    def apply(harness: ObcHarness, deviation: float) -> None:
        def shift(frames: bytes) -> bytes:
            harness.signals[message][signal] = harness.value(command, commanded) + deviation * scale
            return frames

        harness.filters.append(shift)

    return apply


def wheels(harness: ObcHarness, deviation: float) -> None:
    kmh = (SPEED + deviation) * 3.6
    harness.signals["wheel_speed_report"].update({f"wheel_speed_{wheel}": kmh for wheel in ("FL", "FR", "RL", "RR")})


def jump(receiver: str, harness: ObcHarness, metres: float) -> None:
    harness.signals[f"{receiver}_position"][f"{receiver}_latitude"] = math.degrees(metres / EARTH_RADIUS)


def gnss_a_jump(harness: ObcHarness, metres: float) -> None:
    jump("gnss_a", harness, metres)


def gnss_b_jump(harness: ObcHarness, metres: float) -> None:
    jump("gnss_b", harness, metres)


def rate(harness: ObcHarness, step: float) -> None:
    harness.signals["imu_rates"]["imu_pitch_rate"] = step


def force(harness: ObcHarness, step: float) -> None:
    harness.signals["imu_specific_force"]["imu_specific_force_y"] = step


def astray(harness: ObcHarness, bias: float) -> None:
    def hold(frames: bytes) -> bytes:
        harness.obc.control.lqr.integral = bias
        return frames

    harness.filters.append(hold)


STEERING = report(
    "steering_report", "steering_motor_ang_avg_fdbk", MOTOR_DEGREES, "steering_cmd", "steering_motor_ang_cmd"
)
BRAKE = report("brake_pressure_report", "brake_pressure_fdbk_front", 1e-3, "brake_pressure_cmd", "brake_pressure_cmd")
ACCELERATOR = report("accelerator_report", "acc_pedal_fdbk", 100.0, "accelerator_cmd", "acc_pedal_cmd")
THROTTLE = report("pt_report_1", "throttle_position", 100.0, "accelerator_cmd", "acc_pedal_cmd")


def around(name: str, step: float) -> tuple[float, float]:
    return LIMITS[name] - step, LIMITS[name] + step


CASES = [
    Case("steering_implausible", STEERING, *around("max_steering_deviation", 0.0012)),  # two steps of the wire
    Case("brake_implausible", BRAKE, *around("max_brake_deviation", 1000.0)),
    Case("throttle_implausible", ACCELERATOR, *around("max_throttle_excess", 0.002)),
    Case("throttle_implausible", THROTTLE, *around("max_throttle_excess", 0.002)),
    Case("wheel_speed_implausible", wheels, *around("max_wheel_speed_deviation", 0.06)),
    Case("wheel_speed_implausible", wheels, *(-value for value in around("max_wheel_speed_deviation", 0.06))),
    Case("gnss_a_jump", gnss_a_jump, *around("gnss_max_position_step", 0.05)),
    Case("gnss_b_jump", gnss_b_jump, *(-value for value in around("gnss_max_position_step", 0.05))),
    Case("imu_jump", rate, *around("imu_max_rate_step", 0.001)),
    Case("imu_jump", force, *(-value for value in around("imu_max_force_step", 0.01))),
    # The LQR counters part of what leads it astray, so that its deviation is smaller than the bias.
    Case("lqr_diverging", astray, LIMITS["max_controller_deviation"], 2.0 * LIMITS["max_controller_deviation"]),
]


def driving() -> ObcHarness:
    harness = ObcHarness()
    harness.plan_speed = SPEED
    harness.drive()
    harness.set_speed(SPEED)
    harness.signals["pt_report_1"] |= {"current_gear": 2, "engine_speed_rpm": 5000}
    harness.run(35)
    assert (harness.state, harness.active_faults()) == (lib.SSM_NOMINAL, set())
    return harness


def until_present(harness: ObcHarness, fault: int) -> None:
    """Run to the first tick with the condition; sensors speak in their own time."""
    for _ in range(11):
        harness.tick()
        if harness.obc.conditions.present[fault]:
            return
    raise AssertionError("the condition never came")


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.fault}-{case.provoke.__name__}-{case.above:.4g}")
def test_threshold_and_debounce(case: Case) -> None:
    fault = FAULTS[case.fault]
    harness = driving()
    case.provoke(harness, case.below)
    harness.run(fault.debounce_cycles + 15)
    assert harness.active_faults() == set(), "below its threshold"

    harness = driving()
    case.provoke(harness, case.above)
    until_present(harness, fault.id)
    for _ in range(fault.debounce_cycles - 1):
        assert fault.id not in harness.active_faults(), "the debounce still runs"
        harness.tick()
    assert fault.id in harness.active_faults()


def test_one_receiver_that_contradicts_wheels_and_the_other_is_no_fault_of_the_wheels() -> None:
    harness = driving()
    harness.signals["gnss_a_velocity"]["gnss_a_velocity_north"] = 30.0
    harness.run(60)
    assert FAULTS["wheel_speed_implausible"].id not in harness.active_faults()
    assert FAULTS["gnss_a_jump"].id not in harness.active_faults(), "1.5 m in 50 ms are below its threshold"
    del harness.periods["gnss_b_position"]
    harness.run(60)
    assert FAULTS["wheel_speed_implausible"].id in harness.active_faults(), "the one receiver that is left"


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ("steering_report", "steering_implausible"),
        ("brake_pressure_report", "brake_implausible"),
        ("accelerator_report", "throttle_implausible"),
        ("pt_report_1", "gear_implausible"),
        ("wheel_speed_report", "wheel_speed_implausible"),
    ],
)
def test_a_report_that_is_missing_contradicts_no_command(message: str, fault: str) -> None:
    """Its last value is old; what follows from its absence is another fault's reaction, not this one's full brake."""
    harness = driving()
    harness.plan_speed = 0.0
    del harness.periods[message]
    harness.run(60)
    assert FAULTS[fault].id not in harness.active_faults()


def test_a_shift_is_no_disobedience() -> None:
    """The gear hangs behind its command for less than the debounce, again and again."""
    harness = driving()
    fault = FAULTS["gear_implausible"]
    for _ in range(3):
        harness.signals["pt_report_1"]["current_gear"] = 3
        harness.run(fault.debounce_cycles - 1)
        harness.signals["pt_report_1"]["current_gear"] = int(harness.value("gear_shift_cmd", "desired_gear"))
        harness.run(1)
        assert fault.id not in harness.active_faults()
