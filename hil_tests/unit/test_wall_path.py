"""The emergency controller's parts: the wall off the bus, the geometry beside it, and the commands that follow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import FRAME_SIZE

TICK_US = 10_000
STRAIGHT = (-6.0, 0.0, 0.0, 0.0)


def polynomial(coefficients: tuple[float, ...], begin: float = -20.0, end: float = 60.0) -> Any:
    return ffi.new("wall_polynomial *", {"coefficient": coefficients, "begin": begin, "end": end})


def frame(name: str, *values: float) -> Any:
    c = ffi.new("can_frame *")
    ffi.memmove(c, database.message(name).frame(*values), FRAME_SIZE)
    return c


def line(counter: int, offset: float = -6.0, slope: float = 0.02, order: int = 3) -> Any:
    return frame("wall_line", offset, slope, order, 0.01, 100.0, counter)


def bend(counter: int, second: float = 1e-3, third: float = 2e-6) -> Any:
    return frame("wall_bend", second, third, -20.0, 55.0, counter)


class Receiver:
    def __init__(self) -> None:
        self.c = ffi.new("wall_receiver *")

    def push(self, now_us: int, *frames: Any) -> int:
        """Walls so far."""
        for one in frames:
            lib.wall_receiver_push(self.c, one, now_us)
        return int(self.c.count)


def test_a_wall_is_two_halves_with_one_counter() -> None:
    receiver = Receiver()
    assert lib.wall_receiver_age_ms(receiver.c, 10**9) == 65535
    assert receiver.push(100_000, line(1)) == 0
    assert receiver.push(110_000, bend(1)) == 1
    assert list(receiver.c.wall.coefficient) == pytest.approx([-6.0, 0.02, 1e-3, 2e-6])
    assert (receiver.c.wall.begin, receiver.c.wall.end) == (-20.0, 55.0)
    assert lib.wall_receiver_age_ms(receiver.c, 250_000) == 150, "as old as its first half"
    assert receiver.push(150_000, bend(2), line(2, offset=-7.0)) == 2, "in whatever order"
    assert receiver.c.wall.coefficient[0] == pytest.approx(-7.0)


@pytest.mark.parametrize(
    "frames",
    [
        (line(2), bend(1)),
        (line(2), bend(3)),
        (line(1), bend(1)),
        (line(2, order=0), bend(2)),
        (line(2),),
        (bend(2),),
    ],
    ids=["old bend", "later bend", "the same again", "none found", "no bend", "no line"],
)
def test_what_is_no_new_wall(frames: tuple[Any, ...]) -> None:
    receiver = Receiver()
    assert receiver.push(0, line(1), bend(1)) == 1
    assert receiver.push(50_000, *frames) == 1
    assert lib.wall_receiver_age_ms(receiver.c, 50_000) == 50


def test_a_short_frame_is_dropped() -> None:
    receiver, short = Receiver(), line(1)
    short.dlc = 7
    assert receiver.push(0, short, bend(1)) == 0


def test_the_time_out_is_that_of_the_messages() -> None:
    assert lib.wall_receiver_timeout_ms() * 1000 == database.message("wall_line").timeout_us == 150_000


# --- geometry


def circle(distance: float, radius: float) -> tuple[float, float, float, float]:
    """Taylor's polynomial of a wall on the right that bends to the left with a radius."""
    return (-distance, 0.0, 0.5 / radius, 0.0)


