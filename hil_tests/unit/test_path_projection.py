"""The plan as a smooth path against circles and straights."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from control_rig import Course, make_plan, wrap

from bridge._native import ffi, lib

RADIUS = 233.1


def circle(spacing: float, direction: int = 1) -> tuple[Course, Any]:
    course = Course.of([(600.0, direction / RADIUS, direction / RADIUS, 0.3, 0.3)])
    return course, make_plan(course, 0.0, lambda _: 50.0, spacing=spacing, count=60)


def project(plan: Any, x: float, y: float) -> Any:
    projection = ffi.new("path_projection *")
    lib.path_project(plan, x, y, projection)
    return projection


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("spacing", [3.0, 6.0, 8.0])
def test_offsets_from_a_circle_are_exact_to_millimetres(spacing: float, direction: int) -> None:
    _, plan = circle(spacing, direction)
    centre_y = direction * RADIUS
    for s in np.arange(1.0, 59 * spacing - 1.0, 1.37):
        for lateral in (-5.0, -0.1, 0.0, 0.4, 7.0):
            angle = direction * s / RADIUS
            radius = RADIUS - direction * lateral
            x = radius * math.sin(direction * angle)
            y = centre_y - direction * radius * math.cos(angle)
            got = project(plan, x, y)
            assert got.lateral == pytest.approx(lateral, abs=2e-3)
            assert got.foot.s == pytest.approx(s, abs=2e-2)
            assert wrap(got.foot.yaw - angle) == pytest.approx(0.0, abs=1e-3)  # positions are rounded to a millimetre
            assert not got.outside


def test_path_is_continuous_across_points() -> None:
    _, plan = circle(6.0)
    point = ffi.new("path_point *")
    rows = []
    for s in np.arange(0.0, 120.0, 0.01):
        lib.path_at(plan, s, point)
        rows.append((point.x, point.y, point.yaw))
    steps = np.abs(np.diff(np.array(rows), axis=0))
    assert steps[:, :2].max() < 0.0105
    assert steps[:, 2].max() < 3e-4


def test_speed_between_points_is_constant_acceleration() -> None:
    course = Course.of([(100.0, 0.0, 0.0, 0.0, 0.0)])
    plan = make_plan(course, 0.0, lambda s: math.sqrt(max(0.0, 2 * 4.0 * (40.0 - s))), spacing=8.0, count=10)
    point = ffi.new("path_point *")
    for s in (1.0, 13.0, 30.0, 38.5):
        lib.path_at(plan, s, point)
        assert point.speed == pytest.approx(math.sqrt(8.0 * (40.0 - s)), abs=0.03)
        assert point.acceleration == pytest.approx(-4.0, abs=0.06)


@pytest.mark.parametrize("ends_in_stop", [True, False])
def test_path_goes_straight_on_beyond_its_ends(ends_in_stop: bool) -> None:
    course = Course.of([(100.0, 0.0, 0.0, 0.0, 0.0)])
    plan = make_plan(course, 10.0, lambda _: 20.0, spacing=5.0, count=5, ends_in_stop=ends_in_stop)
    before, beyond = project(plan, 7.0, 1.5), project(plan, 40.0, -2.0)
    assert (before.outside, beyond.outside) == (True, True)
    assert before.foot.s == pytest.approx(-3.0, abs=1e-4)
    assert before.lateral == pytest.approx(1.5, abs=1e-4)
    assert before.foot.speed == pytest.approx(20.0)
    assert beyond.foot.s == pytest.approx(30.0, abs=1e-4)
    assert beyond.lateral == pytest.approx(-2.0, abs=1e-4)
    assert beyond.foot.speed == (0.0 if ends_in_stop else pytest.approx(20.0))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_positions_that_are_no_numbers_do_no_harm(value: float) -> None:
    _, plan = circle(6.0)
    point = ffi.new("path_point *")
    lib.path_at(plan, value, point)
    lib.path_project(plan, value, 1.0, ffi.new("path_projection *"))
    lib.path_project(plan, 1.0, value, ffi.new("path_projection *"))


def test_points_on_top_of_each_other_keep_their_direction() -> None:
    plan = ffi.new("trajectory *")
    plan.count = 4
    for i in range(4):
        plan.points[i].yaw, plan.points[i].x, plan.points[i].y = 0.7, 3.0, 4.0
    got = project(plan, 3.0, 4.0)
    assert got.foot.yaw == pytest.approx(0.7)
    assert math.isfinite(got.lateral)
