"""Energy: what the engine and gravity put in is in the motion or in the losses."""

from __future__ import annotations

import math
import random

import pytest

from plant_fmu.driver import Plant

WHEELS = ("fl", "fr", "rl", "rr")


def drive_wildly(car: Plant, seed: int, seconds: float) -> None:
    """Random commands, changed ten times a second."""
    rng = random.Random(seed)
    gear = 2
    for _ in range(round(seconds * 10)):
        speed = float(car["vx"])
        gear = min(6, max(1, gear + rng.choice((-1, *[0] * 18, 1))))
        car.step(
            0.1,
            throttle_demand=rng.random() if rng.random() < 0.7 else 0.0,
            brake_pressure_demand=rng.uniform(0.0, 3e6) if rng.random() < 0.05 else 0.0,
            steer_motor_demand=rng.uniform(-1.0, 1.0) * 8.0 / (8.0 + abs(speed)),
            gear_demand=gear,
            road_bank=rng.uniform(-0.1, 0.35),
            road_grade=rng.uniform(-0.05, 0.05),
            road_friction=rng.uniform(0.5, 1.1),
        )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_account_balances_on_a_wild_drive(seed: int) -> None:
    start = {"engine_running0": True, "ignition": True, "v0": 20.0, "gear0": 2}
    with Plant(start) as car:
        drive_wildly(car, seed, 60.0)
        turnover = sum(abs(float(car[n])) for n in ("energy_engine", "energy_tyre", "energy_aero"))
        assert turnover > 5e5, seed
        assert abs(float(car["energy_error"])) < 1e-9 * turnover
        for name in ("energy_aero", "energy_tyre", "energy_wheel_friction", "energy_clutch"):
            assert float(car[name]) > 0.0, f"{name} is not a loss, seed {seed}"


def test_kinetic_energy_is_that_of_the_speeds() -> None:
    start = {"engine_running0": True, "ignition": True, "v0": 30.0, "gear0": 3, "gear_demand": 3}
    with Plant(start) as car:
        car.step(2.0, throttle_demand=0.5, steer_motor_demand=0.4)
        body = 790.0 * (float(car["vx"]) ** 2 + float(car["vy"]) ** 2)
        body += 1000.0 * float(car["yaw_rate"]) ** 2
        wheels = sum(
            inertia * float(car[f"wheel_speed_{wheel}"]) ** 2
            for wheel, inertia in zip(WHEELS, (1.15, 1.15, 1.35, 1.35), strict=True)
        )
        engine = 0.2 * float(car["engine_speed"]) ** 2
        assert car["energy_kinetic"] == pytest.approx(0.5 * (body + wheels + engine), rel=1e-12)


def test_works_agree_with_the_outputs() -> None:
    """The account against powers integrated from the outputs, on an acceleration uphill."""
    start = {"engine_running0": True, "ignition": True, "v0": 30.0, "gear0": 3, "gear_demand": 3}
    grade, dt = 0.03, 0.001
    with Plant({**start, "oval_asymmetry": 0.0, "road_grade": grade}, step_s=dt) as car:
        engine = aero = gravity = 0.0
        for _ in range(4000):
            car.step(throttle_demand=0.6)
            vx = float(car["vx"])
            engine += float(car["engine_torque"]) * float(car["engine_speed"]) * dt
            aero += 0.5 * 1.2 * 0.725 * vx**3 * dt
            gravity -= 790.0 * 9.81 * math.sin(grade) * vx * dt
        assert car["energy_engine"] == pytest.approx(engine, rel=2e-3)
        assert car["energy_aero"] == pytest.approx(aero, rel=2e-3)
        assert car["energy_gravity"] == pytest.approx(gravity, rel=2e-3)
        gain = float(car["energy_kinetic"]) - 0.5 * 790.0 * 30.0**2
        assert gain < engine + gravity - aero, "more motion than work"
        assert gain > 0.75 * (engine + gravity - aero), "losses beyond belief"


