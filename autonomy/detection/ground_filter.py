"""Ground removal by the distribution of heights in a grid (paper, Algorithm 1); the work is done in C."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from autonomy._native import ffi, lib
from autonomy.detection.cloud import RANGE, Cloud, Tally, to_native, to_room


@dataclass(frozen=True)
class GroundConfig:
    """Thresholds of the ground filter.

    Attributes
    ----------
    cell_size : of the grid, m.
    points_threshold : an object's cell has more points.
    height_threshold : m; an object's cell has more height beyond what the road may climb.
    foot_points : an object's cell with more points loses those at its foot, not higher than the threshold.
    slope_max_deg : steepest road as the car sees it: the bank, and some for pitch, roll and noise.
    """

    cell_size: float = 0.8
    points_threshold: int = 1
    height_threshold: float = 0.1
    foot_points: int = 4
    slope_max_deg: float = 22.0

    def __post_init__(self) -> None:
        if not lib.GROUND_CELL_SIZE_MIN <= self.cell_size <= RANGE:
            raise ValueError(f"cell_size is {self.cell_size:g}; must be {lib.GROUND_CELL_SIZE_MIN:g} to {RANGE:g} m")
        for name, points in (("points_threshold", self.points_threshold), ("foot_points", self.foot_points)):
            if not 0 <= points <= lib.CLOUD_POINTS_MAX:
                raise ValueError(f"{name} is {points}; must be 0 to {lib.CLOUD_POINTS_MAX}")
        if not 0.0 < self.height_threshold <= RANGE:
            raise ValueError(f"height_threshold is {self.height_threshold:g}; must be above 0, at most {RANGE:g} m")
        if not 0.0 <= self.slope_max_deg <= 80.0:
            raise ValueError(f"slope_max_deg is {self.slope_max_deg:g}; must be 0 to 80")


class GroundFilter:
    """Removes the ground from clouds; needs no pose, no track and no memory of earlier scans."""

    def __init__(self, config: GroundConfig | None = None) -> None:
        self.config = config or GroundConfig()
        self._state: Any = ffi.new("ground_filter *")
        native = self._state.config
        native.cell_size = self.config.cell_size
        native.points_threshold = self.config.points_threshold
        native.height_threshold = self.config.height_threshold
        native.foot_points = self.config.foot_points
        native.slope_max = math.tan(math.radians(self.config.slope_max_deg))

    def apply(self, cloud: Cloud, out: Cloud | None = None) -> tuple[Cloud, Tally]:
        """Points of cells that hold an object, in the order they came in.

        Parameters
        ----------
        out : room for the result, of at least as many points, if it is not to be new; may be the cloud itself.

        Raises
        ------
        ValueError
            When cloud or out is not a cloud (`check_cloud`).
        """
        points = to_native(cloud)
        kept = to_room(out, len(cloud))
        tally = Tally.of(lib.ground_filter_apply(self._state, points, len(cloud), to_native(kept)))
        return kept[: tally.kept], tally
