"""The path that plans are cut from: the race line, and the way on to it from where the car stands."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from autonomy.frenet import Curve, FloatArray, Projector
from autonomy.raceline import lateral_offsets, minimum_curvature_path
from autonomy.speed_profile import PathShape, ProfileLimits, closed_profile, corner_speeds
from autonomy.track import Track
from autonomy.vehicle import VehicleLimits

NODE_SPACING = 1.5  # m, about
# Plan points lie on every first to fifth node; a count that all of these divide keeps them on the same nodes.
NODE_MULTIPLE = 60


@dataclass(frozen=True)
class Path:
    """Nodes of a closed path with everything that a plan point carries, shape (n,) each.

    Attributes
    ----------
    x, y : m. yaw : of the path, (-pi, pi], rad. curvature : 1/m. bank : rad.
    speed_limit : m/s, with room to brake for what comes.
    track_station, track_offset : of the node along the track's centre line, and to its left, m.
    """

    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    curvature: FloatArray
    bank: FloatArray
    speed_limit: FloatArray
    track_station: FloatArray
    track_offset: FloatArray


@dataclass(frozen=True)
class PathSettings:
    """How the path is laid.

    Attributes
    ----------
    clearance : of the centre of gravity from the boundaries, m.
    blend_length : of the way on to the race line, m.
    lead_in : length of the path behind the car where a blend begins, m.
    easing : distance over which a plan's change from its speed cap to a slower turn is spread, m.
    limits : of the speed profile, below which every plan stays. Half of the grip is left to control, which keeps the
        side slip in turns, and with it the heading's distance from the path's, near 0.02 rad.
    """

    clearance: float = 2.2
    blend_length: float = 200.0
    lead_in: float = 20.0
    easing: float = 60.0
    limits: ProfileLimits = field(
        default_factory=lambda: ProfileLimits(max_speed=90.0, max_deceleration=6.0, friction_margin=0.48)
    )


class RacePath:
    """The race line of a track for a car.

    Parameters
    ----------
    track : with boundaries and bank.
    vehicle : limits of the car.
    settings : see there.
    """

    def __init__(self, track: Track, vehicle: VehicleLimits, settings: PathSettings | None = None) -> None:
        self._settings = settings or PathSettings()
        self._vehicle = vehicle
        line = minimum_curvature_path(track, self._settings.clearance)
        count = NODE_MULTIPLE * max(1, round(line.length / (NODE_MULTIPLE * NODE_SPACING)))
        self.curve = Curve.through(line.x, line.y, count)
        self.count, self.spacing, self.length = count, self.curve.spacing, self.curve.length
        self._projector = Projector(self.curve)
        self._slope = (np.roll(self.curve.curvature, -1) - np.roll(self.curve.curvature, 1)) / (2.0 * self.spacing)
        stations, offsets = lateral_offsets(track, self.curve)
        self._track_length = track.length
        unwrapped = np.unwrap(stations, period=track.length)
        self._node_stations = np.append(unwrapped, unwrapped[0] + track.length)
        bank = np.array([track.road_at_station(station)[0] for station in stations.tolist()])
        self.race = Path(
            x=self.curve.x,
            y=self.curve.y,
            yaw=_wrapped(self.curve.heading),
            curvature=self.curve.curvature,
            bank=bank,
            speed_limit=closed_profile(
                PathShape(self.spacing, self.curve.curvature, bank), vehicle, self._settings.limits
            ),
            track_station=stations,
            track_offset=offsets,
        )

    def limit_below(self, path: Path, max_speed: float) -> FloatArray:
        """Speed limit of a path for a car that drives no faster than a cap, shape (n,), m/s.

        Where turns ask for less than the cap, the limit leaves it and comes back to it without a corner, nowhere
        above the path's own; elsewhere it is the path's, so that a lowered cap is braked for in comfort.
        """
        nodes = 2 * (round(self._settings.easing / self.spacing) // 2) + 1
        lowest = minimum_filter1d(np.minimum(path.speed_limit, max_speed), nodes, mode="wrap")
        eased = uniform_filter1d(lowest, nodes, mode="wrap")
        return np.where(eased < max_speed - 1.0e-6, eased, path.speed_limit)

    def project(self, x: float, y: float) -> tuple[float, float]:
        """Station on the race line, [0, length), and offset to its left, m."""
        return self._projector.project(x, y)

    def nodes_at(self, track_station: FloatArray) -> FloatArray:
        """Positions among the nodes, [0, count), beside stations of the track's centre line, m; same shape."""
        beyond = np.mod(track_station - self._node_stations[0], self._track_length)
        nodes = np.interp(beyond, self._node_stations - self._node_stations[0], np.arange(self.count + 1.0))
        return np.asarray(nodes)

    def blend(self, x: float, y: float, yaw: float) -> tuple[Path, float]:
        """Path from a pose on to the race line: a quintic in the offset over the station.

        It begins in the direction of the car without curvature against the race line, and meets the race line
        with equal heading and curvature.

        Parameters
        ----------
        x, y, yaw : of the car, m and rad.

        Returns
        -------
        path : the race line with the blend in place.
        length : of the blend from the car on, m along the race line.
        """
        settings = self._settings
        start, offset = self.project(x, y)
        at_car = np.array([start])
        _, _, heading, curvature = (value.item() for value in self.curve.at(at_car))
        # A car that stands across the track still begins along it; the limit keeps the quintic in the track.
        direction = max(-0.3, min(0.3, math.remainder(yaw - heading, math.tau)))
        slope = math.tan(direction) * (1.0 - curvature * offset)
        length = settings.blend_length
        first = math.ceil((start - settings.lead_in) / self.spacing)
        last = math.floor((start + length) / self.spacing)
        unwrapped = np.arange(first, last + 1)
        nodes = unwrapped % self.count
        d, d1, d2 = _quintic(offset, slope, length, unwrapped * self.spacing - start)
        k, k1 = self.curve.curvature[nodes], self._slope[nodes]
        stretch = 1.0 - k * d
        delta = np.arctan2(d1, stretch)
        cos, tan = np.cos(delta), np.tan(delta)
        bent = ((d2 + (k1 * d + k * d1) * tan) * cos**2 / stretch + k) * cos / stretch
        path = replace(
            self.race,
            x=self.race.x.copy(),
            y=self.race.y.copy(),
            yaw=self.race.yaw.copy(),
            curvature=self.race.curvature.copy(),
            speed_limit=self.race.speed_limit.copy(),
            track_offset=self.race.track_offset.copy(),
        )
        path.track_offset[nodes] += d
        heading_at = self.curve.heading[nodes]
        path.x[nodes] = self.race.x[nodes] - d * np.sin(heading_at)
        path.y[nodes] = self.race.y[nodes] + d * np.cos(heading_at)
        path.yaw[nodes] = _wrapped(heading_at + delta)
        path.curvature[nodes] = bent
        path.speed_limit[nodes] = np.minimum(
            path.speed_limit[nodes],
            corner_speeds(PathShape(self.spacing, bent, self.race.bank[nodes]), self._vehicle, settings.limits),
        )
        return path, length


def _quintic(
    offset: float, slope: float, length: float, station: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """d, d', d'' of the quintic from (offset, slope, 0) to (0, 0, 0); straight on before the start."""
    t = np.clip(station / length, 0.0, 1.0)
    a, b = offset, slope * length
    c3, c4, c5 = -10.0 * a - 6.0 * b, 15.0 * a + 8.0 * b, -6.0 * a - 3.0 * b
    d = a + b * t + c3 * t**3 + c4 * t**4 + c5 * t**5
    d1 = (b + 3.0 * c3 * t**2 + 4.0 * c4 * t**3 + 5.0 * c5 * t**4) / length
    d2 = (6.0 * c3 * t + 12.0 * c4 * t**2 + 20.0 * c5 * t**3) / length**2
    return d + np.minimum(station, 0.0) * slope, d1, d2


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray(np.pi - np.mod(np.pi - angle, 2.0 * np.pi))
