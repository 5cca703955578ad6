"""What a radar can get an echo from: other cars, their images in walls, and the walls themselves. All in the plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bridge.sensors.truth import Truth

Floats = NDArray[np.float64]

#: Standard gravity, m/s2.
GRAVITY = 9.80665
#: Two ends of a sight nearer to a wall than this do not count as behind it, m.
CLEARANCE = 0.05


class OtherCar(NamedTuple):
    """True motion of another car: its middle in the track frame (m, rad), the rest along its own axes (m/s, m/s2).

    The size is the AV-21's (TUMRT, params_dallaraAV21.yml), m.
    """

    x: float
    y: float
    yaw: float
    vx: float
    vy: float = 0.0
    yaw_rate: float = 0.0
    ax: float = 0.0
    ay: float = 0.0
    length: float = 4.9
    width: float = 1.93


class Motion(NamedTuple):
    """Of points in the track frame: place, velocity and acceleration, shape (n, 2) each, or (2,) of one."""

    place: Floats
    velocity: Floats
    acceleration: Floats

    def away_from(self, observer: Motion) -> Motion:
        """As seen from a moving point, in axes that do not turn."""
        return Motion(*(mine - its for mine, its in zip(self, observer, strict=True)))


def mounted(truth: Truth, x: float) -> Motion:
    """Motion of a point of the car, x m ahead of its centre of gravity.

    The acceleration is the specific force less what gravity has of it on a sloping road; change of the yaw rate is
    left out.
    """
    axes = _axes(truth.yaw)
    acceleration = (
        truth.specific_force_x + GRAVITY * math.sin(truth.road_pitch) - truth.yaw_rate**2 * x,
        truth.specific_force_y - GRAVITY * math.sin(truth.road_roll) * math.cos(truth.road_pitch),
    )
    return Motion(
        np.array([truth.x, truth.y]) + axes @ [x, 0.0],
        axes @ [truth.vx, truth.vy + truth.yaw_rate * x],
        axes @ acceleration,
    )


def nearest_point(car: OtherCar, places: Floats) -> Motion:
    """The points of a car's outline that are nearest to some places, shape (n, 2), and how they move."""
    axes = _axes(car.yaw)
    half = 0.5 * np.array([car.length, car.width])
    arm = ((places - [car.x, car.y]) @ axes).clip(-half, half)
    across = np.column_stack((-arm[:, 1], arm[:, 0]))
    velocity = np.array([car.vx, car.vy]) + car.yaw_rate * across
    acceleration = np.array([car.ax, car.ay]) - car.yaw_rate**2 * arm
    return Motion([car.x, car.y] + arm @ axes.T, velocity @ axes.T, acceleration @ axes.T)


class Walls:
    """Walls as line segments that hide, mirror and reflect.

    Parameters
    ----------
    lines : closed lines of points, each of shape (n, 2), m, in the track frame.
    post_spacing : m along a wall, between what stands out of it and reflects in all directions.
    """

    def __init__(self, lines: Sequence[NDArray[np.floating]], post_spacing: float) -> None:
        closed = [np.hstack((line, np.roll(line, -1, axis=0))) for line in lines]
        segments = np.concatenate([np.empty((0, 4)), *closed])
        self._start: Floats = segments[:, :2]
        self._span: Floats = segments[:, 2:] - segments[:, :2]
        #: Which of the lines a segment belongs to.
        self._line = np.repeat(np.arange(len(closed)), [len(line) for line in closed])
        length = np.hypot(*self._span.T)
        self._longest = float(length.max(initial=0.0))
        posts = [_along(line, post_spacing) for line in lines]
        #: Places of the posts, shape (n, 2), m.
        self.posts: Floats = np.concatenate([np.empty((0, 2)), *posts])

    def near(self, place: Floats, reach: float) -> NDArray[np.intp]:
        """Segments of which a part may be within reach of a place."""
        apart = self._start + 0.5 * self._span - place
        return np.flatnonzero(np.hypot(*apart.T) < reach + 0.5 * self._longest)

    def hide(self, from_: Floats, to: Floats, segments: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether a segment lies between two places, other than at either of them.

        Parameters
        ----------
        from_, to : shape (n, 2), m.
        segments : that come into question.
        """
        sight = (to - from_)[:, None, :]
        span = self._span[segments][None]
        apart = self._start[segments][None] - from_[:, None, :]
        with np.errstate(divide="ignore", invalid="ignore"):
            determinant = _cross(sight, span)
            part, along = _cross(apart, span) / determinant, _cross(apart, sight) / determinant
        margin = CLEARANCE / np.maximum(np.hypot(*(to - from_).T), CLEARANCE)[:, None]
        crossed = (part > margin) & (part < 1.0 - margin) & (along >= 0.0) & (along <= 1.0)
        return np.asarray(crossed.any(axis=1))

    def images(self, place: Floats, car: OtherCar, segments: NDArray[np.intp]) -> list[tuple[int, Motion]]:
        """Mirror images of a car that can be seen from a place: number of the line, and the image's nearest point.

        What is seen of a car in a mirror is what is nearest to the observer's own image. Of several images in one line
        the nearest counts: it is the strongest.
        """
        if not len(segments):
            return []
        start, span = self._start[segments], self._span[segments]
        normal = np.column_stack((-span[:, 1], span[:, 0])) / np.hypot(*span.T)[:, None]
        off = np.einsum("ij,ij->i", place - start, normal)
        point = nearest_point(car, place - 2.0 * off[:, None] * normal)
        its_off = np.einsum("ij,ij->i", point.place - start, normal)
        image = point.place - 2.0 * its_off[:, None] * normal
        # The sight to the image meets the line of the wall where the wave bounces.
        with np.errstate(divide="ignore", invalid="ignore"):
            bounce = place + (image - place) * (off / (off + its_off))[:, None]
        along = np.einsum("ij,ij->i", bounce - start, span) / np.einsum("ij,ij->i", span, span)
        valid = np.flatnonzero((off * its_off > 0.0) & (along >= 0.0) & (along <= 1.0))
        distance = np.hypot(*(image[valid] - place).T)
        found: list[tuple[int, Motion]] = []
        for i in valid[np.argsort(distance, kind="stable")]:
            line = int(self._line[segments[i]])
            ways = np.array([place, bounce[i]]), np.array([bounce[i], point.place[i]])
            if any(line == other for other, _ in found) or self.hide(*ways, segments).any():
                continue
            mirror = np.eye(2) - 2.0 * np.outer(normal[i], normal[i])
            found.append((line, Motion(image[i], mirror @ point.velocity[i], mirror @ point.acceleration[i])))
        return found


def _axes(yaw: float) -> Floats:
    """Forward and left of a heading as columns."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, -sin], [sin, cos]])


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _along(line: NDArray[np.floating], spacing: float) -> Floats:
    """Points every so many m along a closed line, the first at its start."""
    closed = np.concatenate((line, line[:1]))
    station = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))))
    at = np.arange(0.0, station[-1], spacing)
    return np.column_stack([np.interp(at, station, column) for column in closed.T])