def test_a_turn_alone_gains_no_energy() -> None:
    """What a coasting car on a circle loses is lost in its tyres, to a part in a million."""
    start = {"v0": 10.0, "oval_asymmetry": 0.0, "rolling_resistance": 0.0, "drag_area": 0.0}
    with Plant({**start, "differential_preload": 0.0, "differential_lock_ratio": 0.0}) as car:
        car.step(3.0, steer_motor_demand=0.6)
        energy = float(car["energy_kinetic"])
        lost = float(car["energy_tyre"])
        car.step(20.0)
        assert float(car["energy_tyre"]) > lost
        drop = energy - float(car["energy_kinetic"])
        assert drop == pytest.approx(float(car["energy_tyre"]) - lost, rel=1e-6)


def test_braking_turns_motion_into_heat() -> None:
    with Plant({"v0": 40.0, "oval_asymmetry": 0.0}) as car:
        start = float(car["energy_kinetic"])
        car.step(15.0, brake_pressure_demand=1.5e6)
        assert float(car["energy_kinetic"]) < 1e-6
        brakes = float(car["energy_wheel_friction"])
        rest = float(car["energy_tyre"]) + float(car["energy_aero"])
        assert brakes + rest == pytest.approx(start, rel=1e-9)
        assert brakes > 0.9 * start


def test_clutch_takes_the_slip_of_a_launch() -> None:
    with Plant({"engine_running0": True, "ignition": True, "oval_asymmetry": 0.0}) as car:
        car.step(0.5, gear_demand=1)
        car.step(3.0, throttle_demand=0.4)
        assert float(car["energy_clutch"]) > 1000.0


def test_temperatures_follow_the_work() -> None:
    start = {"engine_running0": True, "ignition": True, "v0": 50.0, "gear0": 5, "gear_demand": 5}
    with Plant(start) as car:
        before = {n: float(car[n]) for n in car.names("output") if "temperature" in n}
        car.step(60.0, throttle_demand=0.7, steer_motor_demand=0.1)
        for name, value in before.items():
            assert float(car[name]) > value, name
        assert float(car["coolant_temperature"]) < 110.0
        assert float(car["oil_temperature"]) < 130.0
        assert car["oil_pressure"] == pytest.approx(500e3, rel=1e-2)
        assert car["fuel_pressure"] == pytest.approx(400e3, rel=1e-2)
        assert car["battery_voltage"] == pytest.approx(13.9, rel=1e-2)


def test_tyre_pressure_follows_its_temperature_at_constant_volume() -> None:
    with Plant({"ambient_temperature": 10.0, "tyre_temperature0": 10.0}) as car:
        for axle, wheels in (("front", ("fl", "fr")), ("rear", ("rl", "rr"))):
            for wheel in wheels:
                assert car[f"tyre_pressure_{wheel}"] == pytest.approx(float(car[f"tyre_cold_pressure_{axle}"]))
    start = {"engine_running0": True, "ignition": True, "v0": 50.0, "gear0": 5, "gear_demand": 5}
    with Plant({**start, "tyre_cold_pressure_front": 2.1e5, "tyre_cold_pressure_rear": 1.9e5}) as car:
        density = {wheel: float(car[f"tyre_pressure_{wheel}"]) / (40.0 + 273.15) for wheel in WHEELS}
        car.step(60.0, throttle_demand=0.6, steer_motor_demand=0.1)
        for wheel in WHEELS:
            kelvin = float(car[f"tyre_temperature_{wheel}"]) + 273.15
            assert kelvin > 45.0 + 273.15
            assert float(car[f"tyre_pressure_{wheel}"]) / kelvin == pytest.approx(density[wheel], rel=1e-12)
        cold = 25.0 + 273.15
        assert [density[w] * cold for w in WHEELS] == pytest.approx([2.1e5, 2.1e5, 1.9e5, 1.9e5])


def test_battery_drops_while_cranking() -> None:
    with Plant() as car:
        rest = float(car["battery_voltage"])
        car.step(0.3, starter=True)
        assert float(car["battery_voltage"]) < rest - 1.0
