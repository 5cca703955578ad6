"""The tracking table against closed forms on a circle, and plan reassembly."""

from __future__ import annotations

import numpy as np
import pytest

from tools.tracking import Plans, plans_from_points, tracking_errors, tracking_table, wrap_angle

RADIUS = 233.1


def circle_plan(start_angle: float, count: int = 32, spacing: float = 7.5) -> tuple[np.ndarray, ...]:
    angle = start_angle + np.arange(count) * spacing / RADIUS
    return (
        RADIUS * np.cos(angle),
        RADIUS * np.sin(angle),
        wrap_angle(angle + np.pi / 2),
        np.full(count, 1 / RADIUS),
    )


def plans_on_circle(starts: list[float], period_us: int = 50_000) -> Plans:
    parts = [circle_plan(start) for start in starts]
    count = len(parts[0][0])
    return Plans(
        np.arange(len(starts), dtype=np.int64) * period_us,
        np.arange(len(starts) + 1, dtype=np.int64) * count,
        *(np.concatenate([part[column] for part in parts]) for column in range(4)),
    )


@pytest.mark.parametrize("offset", [-1.2, -0.05, 0.0, 0.3, 2.0])
@pytest.mark.parametrize("slip", [-0.03, 0.0, 0.05])
def test_error_on_a_circle_is_the_radial_offset(offset: float, slip: float) -> None:
    plans = plans_on_circle([0.0, 0.01, 0.02])
    angle = np.linspace(0.021, 0.9, 500)
    time_us = np.linspace(0, 140_000, 500).astype(np.int64)
    radius = RADIUS - offset  # counter-clockwise: left is inside
    errors = tracking_errors(
        time_us, radius * np.cos(angle), radius * np.sin(angle), angle + np.pi / 2 + slip, np.full(500, 60.0), plans
    )
    np.testing.assert_allclose(errors.cross_track, offset, atol=2e-3)
    np.testing.assert_allclose(errors.yaw, slip, atol=2e-4)


def test_samples_without_a_plan_or_without_motion_do_not_count() -> None:
    plans = plans_on_circle([0.0])
    time_us = np.array([-1, 10, 20], dtype=np.int64)
    speed = np.array([30.0, 0.1, 30.0])
    zeros = np.zeros(3)
    errors = tracking_errors(time_us, zeros + RADIUS, zeros, zeros + np.pi / 2, speed, plans)
    assert errors.speed.tolist() == [30.0]


def test_newest_plan_counts_and_a_jump_of_the_path_shows() -> None:
    """The reference is what was published at the time, not what would flatter the car."""
    first, second = circle_plan(0.0), circle_plan(0.0)
    shifted = (second[0] + 1.0, *second[1:])
    plans = Plans(
        np.array([0, 100], dtype=np.int64),
        np.array([0, 32, 64], dtype=np.int64),
        *(np.concatenate([a, b]) for a, b in zip(first, shifted, strict=True)),
    )
    errors = tracking_errors(
        np.array([50, 150], dtype=np.int64),
        np.array([RADIUS, RADIUS]),
        np.zeros(2),
        np.full(2, np.pi / 2),
        np.full(2, 20.0),
        plans,
    )
    np.testing.assert_allclose(errors.cross_track, [0.0, 1.0], atol=1e-6)


def test_table_splits_by_speed_and_leaves_empty_ranges_open() -> None:
    plans = plans_on_circle([0.0])
    angle = np.array([0.1, 0.2, 0.3])
    radius = RADIUS - np.array([0.1, -0.3, 0.2])
    speed = np.array([50.0, 99.9, 160.0]) / 3.6
    errors = tracking_errors(
        np.array([1, 2, 3], dtype=np.int64),
        radius * np.cos(angle),
        radius * np.sin(angle),
        angle + np.pi / 2,
        speed,
        plans,
    )
    low, middle, high = tracking_table(errors)
    assert low["cte_max_m"] == pytest.approx(0.3, abs=2e-3)
    assert low["cte_abs_mean_m"] == pytest.approx(0.2, abs=2e-3)
    assert low["cte_std_m"] == pytest.approx(0.2, abs=2e-3)
    assert middle["cte_max_m"] is None
    assert middle["samples"] == 0
    assert high["cte_max_m"] == pytest.approx(0.2, abs=2e-3)


def test_points_are_cut_into_plans_where_the_counter_changes() -> None:
    counter = np.array([3, 3, 3, 4, 4, 4], dtype=np.int64)
    index = np.array([0, 1, 2, 0, 1, 2], dtype=np.int64)
    time_us = np.arange(6, dtype=np.int64) * 100
    points = [np.arange(6.0)] * 4
    plans = plans_from_points(counter, index, time_us, *points)
    assert plans.start.tolist() == [0, 3, 6]
    assert plans.time_us.tolist() == [200, 500]
    with pytest.raises(ValueError, match="out of order"):
        plans_from_points(counter, np.array([0, 2, 1, 0, 1, 2], dtype=np.int64), time_us, *points)
    assert plans_from_points(counter[:0], index[:0], time_us[:0], *(p[:0] for p in points)).time_us.size == 0


@pytest.mark.parametrize(("angle", "wrapped"), [(np.pi, np.pi), (-np.pi, np.pi), (3.2, 3.2 - 2 * np.pi), (0.0, 0.0)])
def test_angles_wrap_to_the_half_open_interval(angle: float, wrapped: float) -> None:
    assert wrap_angle(np.array([angle]))[0] == pytest.approx(wrapped)
