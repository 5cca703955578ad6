"""Speed control: engine map, reference, throttle or brake, standstill; then with the plant."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from control_rig import Course, Loop, rolling

from bridge._native import ffi, lib
from plant_fmu.driver import Plant

CAR = lib.controller_table
HOLD = 8.0e5


class Speed:
    """Speed control on the table: the car's speed is what the test says."""

    def __init__(self) -> None:
        self.state = ffi.new("longitudinal *")
        self.input = ffi.new("longitudinal_input *")
        self.output = ffi.new("longitudinal_output *")
        self.input.max_acceleration, self.input.max_deceleration = 4.0, 6.0
        self.input.gear, self.input.engine_speed = 3, 400.0
        self.rolling(30.0)

    def rolling(self, speed: float) -> None:
        self.input.speed = self.state.reference = speed
        road = ffi.new("vehicle_cornering *")
        lib.vehicle_steady_cornering(speed, 0.0, 0.0, road)
        self.input.road = road[0]

    def step(self, target: float, acceleration: float = 0.0, ticks: int = 1) -> Any:
        self.input.target_speed, self.input.target_acceleration = target, acceleration
        for _ in range(ticks):
            lib.longitudinal_step(self.state, self.input, self.output)
        return self.output


# --- engine map ---


@pytest.mark.parametrize("engine_speed", [100.0, 250.0, 333.0, 500.0, 700.0])
def test_throttle_gives_the_torque_asked_for(engine_speed: float) -> None:
    low, high = lib.engine_map_torque(engine_speed, 0.0), lib.engine_map_torque(engine_speed, 1.0)
    assert low < 0.0 < high
    for torque in np.linspace(low + 0.01, high - 0.01, 50):
        throttle = lib.engine_map_throttle(engine_speed, torque)
        assert 0.0 <= throttle <= 1.0
        assert lib.engine_map_torque(engine_speed, throttle) == pytest.approx(torque, abs=0.05)
    assert lib.engine_map_throttle(engine_speed, high + 1.0) == 1.0
    assert lib.engine_map_throttle(engine_speed, low - 1.0) == 0.0
    assert lib.engine_map_throttle(engine_speed, math.nan) == 0.0


@pytest.mark.parametrize(
    ("gear", "speed", "throttle"), [(6, 55.0, 0.7), (4, 35.0, 0.5), (3, 25.0, 0.4), (2, 20.0, 0.0)]
)
def test_engine_map_is_the_plants_engine(gear: int, speed: float, throttle: float) -> None:
    with Plant({"v0": speed, "gear0": gear, "gear_demand": gear, "engine_running0": True, "ignition": True}) as car:
        car.step(3.0, throttle_demand=throttle)
        assert lib.engine_map_torque(float(car["engine_speed"]), throttle) == pytest.approx(
            float(car["engine_torque"]), abs=3.0
        )


# --- on the table ---


def test_reference_keeps_the_rate_limits() -> None:
    speed = Speed()
    speed.step(60.0, ticks=40)
    assert speed.state.reference == pytest.approx(30.0 + 40 * 0.04, abs=1e-3)
    speed = Speed()
    speed.step(0.0, ticks=30)
    assert speed.state.reference == pytest.approx(30.0 - 30 * 0.06, abs=1e-3)


def test_reference_does_not_run_away_from_the_car() -> None:
    speed = Speed()
    speed.step(60.0, ticks=1000)
    assert speed.state.reference == pytest.approx(32.0)
    assert speed.state.integral == pytest.approx(0.0, abs=0.2)


def test_feed_forward_covers_drag_and_rolling_resistance() -> None:
    speed = Speed()
    throttle = speed.step(30.0, ticks=60).throttle
    force = lib.engine_map_torque(400.0, throttle) * CAR.driveline_efficiency * CAR.gear_ratio[3] / CAR.driven_radius
    load = CAR.mass * CAR.gravity + (CAR.downforce_front + CAR.downforce_rear) * 900.0
    assert force == pytest.approx(CAR.drag_factor * 900.0 + CAR.rolling_resistance * load, rel=0.01)


def test_brake_pressure_covers_what_drag_and_engine_do_not() -> None:
    speed = Speed()
    speed.input.acceleration = -4.0
    output = speed.step(30.0, acceleration=-4.0)
    load = CAR.mass * CAR.gravity + (CAR.downforce_front + CAR.downforce_rear) * 900.0
    resistance = CAR.drag_factor * 900.0 + CAR.rolling_resistance * load
    engine = -lib.engine_map_torque(400.0, 0.0) * CAR.gear_ratio[3] / CAR.driven_radius
    expected = CAR.effective_mass[3] * 4.0 - resistance - engine
    assert output.brake_pressure * CAR.brake_gain == pytest.approx(expected, rel=0.01)
    assert output.throttle == 0.0


def test_small_changes_do_not_swap_throttle_and_brake() -> None:
    """Around the force of the closed throttle a swap needs the whole band."""
    speed = Speed()
    speed.step(30.0, acceleration=-2.0, ticks=50)
    assert speed.state.braking
    load = CAR.mass * CAR.gravity + (CAR.downforce_front + CAR.downforce_rear) * 900.0
    engine = -lib.engine_map_torque(400.0, 0.0) * CAR.gear_ratio[3] / CAR.driven_radius
    coasting = -(CAR.drag_factor * 900.0 + CAR.rolling_resistance * load + engine) / CAR.effective_mass[3]
    swaps = 0
    for k in range(200):
        before = speed.state.braking
        speed.input.acceleration = coasting
        speed.step(30.0, acceleration=coasting + 0.06 * (-1) ** k)
        swaps += before != speed.state.braking
    assert swaps <= 1


