"""Objects on the road as any sensor gives them: where, how well known, how fast along the sight, and how credible."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.cloud import Pose
from autonomy.detection.cross_check import VehicleShape
from autonomy.detection.detector import Detections
from autonomy.frenet import FloatArray

RoadObjects = NDArray[np.void]

#: An object in the vehicle frame: middle (m), yaw (rad), length and width (m, what is seen of them), range (m, of what
#: is nearest, from the sensor or, of LiDARs, the frame's origin), covariance of the middle (m2); range rate relative to
#: the radar and over ground, and 1 sigma of both (m/s; infinite without a radar); confidence (0 to 1); who saw it; the
#: radar's number of it (0 without one).
ROAD_OBJECT_DTYPE = np.dtype(
    [(name, np.float64) for name in ("x", "y", "yaw", "length", "width", "range")]
    + [("covariance", np.float64, (2, 2))]
    + [(name, np.float64) for name in ("range_rate", "ground_rate", "rate_std", "confidence")]
    + [("sensors", np.uint8), ("radar_track", np.uint8)]
)


class Sensor(IntFlag):
    """Who saw an object; both after fusion."""

    LIDAR = 1
    RADAR = 2


@dataclass(frozen=True)
class LidarBelief:
    """What is believed of a LiDAR's objects; all but the first figure are ours.

    Attributes
    ----------
    deviation : m, 1 sigma of the middle of a car in each direction (TUM, FusionTracking).
    other_deviation : m, of what cannot be a car.
    confidence, other_confidence : of what can be a car, and of what cannot.
    """

    deviation: float = 0.3
    other_deviation: float = 1.0
    confidence: float = 0.9
    other_confidence: float = 0.3


def no_objects(count: int = 0) -> RoadObjects:
    """Room for some objects, none of which has a range rate."""
    objects = np.zeros(count, dtype=ROAD_OBJECT_DTYPE)
    objects["rate_std"] = np.inf
    return objects


def lidar_objects(
    found: Detections, shape: VehicleShape | None = None, belief: LidarBelief | None = None
) -> RoadObjects:
    """Objects of a LiDAR scan with their covariance, in the same order.

    Where a side of a car is not seen in full, its middle is where the cross-check put it, but may be anywhere between
    there and the middle of what is seen: the missing part adds the variance of a uniform distribution.
    """
    shape, belief = shape or VehicleShape(), belief or LidarBelief()
    cars = found.cars
    objects = no_objects(len(found.objects))
    objects["x"], objects["y"] = cars.centre.T
    objects["yaw"], objects["length"], objects["width"] = cars.heading, cars.length, cars.width
    objects["range"] = found.objects["range"]
    missing = np.column_stack((shape.length - cars.length, shape.width - cars.width)).clip(0.0)
    variance = np.where(cars.fits[:, None], belief.deviation**2 + missing**2 / 12.0, belief.other_deviation**2)
    objects["covariance"] = turned(cars.heading, variance)
    objects["confidence"] = np.where(cars.fits, belief.confidence, belief.other_confidence)
    objects["sensors"] = Sensor.LIDAR
    return objects


def levelled(objects: RoadObjects, height: FloatArray, pose: Pose) -> RoadObjects:
    """Objects as seen from above.

    The vehicle frame lies on a banked road: what is measured in it is longer than on a map, by 7 percent at 21 degrees,
    and what is far ahead in a turn has left its plane.

    Parameters
    ----------
    objects : in the vehicle frame.
    height : shape (n,), m, of each above the frame's plane.
    pose : roll and pitch of the frame.
    """
    level = objects.copy()
    cos_pitch, sin_pitch = math.cos(pose.pitch), math.sin(pose.pitch)
    cos_roll, sin_roll = math.cos(pose.roll), math.sin(pose.roll)
    # The first two rows of the turn by roll, then by pitch.
    turn = np.array([[cos_pitch, sin_pitch * sin_roll, sin_pitch * cos_roll], [0.0, cos_roll, -sin_roll]])
    level["x"], level["y"] = turn @ np.stack((objects["x"], objects["y"], height))
    plane = turn[:, :2]
    along, across = plane @ np.stack((np.cos(objects["yaw"]), np.sin(objects["yaw"])))
    level["yaw"] = np.arctan2(across, along)
    level["covariance"] = plane @ objects["covariance"] @ plane.T
    return level


def turned(angle: FloatArray, variance: FloatArray) -> FloatArray:
    """Covariances in x and y from variances along directions and across, shapes (n, 2, 2), (n,) and (n, 2)."""
    cos, sin = np.cos(angle), np.sin(angle)
    axes = np.moveaxis(np.array([[cos, -sin], [sin, cos]]), -1, 0)
    return np.asarray((axes * variance[:, None, :]) @ axes.transpose(0, 2, 1))
