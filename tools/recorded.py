"""Reads a recording: signals as they were on the bus, truth as the plant had it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dbc.codec import database
from tools.tracking import Plans, plans_from_points

Column = NDArray[np.float64]


class Recorded:
    """One recording.

    Parameters
    ----------
    signals : folder with one Parquet file per message.
    truth : Parquet file of the plant's outputs.
    """

    def __init__(self, signals: Path, truth: Path) -> None:
        self._signals = signals
        self._truth = truth

    def message(self, name: str) -> Mapping[str, Column]:
        """Columns of a message by signal, and `time_us`; all empty when it was never sent."""
        path = self._signals / f"{name}.parquet"
        if not path.exists():
            return {signal: np.zeros(0) for signal in ("time_us", *database.message(name).signals)}
        return _columns(path)

    @cached_property
    def truth(self) -> Mapping[str, Column]:
        """The plant's outputs every tick, SI units, and `time_us`."""
        return _columns(self._truth)

    def plans(self) -> Plans:
        """Every plan that was published, from its frames on CAN-A.

        Raises
        ------
        ValueError
            When the frames of a plan are out of order, which the planner never does.
        """
        pose, motion = self.message("trajectory_pose"), self.message("trajectory_motion")
        count = min(pose["time_us"].size, motion["time_us"].size)  # the last plan may be cut off
        if not np.array_equal(pose["pose_index"][:count], motion["motion_index"][:count]):
            raise ValueError("trajectory_pose and trajectory_motion do not alternate")
        return plans_from_points(
            pose["pose_plan_counter"][:count].astype(np.int64),
            pose["pose_index"][:count].astype(np.int64),
            motion["time_us"][:count].astype(np.int64),
            pose["pose_x"][:count],
            pose["pose_y"][:count],
            motion["motion_yaw"][:count],
            motion["motion_curvature"][:count],
        )


def _columns(path: Path) -> dict[str, Column]:
    table = pq.read_table(path)
    return {name: table.column(name).to_numpy() for name in table.column_names}