def test_no_more_drive_than_the_rear_tyres_hold() -> None:
    speed = Speed()
    speed.rolling(4.0)
    speed.input.gear, speed.input.engine_speed = 1, 500.0
    speed.input.max_acceleration = 30.0
    throttle = speed.step(60.0, ticks=200).throttle
    force = lib.engine_map_torque(500.0, throttle) * CAR.gear_ratio[1] / CAR.driven_radius * CAR.driveline_efficiency
    assert force <= 1.21 * speed.input.road.load_rear
    assert throttle < 1.0


def test_standing_car_is_held_and_a_target_releases_it() -> None:
    speed = Speed()
    speed.rolling(0.0)
    speed.input.gear, speed.input.engine_speed = 1, 136.0
    output = speed.step(0.0, ticks=200)
    assert (output.throttle, output.brake_pressure) == (0.0, pytest.approx(HOLD))
    output = speed.step(0.4, ticks=10)
    assert output.brake_pressure == pytest.approx(HOLD)
    output = speed.step(13.9, ticks=50)
    assert output.brake_pressure == 0.0
    assert 0.0 < output.throttle <= 0.75


def test_hold_while_driving_is_not_enabled() -> None:
    speed = Speed()
    speed.step(50.0, ticks=100)
    lib.longitudinal_hold(speed.state, 12.0, speed.output)
    assert (speed.output.throttle, speed.output.brake_pressure) == (0.0, HOLD)
    assert (speed.state.integral, speed.state.reference) == (0.0, 12.0)


@pytest.mark.parametrize("gear", [0, 7, 255])
def test_no_throttle_without_a_gear(gear: int) -> None:
    speed = Speed()
    speed.input.gear = gear
    assert speed.step(50.0, ticks=100).throttle == 0.0


# --- with the plant ---


def straight() -> Course:
    return Course.of([(3200.0, 0.0, 0.0, 0.1, 0.1)])


def test_launch_without_wheelspin_then_speed_held() -> None:
    with Loop(straight(), lambda _: 13.9) as loop:
        log = loop.run(20.0)
        radius = loop._value("tyre_radius_rear")
    slip = (log["wheel_rear"] * radius - log["v"]) / np.maximum(log["v"], 2.0)
    assert slip.max() < 0.15
    assert log["v"].max() < 14.3
    assert log["v"][-1] == pytest.approx(13.9, abs=0.15)
    assert not np.any((log["throttle"] > 0.0) & (log["brake"] > 0.0))
    reached = log["t"][np.argmax(log["v"] > 13.0)]
    assert reached < 6.0


def test_planned_acceleration_and_stop_are_followed() -> None:
    def planned(s: float) -> float:
        rising = math.sqrt(14.0**2 + 2.0 * 1.5 * max(0.0, s - 100.0))
        stopping = math.sqrt(2.0 * 4.0 * max(0.0, 1500.0 - s))
        return min(rising, 45.0, stopping)

    with Loop(straight(), planned) as loop:
        loop.run(8.0)
        log = loop.run(80.0, until=lambda row: row["v"] < 1e-3 and row["s"] > 1000.0)
        assert log["s"][-1] == pytest.approx(1500.0, abs=1.5)
        assert np.abs(log["speed_error"][log["v"] > 5.0]).max() < 1.0
        assert np.abs(log["speed_error"]).mean() < 0.2
        # Neither gear changes nor the end of the stop may jerk the car; the planned stop is at 4 m/s2.
        assert np.convolve(log["ax"], np.full(10, 0.1), "valid").min() > -6.0
        assert log["ax"][log["v"] < 0.5].min() > -3.0
        assert np.abs(np.diff(log["brake"][log["v"] > 0.1])).max() < 4e5
        stood = loop.run(2.0)
    assert np.abs(stood["v"][50:]).max() < 0.01
    assert stood["brake"][-1] == pytest.approx(HOLD)
    assert not np.any((log["throttle"] > 0.0) & (log["brake"] > 0.0))


def test_safe_stop_brakes_at_the_limit() -> None:
    with Loop(straight(), lambda _: 60.0, parameters=rolling(60.0, 6)) as loop:
        loop.run(3.0)
        loop.input.safe_stop = True
        log = loop.run(15.0, until=lambda row: row["v"] < 1e-3)
        stopping = (log["v"] < 55.0) & (log["v"] > 12.0)
        assert log["ax"][stopping].mean() == pytest.approx(-8.0, abs=0.4)
        assert np.abs(log["lateral"]).max() < 0.2
        stood = loop.run(1.0)
    assert np.abs(stood["v"][50:]).max() < 0.01
    assert log["throttle"].max() == 0.0


def test_lower_speed_limit_is_obeyed_at_once() -> None:
    with Loop(straight(), lambda _: 50.0, parameters=rolling(50.0, 6)) as loop:
        loop.run(2.0)
        loop.input.max_speed = 25.0
        log = loop.run(12.0)
    assert log["v"][-1] == pytest.approx(25.0, abs=0.3)
    assert log["v"].min() > 24.0
