"""Straight-line motion against closed forms: coast-down, braking, launch, gears, top speed."""

from __future__ import annotations

import math

import pytest
from scipy.integrate import solve_ivp

from plant_fmu.driver import Plant, Value

SYMMETRIC: dict[str, Value] = {"oval_asymmetry": 0.0}
DRIVING: dict[str, Value] = {"engine_running0": True, "ignition": True}


def effective_mass(car: Plant) -> float:
    """Mass with the inertia of the four wheels, driveline open."""
    return (
        float(car["mass"])
        + 2.0 * float(car["wheel_inertia_front"]) / float(car["tyre_radius_front"]) ** 2
        + 2.0 * float(car["wheel_inertia_rear"]) / float(car["tyre_radius_rear"]) ** 2
    )


def resistance(car: Plant) -> tuple[float, float]:
    """Constant and speed-squared part of drag and rolling resistance, N and N s2/m2."""
    half_rho = 0.5 * float(car["air_density"])
    crr = float(car["rolling_resistance"])
    downforce = float(car["downforce_area_front"]) + float(car["downforce_area_rear"])
    return (
        crr * float(car["mass"]) * float(car["gravity"]),
        half_rho * (float(car["drag_area"]) + crr * downforce),
    )


def test_coast_down_follows_the_differential_equation() -> None:
    with Plant({**SYMMETRIC, "v0": 60.0}) as car:
        constant, square = resistance(car)
        mass = effective_mass(car)
        solution = solve_ivp(
            lambda _t, v: -(constant + square * v * v) / mass,
            (0.0, 30.0),
            [60.0],
            rtol=1e-10,
            t_eval=[10.0, 20.0, 30.0],
        )
        for expected in solution.y[0]:
            car.step(10.0)
            assert car["vx"] == pytest.approx(expected, rel=5e-4)


@pytest.mark.parametrize("grade", [-0.05, 0.05])
def test_grade_adds_gravity(grade: float) -> None:
    with Plant({**SYMMETRIC, "v0": 30.0, "road_grade": grade}) as car:
        constant, square = resistance(car)
        mass = effective_mass(car)
        weight = float(car["mass"]) * float(car["gravity"])
        rolling = constant * math.cos(grade)
        solution = solve_ivp(
            lambda _t, v: -(rolling + square * v * v + weight * math.sin(grade)) / mass,
            (0.0, 5.0),
            [30.0],
            rtol=1e-10,
        )
        car.step(5.0)
        assert car["vx"] == pytest.approx(solution.y[0][-1], rel=1e-3)
        assert car["specific_force_x"] == pytest.approx(
            float(car["ax"]) + float(car["gravity"]) * math.sin(grade), abs=1e-9
        )


@pytest.mark.parametrize("grade", [-0.05, 0.05])
def test_height_is_that_of_the_grade(grade: float) -> None:
    with Plant({**SYMMETRIC, "v0": 30.0, "road_grade": grade, "road_bank": 0.2}) as car:
        car.step(1.0)
        x, z = float(car["x"]), float(car["z"])
        assert z == pytest.approx(30.0 * math.sin(grade), rel=0.05)
        car.step(0.2, road_grade=0.0)
        assert z == float(car["z"])
        assert float(car["x"]) > x


def test_brake_distance_follows_the_closed_form() -> None:
    with Plant({**SYMMETRIC, "v0": 40.0}) as car:
        pressure = 1.5e6
        car.step(0.5, brake_pressure_demand=pressure)  # the hydraulics have settled
        front, rear = float(car["brake_pressure_front"]), float(car["brake_pressure_rear"])
        assert front == pytest.approx(pressure, rel=1e-3)
        gain = float(car["brake_torque_gain"])
        brakes = 2.0 * gain * front / float(car["tyre_radius_front"]) + 2.0 * gain * rear / float(
            car["tyre_radius_rear"]
        )
        constant, square = resistance(car)
        constant += brakes
        speed, start = float(car["vx"]), float(car["distance"])
        expected = effective_mass(car) / (2.0 * square) * math.log1p(square * speed**2 / constant)
        while float(car["vx"]) > 1e-3 and car.time < 20.0:
            assert float(car["wheel_speed_fl"]) > 0.0 or float(car["vx"]) < 0.5, "wheel locked"
            car.step()
        assert float(car["distance"]) - start == pytest.approx(expected, rel=0.01)


