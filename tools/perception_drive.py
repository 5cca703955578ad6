"""What perception is evaluated on: a drive of the bench, another car on its road, and what the sensors see of both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.motion_compensation import AgedCloud
from autonomy.detection.radar import OwnMotion
from autonomy.partition import AutonomyPartition
from autonomy.perception_nodes import own_motion
from autonomy.track import Track
from bridge.bench import Bench, Progress
from bridge.scenario import Condition, Scenario, load_vehicle
from bridge.sensors import lidar
from bridge.sensors.lidar import AXLE_HEIGHT
from bridge.sensors.radar import Radar
from bridge.sensors.radar_scene import OtherCar
from bridge.sensors.spatial_lidar import Motion, SpatialLidar
from bridge.sensors.surfaces import track_mesh
from bridge.sensors.truth import Truth
from dbc.radar_tracks import Tracks
from tools.run import load_road, make_autonomy


class DriveTick(NamedTuple):
    """One tick of a drive.

    Attributes
    ----------
    time_us : start of the tick.
    truth : of the own car.
    station, lateral : of the own car, m; the station grows from lap to lap.
    motion : as estimated; None before there is an estimate.
    """

    time_us: int
    truth: Truth
    station: float
    lateral: float
    motion: OwnMotion | None


class _Noting:
    """Autonomy that notes where the car is, and where it takes itself to be, tick by tick."""

    def __init__(self, autonomy: AutonomyPartition, track: Track) -> None:
        self._autonomy = autonomy
        self._track = track
        self._laps, self._before = 0, 0.0
        self.bench: Bench
        self.ticks: list[DriveTick] = []

    def tick(self, now_us: int, frames: bytes, cloud: NDArray[np.float32] | None = None) -> bytes:
        sent = self._autonomy.tick(now_us, frames, cloud)
        truth, track = self.bench.truth, self._track
        station, lateral = track.project(truth.x, truth.y)
        self._laps += round((self._before - station) / track.length)
        self._before = station
        estimate = self._autonomy.estimate
        motion = None if estimate is None else own_motion(estimate, track)
        self.ticks.append(DriveTick(now_us, truth, station + self._laps * track.length, lateral, motion))
        return sent


def record_drive(
    scenario: Scenario, until: Condition | None = None, on_progress: Callable[[Progress], None] | None = None
) -> tuple[Track, list[DriveTick]]:
    """Drive a scenario and note where the car was, and where it took itself to be.

    Parameters
    ----------
    until : the scenario's finish by default.
    on_progress : see `Bench.run`.

    Raises
    ------
    RaceloopError
        When a file that the scenario names is wrong.
    """
    track = load_road(scenario, scenario.track)
    noting = _Noting(make_autonomy(scenario, track), track)
    with Bench.from_scenario(scenario, partial(load_road, scenario), lambda _scenario, _road: noting) as bench:
        noting.bench = bench
        bench.run(until, on_progress)
    return track, noting.ticks


@dataclass(frozen=True)
class CarAhead:
    """Another car, whose distance sweeps from near to far and back, and which changes its lane.

    Attributes
    ----------
    track : on which it drives.
    nearest, farthest : m ahead along the centre line.
    sweep_s : from near to far and back.
    lateral, lane_s : m to each side, and s for both.
    """

    track: Track
    nearest: float = 8.0
    farthest: float = 125.0
    sweep_s: float = 40.0
    lateral: float = 3.0
    lane_s: float = 23.0

    def at(self, tick: DriveTick) -> tuple[OtherCar, Motion]:
        """The car at a tick, for the radar and for the LiDARs."""
        truth, time_s = tick.truth, tick.time_us * 1e-6
        sweep = 2.0 * math.pi * time_s / self.sweep_s
        half = 0.5 * (self.farthest - self.nearest)
        gap = self.nearest + half * (1.0 - math.cos(sweep))
        gap_rate = half * math.sin(sweep) * 2.0 * math.pi / self.sweep_s
        phase = 2.0 * math.pi * time_s / self.lane_s
        lateral = self.lateral * math.sin(phase)
        lateral_rate = self.lateral * math.cos(phase) * 2.0 * math.pi / self.lane_s
        _, _, own_heading, own_curvature = map(float, self.track.centre.at(np.array(tick.station)))
        off = truth.yaw - own_heading
        own_rate = (truth.vx * math.cos(off) - truth.vy * math.sin(off)) / (1.0 - own_curvature * tick.lateral)
        rate = max(own_rate + gap_rate, 0.0)
        station = (tick.station + gap) % self.track.length
        curvature = float(self.track.centre.at(np.array(station))[3])
        x, y, yaw = self.track.pose_at(station, lateral)
        bank, _ = self.track.road_at_station(station)
        along, yaw_rate = rate * (1.0 - curvature * lateral), rate * curvature
        seen = Motion(
            *(x, y, -lateral * math.tan(bank), yaw),
            roll=-bank,
            velocity=(along, lateral_rate, 0.0),
            rate=(0.0, 0.0, yaw_rate),
        )
        return OtherCar(x, y, yaw, along, lateral_rate, yaw_rate), seen


class Sensed(NamedTuple):
    """What the sensors gave in a tick, and the other car, if there is one."""

    tick: DriveTick
    car: OtherCar | None
    scan: AgedCloud | None
    tracks: Tracks | None


def sense(
    track: Track, scenario: Scenario, ticks: list[DriveTick], seed: int, ahead: CarAhead | None
) -> Iterator[Sensed]:
    """LiDAR scans and radar tracks along a drive; everything random follows from the seed.

    The vehicle frame is on the ground below the centre of gravity.
    """
    to_axle = load_vehicle(scenario.vehicle).get("cg_to_rear_axle", 0.0)
    generators = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(2)]
    lidars = SpatialLidar(track_mesh(track), generators[0], origin=(to_axle, 0.0, -AXLE_HEIGHT))
    radar = Radar(track.walls(), to_axle, generators[1])
    for tick in ticks:
        other, seen = (None, None) if ahead is None else ahead.at(tick)
        scan = tracks = None
        if lidar.due(tick.time_us):
            scan = lidars.scan(_own(track, tick), [] if seen is None else [seen]).aged
        if radar.due(tick.time_us):
            tracks = radar.scan(tick.truth, [] if other is None else [other])
        yield Sensed(tick, other, scan, tracks)


def _own(track: Track, tick: DriveTick) -> Motion:
    truth = tick.truth
    bank, _ = track.road_at_station(tick.station % track.length)
    return Motion(
        *(truth.x, truth.y, -tick.lateral * math.tan(bank), truth.yaw, truth.pitch, truth.roll),
        velocity=(truth.vx, truth.vy, 0.0),
        rate=(0.0, 0.0, truth.yaw_rate),
    )
