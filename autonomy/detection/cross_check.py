"""The size of objects against the vehicle's geometry: what can be a car, and where then its middle is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.cloud import Cloud
from autonomy.frenet import FloatArray


@dataclass(frozen=True)
class VehicleShape:
    """A car seen from above; the sizes are the AV-21's (TUMRT, params_dallaraAV21.yml).

    Attributes
    ----------
    length, width : m.
    tolerance : m, by which a car may look longer or wider.
    yaw_range_deg : between the heading of a car and the direction of the road.
    """

    length: float = 4.9
    width: float = 1.93
    tolerance: float = 0.5
    yaw_range_deg: float = 10.0

    def __post_init__(self) -> None:
        if not (0.0 < self.width <= self.length < math.inf and 0.0 <= self.tolerance < math.inf):
            raise ValueError(f"{self}: must be 0 < width <= length and 0 <= tolerance, all finite")
        if not 0.0 <= self.yaw_range_deg <= 45.0:
            raise ValueError(f"yaw_range_deg is {self.yaw_range_deg:g}; must be 0 to 45")


@dataclass(frozen=True)
class CrossCheck:
    """Objects as cars.

    Attributes
    ----------
    heading : shape (n,), rad.
    length, width : shape (n,), m; extent of the points along the heading and across.
    fits : shape (n,); no side is longer than a car's, so it may be one, seen whole or in part.
    centre : shape (n, 2), m; middle of the car where it fits, else of what is seen.
    """

    heading: FloatArray
    length: FloatArray
    width: FloatArray
    fits: NDArray[np.bool_]
    centre: FloatArray


def cross_check(
    cloud: Cloud, labels: NDArray[np.int32], objects: NDArray[np.void], direction: FloatArray, shape: VehicleShape
) -> CrossCheck:
    """Compare objects with the vehicle.

    A car heads as the road does, or nearly: its heading is that axis of its box which is within the yaw range of the
    road's direction. The box of a car that is seen in part can point anywhere; then the road's direction is taken.

    A LiDAR sees the near sides of a car only. What they lack to the size of the vehicle is behind them, away from the
    sensor, which is near the origin. Where an object extends to both sides of the sensor, it is left in the middle.

    Parameters
    ----------
    cloud, labels, objects : what `Clustering` was given and found, n objects.
    direction : shape (n,), rad, of the road at each object in the vehicle frame.
    shape : of the vehicle.
    """
    off = np.remainder(objects["yaw"] - direction + 0.25 * math.pi, 0.5 * math.pi) - 0.25 * math.pi
    heading = direction + np.where(np.abs(off) <= math.radians(shape.yaw_range_deg), off, 0.0)
    heading = np.arctan2(np.sin(heading), np.cos(heading))
    if len(objects) == 0:
        return CrossCheck(heading, heading, heading, np.empty(0, dtype=np.bool_), np.empty((0, 2)))
    order = np.argsort(labels, kind="stable")[np.count_nonzero(labels < 0) :]
    points = objects["points"].astype(np.int64)
    starts = np.cumsum(points) - points
    x, y = cloud[order, 0].astype(float), cloud[order, 1].astype(float)
    cos, sin = np.cos(heading), np.sin(heading)
    each_cos, each_sin = np.repeat(cos, points), np.repeat(sin, points)
    forward, length = _extent(x * each_cos + y * each_sin, starts)
    left, width = _extent(y * each_cos - x * each_sin, starts)
    fits = (length <= shape.length + shape.tolerance) & (width <= shape.width + shape.tolerance)
    forward = np.where(fits, _completed(forward, length, shape.length), forward)
    left = np.where(fits, _completed(left, width, shape.width), left)
    return CrossCheck(
        heading, length, width, fits, np.column_stack((forward * cos - left * sin, forward * sin + left * cos))
    )


def _extent(values: FloatArray, starts: NDArray[np.integer]) -> tuple[FloatArray, FloatArray]:
    """Middle and size of what each group of values spans."""
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    return 0.5 * (low + high), high - low


def _completed(middle: FloatArray, seen: FloatArray, whole: float) -> FloatArray:
    """Middle of a side of which the part nearer to the origin is seen."""
    away = np.where(np.abs(middle) > 0.5 * seen, np.sign(middle), 0.0)
    return np.asarray(middle + away * 0.5 * np.maximum(whole - seen, 0.0))
