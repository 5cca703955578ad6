"""Gear changes are smooth: the engine is brought to the new gear's speed before the clutch closes hard."""

from __future__ import annotations

import math

import pytest

from plant_fmu.driver import Plant, Value

DRIVING: dict[str, Value] = {"engine_running0": True, "ignition": True, "oval_asymmetry": 0.0}
DOWN = [(6, 41.5), (5, 35.0), (4, 25.0), (3, 19.5), (2, 9.5)]  # the firmware's shift speeds, m/s
UP = [(1, 11.0), (2, 22.0), (3, 28.5), (4, 37.5), (5, 44.0)]
ALLOWED = 2.0  # m/s2 beyond the car's motion before and after, for one tick at most


def change(gear: int, to: int, speed: float, throttle: float, brake: float) -> tuple[float, float, list[float], int]:
    """Acceleration before and after a change at `speed`, in every tick of it, and its length in ticks."""
    run_up = 4.0 if to < gear else -2.5
    with Plant({**DRIVING, "v0": speed + run_up, "gear0": gear, "gear_demand": gear}) as car:
        while (float(car["vx"]) - speed) * run_up > 0.0 and car.time < 5.0:  # part throttle may not get there
            car.step(throttle_demand=throttle, brake_pressure_demand=brake)
        before = float(car["ax"])
        during = []
        car.step(gear_demand=to)
        while car["gear_shift_status"] != 1:
            during.append(float(car["ax"]))
            car.step()
            assert len(during) < 100, "the shift does not end"
        assert car["gear"] == to
        geared = float(car[f"gear_ratio_{to}"]) * float(car["final_drive_ratio"]) * float(car["wheel_speed_rl"])
        assert car["engine_speed"] == pytest.approx(geared, abs=5.0), "engine and gear are out of step"
        length = len(during)
        for _ in range(20):
            car.step()
            during.append(float(car["ax"]))
        return before, float(car["ax"]), during, length


@pytest.mark.parametrize("brake", [0.0, 0.7e6, 2.0e6])
@pytest.mark.parametrize(("gear", "speed"), DOWN)
def test_downshift_does_not_jerk(gear: int, speed: float, brake: float) -> None:
    before, after, during, length = change(gear, gear - 1, speed, 0.0, brake)
    assert sum(a < min(before, after) - ALLOWED for a in during) <= 1, min(during)
    assert sum(a > max(before, after) + ALLOWED for a in during) <= 1, max(during)
    assert length <= 25


@pytest.mark.parametrize("throttle", [0.3, 0.65, 1.0])
@pytest.mark.parametrize(("gear", "speed"), UP)
def test_upshift_does_not_kick(gear: int, speed: float, throttle: float) -> None:
    before, after, during, length = change(gear, gear + 1, speed, throttle, 0.0)
    coasting = -2.5  # drag, rolling resistance and the tyres' release, no engine
    assert sum(a > max(before, after) + ALLOWED for a in during) <= 1, max(during)
    assert min(during) > coasting
    assert length <= 35


@pytest.mark.parametrize("ignition", [True, False])
def test_shift_ends_although_the_engine_cannot_be_matched(ignition: bool) -> None:
    """An engine that is dead, or whose clutch grips too little to be in step, must not keep the box busy."""
    start: dict[str, Value] = {**DRIVING, "engine_torque_scale": 0.1, "v0": 18.0, "gear0": 3, "gear_demand": 3}
    with Plant(start) as car:
        car.step(0.05, gear_demand=2)
        car.step(1.5, ignition=ignition)
        assert car["gear"] == 2
        assert car["gear_shift_status"] == (1 if ignition else 0)


def test_downshift_of_a_creeping_car_keeps_the_engine_at_idle() -> None:
    with Plant({**DRIVING, "v0": 2.0, "gear0": 2, "gear_demand": 2}) as car:
        car.step(0.2)
        speeds = []
        for _ in range(60):
            car.step(gear_demand=1)
            speeds.append(float(car["engine_speed"]))
        assert (car["gear"], car["gear_shift_status"]) == (1, 1)
        assert max(speeds) < 1.1 * float(car["engine_idle_speed"])
        assert min(speeds) > 0.85 * float(car["engine_idle_speed"])


def test_energy_of_a_blip_is_the_engines_work() -> None:
    with Plant({**DRIVING, "v0": 9.5, "gear0": 2, "gear_demand": 2}) as car:
        car.step(0.1)
        work, speed = float(car["energy_engine"]), float(car["engine_speed"])
        car.step(0.1, gear_demand=1)
        gain = 0.5 * float(car["engine_inertia"]) * (float(car["engine_speed"]) ** 2 - speed**2)
        assert gain > 2000.0
        assert float(car["energy_engine"]) - work == pytest.approx(gain, rel=1e-3)
        assert math.isclose(float(car["energy_error"]), 0.0, abs_tol=1e-6)