@pytest.mark.parametrize("heading", [-0.2, 0.0, 0.15])
@pytest.mark.parametrize("distance", [0.4, 3.0, 12.0])
def test_foot_on_a_straight_wall(distance: float, heading: float) -> None:
    wall = polynomial((-distance / math.cos(heading), -math.tan(heading), 0.0, 0.0))
    foot = ffi.new("wall_foot *")
    lib.wall_path_foot(wall, 0.0, 0.0, foot)
    assert (foot.distance, foot.side, foot.curvature) == pytest.approx((distance, 1.0, 0.0), abs=1e-4)
    assert foot.x == pytest.approx(-distance * math.sin(heading), abs=1e-4)
    lib.wall_path_foot(wall, 0.0, -2.0 * distance / math.cos(heading), foot)
    assert foot.side == -1.0


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (3.0, 0.5), (6.0, -1.0)])
def test_foot_on_a_circle(x: float, y: float) -> None:
    radius, distance = 240.0, 8.0
    foot = ffi.new("wall_foot *")
    lib.wall_path_foot(polynomial(circle(distance, radius)), x, y, foot)
    centre = radius - distance
    assert foot.distance == pytest.approx(radius - math.hypot(x, centre - y), abs=5e-3)
    assert foot.curvature == pytest.approx(1.0 / radius, rel=1e-2)


def test_the_path_keeps_the_distance_or_the_bias() -> None:
    """The paper's rule: from the car when the wall is farther than 1.5 m, else parallel with a bias of 1.5 m."""
    assert [lib.wall_path_distance(d) for d in (0.0, 1.49, 1.5, 1.51, 9.0)] == pytest.approx([1.5, 1.5, 1.5, 1.51, 9.0])


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("lookahead", [8.0, 28.0, 45.0])
def test_target_on_a_parallel(lookahead: float, side: float) -> None:
    radius, distance = 240.0, 6.0
    c = circle(distance, radius)
    wall = polynomial(tuple(side * value for value in c))
    target = lib.wall_path_target(wall, side, distance, 0.0, 0.0, lookahead)
    assert math.hypot(target.x, target.y) == pytest.approx(lookahead, abs=0.05)
    foot = ffi.new("wall_foot *")
    lib.wall_path_foot(wall, target.x, target.y, foot)
    assert (foot.distance, foot.side) == pytest.approx((distance, side), abs=1e-2)
    assert target.x > 0.0


def test_target_no_farther_than_the_wall_was_seen() -> None:
    target = lib.wall_path_target(polynomial(STRAIGHT, end=15.0), 1.0, 6.0, 0.0, 0.0, 45.0)
    assert (target.x, target.y) == pytest.approx((15.0, 0.0), abs=1e-5)


# --- the controller


class Controller:
    """With a car that is where the polynomials say."""

    def __init__(self, speed: float = 60.0) -> None:
        self.c = ffi.new("emergency *")
        self.predictor = ffi.new("motion_predictor *")
        self.out = ffi.new("emergency_output *")
        self.count = 0
        self.wall: Any = ffi.NULL
        self.input = ffi.new("emergency_input *", {"wheel_speed": speed, "wall_timeout_ms": 150, "wall_age_ms": 65535})

    def see(self, coefficients: tuple[float, ...]) -> None:
        self.wall = polynomial(coefficients)
        self.count += 1
        self.input.wall, self.input.wall_count, self.input.wall_age_ms = self.wall, self.count, 0

    def step(self, count: int = 1) -> Any:
        for _ in range(count):
            lib.emergency_step(self.c, self.input, self.predictor, self.out)
            self.input.wall_age_ms = min(self.input.wall_age_ms + 10, 65535)
        return self.out


def test_nothing_to_follow_before_the_first_wall() -> None:
    controller = Controller()
    assert not controller.step(5).valid
    controller.input.wall_age_ms = 0  # a zeroed age without a wall is none
    controller.input.engaged = True
    assert not controller.step().valid


