"""Boxes of the smallest circumference against every edge of scipy's convex hull, and against known shapes."""

import math

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from autonomy._native import ffi, lib

SEED = 20261130


@pytest.fixture(scope="module")
def hull():
    return ffi.new("oriented_box_hull *")


def fit(hull, points):
    points = np.asarray(points, dtype=np.float32)
    points = points[np.lexsort((points[:, 1], points[:, 0]))]
    x, y = (np.ascontiguousarray(points[:, i]) for i in (0, 1))
    return lib.oriented_box_fit(hull, ffi.from_buffer("float[]", x), ffi.from_buffer("float[]", y), len(points))


def turned(points, angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(points) @ np.array([[c, s], [-s, c]])


def smallest(points):
    """Circumference of the smallest box, by all edges."""
    corners = points[ConvexHull(points).vertices]
    best = math.inf
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        angle = math.atan2(*(b - a)[::-1])
        sides = np.ptp(turned(corners, -angle), axis=0)
        best = min(best, 2.0 * sides.sum())
    return best


def off_axis(yaw, angle):
    return abs(math.remainder(yaw - angle, math.pi))


@pytest.mark.parametrize("count", [3, 4, 7, 40, 2000])
def test_no_edge_of_the_hull_gives_a_smaller_box(hull, count):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    for _ in range(30):
        points = turned(rng.normal(0.0, [2.0, 0.6], (count, 2)), rng.uniform(0.0, math.pi)) + rng.uniform(-60, 60, 2)
        points = points.astype(np.float32).astype(float)
        box = fit(hull, points)
        assert 2.0 * (box.length + box.width) == pytest.approx(smallest(points), abs=2e-4)
        assert box.length >= box.width >= 0.0
        assert -math.pi / 2 < box.yaw <= math.pi / 2
        # It holds all points and touches them on every side.
        inside = turned(points - [box.x, box.y], -box.yaw)
        assert inside.max(axis=0) == pytest.approx([box.length / 2, box.width / 2], abs=1e-4)
        assert inside.min(axis=0) == pytest.approx([-box.length / 2, -box.width / 2], abs=1e-4)


def test_points_on_a_circle_go_around_once(hull):
    angle = np.linspace(0.0, 2.0 * math.pi, 5000, endpoint=False)
    box = fit(hull, np.column_stack((3.0 * np.cos(angle), 3.0 * np.sin(angle))))
    assert (box.length, box.width) == pytest.approx((6.0, 6.0), abs=1e-3)


@pytest.mark.parametrize("angle", np.linspace(-1.5, 1.5, 13))
def test_the_near_sides_of_a_car_give_its_box(hull, angle):
    """An L: the box along the line between its ends has the same area, so area would not tell."""
    rng = np.random.default_rng(SEED)
    rear = np.column_stack((np.full(40, -2.45), np.linspace(-0.965, 0.965, 40)))
    side = np.column_stack((np.linspace(-2.45, 2.45, 90), np.full(90, -0.965)))
    points = np.concatenate((rear, side)) + rng.normal(0.0, 0.003, (130, 2))
    box = fit(hull, np.add(turned(points, angle), [30.0, -4.0]))
    assert (box.length, box.width) == pytest.approx((4.9, 1.93), abs=0.03)
    assert off_axis(box.yaw, angle) < 0.02
    assert (box.x, box.y) == pytest.approx((30.0, -4.0), abs=0.03)


@pytest.mark.parametrize("angle", np.linspace(-1.5, 1.5, 7))
def test_turning_and_moving_the_points_turns_and_moves_the_box(hull, angle):
    points = np.random.default_rng(SEED).normal(0.0, [3.0, 0.7], (60, 2))
    plain, moved = fit(hull, points), fit(hull, np.add(turned(points, angle), [12.0, 35.0]))
    assert (moved.length, moved.width) == pytest.approx((plain.length, plain.width), abs=1e-4)
    assert off_axis(moved.yaw, plain.yaw + angle) < 1e-4
    assert (moved.x, moved.y) == pytest.approx(np.add(turned([plain.x, plain.y], angle), [12.0, 35.0]), abs=1e-4)


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([(3, -4)], (3, -4, 0, 0, 0)),
        ([(3, -4)] * 5, (3, -4, 0, 0, 0)),
        ([(0, 0), (3, 4)], (1.5, 2, 5, 0, math.atan2(4, 3))),
        ([(0, 0), (0, 4), (0, 1), (0, 4)], (0, 2, 4, 0, math.pi / 2)),
        ([(-1, 2), (3, 2), (1, 2)], (1, 2, 4, 0, 0)),
        ([(0, 0), (1e-25, 1e-25), (2e-25, 0)], (0, 0, 0, 0, 0)),
        ([(0, 0), (1e-25, 1e-25), (2, 0)], (1, 0, 2, 0, 0)),
        ([(0, 0), (4, 0), (4, 1), (0, 1), (2, 0.5)], (2, 0.5, 4, 1, 0)),
        ([(0, 0), (1, 0), (1, 4), (0, 4)], (0.5, 2, 4, 1, math.pi / 2)),
        ([(0, 0), (2, 0), (2, 2), (0, 2)], (1, 1, 2, 2, 0)),
    ],
)
def test_small_sets(hull, points, expected):
    box = fit(hull, points)
    assert (box.x, box.y, box.length, box.width, box.yaw) == pytest.approx(expected, abs=1e-6)
