"""Other cars on the road, which drive by a script: along the road, at the speed and on the line that they are told.

They obey no dynamics but limits of acceleration, keep to no rule, and do not see the car of the bench.
"""

from __future__ import annotations

import math

from bridge.interfaces import Road
from bridge.race_control import StepSequence
from bridge.scenario import Opponent, Situation
from bridge.sensors.radar_scene import OtherCar
from bridge.sensors.spatial_lidar import Motion
from bridge.sensors.surfaces import RoadSurface

#: How fast a car goes over to another line, m/s, and how fast it changes to that, m/s2.
LATERAL_SPEED, LATERAL_ACCELERATION = 2.0, 2.0
_APART = 1.0  # m, to both sides of a place: between them the road's curvature is taken


class ScriptedCar:
    """One opponent.

    Parameters
    ----------
    opponent : its script.
    road : see `bridge.interfaces`.
    surface : of that road.

    Attributes
    ----------
    station, lateral : of the middle of its outline; m, the station in [0, length).
    speed, lateral_speed : along the centre line and to the left of it, m/s.
    """

    def __init__(self, opponent: Opponent, road: Road, surface: RoadSurface) -> None:
        self.name = opponent.name
        self.station, self.lateral = opponent.start_s_m, opponent.start_d_m
        self.speed = self.lateral_speed = 0.0
        self._road, self._surface = road, surface
        self._script = StepSequence(opponent.script)
        self._target_speed, self._target_lateral = 0.0, opponent.start_d_m
        self._acceleration = 0.0

    def act(self, now: Situation) -> None:
        """Take the next step of the script when it is time."""
        step = self._script.advance(now)
        if step is None:
            return
        if step.speed_mps is not None:
            self._target_speed = step.speed_mps
        if step.d_m is not None:
            self._target_lateral = step.d_m
        self._acceleration = step.acceleration_mps2

    def advance(self, dt: float) -> None:
        """Drive on for some time, s."""
        speed = _towards(self.speed, self._target_speed, self._acceleration * dt)
        self.station = (self.station + 0.5 * (self.speed + speed) * dt) % self._road.length
        self.speed = speed
        # As fast to the side as it can still stop at the line that it goes over to; a car that stands does not.
        error = self._target_lateral - self.lateral
        fastest = min(LATERAL_SPEED, 0.1 * speed, math.sqrt(2.0 * LATERAL_ACCELERATION * abs(error)))
        self.lateral_speed = _towards(self.lateral_speed, math.copysign(fastest, error), LATERAL_ACCELERATION * dt)
        self.lateral += self.lateral_speed * dt

    @property
    def outline(self) -> OtherCar:
        """As the radar sees it, in the plane."""
        x, y, heading = self._road.pose_at(self.station, self.lateral)
        curvature = self._curvature()
        along = self.speed * (1.0 - curvature * self.lateral)
        yaw = heading + math.atan2(self.lateral_speed, max(along, 1.0))
        speed = math.hypot(along, self.lateral_speed)
        return OtherCar(x, y, yaw, speed, yaw_rate=self.speed * curvature, ay=speed * self.speed * curvature)

    @property
    def body(self) -> Motion:
        """As the LiDARs see it, on the banked road."""
        car = self.outline
        bank, grade = self._road.road_at_station(self.station)
        return Motion(
            *(car.x, car.y, self._surface.at(self.station, self.lateral), car.yaw, -grade, -bank),
            velocity=(car.vx, 0.0, 0.0),
            rate=(0.0, 0.0, car.yaw_rate),
        )

    def _curvature(self) -> float:
        ahead, behind = (
            self._road.pose_at((self.station + way) % self._road.length, 0.0)[2] for way in (_APART, -_APART)
        )
        turn = math.remainder(ahead - behind, 2.0 * math.pi)
        return turn / (2.0 * _APART)


def _towards(value: float, target: float, change: float) -> float:
    """A value after it has moved by no more than a change."""
    return value + max(-change, min(change, target - value))
