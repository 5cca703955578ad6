"""Geodetic positions to the track frame."""

from __future__ import annotations

import math

WGS84_SEMI_MAJOR_AXIS = 6378137.0  # m
WGS84_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_SQUARED = WGS84_FLATTENING * (2.0 - WGS84_FLATTENING)


def geodetic_to_ecef(latitude: float, longitude: float, height: float) -> tuple[float, float, float]:
    """Earth-centred, earth-fixed position of a point given on the WGS 84 ellipsoid.

    Parameters
    ----------
    latitude, longitude : rad.
    height : above the ellipsoid, m.

    Returns
    -------
    x, y, z in m.
    """
    sin_latitude = math.sin(latitude)
    normal_radius = WGS84_SEMI_MAJOR_AXIS / math.sqrt(1.0 - _ECCENTRICITY_SQUARED * sin_latitude * sin_latitude)
    equatorial = (normal_radius + height) * math.cos(latitude)
    return (
        equatorial * math.cos(longitude),
        equatorial * math.sin(longitude),
        (normal_radius * (1.0 - _ECCENTRICITY_SQUARED) + height) * sin_latitude,
    )


class LocalTangentPlane:
    """East-north-up frame with its origin on the ellipsoid normal of a track's origin.

    The conversion is exact (through ECEF); it has no series whose error grows with distance.

    Parameters
    ----------
    latitude_deg, longitude_deg : of the origin, WGS 84.
    height : of the origin above the ellipsoid, m.
    """

    def __init__(self, latitude_deg: float, longitude_deg: float, height: float) -> None:
        latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
        self.height = height
        self._origin = geodetic_to_ecef(latitude, longitude, height)
        self._sin_latitude, self._cos_latitude = math.sin(latitude), math.cos(latitude)
        self._sin_longitude, self._cos_longitude = math.sin(longitude), math.cos(longitude)

    def to_enu(self, latitude_deg: float, longitude_deg: float, height: float) -> tuple[float, float, float]:
        """East, north and up of a geodetic position, m."""
        x, y, z = geodetic_to_ecef(math.radians(latitude_deg), math.radians(longitude_deg), height)
        dx, dy, dz = x - self._origin[0], y - self._origin[1], z - self._origin[2]
        outward = self._cos_longitude * dx + self._sin_longitude * dy
        return (
            self._cos_longitude * dy - self._sin_longitude * dx,
            self._cos_latitude * dz - self._sin_latitude * outward,
            self._cos_latitude * outward + self._sin_latitude * dz,
        )
