"""Plans out of a recording: frames in another order make no difference, a missing one costs its plan only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from tools.recorded import Recorded
from tools.tracking import Plans

PLANS, POINTS = 40, 12


def recorded(folder: Path, pose_rows: NDArray[np.int64], motion_rows: NDArray[np.int64]) -> Plans:
    """What is read of 40 plans of 12 points of which these rows were recorded, in this order."""
    folder.mkdir()
    number, index = np.divmod(np.arange(PLANS * POINTS), POINTS)
    x = np.arange(PLANS * POINTS) * 1.0
    counter = (number + 5) % 16
    pose = {"pose_plan_counter": counter, "pose_index": index, "pose_x": x, "pose_y": -x}
    motion = {"motion_plan_counter": counter, "motion_index": index, "motion_yaw": x / 10, "motion_curvature": x / 100}
    for name, columns, rows in (("trajectory_pose", pose, pose_rows), ("trajectory_motion", motion, motion_rows)):
        table = {"time_us": number[rows] * 50_000, **{key: value[rows] * 1.0 for key, value in columns.items()}}
        pq.write_table(pa.table(table), folder / f"{name}.parquet")
    return Recorded(folder, folder / "truth.parquet").plans()


def same(left: Plans, right: Plans) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(vars(left).values(), vars(right).values(), strict=True))


@pytest.fixture
def rows() -> NDArray[np.int64]:
    return np.arange(PLANS * POINTS)


def test_every_point_is_in_its_plan(tmp_path: Path, rows: NDArray[np.int64]) -> None:
    plans = recorded(tmp_path / "all", rows, rows)
    assert np.array_equal(plans.x, rows)
    assert np.array_equal(plans.start, np.arange(PLANS + 1) * POINTS)
    assert np.array_equal(plans.time_us, np.arange(PLANS) * 50_000)


def test_order_within_and_between_plans_makes_no_difference(tmp_path: Path, rows: NDArray[np.int64]) -> None:
    swapped = rows.copy()
    for place in (0, 30, POINTS * 7 - 1, POINTS * 16 - 1):  # the last two across the change of a plan
        swapped[[place, place + 1]] = swapped[[place + 1, place]]
    straight = recorded(tmp_path / "straight", rows, rows)
    assert same(recorded(tmp_path / "pose", swapped, rows), straight)
    assert same(recorded(tmp_path / "motion", rows, swapped), straight)


def test_a_missing_frame_costs_its_plan_only(tmp_path: Path, rows: NDArray[np.int64]) -> None:
    kept = recorded(tmp_path / "gap", np.delete(rows, POINTS * 3 + 4), np.delete(rows, POINTS * 20))
    expected = rows[~np.isin(rows // POINTS, (3, 20))]
    assert np.array_equal(kept.x, expected)
    assert np.array_equal(kept.start, np.arange(PLANS - 1) * POINTS)


def test_nothing_recorded_is_no_plan(tmp_path: Path, rows: NDArray[np.int64]) -> None:
    assert recorded(tmp_path / "none", rows[:0], rows[:0]).x.size == 0
