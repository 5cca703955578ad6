"""Detection as one step: cloud and pose in, objects and a status out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.boundary_estimate import BoundaryEstimate, BoundaryStatus
from autonomy.detection.cloud import POINTS_MAX, Cloud, DetectionStatus, Pose, check_cloud
from autonomy.detection.clustering import OBJECT_DTYPE, Clustering, ClusteringConfig
from autonomy.detection.cross_check import CrossCheck, VehicleShape, cross_check
from autonomy.detection.geofence import Geofence
from autonomy.detection.ground_filter import GroundConfig, GroundFilter
from autonomy.frenet import FloatArray
from autonomy.track import Track


@dataclass(frozen=True)
class DetectionConfig:
    """All of detection that can be chosen; margin of the geofence in m."""

    margin: float = 1.0
    ground: GroundConfig = field(default_factory=GroundConfig)
    clustering: ClusteringConfig = field(default_factory=ClusteringConfig)
    shape: VehicleShape = field(default_factory=VehicleShape)


@dataclass(frozen=True)
class Detections:
    """What one scan gave.

    Attributes
    ----------
    status : OK, or why there are no objects, or not all of them.
    objects : OBJECT_DTYPE, in the vehicle frame, nearest first.
    cars : the objects against the vehicle's geometry, in the same order.
    boundary : whether a wall was seen; None without an estimate, or when the scan did not get that far.
    """

    status: DetectionStatus
    objects: NDArray[np.void]
    cars: CrossCheck
    boundary: BoundaryStatus | None = None

    @classmethod
    def nothing(cls, status: DetectionStatus) -> Detections:
        """No objects, and why."""
        none = np.empty(0)
        cars = CrossCheck(none, none, none, none.astype(np.bool_), np.empty((0, 2)))
        return cls(status, np.empty(0, dtype=OBJECT_DTYPE), cars)


class Detector:
    """Geofence, ground removal, clustering and cross-check in a row.

    The geofence comes first: a wall must not share a cell of the grid with the road at its foot.

    Parameters
    ----------
    track : on which the car drives.
    config : thresholds.
    boundary : estimate of where the walls are, for the same track; without one, the geofence is the track file's.

    Raises
    ------
    ValueError
        When the track cannot be fenced in (`Geofence`).
    """

    def __init__(
        self, track: Track, config: DetectionConfig | None = None, boundary: BoundaryEstimate | None = None
    ) -> None:
        self.config = config or DetectionConfig()
        self.boundary = boundary
        self._geofence = Geofence(track, self.config.margin) if boundary is None else boundary.around
        self._ground_filter = GroundFilter(self.config.ground)
        self._clustering = Clustering(self.config.clustering)
        self._room = np.empty((POINTS_MAX, 3), dtype=np.float32)
        self._line = np.column_stack((track.centre.x, track.centre.y))
        self._heading = track.centre.heading
        self.scans: Counter[DetectionStatus] = Counter()
        """Scans so far, by status."""
        self.not_finite = 0
        """Points dropped so far because a coordinate was NaN or infinite."""

    def step(self, cloud: object, pose: Pose) -> Detections:
        """Detect the objects of one scan; never raises.

        It depends on nothing but its arguments, and on earlier scans through the estimate of the boundary alone.

        Parameters
        ----------
        cloud : float32 array of shape (n, 3), m, in the vehicle frame; points that are not finite are dropped.
        pose : of the car when the cloud was taken.
        """
        detections = self._detect(cloud, pose)
        self.scans[detections.status] += 1
        return detections

    def _detect(self, cloud: object, pose: Pose) -> Detections:
        status = check_cloud(cloud)
        if status is not DetectionStatus.OK:
            return Detections.nothing(status)
        if not pose.finite:
            return Detections.nothing(DetectionStatus.BAD_POSE)
        points: Cloud = np.asarray(cloud)
        inside, fenced = self._geofence.apply(points, pose, out=self._room)
        self.not_finite += fenced.not_finite
        if fenced.not_finite == len(points):
            return Detections.nothing(DetectionStatus.NOTHING_FINITE)
        raised, _ = self._ground_filter.apply(inside, out=self._room)
        walls = None
        if self.boundary is not None:
            fence = self.boundary.step(raised, pose, self.config.margin)
            raised, walls = raised[fence.inside], fence.status
        clusters = self._clustering.apply(raised)
        direction = self._road_direction(clusters.objects, pose)
        cars = cross_check(raised, clusters.labels, clusters.objects, direction, self.config.shape)
        return Detections(clusters.status, clusters.objects, cars, walls)

    def _road_direction(self, objects: NDArray[np.void], pose: Pose) -> FloatArray:
        """Heading of the nearest node of the centre line, in the vehicle frame, rad."""
        cos, sin = np.cos(pose.yaw), np.sin(pose.yaw)
        place = np.column_stack(
            (
                pose.x + cos * objects["x"] - sin * objects["y"],
                pose.y + sin * objects["x"] + cos * objects["y"],
            )
        )
        apart = place[:, None, :] - self._line[None, :, :]
        nearest = np.argmin(np.einsum("ijk,ijk->ij", apart, apart), axis=1)
        return np.asarray(self._heading[nearest] - pose.yaw)