def test_brake_shares_follow_the_parameter_and_never_exceed_the_maximum() -> None:
    with Plant(SYMMETRIC) as car:
        car.step(1.0, brake_pressure_demand=1e9)
        front, rear = float(car["brake_pressure_front"]), float(car["brake_pressure_rear"])
        assert front == pytest.approx(float(car["brake_pressure_max"]), rel=1e-6)
        assert front / (front + rear) == pytest.approx(float(car["brake_front_share"]))


@pytest.mark.parametrize("friction", [0.3, 1.0])
def test_wheels_lock_at_full_pressure(friction: float) -> None:
    with Plant({**SYMMETRIC, "v0": 40.0, "road_friction": friction}) as car:
        car.step(0.5, brake_pressure_demand=6e6)
        for wheel in ("fl", "fr", "rl", "rr"):
            assert car[f"wheel_speed_{wheel}"] == 0.0
        assert float(car["vx"]) > 20.0
        speed, time = float(car["vx"]), car.time
        car.step(0.5)
        rate = (speed - float(car["vx"])) / (car.time - time)
        peak = float(car["tyre_pdx1"]) * float(car["tyre_mu_scale_x"]) * friction
        # A locked car slides with less than the peak friction.
        assert 0.6 * peak * 9.81 < rate < 1.3 * peak * 9.81


def test_moderate_brake_does_not_lock() -> None:
    with Plant({**SYMMETRIC, "v0": 40.0}) as car:
        car.step(1.0, brake_pressure_demand=1.5e6)
        rolling = float(car["vx"]) / float(car["tyre_radius_front"])
        assert car["wheel_speed_fl"] == pytest.approx(rolling, rel=0.03)


def test_crank_and_idle() -> None:
    with Plant() as car:
        car.step(0.5, starter=True)
        assert car["engine_running"] is False, "fires without ignition"
        assert float(car["engine_speed"]) > 20.0
        car.step(1.0, starter=False)
        assert float(car["engine_speed"]) < 5.0
        car.step(1.0, ignition=True, starter=True)
        car.step(2.0, starter=False)
        assert car["engine_running"] is True
        assert car["engine_speed"] == pytest.approx(float(car["engine_idle_speed"]), rel=0.02)
        car.step(3.0, ignition=False)
        assert car["engine_running"] is False
        assert float(car["engine_speed"]) < 1.0


def test_stopped_engine_needs_the_starter() -> None:
    with Plant() as car:
        car.step(2.0, ignition=True, throttle_demand=0.5)
        assert car["engine_running"] is False
        assert car["engine_speed"] == 0.0


@pytest.mark.parametrize(("throttle", "speed"), [(0.1, 0.0), (0.2, 3.0), (0.3, 6.0), (0.6, 12.0), (1.0, 20.0)])
def test_launch_does_not_stall(throttle: float, speed: float) -> None:
    with Plant({**SYMMETRIC, **DRIVING}) as car:
        car.step(1.0, brake_pressure_demand=2e6, gear_demand=1)
        assert car["gear"] == 1
        car.step(throttle_demand=throttle, brake_pressure_demand=0.0)
        for _ in range(80):
            car.step(0.1)
            assert car["engine_running"] is True
            assert float(car["engine_speed"]) > 0.75 * float(car["engine_idle_speed"])
        assert float(car["vx"]) > speed - 1e-9


def test_stop_in_gear_does_not_stall() -> None:
    with Plant({**SYMMETRIC, **DRIVING, "v0": 20.0, "gear0": 2, "gear_demand": 2}) as car:
        car.step(6.0, brake_pressure_demand=6e6)
        assert car["engine_running"] is True
        assert abs(float(car["vx"])) < 1e-3
        assert car["engine_speed"] == pytest.approx(float(car["engine_idle_speed"]), rel=0.05)


