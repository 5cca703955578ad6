"""Staying behind another car: speeds against the braking distances that they are made from, and who is in the way."""

from __future__ import annotations

import math

import numpy as np
import pytest

import scenarios
from autonomy.following import CarAhead, FollowSettings, cars_ahead, speed_behind
from autonomy.localisation import Estimate, Quality
from autonomy.opponents.prediction import Prediction
from autonomy.planning import POINTS, Plan, Planner
from autonomy.race_path import RacePath
from autonomy.status import Mission, SsmStatus, VehicleStatus
from autonomy.track import Track
from autonomy.track_files import load_track
from autonomy.vehicle import VehicleLimits, load_vehicle
from dbc.states import CtState, SsmState, VehicleFlag

AV21 = scenarios.DIRECTORY / "vehicles" / "av21.yaml"
SETTINGS = FollowSettings()
TIMES = np.arange(41) * 0.1


@pytest.fixture(scope="module")
def track() -> Track:
    return load_track(scenarios.DIRECTORY / "tracks" / "lvms.yaml")


@pytest.fixture(scope="module")
def limits() -> VehicleLimits:
    return VehicleLimits.from_parameters(AV21, load_vehicle(AV21))


@pytest.fixture(scope="module")
def path(track: Track, limits: VehicleLimits) -> RacePath:
    return RacePath(track, limits)


def predicted(track: Track, station: float, lateral: float, speed: float) -> Prediction:
    s = (station + speed * TIMES) % track.length
    d = np.full_like(s, lateral)
    x, y = track.centre.offset(s, d)
    return Prediction(7, 0, 0, TIMES, s, d, x, y, track.centre.at(s)[2], np.full_like(s, speed))


def car(gap: float, speed: float) -> CarAhead:
    return CarAhead(1, 0.1, (gap + speed * TIMES).tolist(), [speed] * len(TIMES))


@pytest.mark.parametrize("speed", [0.0, 20.0, 55.0])
@pytest.mark.parametrize("gap", [10.0, 60.0, 150.0])
def test_the_speed_allowed_can_be_braked_off_before_the_distance_kept(gap: float, speed: float) -> None:
    """Relative to the other car the way of braking is (v - v_other)^2 / 2b or less: integrated step by step."""
    own = speed_behind([car(gap, speed)], 0.0, 0.0, SETTINGS)
    kept = SETTINGS.standstill_gap + SETTINGS.headway * speed
    left, dt = gap, 1.0e-3
    while own > speed:
        left += (speed - own) * dt
        own -= SETTINGS.deceleration * dt
    assert left > min(gap, kept) - 0.1


def test_at_the_distance_kept_the_speed_is_the_other_ones() -> None:
    kept = SETTINGS.standstill_gap + SETTINGS.headway * 40.0
    assert speed_behind([car(kept, 40.0)], 0.0, 0.0, SETTINGS) == pytest.approx(40.0)
    assert speed_behind([car(kept - 5.0, 40.0)], 0.0, 0.0, SETTINGS) < 40.0
    assert speed_behind([car(2.0, 0.0)], 0.0, 0.0, SETTINGS) == 0.0


def test_the_gap_is_that_of_the_time_at_the_place() -> None:
    """After two seconds and 100 m of the plan, a car at 30 m/s is 60 m farther on."""
    now = speed_behind([car(80.0 - 100.0 + 60.0, 30.0)], 0.0, 0.0, SETTINGS)
    assert speed_behind([car(80.0, 30.0)], 2.0, 100.0, SETTINGS) == pytest.approx(now)
    later = speed_behind([car(80.0, 30.0)], 6.0, 0.0, SETTINGS)
    assert later == pytest.approx(speed_behind([car(80.0 + 180.0, 30.0)], 0.0, 0.0, SETTINGS)), "beyond the horizon"


def test_the_nearest_counts_and_nobody_allows_everything() -> None:
    near, far = car(30.0, 40.0), car(120.0, 20.0)
    each = [speed_behind([one], 0.0, 0.0, SETTINGS) for one in (near, far)]
    assert speed_behind([near, far], 0.0, 0.0, SETTINGS) == min(each)
    assert speed_behind([], 0.0, 0.0, SETTINGS) == math.inf


