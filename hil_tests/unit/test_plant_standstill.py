"""The car truly stands still: no creeping, hold on a bank, static equilibrium."""

from __future__ import annotations

import math

import pytest

from plant_fmu.driver import Plant

WHEELS = ("fl", "fr", "rl", "rr")


def test_parked_car_does_not_move_at_all() -> None:
    with Plant() as car:
        car.step(10.0, brake_pressure_demand=2e6)
        for name in ("x", "y", "yaw", "vx", "vy", "yaw_rate", "distance"):
            assert car[name] == 0.0, name
        assert car["specific_force_z"] == pytest.approx(9.81)
        assert car["specific_force_x"] == 0.0


def test_static_loads() -> None:
    with Plant() as car:
        loads = {w: float(car[f"wheel_load_{w}"]) for w in WHEELS}
        assert sum(loads.values()) == pytest.approx(790.0 * 9.81)
        assert loads["fl"] == loads["fr"]
        front = (loads["fl"] + loads["fr"]) / sum(loads.values())
        assert front == pytest.approx(1.247 / 2.971, rel=1e-6)


@pytest.mark.parametrize("bank_deg", [9.0, -9.0, 20.0])
def test_holds_on_a_bank_with_the_brake(bank_deg: float) -> None:
    bank = math.radians(bank_deg)
    with Plant({"road_bank": bank}) as car:
        car.step(10.0, brake_pressure_demand=3e6)
        x, y, yaw = float(car["x"]), float(car["y"]), float(car["yaw"])
        assert abs(y) < 0.02  # the tyres give a little
        car.step(60.0)
        assert car["x"] == pytest.approx(x, abs=1e-9)
        assert car["y"] == pytest.approx(y, abs=1e-9)
        assert car["yaw"] == pytest.approx(yaw, abs=1e-9)
        assert math.hypot(float(car["vx"]), float(car["vy"])) < 1e-12
        assert car["specific_force_y"] == pytest.approx(-9.81 * math.sin(bank), rel=1e-6)
        side = sum(float(car[f"tyre_force_y_{w}"]) for w in WHEELS)
        assert side == pytest.approx(-790.0 * 9.81 * math.sin(bank), rel=1e-6)
        low = "l" if bank > 0.0 else "r"
        high = "r" if bank > 0.0 else "l"
        assert float(car[f"wheel_load_f{low}"]) > float(car[f"wheel_load_f{high}"])


@pytest.mark.parametrize("bank_deg", [9.0, 20.0])
def test_an_hour_on_a_bank_with_the_brake_moves_the_car_by_the_give_of_its_tyres(bank_deg: float) -> None:
    """What the car settles at first is the deflection that carries the slope; there is no creep on top."""
    bank = math.radians(bank_deg)
    with Plant({"road_bank": bank}, step_s=1.0) as car:
        car.step(10.0, brake_pressure_demand=2e6)
        settled = (float(car["x"]), float(car["y"]), float(car["yaw"]))
        # Each tyre is a spring of its cornering stiffness over its relaxation length; the four carry the slope.
        nominal, load = float(car["tyre_nominal_load"]), 790.0 * 9.81 * math.cos(bank) / 4.0
        stiffness = nominal * float(car["tyre_pky1"]) * math.sin(2.0 * math.atan(load / (4.1265 * nominal)))
        give = 790.0 * 9.81 * math.sin(bank) * float(car["tyre_relaxation_y"]) / (4.0 * stiffness)
        assert math.hypot(*settled[:2]) == pytest.approx(give, rel=0.08)
        car.step(3590.0)
        assert math.hypot(float(car["x"]), float(car["y"])) < 0.005
        assert (car["x"], car["y"], car["yaw"]) == pytest.approx(settled, abs=1e-9)


def test_slides_down_an_icy_bank() -> None:
    """The hold is friction, not glue."""
    with Plant({"road_bank": math.radians(20.0), "road_friction": 0.1}) as car:
        car.step(3.0, brake_pressure_demand=3e6)
        assert float(car["y"]) > 1.0


def test_rolls_down_a_grade_without_brake_and_holds_with_it() -> None:
    with Plant({"road_grade": math.radians(5.0)}) as car:
        car.step(3.0, brake_pressure_demand=3e6)
        held = float(car["x"])
        assert abs(held) < 0.02
        car.step(3.0, brake_pressure_demand=0.0)
        assert float(car["vx"]) < -1.0
        car.step(3.0, brake_pressure_demand=3e6)
        assert abs(float(car["vx"])) < 1e-6


def test_idling_in_gear_does_not_creep() -> None:
    with Plant({"engine_running0": True, "ignition": True}) as car:
        car.step(10.0, gear_demand=1)
        assert car["gear"] == 1
        assert (car["x"], car["vx"]) == (0.0, 0.0)


@pytest.mark.parametrize("pressure", [0.8e6, 2e6, 6e6])
def test_stop_ends_at_rest_without_rocking_back(pressure: float) -> None:
    with Plant({"v0": 15.0, "oval_asymmetry": 0.0}) as car:
        furthest = 0.0
        for _ in range(1500):
            car.step(brake_pressure_demand=pressure)
            furthest = max(furthest, float(car["x"]))
        assert furthest - float(car["x"]) < 0.05
        assert abs(float(car["vx"])) < 1e-9
        x = float(car["x"])
        car.step(20.0)
        assert car["x"] == pytest.approx(x, abs=1e-9)


def test_start_pose() -> None:
    with Plant({"x0": 12.5, "y0": -3.0, "yaw0": 4.0, "v0": 10.0}) as car:
        assert (car["x"], car["y"], car["vx"]) == (12.5, -3.0, 10.0)
        assert car["yaw"] == pytest.approx(4.0 - 2.0 * math.pi)
        assert car["wheel_speed_fl"] == pytest.approx(10.0 / 0.2958)
