"""Geodetic to track frame against independent geometry."""

import math

import numpy as np
import pytest

from autonomy.geodesy import WGS84_FLATTENING, WGS84_SEMI_MAJOR_AXIS, LocalTangentPlane, geodetic_to_ecef

LVMS = (36.27222469, -115.0102968, 605.0)


def geodetic(x, y, z):
    """Latitude, longitude and height of an ECEF point by fixed-point iteration, which the code under test lacks."""
    e2 = WGS84_FLATTENING * (2.0 - WGS84_FLATTENING)
    p = math.hypot(x, y)
    latitude = math.atan2(z, p * (1.0 - e2))
    for _ in range(20):
        n = WGS84_SEMI_MAJOR_AXIS / math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
        latitude = math.atan2(z + e2 * n * math.sin(latitude), p)
    n = WGS84_SEMI_MAJOR_AXIS / math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
    return latitude, math.atan2(y, x), p / math.cos(latitude) - n


def rotation(latitude, longitude):
    """ENU axes in ECEF from the cross products of up and the Earth's axis."""
    up = np.array(
        [math.cos(latitude) * math.cos(longitude), math.cos(latitude) * math.sin(longitude), math.sin(latitude)]
    )
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    return np.array([east, np.cross(up, east), up])


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.0, 0.0, 0.0), (6378137.0, 0.0, 0.0)),
        ((0.0, 90.0, 100.0), (0.0, 6378237.0, 0.0)),
        ((90.0, 0.0, 0.0), (0.0, 0.0, 6356752.314245)),
        ((-90.0, 0.0, 10.0), (0.0, 0.0, -6356762.314245)),
    ],
)
def test_ecef_of_known_places(place, expected):
    latitude, longitude, height = place
    got = geodetic_to_ecef(math.radians(latitude), math.radians(longitude), height)
    assert got == pytest.approx(expected, abs=1e-5)


def test_points_about_the_track_come_back():
    latitude, longitude, height = math.radians(LVMS[0]), math.radians(LVMS[1]), LVMS[2]
    origin = np.array(geodetic_to_ecef(latitude, longitude, height))
    axes = rotation(latitude, longitude)
    plane = LocalTangentPlane(*LVMS)
    rng = np.random.default_rng(7)
    for enu in rng.uniform([-2000.0, -2000.0, -20.0], [2000.0, 2000.0, 20.0], (50, 3)):
        phi, lam, h = geodetic(*(origin + axes.T @ enu))
        assert plane.to_enu(math.degrees(phi), math.degrees(lam), h) == pytest.approx(tuple(enu), abs=1e-6)


def test_one_microdegree_is_the_arc_of_the_local_radii():
    latitude, longitude, height = LVMS
    plane = LocalTangentPlane(*LVMS)
    e2 = WGS84_FLATTENING * (2.0 - WGS84_FLATTENING)
    w = math.sqrt(1.0 - e2 * math.sin(math.radians(latitude)) ** 2)
    meridian, normal = WGS84_SEMI_MAJOR_AXIS * (1.0 - e2) / w**3, WGS84_SEMI_MAJOR_AXIS / w
    step = math.radians(1e-6)
    _, north, _ = plane.to_enu(latitude + 1e-6, longitude, height)
    east, _, _ = plane.to_enu(latitude, longitude + 1e-6, height)
    assert north == pytest.approx((meridian + height) * step, rel=1e-6)
    assert east == pytest.approx((normal + height) * math.cos(math.radians(latitude)) * step, rel=1e-6)


def test_the_height_of_the_plane_is_enough_for_the_position():
    # The receivers' height is not used: 2 m of it move a point 600 m away by less than a millimetre.
    plane = LocalTangentPlane(*LVMS)
    low, high = (plane.to_enu(LVMS[0] + 0.0054, LVMS[1] + 0.0054, h) for h in (605.0, 607.0))
    assert math.hypot(low[0] - high[0], low[1] - high[1]) < 1e-3