def test_who_is_ahead_and_in_the_way(track: Track, path: RacePath) -> None:
    """On the back straight the race line is 5.2 m to the right of the centre line."""
    own = 1200.0
    node = float(path.nodes_at(np.array([own]))[0])
    offset = float(np.interp(node, np.arange(path.count), path.race.track_offset))
    assert offset == pytest.approx(-5.2, abs=0.1)

    def found(station: float, lateral: float, speed: float = 30.0) -> list[CarAhead]:
        return cars_ahead([predicted(track, station, lateral, speed)], path, path.race, node, SETTINGS)

    (ahead,) = found(own + 50.0, offset)
    assert ahead.identity == 7
    assert ahead.distance[0] == pytest.approx(50.0 - SETTINGS.length, abs=0.5)
    assert ahead.distance[-1] - ahead.distance[0] == pytest.approx(120.0, abs=1.0)
    assert found(own - 10.0, offset) == [], "behind"
    assert found(own + 50.0, offset + SETTINGS.corridor + 0.3) == [], "beside the line"
    assert found(own + SETTINGS.ahead + 10.0, offset) == [], "far away"
    assert found(own + 240.0, 0.0, 1.0) == []


def test_a_car_that_the_race_line_will_come_to_is_in_the_way(track: Track, path: RacePath) -> None:
    """At 1371 m the line is on the right, at 1553 m on the left; a car on the left is in the way before it is there."""
    node = float(path.nodes_at(np.array([1400.0]))[0])
    assert cars_ahead([predicted(track, 1420.0, 4.4, 45.0)], path, path.race, node, SETTINGS)
    assert not cars_ahead([predicted(track, 1420.0, 4.4, 5.0)], path, path.race, node, SETTINGS)


@pytest.mark.parametrize("own", [5.0, 2460.0])
def test_the_line_of_start_and_finish_does_not_matter(track: Track, path: RacePath, own: float) -> None:
    node = float(path.nodes_at(np.array([own]))[0])
    place = (own + 40.0) % track.length
    lateral = float(np.interp(path.nodes_at(np.array([place]))[0], np.arange(path.count), path.race.track_offset))
    (ahead,) = cars_ahead([predicted(track, place, lateral, 30.0)], path, path.race, node, SETTINGS)
    assert ahead.distance[0] == pytest.approx(40.0 - SETTINGS.length, abs=0.5)


def planned(path: RacePath, limits: VehicleLimits, *others: Prediction) -> Plan:
    """The plan of a car that has driven 60 m/s on the back straight, one second after it has seen the others."""
    planner = Planner(path, limits)
    ssm = SsmStatus(SsmState.NOMINAL, 60.0, 8.0, 10.0)
    vehicle = VehicleStatus(CtState.NOM_RACE, VehicleFlag.NONE, 70.0)
    node = round(float(path.nodes_at(np.array([1150.0]))[0]))
    place = Estimate._make([0.0] * len(Estimate._fields))._replace(vx=60.0, source=0, quality=Quality.GOOD)
    for tick in range(41):
        station = node + round(tick * 0.05 * 60.0 / path.spacing)
        at = station % path.count
        x, y, yaw = float(path.race.x[at]), float(path.race.y[at]), float(path.race.yaw[at])
        plan = planner.plan(place._replace(x=x, y=y, yaw=yaw), ssm, vehicle, others if tick > 20 else ())
    return plan


def test_a_plan_brakes_for_a_slower_car_and_no_other(track: Track, path: RacePath, limits: VehicleLimits) -> None:
    free = planned(path, limits)
    assert free.mission is Mission.RACE
    assert not free.follows
    slow = planned(path, limits, predicted(track, 1370.0, -5.2, 20.0))
    assert slow.follows
    assert slow.speed[-1] == pytest.approx(20.0, abs=3.0)
    assert slow.speed.min() > 15.0, "to its speed, and not much below to open the gap"
    assert free.speed[-1] > 55.0
    beside = planned(path, limits, predicted(track, 1330.0, 1.0, 20.0))
    faster = planned(path, limits, predicted(track, 1370.0, -5.2, 70.0))
    for other in (beside, faster):
        assert not other.follows
        assert other.speed.tolist() == free.speed.tolist()


def test_no_plan_brakes_harder_than_allowed(track: Track, path: RacePath, limits: VehicleLimits) -> None:
    plan = planned(path, limits, predicted(track, 1300.0, -5.2, 0.0))
    assert plan.follows
    assert len(plan.speed) == POINTS
    deceleration = -np.diff(plan.speed**2) / (2.0 * plan.spacing)
    assert 4.0 < deceleration.max() <= SETTINGS.hard_deceleration + 1e-6
