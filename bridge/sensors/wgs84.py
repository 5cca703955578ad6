"""WGS 84 position of a point in the track frame.

Written for the bench alone: the estimator has its own conversion, so that one error cannot hide in both.
"""

from __future__ import annotations

import math

#: Semi-major axis, m, and first eccentricity squared (NIMA TR8350.2, table 3.1 and 3.3).
SEMI_MAJOR_AXIS = 6378137.0
ECCENTRICITY_SQUARED = 6.69437999014e-3


class TrackFrame:
    """East-north-up frame with its origin on the Earth.

    Parameters
    ----------
    latitude_deg, longitude_deg, height : origin; degrees and m above the ellipsoid.
    """

    def __init__(self, latitude_deg: float, longitude_deg: float, height: float) -> None:
        self.height = height
        latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
        self._sin_lat, self._cos_lat = math.sin(latitude), math.cos(latitude)
        self._sin_lon, self._cos_lon = math.sin(longitude), math.cos(longitude)
        normal = SEMI_MAJOR_AXIS / math.sqrt(1.0 - ECCENTRICITY_SQUARED * self._sin_lat**2)
        self._x = (normal + height) * self._cos_lat * self._cos_lon
        self._y = (normal + height) * self._cos_lat * self._sin_lon
        self._z = (normal * (1.0 - ECCENTRICITY_SQUARED) + height) * self._sin_lat

    def geodetic(self, east: float, north: float, up: float) -> tuple[float, float, float]:
        """Latitude and longitude in degrees, height in m, of a point given in m.

        The point is turned into the Earth-centred frame exactly; latitude and height by Bowring's closed form
        (Survey Review 23, 1976), whose error is below 1e-11 rad near the surface.
        """
        radial = self._cos_lat * up - self._sin_lat * north
        x = self._x + self._cos_lon * radial - self._sin_lon * east
        y = self._y + self._sin_lon * radial + self._cos_lon * east
        z = self._z + self._sin_lat * up + self._cos_lat * north
        flattening_ratio = math.sqrt(1.0 - ECCENTRICITY_SQUARED)
        distance = math.hypot(x, y)
        reduced = math.atan2(z, distance * flattening_ratio)
        second = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED)
        latitude = math.atan2(
            z + second * SEMI_MAJOR_AXIS * flattening_ratio * math.sin(reduced) ** 3,
            distance - ECCENTRICITY_SQUARED * SEMI_MAJOR_AXIS * math.cos(reduced) ** 3,
        )
        sine = math.sin(latitude)
        normal = SEMI_MAJOR_AXIS / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sine * sine)
        height = distance * math.cos(latitude) + z * sine - normal * (1.0 - ECCENTRICITY_SQUARED * sine * sine)
        return math.degrees(latitude), math.degrees(math.atan2(y, x)), height
