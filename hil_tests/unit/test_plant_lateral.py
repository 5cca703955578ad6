"""Cornering against the linear bicycle model, banking, the oval asymmetry, the steering actuator."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from plant_fmu.driver import Plant, Value

SYMMETRIC: dict[str, Value] = {"oval_asymmetry": 0.0}
DRIVING: dict[str, Value] = {"engine_running0": True, "ignition": True}
OPEN_DIFFERENTIAL: dict[str, Value] = {"differential_preload": 0.0, "differential_lock_ratio": 0.0}


def cruise(gear: int, speed: float) -> dict[str, Value]:
    return {**DRIVING, "v0": speed, "gear0": gear, "gear_demand": gear}


def hold_speed(car: Plant, speed: float, seconds: float, integral: float = 0.3) -> float:
    """Hold a speed with a PI throttle; return the integral to carry on with."""
    for _ in range(round(seconds / car.step_s)):
        error = speed - float(car["vx"])
        integral += 0.3 * error * car.step_s
        car.step(throttle_demand=min(max(integral + 0.3 * error, 0.0), 1.0))
    return integral


def corner(car: Plant, speed: float, yaw_rate: float, seconds: float = 12.0) -> None:
    """Steer with an integral controller until the car turns at `yaw_rate`."""
    integral, steer = 0.4, 0.0
    for step in range(round(seconds / car.step_s)):
        target = yaw_rate * min(1.0, step * car.step_s)
        steer += 8.0 * (target - float(car["yaw_rate"])) * car.step_s
        error = speed - float(car["vx"])
        integral += 0.2 * error * car.step_s
        car.step(steer_motor_demand=steer, throttle_demand=min(max(integral + 0.3 * error, 0.0), 1.0))


def cornering_stiffness(car: Plant, load: float) -> float:
    nominal, pky2 = float(car["tyre_nominal_load"]), float(car["tyre_pky2"])
    return nominal * float(car["tyre_pky1"]) * math.sin(2.0 * math.atan(load / (pky2 * nominal)))


def slip_stiffness(car: Plant, load: float) -> float:
    change = load / float(car["tyre_nominal_load"]) - 1.0
    return load * float(car["tyre_pkx1"]) * math.exp(float(car["tyre_pkx3"]) * change)


@pytest.mark.parametrize("spool", [False, True])
@pytest.mark.parametrize("speed", [15.0, 30.0, 45.0])
def test_small_steering_gives_the_yaw_rate_of_the_linear_bicycle(speed: float, spool: bool) -> None:
    """Below 1 m/s2 the steady turn must follow the linear single-track model.

    With a spool the rear wheels turn alike, so in a turn they slip against each other: a moment
    against the turn of half the slip stiffness of one tyre times the track squared, per r/v. And
    as both slip alike under drive, the more heavily loaded outer one drives more.
    """
    gear = {15.0: 2, 30.0: 3, 45.0: 4}[speed]
    with Plant({**SYMMETRIC, **({} if spool else OPEN_DIFFERENTIAL), **cruise(gear, speed)}) as car:
        road_wheel = 0.6 * 2.971 / speed**2
        car["steer_motor_demand"] = road_wheel * float(car["steer_ratio"])
        hold_speed(car, speed, 12.0)
        lf, lr = float(car["cg_to_front_axle"]), float(car["cg_to_rear_axle"])
        loads = {w: float(car[f"wheel_load_{w}"]) for w in ("fl", "fr", "rl", "rr")}
        front = cornering_stiffness(car, loads["fl"]) + cornering_stiffness(car, loads["fr"])
        rear = cornering_stiffness(car, loads["rl"]) + cornering_stiffness(car, loads["rr"])
        left, right = slip_stiffness(car, loads["rl"]), slip_stiffness(car, loads["rr"])
        track = float(car["track_width_rear"])
        spool_moment = 0.25 * (left + right) * track**2 if spool else 0.0
        drive = float(car["tyre_force_x_rl"]) + float(car["tyre_force_x_rr"])
        drive_moment = 0.5 * track * drive * (right - left) / (right + left) if spool else 0.0
        vx, delta = float(car["vx"]), float(car["steer_wheel_angle"])
        # Steady state of side force and yaw moment in side-slip angle and yaw rate.
        a11, a12 = -(front + rear), -(front * lf - rear * lr) / vx - float(car["mass"]) * vx
        a21, a22 = -(front * lf - rear * lr), -(front * lf**2 + rear * lr**2 + spool_moment) / vx
        determinant = a11 * a22 - a12 * a21
        force, moment = -front * delta, -front * lf * delta - drive_moment
        side_slip = (force * a22 - moment * a12) / determinant
        yaw_rate = (moment * a11 - force * a21) / determinant
        assert delta == pytest.approx(road_wheel, rel=1e-6)
        assert car["yaw_rate"] == pytest.approx(yaw_rate, rel=0.025)
        assert car["slip_angle"] == pytest.approx(side_slip, rel=0.06, abs=4e-5)


def test_steering_to_the_left_turns_left() -> None:
    with Plant({**SYMMETRIC, **cruise(3, 30.0)}) as car:
        car.step(1.0, steer_motor_demand=0.1, throttle_demand=0.2)
        assert float(car["yaw_rate"]) > 0.02
        assert float(car["y"]) > 0.1
        assert float(car["ay"]) > 0.5
        assert float(car["wheel_load_fr"]) > float(car["wheel_load_fl"])
        assert float(car["body_roll"]) > 0.0  # the left side lifts


def test_the_mirrored_turn_is_the_mirror_image() -> None:
    results = []
    for sign in (1.0, -1.0):
        with Plant({**SYMMETRIC, **cruise(3, 30.0)}) as car:
            car.step(3.0, steer_motor_demand=0.3 * sign, throttle_demand=0.2)
            results.append([float(car[n]) * sign for n in ("yaw_rate", "vy", "y", "yaw", "roll")])
    assert results[0] == pytest.approx(results[1], rel=1e-9)


def test_symmetric_car_runs_straight() -> None:
    with Plant({**SYMMETRIC, **cruise(6, 60.0)}) as car:
        car.step(5.0, throttle_demand=0.6)
        assert (car["y"], car["yaw"], car["vy"]) == (0.0, 0.0, 0.0)


def test_oval_set_up_pulls_to_the_left() -> None:
    with Plant(cruise(6, 60.0)) as car:
        car.step(3.0, throttle_demand=0.55)
        assert 2.0 < float(car["y"]) < 15.0
        assert float(car["yaw_rate"]) > 0.01
    with Plant({**cruise(6, 60.0), "oval_asymmetry": -1.0}) as car:
        car.step(3.0, throttle_demand=0.55)
        assert float(car["y"]) < -2.0


def test_oval_set_up_does_nothing_at_standstill() -> None:
    with Plant() as car:
        car.step(5.0)
        assert (car["x"], car["y"], car["yaw"]) == (0.0, 0.0, 0.0)


def test_racing_speed_in_the_banked_turn_with_reserve() -> None:
    """227 km/h on R = 233.1 m with 20 degrees: even on a road with 30 % less grip."""
    bank = math.radians(20.0)
    speed, radius = 63.06, 233.1
    want = speed / radius * math.cos(bank)
    for friction in (1.0, 0.7):
        with Plant({**cruise(5, speed), "road_bank": bank, "road_friction": friction}) as car:
            corner(car, speed, want)
            assert car["yaw_rate"] == pytest.approx(want, rel=0.01)
            assert car["vx"] == pytest.approx(speed, rel=0.01)
            assert abs(float(car["slip_angle"])) < 0.03
            # In-plane and normal balance of a body on a banked circle.
            centripetal = float(car["vx"]) ** 2 / radius
            expected_y = centripetal * math.cos(bank) - 9.81 * math.sin(bank)
            expected_z = centripetal * math.sin(bank) + 9.81 * math.cos(bank)
            assert car["specific_force_y"] == pytest.approx(expected_y, rel=0.02)
            assert car["specific_force_z"] == pytest.approx(expected_z, rel=0.01)
            loads = sum(float(car[f"wheel_load_{w}"]) for w in ("fl", "fr", "rl", "rr"))
            downforce = 0.5 * 1.2 * (0.522 + 1.034) * float(car["vx"]) ** 2
            assert loads == pytest.approx(790.0 * expected_z + downforce, rel=0.01)


def test_plan_view_circle_on_a_banking() -> None:
    """Plan heading turns by v/R per second, and the path is a circle of radius R."""
    bank, speed, radius = math.radians(20.0), 40.0, 233.1
    with Plant({**SYMMETRIC, **cruise(4, speed), "road_bank": bank}) as car:
        corner(car, speed, speed / radius * math.cos(bank), seconds=10.0)
        points, yaw = [], [float(car["yaw"])]
        for _ in range(200):
            car.step(0.01)
            points.append((float(car["x"]), float(car["y"])))
            yaw.append(float(car["yaw"]))
        turned = math.remainder(yaw[-1] - yaw[0], 2.0 * math.pi)
        assert turned / 2.0 == pytest.approx(speed / radius, rel=0.02)
        (x1, y1), (x2, y2), (x3, y3) = points[0], points[100], points[-1]
        a, b, c = math.dist((x1, y1), (x2, y2)), math.dist((x2, y2), (x3, y3)), math.dist((x1, y1), (x3, y3))
        area = 0.5 * abs((x2 - x1) * (y3 - y1) - (x3 - x1) * (y2 - y1))
        assert a * b * c / (4.0 * area) == pytest.approx(radius, rel=0.02)


def test_neutral_speed_on_the_bank_needs_no_side_force() -> None:
    bank, radius = math.radians(20.0), 233.1
    speed = math.sqrt(9.81 * radius * math.tan(bank))
    with Plant({**SYMMETRIC, **OPEN_DIFFERENTIAL, **cruise(3, speed), "road_bank": bank}) as car:
        corner(car, speed, speed / radius * math.cos(bank))
        assert car["specific_force_y"] == pytest.approx(0.0, abs=0.05)
        side = sum(float(car[f"tyre_force_y_{w}"]) for w in ("fl", "fr", "rl", "rr"))
        assert abs(side) < 50.0
        assert abs(float(car["wheel_load_fl"]) - float(car["wheel_load_fr"])) < 20.0


def test_banked_straight_pulls_down_the_slope() -> None:
    with Plant({**SYMMETRIC, **cruise(4, 40.0), "road_bank": math.radians(9.0)}) as car:
        car.step(2.0, throttle_demand=0.3)
        assert float(car["y"]) > 0.2
        assert float(car["roll"]) < math.radians(-8.0)


def test_yaw_stays_wrapped() -> None:
    with Plant({**SYMMETRIC, **cruise(2, 15.0), "yaw0": 3.0}) as car:
        seen = []
        for _ in range(200):
            car.step(0.1, steer_motor_demand=1.0, throttle_demand=0.2)
            seen.append(float(car["yaw"]))
        assert all(-math.pi < yaw <= math.pi for yaw in seen)
        assert min(seen) < -3.0
        assert max(seen) > 3.0


def test_spool_keeps_the_rear_wheels_together() -> None:
    start: dict[str, Value] = {**SYMMETRIC, **cruise(2, 12.0), "steer_motor_demand": 1.5}
    with Plant(start) as car:
        car.step(3.0, throttle_demand=0.15)
        assert car["wheel_speed_rl"] == pytest.approx(float(car["wheel_speed_rr"]), rel=1e-9)
        spool = float(car["yaw_rate"])
    with Plant({**start, **OPEN_DIFFERENTIAL}) as car:
        car.step(3.0, throttle_demand=0.15)
        ratio = float(car["wheel_speed_rr"]) / float(car["wheel_speed_rl"])
        expected = 1.0 + float(car["track_width_rear"]) * float(car["yaw_rate"]) / float(car["vx"])
        assert ratio == pytest.approx(expected, rel=0.01)
        assert float(car["yaw_rate"]) > spool, "a spool resists turning"


def test_steering_dead_time_rate_and_end_stop() -> None:
    with Plant() as car:
        car.step(0.04, steer_motor_demand=10.0)
        assert car["steer_motor_angle"] == 0.0
        angles = []
        for _ in range(150):
            car.step(0.01)
            angles.append(float(car["steer_motor_angle"]))
        rates = [(b - a) / 0.01 for a, b in pairwise(angles)]
        assert max(rates) == pytest.approx(math.radians(500.0), rel=1e-3)
        assert angles[-1] == pytest.approx(math.radians(240.0), rel=1e-3)
        assert max(angles) <= math.radians(240.0) + 1e-12
        assert car["steer_wheel_angle"] == pytest.approx(math.radians(16.0), rel=1e-3)


def test_steering_bandwidth() -> None:
    """At its natural frequency a second-order lag with damping 0.707 passes 0.707."""
    with Plant({"steer_delay": 0.0}, step_s=0.001) as car:
        amplitude, peak = 0.02, 0.0
        for _ in range(3000):
            car.step(steer_motor_demand=amplitude * math.sin(2.0 * math.pi * 3.0 * car.time))
            if car.time > 2.0:
                peak = max(peak, abs(float(car["steer_motor_angle"])))
        assert peak / amplitude == pytest.approx(1.0 / math.sqrt(2.0), rel=0.03)


@pytest.mark.parametrize("speed", [-3.0, 0.0, 0.3])
def test_slow_and_backward_rolling_stays_finite_and_calm(speed: float) -> None:
    with Plant({**SYMMETRIC, "v0": speed, "steer_motor_demand": 2.0}) as car:
        for _ in range(500):
            car.step()
            assert abs(float(car["vx"])) <= abs(speed) + 1e-9
            assert abs(float(car["yaw_rate"])) < 1.0
        assert all(math.isfinite(float(v)) for v in car.outputs().values())


LEFT, RIGHT = ("wheel_grip_fl", "wheel_grip_rl"), ("wheel_grip_fr", "wheel_grip_rr")


def braked(inputs: dict[str, Value]) -> tuple[float, float, float]:
    """Yaw rate, way to the left and speed after half a second with the brake on, from 40 m/s straight ahead."""
    with Plant({**SYMMETRIC, "v0": 40.0, **inputs}) as car:
        for _ in range(50):
            car.step(brake_pressure_demand=1.5e6)
        return float(car["yaw_rate"]), float(car["y"]), float(car["vx"])


def test_grip_of_single_wheels_turns_the_braking_car_to_the_side_that_has_it() -> None:
    straight, slow_left, slow_right = (braked(dict.fromkeys(side, 0.3)) for side in ((), LEFT, RIGHT))
    assert straight[:2] == pytest.approx((0.0, 0.0), abs=1e-9)
    assert slow_left[0] < -0.01, "to the right"
    assert slow_left[1] < 0.0
    assert slow_right == pytest.approx((-slow_left[0], -slow_left[1], slow_left[2]), rel=1e-6)
    assert slow_left[2] > straight[2], "it brakes less"


def test_grip_of_all_wheels_is_that_of_the_road() -> None:
    assert braked(dict.fromkeys(LEFT + RIGHT, 0.5)) == braked({"road_friction": 0.5}) != braked({})
    assert braked(dict.fromkeys(LEFT + RIGHT, -1.0)) == braked({"road_friction": 0.01}), "it saturates"


def test_spin_is_survived() -> None:
    """A hand-brake turn at speed: large slips, backward rolling, then rest. Nothing blows up."""
    with Plant({**SYMMETRIC, "v0": 40.0, "road_friction": 0.5}) as car:
        for _ in range(2000):
            car.step(steer_motor_demand=4.0, brake_pressure_demand=1e6)
            assert abs(float(car["vx"])) < 41.0
            assert abs(float(car["vy"])) < 41.0
            assert abs(float(car["yaw_rate"])) < 10.0
        assert math.hypot(float(car["vx"]), float(car["vy"])) < 1e-6
