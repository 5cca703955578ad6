"""The wall in spatial scans: where it is, all around a banked lap, at speed and beside other cars."""

from __future__ import annotations

import math

import numpy as np
import pytest

import scenarios
from autonomy.detection.cloud import Pose
from autonomy.detection.radar import OwnMotion
from autonomy.track_files import load_track
from autonomy.vehicle import load_vehicle
from autonomy.wall_node import WallNode
from bridge.sensors.spatial_lidar import Motion
from bridge.sensors.suite import SensorSuite
from bridge.sensors.surfaces import WALL_HEIGHT
from bridge.sensors.truth import Truth
from dbc.codec import database
from dbc.frames import iterate

TRACK = load_track(scenarios.DIRECTORY / "tracks" / "lvms.yaml")
TO_AXLE = load_vehicle(scenarios.DIRECTORY / "vehicles" / "av21.yaml")["cg_to_rear_axle"]
LINE = database.message("wall_line")
SPEED = 60.0
SEED = 5


def wall_beside(frames: bytes) -> float:
    """Distance of the wall to the left of the car, m, as sent; NaN when none was found."""
    (line,) = (frame for frame in iterate(frames) if frame.id == LINE.frame_id)
    values = dict(zip(LINE.signals, LINE.decode(line.data), strict=True))
    return values["wall_offset"] if values["wall_share"] > 0.0 else math.nan


@pytest.mark.parametrize("lateral", [-4.5, 0.0, 5.0])
@pytest.mark.parametrize("moves", [True, False], ids=["motion known", "motion not known"])
def test_the_wall_is_where_it_is_all_around_the_lap(lateral: float, moves: bool) -> None:
    """Along the banked road, so farther than in the plan by its bank; another car drives ahead."""
    print(f"seed {SEED}")
    suite = SensorSuite(TRACK.origin, SEED, TRACK.walls(), TO_AXLE, spatial=TRACK)
    off = []
    for station in np.arange(0.0, TRACK.length, 62.0).tolist():
        x, y, yaw = TRACK.pose_at(station, lateral)
        bank, _ = TRACK.road_at_station(station)
        rate = SPEED * float(TRACK.centre.at(np.array(station))[3])
        truth = Truth(x, y, 0.0, yaw, SPEED, 0.0, rate, -bank, *(0.0,) * 7)
        ahead = (station + 25.0) % TRACK.length
        place, its_bank = TRACK.pose_at(ahead, -2.0), TRACK.road_at_station(ahead)[0]
        car = Motion(place[0], place[1], 2.0 * math.tan(its_bank), place[2], roll=-its_bank, velocity=(SPEED, 0.0, 0.0))
        cloud = suite.scan(40_000, truth, [car])
        motion = OwnMotion(Pose(x, y, yaw, roll=-bank), SPEED, 0.0, rate) if moves else None
        beside = wall_beside(WallNode(TRACK, spatial=True).tick(40_000, cloud, motion))
        middle = 0.5 * WALL_HEIGHT * math.sin(bank)  # an upright wall leans away from a banked car
        off.append(beside + (7.45 + lateral) / math.cos(bank) + middle)
    assert np.isfinite(off).all(), "found everywhere"
    assert np.abs(off).max() < (0.12 if moves else 0.3)