def test_gear_run_from_neutral_to_sixth() -> None:
    with Plant({**SYMMETRIC, **DRIVING}) as car:
        gear, seen = 1, [0]
        car.step(0.5)
        while car.time < 60.0 and seen[-1] != 6:
            # Ease the throttle in first gear, where the engine outdoes the tyres.
            car.step(throttle_demand=0.5 if seen[-1] < 2 else 0.8, gear_demand=gear)
            assert car["engine_running"] is True
            assert float(car["engine_speed"]) < 1.03 * float(car["engine_speed_limit"])
            if car["gear"] != seen[-1]:
                seen.append(int(car["gear"]))
            if car["gear_shift_status"] == 1 and gear < 6 and seen[-1] == gear and float(car["engine_speed"]) > 650.0:
                gear += 1
        assert seen == [0, 1, 2, 3, 4, 5, 6]


def test_shift_takes_its_time_and_cuts_torque() -> None:
    with Plant({**SYMMETRIC, **DRIVING, "v0": 40.0, "gear0": 3, "gear_demand": 3}) as car:
        car.step(2.0, throttle_demand=0.8)
        assert float(car["wheel_torque"]) > 500.0
        car.step(0.05, gear_demand=4)
        assert (car["gear"], car["gear_shift_status"]) == (3, 3)
        assert abs(float(car["wheel_torque"])) < 1.0
        assert car["clutch_engagement"] == 0.0
        car.step(0.06)
        assert car["gear"] == 4
        car.step(0.5)
        assert car["gear_shift_status"] == 1
        assert float(car["wheel_torque"]) > 500.0
        car.step(0.05, gear_demand=3)
        assert car["gear_shift_status"] == 4


def test_downshift_beyond_the_rev_limit_is_locked_out() -> None:
    with Plant({**SYMMETRIC, **DRIVING, "v0": 60.0, "gear0": 3, "gear_demand": 3}) as car:
        car.step(0.5, gear_demand=1)
        assert (car["gear"], car["gear_shift_status"]) == (3, 2)
        car.step(0.2, gear_demand=3)
        assert car["gear_shift_status"] == 1


def test_no_shift_without_ignition() -> None:
    with Plant() as car:
        car.step(1.0, gear_demand=1)
        assert (car["gear"], car["gear_shift_status"]) == (0, 0)


def test_gear_demand_saturates() -> None:
    with Plant({**SYMMETRIC, **DRIVING}) as car:
        car.step(1.0, gear_demand=-3)
        assert car["gear"] == 0
        car.step(5.0, gear_demand=99, brake_pressure_demand=3e6)
        assert car["gear"] == 6


def test_reaches_racing_speed_in_time() -> None:
    with Plant({**DRIVING, "v0": 14.0, "gear0": 1, "gear_demand": 1}) as car:
        gear = 1
        while float(car["vx"]) < 63.06:
            if car["gear_shift_status"] == 1 and float(car["engine_speed"]) > 690.0:
                gear = min(gear + 1, 6)
            steer = -1.0 * float(car["y"]) - 12.0 * float(car["yaw"])
            car.step(
                throttle_demand=0.6 if gear < 3 else 1.0,
                gear_demand=gear,
                steer_motor_demand=0.1 * steer,
            )
            assert float(car["distance"]) < 900.0
        assert float(car["distance"]) > 250.0, "more power than the car has"


def test_peak_power_is_that_of_the_2022_car() -> None:
    """On a steep hill in fifth gear the engine sweeps its range slowly enough to follow the map."""
    powers = []
    start: dict[str, Value] = {"v0": 60.0, "gear0": 5, "gear_demand": 5, "throttle_demand": 1.0}
    with Plant({**SYMMETRIC, **DRIVING, **start}) as car:
        for _ in range(3000):
            car.step()
            powers.append(float(car["engine_torque"]) * float(car["engine_speed"]))
    assert max(powers) == pytest.approx(335e3, rel=0.01)


def test_torque_rise_is_limited() -> None:
    start: dict[str, Value] = {"v0": 50.0, "gear0": 5, "gear_demand": 5}
    with Plant({**SYMMETRIC, **DRIVING, **start}) as car:
        car.step(1.0, throttle_demand=0.4)
        before = float(car["engine_torque"])
        car.step(0.5, throttle_demand=1.0)
        gain = float(car["engine_torque"]) - before
        limit = float(car["engine_torque_rise_limit"])
        assert 0.9 * 0.5 * limit < gain < 1.05 * 0.5 * limit
