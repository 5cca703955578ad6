"""Cars that drive by a script: against the equations of uniformly accelerated motion, and their two looks agree."""

from __future__ import annotations

import math

import numpy as np
import pytest

import scenarios
from autonomy.track_files import load_track
from bridge.condition import Condition, Situation
from bridge.opponents import LATERAL_ACCELERATION, LATERAL_SPEED, ScriptedCar
from bridge.scenario import Opponent, OpponentStep
from bridge.sensors.surfaces import RoadSurface

TRACK = load_track(scenarios.DIRECTORY / "tracks" / "lvms.yaml")
SURFACE = RoadSurface(TRACK)
DT = 0.01


def car(*script: OpponentStep, station: float = 100.0, lateral: float = 2.0) -> ScriptedCar:
    return ScriptedCar(Opponent("other", station, lateral, script), TRACK, SURFACE)


def drive(one: ScriptedCar, seconds: float, begin_s: float = 0.0) -> None:
    for tick in range(round(seconds / DT)):
        one.act(Situation(round((begin_s + tick * DT) * 1e6), 0, 0, 0.0, 0, True))
        one.advance(DT)


def test_it_stands_until_it_is_told() -> None:
    one = car(OpponentStep(Condition(time_us=2_000_000), speed_mps=10.0))
    drive(one, 2.0)
    assert (one.station, one.lateral, one.speed) == (100.0, 2.0, 0.0)
    assert one.outline[3:5] == (0.0, 0.0)
    drive(one, 0.01, 2.0)
    assert one.speed > 0.0


def test_it_accelerates_evenly_and_keeps_its_speed() -> None:
    """30 m/s at 5 m/s2 takes 6 s and 90 m; then 4 s at 30 m/s."""
    one = car(OpponentStep(Condition(), speed_mps=30.0))
    drive(one, 10.0)
    assert one.speed == pytest.approx(30.0)
    assert one.station == pytest.approx(100.0 + 90.0 + 4.0 * 30.0, abs=1e-6)
    assert one.lateral == 2.0


def test_it_brakes_to_a_standstill_and_not_beyond() -> None:
    one = car(
        OpponentStep(Condition(), speed_mps=30.0, acceleration_mps2=30.0),
        OpponentStep(Condition(time_us=2_000_000), speed_mps=0.0, acceleration_mps2=10.0),
    )
    drive(one, 2.0)
    before = one.station
    drive(one, 5.0, 2.0)
    assert one.speed == 0.0
    assert one.station - before == pytest.approx(30.0**2 / 20.0, abs=1e-6)


def test_it_goes_over_to_another_line_and_stays_on_it() -> None:
    one = car(
        OpponentStep(Condition(), speed_mps=40.0, acceleration_mps2=20.0),
        OpponentStep(Condition(time_us=3_000_000), d_m=-4.0),
    )
    drive(one, 3.0)
    places, speeds = [], []
    for tick in range(800):
        drive(one, DT, 3.0 + tick * DT)
        places.append(one.lateral)
        speeds.append(one.lateral_speed)
    assert one.lateral == pytest.approx(-4.0, abs=0.01)
    assert min(places) > -4.1
    assert max(np.abs(speeds)) == pytest.approx(LATERAL_SPEED)
    assert max(np.abs(np.diff(speeds))) <= LATERAL_ACCELERATION * DT + 1e-9
    assert one.speed == 40.0


def test_a_car_that_stands_does_not_go_sideways() -> None:
    one = car(OpponentStep(Condition(), d_m=-4.0))
    drive(one, 3.0)
    assert one.lateral == 2.0


def test_the_lap_goes_on_behind_the_line() -> None:
    one = car(OpponentStep(Condition(), speed_mps=50.0, acceleration_mps2=30.0), station=TRACK.length - 20.0)
    drive(one, 3.0)
    assert 0.0 <= one.station < 150.0


def test_its_speed_over_ground_is_that_of_its_place() -> None:
    """Differences of the place, in a turn, while it changes its line."""
    one = car(
        OpponentStep(Condition(), speed_mps=40.0, acceleration_mps2=20.0),
        OpponentStep(Condition(time_us=3_000_000), d_m=-4.0),
        station=450.0,
    )
    drive(one, 5.0)
    before = one.outline
    drive(one, DT, 5.0)
    after = one.outline
    moved = np.array([after.x - before.x, after.y - before.y]) / DT
    assert np.hypot(*moved) == pytest.approx(after.vx, rel=2e-3)
    assert math.atan2(moved[1], moved[0]) == pytest.approx(after.yaw, abs=2e-3)
    assert math.remainder(after.yaw - before.yaw, 2 * math.pi) / DT == pytest.approx(after.yaw_rate, abs=0.06)


def test_both_looks_are_of_one_car() -> None:
    """The radar's in the plane, the LiDARs' on the bank: the same place and speed, at the height of the road."""
    one = car(OpponentStep(Condition(), speed_mps=40.0, acceleration_mps2=20.0), station=600.0, lateral=3.0)
    drive(one, 3.0)
    outline, body = one.outline, one.body
    assert (body.x, body.y, body.yaw, body.velocity) == (outline.x, outline.y, outline.yaw, (outline.vx, 0.0, 0.0))
    bank, _ = TRACK.road_at_station(one.station)
    assert body.z == pytest.approx(-3.0 * math.tan(bank))
    assert body.roll == -bank
    assert bank > 0.3
