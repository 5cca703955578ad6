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
        """Every plan that was published whole, from its frames on CAN-A.

        A plan with a frame missing is left out. Within a plan the order of frames does not matter: a kernel may pass
        on in another order what one station sent.
        """
        pose, motion = self.message("trajectory_pose"), self.message("trajectory_motion")
        pose_number, pose_index = _numbered(pose["pose_plan_counter"]), pose["pose_index"].astype(np.int64)
        motion_number, motion_index = _numbered(motion["motion_plan_counter"]), motion["motion_index"].astype(np.int64)
        point, in_pose, in_motion = np.intersect1d(
            pose_number * _POINTS_MAX + pose_index, motion_number * _POINTS_MAX + motion_index, return_indices=True
        )
        _, plan, count = np.unique(point // _POINTS_MAX, return_inverse=True, return_counts=True)
        last = np.zeros(count.size, np.int64)
        np.maximum.at(last, plan, point % _POINTS_MAX)
        whole = (count == last + 1)[plan]
        in_pose, in_motion = in_pose[whole], in_motion[whole]
        return plans_from_points(
            pose_number[in_pose],
            pose_index[in_pose],
            motion["time_us"][in_motion].astype(np.int64),
            pose["pose_x"][in_pose],
            pose["pose_y"][in_pose],
            motion["motion_yaw"][in_motion],
            motion["motion_curvature"][in_motion],
        )


_POINTS_MAX = 1 << 6
"""Points of a plan: their index has six bits."""

_COUNTER_VALUES = 16
"""Of the plan counter."""


def _numbered(counter: Column) -> NDArray[np.int64]:
    """Number of the plan that each frame belongs to, from the wrapping counter, whatever the order near a change."""
    codes = counter.astype(np.int64)
    half = _COUNTER_VALUES // 2
    steps = (np.diff(codes, prepend=codes[:1]) + half) % _COUNTER_VALUES - half
    return np.cumsum(steps) + (codes[0] if codes.size else 0) + _COUNTER_VALUES


def _columns(path: Path) -> dict[str, Column]:
    table = pq.read_table(path)
    return {name: table.column(name).to_numpy() for name in table.column_names}