@pytest.mark.parametrize(("engaged", "valid_ms"), [(False, 150), (True, 150 + lib.EMERGENCY_HOLD_MS)])
def test_a_wall_lasts_for_its_time_and_is_held_only_while_engaged(engaged: bool, valid_ms: int) -> None:
    controller = Controller()
    controller.see(circle(6.0, 240.0))
    controller.step()
    controller.input.engaged = engaged
    valid = [bool(controller.step().valid) for _ in range(80)]
    assert valid == [True] * (valid_ms // 10) + [False] * (80 - valid_ms // 10)


def test_the_last_curvature_is_held() -> None:
    controller = Controller()
    controller.see(circle(6.0, 240.0))
    controller.step()
    controller.input.engaged = True
    controller.step(20)
    cornering = ffi.new("vehicle_cornering *")
    lib.vehicle_steady_cornering(60.0, controller.c.curvature, 0.0, cornering)
    assert controller.c.curvature == pytest.approx(1.0 / 240.0, rel=0.02)
    assert controller.step().road_wheel_angle == pytest.approx(cornering.steer)


def test_parallel_to_the_wall_it_steers_straight_whatever_the_distance() -> None:
    for distance in (1.6, 6.0, 14.0):
        controller = Controller()
        controller.see((-distance, 0.0, 0.0, 0.0))
        assert abs(controller.step().road_wheel_angle) < 1e-6


@pytest.mark.parametrize("distance", [0.2, 1.0, 1.4])
def test_a_car_near_the_wall_is_led_away_from_it(distance: float) -> None:
    right, left = Controller(), Controller()
    right.see((-distance, 0.0, 0.0, 0.0))
    left.see((distance, 0.0, 0.0, 0.0))
    angle = right.step().road_wheel_angle
    assert angle > 1e-4
    assert left.step().road_wheel_angle == pytest.approx(-angle)


def test_towards_the_wall_it_steers_away_and_keeps_the_distance_of_the_beginning() -> None:
    controller = Controller()
    controller.see((-5.0, 0.05, 0.0, 0.0))  # the wall comes nearer ahead
    assert controller.step().road_wheel_angle > 1e-3
    controller.input.engaged = True
    controller.see((-3.0, 0.0, 0.0, 0.0))
    controller.step()
    assert controller.c.distance == pytest.approx(5.0, abs=0.02)
    assert controller.out.road_wheel_angle > 1e-4, "back to it"


def test_a_wheel_that_locks_does_not_stop_the_car() -> None:
    controller = Controller(speed=60.0)
    controller.see(STRAIGHT)
    controller.step()
    controller.input.wheel_speed = 0.0
    assert controller.step(100).speed == pytest.approx(60.0 - 15.0, abs=0.01)
    controller.input.wheel_speed = 50.0
    assert controller.step().speed == 50.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_leaves_nothing_that_is_not(bad: float) -> None:
    controller = Controller()
    controller.see(STRAIGHT)
    controller.input.wheel_speed = controller.input.road_wheel_angle = bad
    for _ in range(20):
        out = controller.step()
        assert math.isfinite(out.speed)
        assert not out.valid or math.isfinite(out.road_wheel_angle)
    controller.see((bad, bad, bad, bad))
    assert not controller.step().valid
    controller.see(STRAIGHT)
    controller.input.wheel_speed, controller.input.road_wheel_angle = 40.0, 0.0
    assert controller.step(2).valid, "one bad wall spoils nothing for good"


def test_between_two_walls_it_reckons_its_way() -> None:
    """At constant speed with straight wheels the foot moves along the wall as the car does."""
    controller = Controller(speed=50.0)
    controller.see((-6.0, 0.1, 0.0, 0.0))
    controller.step()
    controller.step(4)
    assert controller.c.car.x == pytest.approx(50.0 * 0.04, abs=1e-3)
    assert controller.c.car.y == pytest.approx(0.0, abs=1e-3)
    controller.see((-6.0, 0.1, 0.0, 0.0))
    controller.step()
    assert controller.c.car.x == 0.0


def test_random_walls_give_finite_commands() -> None:
    generator = np.random.default_rng(1)
    controller = Controller()
    for _ in range(2000):
        scale = (20.0, 1.0, 0.02, 2e-4)
        if generator.random() < 0.3:
            controller.see(tuple(generator.uniform(-1.0, 1.0, 4) * scale))
        controller.input.wheel_speed = generator.uniform(0.0, 80.0)
        controller.input.road_wheel_angle = generator.uniform(-0.28, 0.28)
        controller.input.engaged = bool(generator.random() < 0.5)
        out = controller.step()
        assert math.isfinite(out.road_wheel_angle)
