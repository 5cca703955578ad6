"""Planning at 20 Hz: which mission, which path, how fast along it.

The speed of a plan is a function of the place. A new plan begins with the speed that the previous one had where the
new one starts, so measurement noise does not get into the reference; only when the car and the plan are far apart
does the plan give way to the car.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from autonomy.following import CarAhead, FollowSettings, cars_ahead, speed_behind
from autonomy.frenet import FloatArray
from autonomy.localisation import Estimate
from autonomy.opponents.prediction import Prediction
from autonomy.race_path import Path, RacePath
from autonomy.status import Mission, SsmStatus, VehicleStatus
from autonomy.vehicle import VehicleLimits
from dbc.states import CtState, SsmState, VehicleFlag

POINTS = 32
LONGEST_STEP = 5  # nodes of the path between two points


@dataclass(frozen=True)
class Plan:
    """Trajectory: points of the path ahead with their speeds, shape (n,) each.

    Attributes
    ----------
    mission : what it is for.
    ends_in_stop : the last speed is 0; beyond the first 0 the path only leads straight on.
    origin_s : station of the first point on the track's centre line, m.
    x, y, yaw, curvature, speed, bank : of the points; heading and curvature of the path.
    spacing : of the points along the race line, m.
    follows : it is slower than it would be without the cars ahead.
    """

    mission: Mission
    ends_in_stop: bool
    origin_s: float
    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    curvature: FloatArray
    speed: FloatArray
    bank: FloatArray
    spacing: float
    follows: bool


@dataclass(frozen=True)
class PlannerSettings:
    """Comfort and geometry of the plans.

    Attributes
    ----------
    jerk : m/s3, with which acceleration changes in free driving.
    deceleration : m/s2, of slowing down and stopping.
    hard_deceleration : m/s2, on a path that is slower than the car.
    drive_margin, traction_margin : share of the engine's acceleration and of the tyres' grip that a plan asks for.
    lead : m/s, by which plan and car may differ before the plan gives way.
    behind : m, of the first point behind the car, at least.
    preview : s, of travel between two points.
    standing : m/s, below which the car counts as standing.
    relay : m beside its path, from which on the path of a standing car is laid anew.
    """

    jerk: float = 3.0
    deceleration: float = 4.0
    hard_deceleration: float = 6.0
    drive_margin: float = 0.8
    traction_margin: float = 0.8
    lead: float = 3.0
    behind: float = 1.0
    preview: float = 0.12
    standing: float = 0.5
    relay: float = 1.0


def choose_mission(ssm: SsmStatus, vehicle: VehicleStatus, on_race_line: bool) -> Mission:
    """Mission by race control's flags and the state of the car.

    Anything not known to allow driving is HOLD.
    """
    if ssm.state == SsmState.EMERGENCY:
        return Mission.STOP
    if ssm.state not in (SsmState.NOMINAL, SsmState.DEGRADED):
        return Mission.HOLD
    state = vehicle.ct_state
    if state == CtState.COORD_STOP:
        return Mission.STOP
    if state in (CtState.CAUTION, CtState.NOM_RACE) and vehicle.vehicle_flag == VehicleFlag.CHEQUERED:
        return Mission.STOP
    if state == CtState.NOM_RACE:
        return Mission.RACE
    if state in (CtState.INIT_DRIVING, CtState.CAUTION):
        return Mission.CAUTION if on_race_line else Mission.PIT_OUT
    return Mission.HOLD


class Planner:
    """Makes plans.

    Parameters
    ----------
    path : race line of the track.
    vehicle : limits of the car.
    settings, follow : see there.
    """

    _TABLE_STEP = 0.5  # m/s

    def __init__(
        self,
        path: RacePath,
        vehicle: VehicleLimits,
        settings: PlannerSettings | None = None,
        follow: FollowSettings | None = None,
    ) -> None:
        self._settings = settings or PlannerSettings()
        self._follow = follow or FollowSettings()
        self._race_path = path
        self._use(path.race)
        self._laid = False
        self._blend_left = 0.0  # m of the way on to the race line
        self._last_station = 0.0
        self._mission = Mission.HOLD
        self._stop_node: int | None = None
        # The last plan: first node, nodes per point, speed at each point, acceleration with which it is reached.
        self._first, self._step = 0, 1
        self._speed = [0.0] * POINTS
        self._acceleration = [0.0] * POINTS
        top = float(path.race.speed_limit.max())
        self._drive: list[float] = [
            self._settings.drive_margin
            * max(0.0, vehicle.acceleration_range(speed, 0.0, 0.0, 0.0, self._settings.traction_margin)[1])
            for speed in np.arange(0.0, top + 2.0 * self._TABLE_STEP, self._TABLE_STEP).tolist()
        ]
        self._follows = False
        self.cross_track = 0.0

    def plan(
        self,
        estimate: Estimate,
        ssm: SsmStatus,
        vehicle: VehicleStatus,
        predictions: Iterable[Prediction] = (),
    ) -> Plan:
        """Make the plan of this cycle.

        Parameters
        ----------
        estimate : of the car's motion now.
        ssm, vehicle : newest status of the SSM and the car.
        predictions : of the other cars, from now on.
        """
        station, _ = self._race_path.project(estimate.x, estimate.y)
        mission = choose_mission(ssm, vehicle, self._blend_left <= 0.0)
        self._follow_path(estimate, station, mission)
        speed_here, _ = self._planned(station / self._race_path.spacing)
        # The plan gives way to a car that it has lost, by no more than the excess.
        gap = speed_here - estimate.vx
        excess = gap - max(-self._settings.lead, min(self._settings.lead, gap))
        first, step = self._anchor(station, speed_here - excess)
        speed, acceleration = self._planned(first)
        speed = max(0.0, speed - excess)
        if mission is Mission.STOP:
            if self._stop_node is None:
                self._stop_node = self._stopping_node(first, speed, acceleration, ssm)
        else:
            self._stop_node = None
        max_speed = ssm.max_speed
        if mission in (Mission.PIT_OUT, Mission.CAUTION):
            max_speed = min(max_speed, vehicle.round_target_speed)
        self._follows = False
        if mission is Mission.HOLD:
            self._speed, self._acceleration = [0.0] * POINTS, [0.0] * POINTS
        else:
            node = station / self._race_path.spacing
            cars = cars_ahead(predictions, self._race_path, self._path, node, self._follow)
            self._speed, self._acceleration = self._march((first, step), (speed, acceleration), max_speed, ssm, cars)
        self._first, self._step, self._mission = first, step, mission
        return self._cut()

    def _use(self, path: Path) -> None:
        self._path = path
        self._limit_cap = math.nan  # what _limit was made for: nothing yet

    def _limit_below(self, max_speed: float) -> list[float]:
        if max_speed != self._limit_cap:
            self._limit: list[float] = self._race_path.limit_below(self._path, max_speed).tolist()
            self._limit_cap = max_speed
        return self._limit

    def _follow_path(self, estimate: Estimate, station: float, mission: Mission) -> None:
        """Lay the way on to the race line where the car stands, once, and leave it behind at its end."""
        half = 0.5 * self._race_path.length
        moved = (station - self._last_station + half) % self._race_path.length - half
        self._last_station = station
        self.cross_track = self._off_path(estimate, station)
        standing = abs(estimate.vx) < self._settings.standing
        leaving_hold = self._mission is Mission.HOLD and mission is not Mission.HOLD
        if not self._laid or (standing and (leaving_hold or abs(self.cross_track) > self._settings.relay)):
            path, self._blend_left = self._race_path.blend(estimate.x, estimate.y, estimate.yaw)
            self._use(path)
            self._laid = True
            self.cross_track = 0.0
        elif self._path is not self._race_path.race:
            self._blend_left -= moved
            # Points just behind the car may still lie on the blend.
            if self._blend_left < -2.0 * LONGEST_STEP * self._race_path.spacing:
                self._use(self._race_path.race)

    def _off_path(self, estimate: Estimate, station: float) -> float:
        """Offset of the car to the left of the path, m."""
        node = round(station / self._race_path.spacing) % self._race_path.count
        yaw = float(self._path.yaw[node])
        dx, dy = estimate.x - float(self._path.x[node]), estimate.y - float(self._path.y[node])
        return dy * math.cos(yaw) - dx * math.sin(yaw)

    def _anchor(self, station: float, speed: float) -> tuple[int, int]:
        """First node and nodes per point. Points lie on multiples of the step, so plans share their points."""
        spacing = self._race_path.spacing
        step = max(1, min(LONGEST_STEP, round(speed * self._settings.preview / spacing)))
        return math.floor((station - self._settings.behind) / (step * spacing)) * step % self._race_path.count, step

    def _planned(self, node: float) -> tuple[float, float]:
        """Speed and acceleration of the last plan at a node position; 0 beyond its end."""
        count = self._race_path.count
        position = ((node - self._first + count // 2) % count - count // 2) / self._step
        if position >= POINTS - 1:
            return 0.0, 0.0
        # A longer step may put the new first point before the old one: carry the first acceleration back.
        i = max(0, int(position))
        fraction = position - i
        low, high = self._speed[i] ** 2, self._speed[i + 1] ** 2
        if fraction < 0.0:
            squared = low + 2.0 * fraction * self._step * self._race_path.spacing * self._acceleration[0]
            return math.sqrt(max(0.0, squared)), self._acceleration[0]
        acceleration = self._acceleration[i] if fraction == 0.0 else self._acceleration[i + 1]
        return math.sqrt(low + fraction * (high - low)), acceleration

    def _deceleration(self, ssm: SsmStatus) -> float:
        # A limit of 0 cannot forbid slowing down.
        return max(0.5, min(self._settings.deceleration, ssm.max_deceleration))

    def _stopping_node(self, first: int, speed: float, acceleration: float, ssm: SsmStatus) -> int:
        """Node at which a comfortable stop ends, the onset of the deceleration included."""
        deceleration, jerk = self._deceleration(ssm), self._settings.jerk
        onset = 0.5 * deceleration / jerk + max(0.0, acceleration) / jerk
        distance = speed * onset + speed * speed / (2.0 * deceleration)
        return (first + math.ceil(distance / self._race_path.spacing)) % self._race_path.count

    def _march(
        self,
        grid: tuple[int, int],
        start: tuple[float, float],
        max_speed: float,
        ssm: SsmStatus,
        cars: Sequence[CarAhead],
    ) -> tuple[list[float], list[float]]:
        """Speeds of the points on the grid (first node, nodes per point), and the accelerations that lead to them.

        Cars tell their distance from the own one, which is a little ahead of the first point.
        """
        (first, step), (speed, acceleration) = grid, start
        count, spacing = self._race_path.count, self._race_path.spacing
        distance = step * spacing
        jerk, deceleration = self._settings.jerk, self._deceleration(ssm)
        limit, drive, stop = self._limit_below(max_speed), self._drive, self._stop_node
        hardest = min(self._follow.hard_deceleration, max(0.5, ssm.max_deceleration))
        time_s, way = 0.0, -self._settings.behind
        speeds, accelerations = [speed], [acceleration]
        for i in range(1, POINTS):
            node = (first + i * step) % count
            if speed < max_speed:
                most = min(ssm.max_acceleration, drive[min(int(speed / self._TABLE_STEP), len(drive) - 1)])
                # No more than the jerk can take back before the speed is reached.
                wish = min(most, math.sqrt(2.0 * jerk * max(0.0, min(max_speed, limit[node]) - speed)))
            else:
                wish = -min(deceleration, math.sqrt(2.0 * jerk * (speed - max_speed)))
            stopped = False
            if stop is not None:
                nodes_left = (stop - node + count // 2) % count - count // 2
                stopped = nodes_left <= 0
                if not stopped:
                    wish = min(wish, -0.5 * speed * speed / (nodes_left * spacing + distance))
            onset = jerk
            if cars:
                way += distance
                held = self._wish_behind(speed, speed_behind(cars, time_s, way, self._follow), hardest)
                if held < wish:
                    wish, self._follows = held, True
                # Brakes for another car are applied and released faster than in free driving.
                if min(wish, acceleration) < 0.0 and self._follows:
                    onset = self._follow.jerk
            # Jerk times the time to the next point; a car that starts takes its first acceleration at once.
            change = onset * distance / max(speed, 1.0)
            squared = speed * speed + 2.0 * distance * max(acceleration - change, min(acceleration + change, wish))
            new_speed = 0.0 if stopped or squared <= 0.0 else math.sqrt(squared)
            arrived = (new_speed > max_speed) != (speed > max_speed)
            if arrived:
                new_speed = max_speed
            if new_speed > limit[node]:
                # Only a path that was changed under the car is too fast at its first point: then brake.
                slowest = math.sqrt(max(0.0, speed * speed - 2.0 * distance * self._settings.hard_deceleration))
                new_speed = max(limit[node], min(new_speed, slowest))
            acceleration = 0.0 if arrived else (new_speed * new_speed - speed * speed) / (2.0 * distance)
            time_s += 2.0 * distance / max(speed + new_speed, 0.1)
            speed = new_speed
            speeds.append(speed)
            accelerations.append(acceleration)
        return speeds, accelerations

    def _wish_behind(self, speed: float, allowed: float, hardest: float) -> float:
        """Acceleration by which a speed comes to the one that is allowed behind another car."""
        if speed <= allowed:
            return math.sqrt(2.0 * self._settings.jerk * (allowed - speed))
        return -min(hardest, math.sqrt(2.0 * self._follow.jerk * (speed - allowed)))

    def _cut(self) -> Plan:
        nodes = (self._first + self._step * np.arange(POINTS)) % self._race_path.count
        path = self._path
        return Plan(
            mission=self._mission,
            ends_in_stop=self._speed[-1] == 0.0,
            origin_s=float(path.track_station[self._first]),
            x=path.x[nodes],
            y=path.y[nodes],
            yaw=path.yaw[nodes],
            curvature=path.curvature[nodes],
            speed=np.array(self._speed),
            bank=path.bank[nodes],
            spacing=self._step * self._race_path.spacing,
            follows=self._follows,
        )
