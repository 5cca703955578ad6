"""The track: centre line, width, bank, and where it lies on the Earth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autonomy.frenet import Curve, FloatArray, Projector
from autonomy.geodesy import LocalTangentPlane

#: Sides of a track, in the direction of travel.
SIDES = ("left", "right")


@dataclass(frozen=True)
class Origin:
    """Origin of the track frame: WGS 84, degrees and m above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    height: float

    def tangent_plane(self) -> LocalTangentPlane:
        """East-north-up frame of the track."""
        return LocalTangentPlane(self.latitude_deg, self.longitude_deg, self.height)


class Track:
    """A closed track.

    Parameters
    ----------
    name : for people.
    origin : of the track frame; None for a track known only by its plane coordinates.
    centre : centre line with uniform stations.
    width_left, width_right : shape (n,), m, from the centre line to the boundaries at its nodes.
    bank : shape (n,), rad, positive when the left side is low.
    grade : shape (n,), rad, positive uphill.
    walled : sides, left or right, on whose boundary a wall stands all around.
    """

    def __init__(
        self,
        name: str,
        origin: Origin | None,
        centre: Curve,
        *,
        width_left: FloatArray,
        width_right: FloatArray,
        bank: FloatArray,
        grade: FloatArray,
        walled: Sequence[str] = (),
    ) -> None:
        self.name = name
        self.origin = origin
        self.centre = centre
        self.width_left, self.width_right = width_left, width_right
        self.bank, self.grade = bank, grade
        self.walled = tuple(walled)
        self._projector = Projector(centre)
        self._bank: tuple[float, ...] = tuple(bank.tolist())
        self._grade: tuple[float, ...] = tuple(grade.tolist())

    @property
    def length(self) -> float:
        """Length of the centre line, m."""
        return self.centre.length

    def project(self, x: float, y: float) -> tuple[float, float]:
        """Station along and offset to the left of the centre line, m."""
        return self._projector.project(x, y)

    def road_at(self, x: float, y: float) -> tuple[float, float]:
        """Bank (positive: left side low) and grade (positive: uphill) in the direction of travel, rad."""
        station, _ = self._projector.project(x, y)
        return self.road_at_station(station)

    def road_at_station(self, station: float) -> tuple[float, float]:
        """Bank and grade at a station, linear between the nodes, rad."""
        position = station / self.centre.spacing
        whole = math.floor(position)
        fraction = position - whole
        i = whole % self.centre.count
        j = (i + 1) % self.centre.count
        return (
            self._bank[i] + fraction * (self._bank[j] - self._bank[i]),
            self._grade[i] + fraction * (self._grade[j] - self._grade[i]),
        )

    def boundaries(self) -> tuple[FloatArray, FloatArray]:
        """Left and right boundary, each of shape (n, 2), m."""
        normal = np.column_stack((-np.sin(self.centre.heading), np.cos(self.centre.heading)))
        line = np.column_stack((self.centre.x, self.centre.y))
        return line + self.width_left[:, None] * normal, line - self.width_right[:, None] * normal

    def walls(self) -> list[FloatArray]:
        """Walls as closed lines of points, each of shape (n, 2), m."""
        return [edge for side, edge in zip(SIDES, self.boundaries(), strict=True) if side in self.walled]

    def pose_at(self, station: float, lateral: float) -> tuple[float, float, float]:
        """x, y (m) and heading (rad, (-pi, pi]) of a car parallel to the centre line at (s, d)."""
        s, d = np.array([station]), np.array([lateral])
        x, y = self.centre.offset(s, d)
        heading = float(self.centre.at(s)[2][0])
        return float(x[0]), float(y[0]), math.atan2(math.sin(heading), math.cos(heading))
