"""Synthetic LiDAR scans of a banked track with walls and cars, for the tests and the benchmark of detection.

Rays are cast from three LiDARs on to the road, the walls and the boxes that a car is made of. The road is the track
model's: a straight line across, with the bank of its station. Everything random comes from a seed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.cloud import Cloud, Pose
from autonomy.frenet import FloatArray
from autonomy.track import Track
from bridge.sensors.lidar import AXLE_HEIGHT, MOUNTS
from bridge.sensors.surfaces import CAR_PARTS

FIELD_OF_VIEW_DEG = 120.0
COLUMNS, LINES = 480, 64
ELEVATION_DEG = (-22.0, 8.0)
RANGE_NOISE = 0.01  # m, standard deviation
POINTS = 60_000  # of a merged scan

_WALL_HEIGHT = 1.1  # m
_APRON = 25.0  # m, level, from the inner boundary to the inner wall
_RASTER = 4.0  # m
_REACH = 260.0  # m, of the raster beyond the centre line
_RANGES = np.geomspace(0.5, 220.0, 28)  # m, between which a ray is looked at
_HALVINGS = 7


@dataclass(frozen=True)
class Scan:
    """One merged scan.

    Attributes
    ----------
    cloud : in the vehicle frame, in the order of the beams.
    pose : of the vehicle frame, whose origin is the rear axle's middle on the ground.
    cars : shape (k, 3): x, y (m) and heading (rad) of the outlines' middles in the vehicle frame.
    source : of each point: -1 road or wall, else the car.
    """

    cloud: Cloud
    pose: Pose
    cars: FloatArray
    source: NDArray[np.int64]


class LidarScene:
    """A track to take scans on."""

    def __init__(self, track: Track) -> None:
        from scipy.spatial import cKDTree  # noqa: PLC0415

        self.track = track
        line = track.centre
        low = np.array([line.x.min(), line.y.min()]) - _REACH
        high = np.array([line.x.max(), line.y.max()]) + _REACH
        columns, rows = (np.arange(a, b, _RASTER) + 0.5 * _RASTER for a, b in zip(low, high, strict=True))
        middles = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1)
        self._corner = low
        nodes = np.column_stack((line.x, line.y))
        _, nearest = cKDTree(nodes).query(middles)
        self._nearest: NDArray[np.int64] = np.asarray(nearest)
        self._cos, self._sin, self._tan_bank = np.cos(line.heading), np.sin(line.heading), np.tan(track.bank)

    def nearest_node(self, x: FloatArray, y: FloatArray) -> NDArray[np.int64]:
        """Node of the centre line nearest to the middle of the raster's cell that a place is in."""
        column = ((x - self._corner[0]) / _RASTER).astype(int).clip(0, self._nearest.shape[0] - 1)
        row = ((y - self._corner[1]) / _RASTER).astype(int).clip(0, self._nearest.shape[1] - 1)
        return np.asarray(self._nearest[column, row])

    def road(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Height of the ground, and distances to the left, from the outer and to the inner wall, m."""
        line, track = self.track.centre, self.track
        i = self.nearest_node(x, y)
        dx, dy = x - line.x[i], y - line.y[i]
        cos, sin = self._cos[i], self._sin[i]
        along, across, curvature = dx * cos + dy * sin, dy * cos - dx * sin, line.curvature[i]
        radius = np.hypot(curvature * along, 1.0 - curvature * across)
        left = (2.0 * across - curvature * (along**2 + across**2)) / (1.0 + radius)
        # The nearest node of a cell of the raster may be some nodes off; between the nodes, so that there are no steps.
        nodes = i + along / (line.spacing * np.maximum(1.0 - curvature * across, 0.5))
        before = np.floor(nodes).astype(np.int64)
        tan_bank = self._tan_bank[before % line.count]
        tan_bank = tan_bank + (nodes - before) * (self._tan_bank[(before + 1) % line.count] - tan_bank)
        height = -np.minimum(left, track.width_left[i]) * tan_bank
        return height, left, left + track.width_right[i], track.width_left[i] + _APRON - left

    def _frame(self, station: float, lateral: float) -> tuple[FloatArray, FloatArray, Pose]:
        """Rotation and origin of something that stands on the road, and its pose."""
        x, y, yaw = self.track.pose_at(station, lateral)
        bank, _ = self.track.road_at_station(station)
        pose = Pose(x, y, yaw, roll=-bank)
        c, s, cr, sr = math.cos(yaw), math.sin(yaw), math.cos(pose.roll), math.sin(pose.roll)
        rotation = np.array([[c, -s * cr, s * sr], [s, c * cr, -c * sr], [0.0, sr, cr]])
        return rotation, np.array([x, y, -lateral * math.tan(bank)]), pose

    def scan(
        self, station: float, lateral: float, cars: Sequence[tuple[float, float]], seed: int, points: int = POINTS
    ) -> Scan:
        """Take a scan.

        Parameters
        ----------
        station, lateral : of the car with the LiDARs, m.
        cars : stations and lateral offsets of the middles of others, m; parallel to the road.
        seed : of range noise and of which echoes are lost.
        points : of the result, where the beams give as many.
        """
        rng = np.random.default_rng(seed)
        rotation, origin, pose = self._frame(station, lateral)
        outlines = np.empty((len(cars), 3))
        for number, place in enumerate(cars):
            _, car_origin, car_pose = self._frame(*place)
            outlines[number, :2] = ((car_origin - origin) @ rotation)[:2]
            outlines[number, 2] = math.remainder(car_pose.yaw - pose.yaw, 2.0 * math.pi)
        distance, source = self.cast(station, lateral, cars)
        echoes = np.flatnonzero(np.isfinite(distance))
        if len(echoes) > points:
            echoes = np.sort(rng.choice(echoes, points, replace=False))
        noisy = distance[echoes] + rng.normal(0.0, RANGE_NOISE, len(echoes))
        starts, beams = _beams()
        cloud = starts[echoes] + beams[echoes] * noisy[:, None]
        return Scan(cloud.astype(np.float32), pose, outlines, source[echoes])

    def cast(
        self, station: float, lateral: float, cars: Sequence[tuple[float, float]]
    ) -> tuple[FloatArray, NDArray[np.int64]]:
        """Where all beams end, without noise or loss.

        Parameters
        ----------
        station, lateral, cars : as in `scan`.

        Returns
        -------
        distance : shape (n,), m, LiDAR after LiDAR, column after column, line after line; infinite without an echo.
        source : of each: -1 road or wall, else the car.
        """
        rotation, origin, _ = self._frame(station, lateral)
        starts, beams = _beams()
        from_, to = origin + starts @ rotation.T, beams @ rotation.T
        distance = self._ground_distance(from_, to)
        source = np.full(len(beams), -1)
        for number, place in enumerate(cars):
            car_rotation, car_origin, _ = self._frame(*place)
            hit = _car_distance((from_ - car_origin) @ car_rotation, to @ car_rotation)
            nearer = hit < distance
            distance[nearer], source[nearer] = hit[nearer], number
        return distance, source

    def _ground_distance(self, start: FloatArray, beam: FloatArray) -> FloatArray:
        """Distance to road or wall along each beam, m; infinite without an echo."""

        def free(rays: NDArray[np.int64], distance: FloatArray) -> tuple[FloatArray, FloatArray]:
            """How far off the ground and off the walls the place at a distance is; negative inside."""
            place = start[rays] + beam[rays] * distance[:, None]
            height, _, outer, inner = self.road(place[:, 0], place[:, 1])
            return place[:, 2] - height, np.minimum(outer, inner)

        low = np.full(len(beam), np.nan)
        high = np.full(len(beam), np.nan)
        waiting = np.arange(len(beam))
        for before, after in pairwise(_RANGES):
            solid = np.minimum(*free(waiting, np.full(len(waiting), after))) < 0.0
            low[waiting[solid]], high[waiting[solid]] = before, after
            waiting = waiting[~solid]
        rays = np.flatnonzero(np.isfinite(low))
        a, b = low[rays], high[rays]
        for _ in range(_HALVINGS):
            middle = 0.5 * (a + b)
            solid = np.minimum(*free(rays, middle)) < 0.0
            a, b = np.where(solid, a, middle), np.where(solid, middle, b)
        above, beside = free(rays, b)
        outside, inside = np.minimum(*free(rays, a)), np.minimum(above, beside)
        echo = (beside > 0.0) | (above < _WALL_HEIGHT)
        distance = np.full(len(beam), np.inf)
        distance[rays[echo]] = (a + (b - a) * outside / (outside - inside))[echo]
        return distance


def _beams() -> tuple[FloatArray, FloatArray]:
    """Origins and directions of all beams in the vehicle frame, shape (n, 3) each."""
    azimuth = np.radians(((np.arange(COLUMNS) + 0.5) / COLUMNS - 0.5) * FIELD_OF_VIEW_DEG)
    elevation = np.radians(np.linspace(*ELEVATION_DEG, LINES))
    starts, beams = [], []
    for mount in MOUNTS:
        turn, rise = np.meshgrid(azimuth + mount.yaw, elevation, indexing="ij")
        beam = np.stack((np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)), axis=-1)
        beams.append(beam.reshape(-1, 3))
        starts.append(np.broadcast_to([mount.x, mount.y, mount.z + AXLE_HEIGHT], beams[-1].shape))
    return np.concatenate(starts), np.concatenate(beams)


def _car_distance(start: FloatArray, beam: FloatArray) -> FloatArray:
    """Distance to the car along each beam, both in the car's frame, m; infinite where it is missed."""
    distance = np.full(len(beam), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for box in CAR_PARTS:
            sides = np.array(box)
            to_low, to_high = (sides[:, 0] - start) / beam, (sides[:, 1] - start) / beam
            enter = np.nanmax(np.minimum(to_low, to_high), axis=1)
            leave = np.nanmin(np.maximum(to_low, to_high), axis=1)
            hit = (enter <= leave) & (enter > 0.0)
            distance[hit] = np.minimum(distance[hit], enter[hit])
    return distance
