"""What LiDARs see, as quads: the road with its bank, walls, and the bodies of cars."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bridge.interfaces import Road

FloatArray = NDArray[np.floating]

#: Share of the light that comes back, diffusely, at the wavelength of a LiDAR; ours, as no figures are public.
ASPHALT, CONCRETE, CAR_BODY = 0.15, 0.4, 0.3

WALL_HEIGHT = 1.1  # m
APRON_WIDTH = 25.0  # m

#: Boxes of a car: x, y, z from low to high, m, from the middle of its outline on the ground; 4.9 m by 1.93 m over all.
CAR_PARTS = (
    ((-2.0, 2.3), (-0.45, 0.45), (0.05, 0.55)),  # tub
    ((-1.6, 0.2), (-0.3, 0.3), (0.55, 1.1)),  # cockpit and engine cover
    ((2.2, 2.45), (-0.95, 0.95), (0.08, 0.3)),  # front wing
    ((-2.45, -2.1), (-0.7, 0.7), (0.6, 0.95)),  # rear wing
    ((-2.3, -2.1), (-0.05, 0.05), (0.3, 0.6)),  # its pillar
    ((-1.8, -1.2), (-0.965, -0.605), (0.0, 0.62)),  # wheels
    ((-1.8, -1.2), (0.605, 0.965), (0.0, 0.62)),
    ((1.17, 1.77), (-0.965, -0.605), (0.0, 0.62)),
    ((1.17, 1.77), (0.605, 0.965), (0.0, 0.62)),
)

#: Corners of the six sides of a box, in order around; bits of a corner's number choose low or high of x, y, z.
_SIDES = ((0, 2, 6, 4), (1, 3, 7, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 1, 3, 2), (4, 5, 7, 6))


@dataclass(frozen=True)
class QuadMesh:
    """Quads, seen from both sides.

    Attributes
    ----------
    corners : shape (n, 4, 3), m, in order around; folded between the first and the third where they are not in a plane.
    reflectivity : shape (n,), 0 to 1.
    """

    corners: FloatArray
    reflectivity: FloatArray

    @classmethod
    def merged(cls, meshes: Iterable[QuadMesh]) -> QuadMesh:
        """All of them as one."""
        parts = list(meshes)
        return cls(
            np.concatenate([part.corners for part in parts]), np.concatenate([part.reflectivity for part in parts])
        )


def strip(one: FloatArray, other: FloatArray, reflectivity: float, *, closed: bool = True) -> QuadMesh:
    """Quads between two lines with straight lines across.

    Parameters
    ----------
    one, other : shape (n, 3), m, points across from each other.
    closed : whether the last points are joined to the first.
    """
    next_one, next_other = np.roll(one, -1, axis=0), np.roll(other, -1, axis=0)
    corners = np.stack((one, next_one, next_other, other), axis=1)
    corners = corners if closed else corners[:-1]
    return QuadMesh(corners, np.full(len(corners), reflectivity))


def boxes(parts: Sequence[Sequence[Sequence[float]]], reflectivity: float = CAR_BODY) -> QuadMesh:
    """The sides of boxes along the axes.

    Parameters
    ----------
    parts : of each box, low and high of x, y and z, m.
    """
    bounds = np.asarray(parts, dtype=np.float64)
    choice = (np.arange(8)[:, None] >> np.arange(3)) & 1
    corners = bounds[:, np.arange(3), choice]
    sides = corners[:, np.array(_SIDES)].reshape(-1, 4, 3)
    return QuadMesh(sides, np.full(len(sides), reflectivity))


class RoadSurface:
    """Height of a road: along the centre line what its grade gives, 0 in the mean; across a straight line by the bank.

    Parameters
    ----------
    road : see `bridge.interfaces`.
    stations : at which the grade is taken, m, ascending from 0; every 4 m by default.

    Attributes
    ----------
    heights : of the centre line at the stations, m.
    """

    def __init__(self, road: Road, stations: FloatArray | None = None) -> None:
        self._road = road
        self._stations = np.arange(0.0, road.length, 4.0) if stations is None else stations
        grade = np.array([road.road_at_station(station)[1] for station in self._stations.tolist()])
        climb = np.tan(grade) * np.diff(self._stations, append=road.length)
        # What a lap does not close by is spread over it.
        height = np.cumsum(climb) - climb - self._stations / road.length * climb.sum()
        self.heights: FloatArray = height - height.mean()

    def at(self, station: float, lateral: float) -> float:
        """Height at a place, m; beyond the boundaries as if the road went on."""
        height = np.interp(station, self._stations, self.heights, period=self._road.length)
        return float(height) - lateral * math.tan(self._road.road_at_station(station)[0])


def track_mesh(
    road: Road,
    *,
    step: int = 4,
    apron: float = APRON_WIDTH,
    wall_height: float = WALL_HEIGHT,
    fence: bool = False,
) -> QuadMesh:
    """Road surface, apron and walls of a track in the track frame.

    The centre line has the height that its grade gives it, 0 in the mean. Across, the road is a straight line with the
    bank of its station from boundary to boundary; where no wall stands on a boundary, the apron goes on level.

    Parameters
    ----------
    road : see `bridge.interfaces`.
    step : points of the boundaries from one line across to the next. Of a turn with a radius of 233 m, given every
        metre, the chords over 4 m are off by 9 mm.
    apron : its width, m.
    wall_height : m, of every wall.
    fence : whether a wall stands where the apron ends, too.

    Raises
    ------
    ValueError
        When step is not positive, or less than three lines across are left.
    """
    left, right = (np.asarray(edge)[::step] for edge in road.boundaries()) if step > 0 else (np.empty((0, 2)),) * 2
    if len(left) < 3:
        raise ValueError(f"step is {step}; must be positive and leave three lines across the track or more")
    stations = np.arange(len(left)) * step * road.length / len(road.boundaries()[0])
    centre = np.array([road.pose_at(station, 0.0)[:2] for station in stations.tolist()])
    bank = np.array([road.road_at_station(station)[0] for station in stations.tolist()])
    height = RoadSurface(road, stations).heights
    to_left = (left - right) / np.hypot(*(left - right).T)[:, None]
    edges = []
    for edge in (left, right):
        offset = np.einsum("ij,ij->i", edge - centre, to_left)
        edges.append(np.column_stack((edge, height - offset * np.tan(bank))))
    parts = [strip(edges[0], edges[1], ASPHALT)]
    feet = [*edges]
    walls = [np.asarray(wall) for wall in road.walls()]
    for edge, boundary, away in zip(edges, road.boundaries(), (to_left, -to_left), strict=True):
        if apron > 0.0 and not any(np.array_equal(wall, boundary) for wall in walls):
            end = edge + apron * np.column_stack((away, np.zeros(len(away))))
            parts.append(strip(edge, end, ASPHALT))
            feet.append(end)
            if fence:
                parts.append(_wall(end, wall_height))
    ground = np.concatenate(feet)
    for wall in walls:
        line = wall[::step]
        nearest = [int(np.argmin(np.hypot(*(ground[:, :2] - point).T))) for point in line]
        parts.append(_wall(np.column_stack((line, ground[nearest, 2])), wall_height))
    return QuadMesh.merged(parts)


def _wall(foot: FloatArray, height: float) -> QuadMesh:
    return strip(foot, foot + np.array((0.0, 0.0, height)), CONCRETE)
