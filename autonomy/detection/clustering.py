"""Connectivity-based clustering in two steps, and a box around each cluster; the work is done in C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from autonomy._native import ffi, lib
from autonomy.detection.cloud import RANGE, Cloud, DetectionStatus, Tally, to_native

OUTLIER: int = lib.CLUSTERS_OUTLIER

#: An object, as the C struct `clusters_object`: middle (m), length and width (m, length not less than width), yaw of
#: the length (rad, (-pi/2, pi/2]), heights of the lowest and the highest point, distance of the nearest point, points.
OBJECT_DTYPE = np.dtype(
    [(name, np.float32) for name in ("x", "y", "length", "width", "yaw", "z_low", "z_high", "range")]
    + [("points", np.uint32)]
)

_STATUS = {
    lib.CLUSTERS_OK: DetectionStatus.OK,
    lib.CLUSTERS_TOO_DENSE: DetectionStatus.TOO_DENSE,
    lib.CLUSTERS_TOO_MANY_OBJECTS: DetectionStatus.TOO_MANY_OBJECTS,
}


@dataclass(frozen=True)
class ClusteringConfig:
    """Criteria of the two steps.

    Attributes
    ----------
    link_distance : m, first step: longest link between two points.
    points_min : a cluster of the first step with fewer points is outliers.
    join_along, join_across : m, second step: longest link between two clusters in x and in y; half axes of an ellipse.
    """

    link_distance: float = 0.8
    points_min: int = 3
    join_along: float = 4.5
    join_across: float = 1.0

    def __post_init__(self) -> None:
        low = lib.CONNECTIVITY_DISTANCE_MIN
        for name, value, high in (
            ("link_distance", self.link_distance, RANGE),
            ("join_along", self.join_along, RANGE),
            ("join_across", self.join_across, self.join_along),
        ):
            if not low <= value <= high:
                raise ValueError(f"{name} is {value:g}; must be {low:g} to {high:g} m")
        if not 1 <= self.points_min <= lib.CLOUD_POINTS_MAX:
            raise ValueError(f"points_min is {self.points_min}; must be 1 to {lib.CLOUD_POINTS_MAX}")


@dataclass(frozen=True)
class Clusters:
    """What clustering found.

    Attributes
    ----------
    status : OK, TOO_DENSE (no objects) or TOO_MANY_OBJECTS (the nearest).
    objects : OBJECT_DTYPE, nearest first.
    labels : shape (n,), of each point the place of its object among them, or OUTLIER.
    tally : removed are outliers, and the points of objects that were too many.
    """

    status: DetectionStatus
    objects: NDArray[np.void]
    labels: NDArray[np.int32]
    tally: Tally


class Clustering:
    """Finds the objects in clouds without ground; the same for any order of the points."""

    def __init__(self, config: ClusteringConfig | None = None) -> None:
        self.config = config or ClusteringConfig()
        self._space: Any = ffi.new("clusters *")
        native = self._space.config
        native.link_distance = self.config.link_distance
        native.points_min = self.config.points_min
        native.join_along = self.config.join_along
        native.join_across = self.config.join_across

    def apply(self, cloud: Cloud) -> Clusters:
        """Objects of a cloud.

        Raises
        ------
        ValueError
            When it is not a cloud (`check_cloud`).
        """
        points = to_native(cloud)
        labels = np.empty(len(cloud), dtype=np.int32)
        objects = np.empty(lib.CLUSTERS_OBJECTS_MAX, dtype=OBJECT_DTYPE)
        result = lib.clusters_find(
            self._space,
            points,
            len(cloud),
            ffi.from_buffer("int32_t[]", labels),
            ffi.from_buffer("clusters_object[]", objects),
        )
        return Clusters(_STATUS[result.status], objects[: result.object_count], labels, Tally.of(result.tally))
