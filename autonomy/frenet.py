"""Closed plane curves with uniform stations, and the projection between x, y and s, d on them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

FloatArray = NDArray[np.floating]


def wrap_angle(angle: float) -> float:
    """Angle wrapped to (-pi, pi], rad."""
    return -(((math.pi - angle) % (2.0 * math.pi)) - math.pi)


class Curve:
    """A closed curve, sampled at uniform stations.

    Parameters
    ----------
    x, y : shape (n,), m; node i lies at station ``i * length / n``.
    heading : shape (n,), rad, continuous along the lap (not wrapped).
    curvature : shape (n,), 1/m, positive to the left.
    length : of the lap, m.
    """

    def __init__(self, x: FloatArray, y: FloatArray, heading: FloatArray, curvature: FloatArray, length: float) -> None:
        self.x, self.y, self.heading, self.curvature = x, y, heading, curvature
        self.length = length
        self.count = len(x)
        self.spacing = length / self.count
        self.turn = round((heading[-1] - heading[0]) / (2.0 * math.pi)) * 2.0 * math.pi

    @property
    def stations(self) -> FloatArray:
        """Stations of the nodes, shape (n,), m."""
        return np.arange(self.count) * self.spacing

    @classmethod
    def through(cls, x: FloatArray, y: FloatArray, count: int) -> Curve:
        """Curve through points by a periodic cubic spline.

        The parameter is the chord length, refined once to the arc length so that stations are true distances.

        Parameters
        ----------
        x, y : shape (m,), m >= 4, distinct consecutive points, without repeating the first at the end.
        count : nodes of the result.
        """
        closed_x, closed_y = np.append(x, x[0]), np.append(y, y[0])
        knots = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(closed_x), np.diff(closed_y)))))
        for _ in range(2):
            spline = CubicSpline(knots, np.column_stack((closed_x, closed_y)), bc_type="periodic")
            knots = _arc_length(spline, knots)
        spline = CubicSpline(knots, np.column_stack((closed_x, closed_y)), bc_type="periodic")
        length = float(knots[-1])
        position = spline(np.arange(count) * (length / count))
        first = spline(np.arange(count) * (length / count), 1)
        second = spline(np.arange(count) * (length / count), 2)
        speed = np.hypot(first[:, 0], first[:, 1])
        curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
        heading = np.unwrap(np.arctan2(first[:, 1], first[:, 0]))
        return cls(position[:, 0].copy(), position[:, 1].copy(), heading, curvature, length)

    def at(self, station: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Position, heading and curvature between the nodes.

        Position by cubic Hermite interpolation, which keeps the tangent; heading and curvature linear.

        Parameters
        ----------
        station : any shape, m; taken modulo the length.

        Returns
        -------
        x, y, heading (continuous over one lap), curvature.
        """
        position = np.asarray(station) / self.spacing
        whole = np.floor(position)
        fraction = position - whole
        i = whole.astype(np.int64) % self.count
        j = (i + 1) % self.count
        h00 = (1.0 + 2.0 * fraction) * (1.0 - fraction) ** 2
        h10 = fraction * (1.0 - fraction) ** 2 * self.spacing
        h01 = 1.0 - h00
        h11 = -(fraction**2) * (1.0 - fraction) * self.spacing
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        x = h00 * self.x[i] + h10 * cos[i] + h01 * self.x[j] + h11 * cos[j]
        y = h00 * self.y[i] + h10 * sin[i] + h01 * self.y[j] + h11 * sin[j]
        heading = self.heading[i] + fraction * (self.heading[j] + np.where(j == 0, self.turn, 0.0) - self.heading[i])
        curvature = self.curvature[i] + fraction * (self.curvature[j] - self.curvature[i])
        return x, y, heading, curvature

    def offset(self, station: FloatArray, lateral: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points beside the curve: x, y of (s, d), d positive to the left, m."""
        x, y, heading, _ = self.at(station)
        return x - lateral * np.sin(heading), y + lateral * np.cos(heading)


def _arc_length(spline: CubicSpline, knots: FloatArray) -> FloatArray:
    """Arc length of a plane spline at its knots, by five-point Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    step = np.diff(knots)
    points = knots[:-1, None] + 0.5 * step[:, None] * (nodes[None, :] + 1.0)
    tangent = spline(points, 1)
    piece = 0.5 * step * (np.hypot(tangent[..., 0], tangent[..., 1]) @ weights)
    return np.concatenate(([0.0], np.cumsum(piece)))


class Projector:
    """Projects points that move along a curve on to it.

    Searches on from the last answer, so a call costs the same wherever the car is. Plain floats: at this size
    they are several times as fast as arrays. A point that left the neighbourhood of the last answer (first call,
    a jump) is found by looking at all nodes.
    """

    _STRIDES = 8  # of at most 20 nodes each, before the search starts afresh
    _NEIGHBOURHOOD = 40.0  # m beside the curve; farther off, the last answer is no hint

    def __init__(self, curve: Curve) -> None:
        self._spacing = curve.spacing
        self._count = curve.count
        self._length = curve.length
        self._x: tuple[float, ...] = tuple(curve.x.tolist())
        self._y: tuple[float, ...] = tuple(curve.y.tolist())
        self._cos: tuple[float, ...] = tuple(np.cos(curve.heading).tolist())
        self._sin: tuple[float, ...] = tuple(np.sin(curve.heading).tolist())
        self._curvature: tuple[float, ...] = tuple(curve.curvature.tolist())
        self._nodes = np.column_stack((curve.x, curve.y))
        self._index = -1

    def project(self, x: float, y: float) -> tuple[float, float]:
        """Station and lateral offset of a point.

        Parameters
        ----------
        x, y : m, nearer to the curve than its radius of curvature.

        Returns
        -------
        s in [0, length), m; d, m, positive to the left.
        """
        found = self._walk(self._index, x, y) if self._index >= 0 else None
        if found is None:
            i = self._nearest(x, y)
            found = i, *self._beside(i, x, y)
        i, along, across = found
        self._index = i
        # Exact on the osculating circle of the node, and on a straight.
        curvature = self._curvature[i]
        shrink = 1.0 - curvature * across
        if abs(curvature) > 1.0e-9:
            step = math.atan2(curvature * along, shrink) / curvature
            lateral = (1.0 - math.hypot(curvature * along, shrink)) / curvature
        else:
            step, lateral = along, across
        return (i * self._spacing + step) % self._length, lateral

    def _beside(self, i: int, x: float, y: float) -> tuple[float, float]:
        """Point in the axes of a node: along and across it, m."""
        dx, dy, cos, sin = x - self._x[i], y - self._y[i], self._cos[i], self._sin[i]
        return dx * cos + dy * sin, dy * cos - dx * sin

    def _walk(self, i: int, x: float, y: float) -> tuple[int, float, float] | None:
        """Node whose normal passes the point, from node i on, and the point in its axes; None when it is not near."""
        for _ in range(self._STRIDES):
            along, across = self._beside(i, x, y)
            if abs(across) > self._NEIGHBOURHOOD:
                return None
            nodes = round(along / (self._spacing * max(1.0 - self._curvature[i] * across, 0.5)))
            if nodes == 0:
                return i, along, across
            i = (i + max(-20, min(20, nodes))) % self._count
        return None

    def _nearest(self, x: float, y: float) -> int:
        return int(np.argmin((self._nodes[:, 0] - x) ** 2 + (self._nodes[:, 1] - y) ** 2))
