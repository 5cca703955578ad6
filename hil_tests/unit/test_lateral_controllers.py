"""Lateral controllers and the vehicle model behind them: closed forms, signs, symmetry, limits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from control_rig import LQR, PURE_PURSUIT, STANLEY, Course, make_plan, wrap
from scipy.integrate import solve_ivp

from bridge._native import ffi, lib

CAR = lib.controller_table
WHEELBASE = CAR.cg_to_front + CAR.cg_to_rear
STEP = CAR.steer_step


def cornering(speed: float, curvature: float, bank: float) -> Any:
    out = ffi.new("vehicle_cornering *")
    lib.vehicle_steady_cornering(speed, curvature, bank, out)
    return out


class Controls:
    """Control on a course, the car put where a test wants it."""

    def __init__(self, course: Course, controller: int = LQR) -> None:
        self.course = course
        self.state = ffi.new("control *")
        lib.control_init(self.state)
        self.input = ffi.new("control_input *")
        self.output = ffi.new("control_output *")
        self.plan = make_plan(course, 0.0, lambda _: 50.0, count=60)
        self.input.plan = self.plan
        self.input.lateral = controller
        self.input.max_speed, self.input.max_acceleration, self.input.max_deceleration = 60.0, 5.0, 5.0
        self.input.drive_enabled = True

    def put(self, s: float, speed: float, lateral: float = 0.0, heading: float = 0.0) -> None:
        """Steady cornering at `s`, moved and turned by the errors given."""
        yaw = float(self.course.at("yaw", s))
        curvature, bank = float(self.course.at("curvature", s)), float(self.course.at("bank", s))
        steady = cornering(speed, curvature, bank)
        estimate = self.input.estimate
        estimate.x = float(self.course.at("x", s)) - lateral * math.sin(yaw)
        estimate.y = float(self.course.at("y", s)) + lateral * math.cos(yaw)
        estimate.yaw = wrap(yaw - steady.sideslip + heading)
        estimate.vx, estimate.vy, estimate.yaw_rate = speed, speed * steady.sideslip, steady.yaw_rate
        estimate.valid = True
        self.input.feedback.wheel_speed = speed
        self.input.feedback.road_wheel_angle = steady.steer
        self.state.predictor.angle = steady.steer
        for i in range(lib.CONTROLLER_DEAD_TICKS):
            self.state.predictor.commands[i] = steady.steer

    def step(self) -> Any:
        lib.control_step(self.state, self.input, self.output)
        return self.output


def circle(radius: float, bank: float = 0.0) -> Course:
    return Course.of([(600.0, 1.0 / radius, 1.0 / radius, bank, bank)])


def straight(bank: float = 0.0) -> Course:
    return Course.of([(600.0, 0.0, 0.0, bank, bank)])


# --- vehicle model ---


@pytest.mark.parametrize(("speed", "curvature", "bank"), [(20.0, 0.004, 0.0), (60.0, 0.0043, 0.35), (60.0, 0.0, 0.2)])
def test_steady_cornering_balances_force_and_moment(speed: float, curvature: float, bank: float) -> None:
    """The slip angles must carry the centripetal force less gravity's share, and leave no moment but the axle's."""
    out = cornering(speed, curvature, bank)
    lateral = CAR.mass * (speed**2 * curvature * math.cos(bank) - CAR.gravity * math.sin(bank))
    front, rear = out.slip_front * out.stiffness_front, out.slip_rear * out.stiffness_rear
    assert front + rear == pytest.approx(lateral, rel=1e-4, abs=0.1)
    moment = CAR.cg_to_front * front - CAR.cg_to_rear * rear
    assert moment == pytest.approx(-out.yaw_moment, rel=1e-3, abs=1.0)
    locking = CAR.differential_preload / CAR.driven_radius + CAR.differential_ratio * 2500.0
    assert abs(moment) <= locking * CAR.track_rear
    assert out.steer == pytest.approx(WHEELBASE * curvature + out.slip_front - out.slip_rear, abs=1e-6)
    assert out.sideslip == pytest.approx(CAR.cg_to_rear * curvature - out.slip_rear, abs=1e-6)


def test_bank_that_carries_the_car_needs_no_slip() -> None:
    """At tan(bank) = v2 k / g only the wheelbase and the differential are left to steer for."""
    speed, bank = 28.0, 0.33
    out = cornering(speed, CAR.gravity * math.tan(bank) / speed**2, bank)
    assert out.slip_front * out.stiffness_front + out.slip_rear * out.stiffness_rear == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("speed", [3.0, 20.0, 60.0])
def test_motion_step_follows_the_bicycle(speed: float) -> None:
    tyres, steer = cornering(speed, 0.0, 0.0), 0.01
    cf, cr = tyres.stiffness_front, tyres.stiffness_rear
    lf, lr = CAR.cg_to_front, CAR.cg_to_rear

    def slope(_: float, z: Any) -> list[float]:
        vy, r = z
        front = cf * (steer - (vy + lf * r) / speed)
        rear = cr * (lr * r - vy) / speed
        return [(front + rear) / CAR.mass - speed * r, (lf * front - lr * rear) / CAR.yaw_inertia]

    exact = solve_ivp(slope, (0.0, 0.4), [0.0, 0.0], rtol=1e-9, atol=1e-9).y[:, -1]
    motion = ffi.new("vehicle_motion *")
    for _ in range(40):
        lib.vehicle_motion_step(motion, tyres, speed, 0.0, steer, 0.01)
    assert motion.vy == pytest.approx(exact[0], rel=0.06, abs=2e-3)
    assert motion.yaw_rate == pytest.approx(exact[1], rel=0.04)


@pytest.mark.parametrize("speed", [0.0, 0.01, 0.5])
def test_motion_step_rolls_without_slip_at_walking_pace(speed: float) -> None:
    tyres = cornering(speed, 0.0, 0.0)
    motion = ffi.new("vehicle_motion *")
    for _ in range(50):
        lib.vehicle_motion_step(motion, tyres, speed, 0.0, 0.1, 0.01)
    assert motion.yaw_rate == pytest.approx(speed * 0.1 / WHEELBASE, rel=0.02, abs=1e-7)


def test_prediction_knows_the_commands_on_their_way() -> None:
    predictor = ffi.new("motion_predictor *")
    out = ffi.new("motion_prediction *")
    tyres, now = cornering(40.0, 0.0, 0.0), ffi.new("vehicle_motion *")
    lib.motion_predictor_predict(predictor, now, tyres, 40.0, 0.0, out)
    assert (out.motion.y, out.motion.yaw_rate, out.steer) == (0.0, 0.0, 0.0)
    assert out.motion.x == pytest.approx(40.0 * 0.01 * lib.CONTROLLER_DEAD_TICKS, rel=1e-5)
    lib.motion_predictor_update(predictor, 0.05, math.nan)
    for _ in range(lib.CONTROLLER_DEAD_TICKS):
        before = predictor.angle
        lib.motion_predictor_update(predictor, 0.05, math.nan)
    assert before == 0.0
    assert predictor.angle > 0.0
    lib.motion_predictor_predict(predictor, now, tyres, 40.0, 0.0, out)
    assert out.steer > predictor.angle
    assert out.motion.yaw_rate > 0.0


def test_reported_angle_pulls_the_observer() -> None:
    predictor = ffi.new("motion_predictor *")
    for _ in range(100):
        lib.motion_predictor_update(predictor, 0.0, 0.02)
    assert 0.005 < predictor.angle < 0.02


# --- controllers ---


@pytest.mark.parametrize("controller", [LQR, STANLEY, PURE_PURSUIT])
@pytest.mark.parametrize(("speed", "bank"), [(15.0, 0.0), (40.0, 0.2), (63.0, 0.35)])
def test_on_the_path_every_controller_holds_the_turn(controller: int, speed: float, bank: float) -> None:
    controls = Controls(circle(233.1, bank), controller)
    controls.put(150.0, speed)
    steady = cornering(speed, 1.0 / 233.1, bank)
    assert controls.step().road_wheel_angle[controller] == pytest.approx(steady.steer, abs=1.2e-3)
    assert abs(controls.output.road_wheel_command - steady.steer) < 1.2e-3 + STEP


@pytest.mark.parametrize("controller", [LQR, STANLEY, PURE_PURSUIT])
@pytest.mark.parametrize("speed", [2.0, 14.0, 63.0])
@pytest.mark.parametrize(("lateral", "heading"), [(0.5, 0.0), (0.0, 0.02), (0.5, 0.02)])
def test_every_controller_steers_back_and_is_symmetric(
    controller: int, speed: float, lateral: float, heading: float
) -> None:
    wishes = []
    for sign in (1, -1):
        controls = Controls(straight(), controller)
        controls.put(150.0, speed, sign * lateral, sign * heading)
        output = controls.step()
        assert output.cross_track_error == pytest.approx(sign * lateral, abs=1e-3)
        assert output.heading_error == pytest.approx(sign * heading, abs=1e-4)
        wishes.append(output.road_wheel_angle[controller])
    assert wishes[0] < -5e-4
    assert wishes[1] == pytest.approx(-wishes[0], rel=1e-3, abs=1e-5)


def test_every_controller_runs_whoever_is_chosen() -> None:
    commands = {}
    for controller in (LQR, STANLEY, PURE_PURSUIT):
        controls = Controls(circle(300.0), controller)
        controls.put(100.0, 30.0, 0.3)
        commands[controller] = list(controls.step().road_wheel_angle)[1:4]
        assert controls.output.road_wheel_command == pytest.approx(commands[controller][controller - 1], abs=STEP)
    assert commands[LQR] == commands[STANLEY] == commands[PURE_PURSUIT]
    assert len(set(commands[LQR])) == 3


def test_preview_steers_before_the_turn_begins() -> None:
    course = Course.of([(200.0, 0.0, 0.0, 0.0, 0.0), (15.0, 0.0, 0.004, 0.0, 0.0), (300.0, 0.004, 0.004, 0.0, 0.0)])
    far, near = Controls(course), Controls(course)
    far.put(140.0, 60.0)
    near.put(190.0, 60.0)
    assert abs(far.step().road_wheel_angle[LQR]) < 1e-4
    assert near.step().road_wheel_angle[LQR] > 1e-3


def test_integral_winds_up_slowly_and_not_beyond_its_bound() -> None:
    controls = Controls(straight())
    controls.put(100.0, 60.0, lateral=-3.0)
    for _ in range(100):
        controls.step()
    after_a_second = controls.state.lqr.integral
    assert 0.0 < after_a_second <= 0.5 * CAR.lqr_gain[24][6] * 1.01
    for _ in range(20000):
        controls.step()
    assert controls.state.lqr.integral == pytest.approx(0.02)


@pytest.mark.parametrize("controller", [0, STANLEY, PURE_PURSUIT, 4, 5, 255])
def test_integral_rests_while_another_controller_drives(controller: int) -> None:
    controls = Controls(straight(), controller)
    controls.put(100.0, 60.0, lateral=-0.4)
    for _ in range(50):
        controls.step()
    assert controls.state.lqr.integral == 0.0


def test_wheels_are_not_turned_on_the_spot() -> None:
    controls = Controls(straight())
    controls.put(100.0, 40.0, lateral=-0.5)
    moving = controls.step().road_wheel_command
    assert moving > 0.0
    controls.put(100.0, 0.0, lateral=2.0)
    for _ in range(50):
        assert controls.step().road_wheel_command == moving
    assert controls.state.lqr.integral == 0.0


@pytest.mark.parametrize("controller", [LQR, STANLEY, PURE_PURSUIT])
@pytest.mark.parametrize("speed", [0.6, 5.0, 63.0])
def test_command_stays_within_the_rack(controller: int, speed: float) -> None:
    controls = Controls(straight(), controller)
    controls.put(100.0, speed, lateral=40.0, heading=2.5)
    for _ in range(10):
        assert abs(controls.step().road_wheel_command) <= CAR.steer_max + 0.5 * STEP


def test_commands_are_whole_steps_and_right_on_average() -> None:
    controls = Controls(circle(800.0), STANLEY)
    controls.put(100.0, 30.0)
    controls.input.lateral = STANLEY
    wishes, commands = [], []
    for _ in range(400):
        output = controls.step()
        wishes.append(output.road_wheel_angle[STANLEY])
        commands.append(output.road_wheel_command)
    steps = np.array(commands) / STEP
    assert np.abs(steps - np.round(steps)).max() < 1e-3
    assert np.mean(commands) == pytest.approx(np.mean(wishes), abs=0.01 * STEP)


@pytest.mark.parametrize("field", ["x", "y", "yaw", "vx", "vy", "yaw_rate", "ax", "ay"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_estimate_with_a_bad_number_is_no_estimate(field: str, value: float) -> None:
    controls = Controls(straight())
    controls.put(100.0, 40.0, lateral=-0.5)
    held = controls.step().road_wheel_command
    setattr(controls.input.estimate, field, value)
    for _ in range(30):
        output = controls.step()
        assert not output.lateral_valid
        assert output.road_wheel_command == held
        assert output.throttle == 0.0
    assert output.brake_pressure > 0.0


def test_without_a_plan_the_car_is_braked_straight_on() -> None:
    controls = Controls(straight())
    controls.put(100.0, 40.0)
    controls.input.plan = ffi.NULL
    for _ in range(30):
        output = controls.step()
    assert not output.lateral_valid
    assert output.throttle == 0.0
    assert output.brake_pressure > 3e5


@pytest.mark.parametrize(("wheel", "estimated"), [(0.0, 40.0), (40.0, 0.0), (1.0, 60.0), (60.0, 30.0)])
def test_a_source_of_speed_that_hangs_does_not_make_the_car_run_away(wheel: float, estimated: float) -> None:
    """Wheels that lock or a stuck sensor, and an estimate that hangs: the faster of the two counts."""
    controls = Controls(straight())
    controls.input.max_speed = 20.0
    for _ in range(100):
        controls.put(100.0, estimated)
        controls.input.feedback.wheel_speed = wheel
        controls.input.feedback.gear, controls.input.feedback.gear_shift_status = 3, lib.GEAR_SHIFT_READY
        controls.input.feedback.engine_speed = 400.0
        output = controls.step()
    assert (output.throttle, output.brake_pressure > 0.0) == (0.0, True)
    assert output.speed_error < 0.0


@pytest.mark.parametrize("ends_in_stop", [False, True])
def test_beyond_the_last_point_the_car_is_braked(ends_in_stop: bool) -> None:
    """A planner that repeats an old plan drives nobody off its end."""
    controls = Controls(straight())
    controls.plan = make_plan(controls.course, 0.0, lambda _: 50.0, count=10, ends_in_stop=ends_in_stop)
    controls.input.plan = controls.plan
    end = float(controls.plan.points[9].s)
    for s, brakes in ((end - 30.0, False), (end + 1.0, True), (end + 400.0, True)):
        controls.put(s, 40.0)
        controls.input.estimate.x = s
        for _ in range(30):
            output = controls.step()
        assert (output.brake_pressure > 0.0) is brakes, s
        assert output.lateral_valid


@pytest.mark.parametrize("seed", range(3))
def test_no_input_makes_a_command_leave_its_range(seed: int) -> None:
    print(f"seed {seed}")
    random = np.random.default_rng(seed)
    controls = Controls(circle(100.0))
    odd = [math.nan, math.inf, -math.inf, 0.0, 1e30, -1e30, 1e-30]
    for _ in range(3000):
        controls.put(float(random.uniform(0, 300)), float(random.uniform(0, 80)), float(random.normal(0, 5)))
        i = controls.input
        for struct in (i.estimate, i.feedback):
            for name in dir(struct):
                if random.random() < 0.05 and isinstance(getattr(struct, name), float):
                    setattr(struct, name, float(random.choice(odd)))
        for name in ("max_speed", "max_acceleration", "max_deceleration"):
            setattr(i, name, float(random.choice([*odd, 5.0, 50.0])))
        i.lateral = int(random.integers(0, 256))
        i.feedback.gear, i.feedback.gear_shift_status = int(random.integers(0, 256)), int(random.integers(0, 8))
        i.drive_enabled, i.safe_stop = bool(random.integers(2)), bool(random.integers(2))
        output = controls.step()
        assert abs(output.road_wheel_command) <= CAR.steer_max + 0.5 * STEP
        assert 0.0 <= output.throttle <= 1.0
        assert 0.0 <= output.brake_pressure <= 6.0e6
        assert output.throttle == 0.0 or output.brake_pressure == 0.0
        assert output.gear <= 6
