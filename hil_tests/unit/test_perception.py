"""Perception as a whole: a car on the road becomes a track, nothing else does, and no input makes it raise."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

import scenarios
from autonomy.detection.cloud import DetectionStatus, Pose
from autonomy.detection.motion_compensation import AgedCloud
from autonomy.detection.radar import OwnMotion, RadarStatus
from autonomy.opponents.tracker import ScanStatus
from autonomy.perception import SILENCE_US, Perceived, Perception, Source
from autonomy.status import NodeStatus
from autonomy.track import Track
from autonomy.track_files import load_track
from bridge.scenario import load_scenario
from bridge.sensors.truth import Truth
from dbc.radar_tracks import TRACK_DTYPE, TRACKS
from tools.perception_drive import CarAhead, DriveTick, Sensed, sense

SCENARIO = load_scenario(scenarios.DIRECTORY / "solo_lap.yaml")
SPEED = 60.0
SECONDS = 2.0


@pytest.fixture(scope="module")
def track() -> Track:
    return load_track(SCENARIO.track)


def drive(track: Track, start: float, lateral: float = 1.0) -> list[DriveTick]:
    """At a constant speed along the centre line, exactly known."""
    ticks = []
    for now_us in range(0, round(SECONDS * 1e6), 10_000):
        station = start + SPEED * now_us * 1e-6
        x, y, yaw = track.pose_at(station % track.length, lateral)
        bank, _ = track.road_at_station(station % track.length)
        curvature = float(track.centre.at(np.array(station))[3])
        along = SPEED * (1.0 - curvature * lateral)
        truth = Truth(x, y, 0.0, yaw, along, 0.0, SPEED * curvature, -bank, *(0.0,) * 7)
        motion = OwnMotion(Pose(x, y, yaw, roll=-bank), along, 0.0, SPEED * curvature)
        ticks.append(DriveTick(now_us, truth, station, lateral, motion))
    return ticks


def ahead(track: Track) -> CarAhead:
    """A car that stays 35 m ahead."""
    return CarAhead(track, nearest=35.0, farthest=35.0, lateral=2.0)


def look(perception: Perception, all_sensed: Iterator[Sensed]) -> list[tuple[Sensed, Perceived]]:
    return [
        (sensed, perception.step(sensed.tick.time_us, sensed.tick.motion, sensed.scan, sensed.tracks))
        for sensed in all_sensed
    ]


@pytest.mark.parametrize("start", [20.0, 700.0])
def test_a_car_ahead_becomes_one_track(track: Track, start: float) -> None:
    print("seed 3")
    seen = look(Perception(track), sense(track, SCENARIO, drive(track, start), 3, ahead(track)))
    outputs = [(sensed, perceived) for sensed, perceived in seen if perceived.tracks is not None]
    assert [perceived.time_us for _, perceived in outputs] == list(range(0, round(SECONDS * 1e6), 20_000))
    last, perceived = outputs[-1]
    assert perceived.tracks is not None
    assert perceived.predictions is not None
    (tracked,) = perceived.tracks
    car = last.car
    assert car is not None
    assert math.hypot(tracked.x - car.x, tracked.y - car.y) < 0.6
    assert math.hypot(tracked.vx, tracked.vy) == pytest.approx(car.vx, abs=3.0)
    (prediction,) = perceived.predictions
    assert prediction.identity == tracked.identity
    assert math.hypot(prediction.x[0] - car.x, prediction.y[0] - car.y) < 1.0


def test_nobody_ahead_is_no_track(track: Track) -> None:
    print("seed 3")
    seen = look(Perception(track), sense(track, SCENARIO, drive(track, 700.0), 3, None))
    assert all(not perceived.tracks for _, perceived in seen)
    statuses = {perceived.lidar.status for _, perceived in seen if perceived.lidar is not None}
    assert statuses == {DetectionStatus.OK}


def test_the_radar_alone_is_enough(track: Track) -> None:
    print("seed 3")
    perception = Perception(track)
    last = None
    for sensed in sense(track, SCENARIO, drive(track, 20.0), 3, ahead(track)):
        last = perception.step(sensed.tick.time_us, sensed.tick.motion, None, sensed.tracks)
        car = sensed.car
    assert last is not None
    assert car is not None
    tracks = perception.step(2_000_000, None).tracks
    assert tracks is not None
    assert min(math.hypot(one.x - car.x, one.y - car.y) for one in tracks) < 3.0
    assert perception.status(2_000_000, Source.RADAR) is NodeStatus.OK
    assert perception.status(2_000_000, Source.LIDAR) is NodeStatus.INITIALIZED


def test_the_same_twice(track: Track) -> None:
    print("seed 5")
    first, second = (
        look(Perception(track), sense(track, SCENARIO, drive(track, 20.0)[:60], 5, ahead(track))) for _ in range(2)
    )
    for (_, one), (_, other) in zip(first, second, strict=True):
        assert repr(one.tracks) == repr(other.tracks)
        if one.fused is not None and other.fused is not None:
            assert one.fused.objects.tobytes() == other.fused.objects.tobytes()


def test_silence_is_an_error(track: Track) -> None:
    print("seed 3")
    perception = Perception(track)
    ticks = drive(track, 20.0)[:30]
    look(perception, sense(track, SCENARIO, ticks, 3, None))
    scans_us = [tick.time_us for tick in ticks if tick.time_us % 50_000 == 40_000]
    for source, last_us in ((Source.LIDAR, scans_us[-1]), (Source.RADAR, scans_us[-1] - 20_000)):
        assert perception.status(last_us + SILENCE_US, source) is NodeStatus.OK
        assert perception.status(last_us + SILENCE_US + 1, source) is NodeStatus.ERROR


def scan_of_ones(count: int = 5, age: float = 0.0) -> AgedCloud:
    return np.hstack((np.ones((count, 3)), np.full((count, 1), age))).astype(np.float32)


BAD_SCANS = {
    "empty": (scan_of_ones(0), DetectionStatus.EMPTY),
    "NaN": (np.hstack((np.full((4, 3), np.nan), np.zeros((4, 1)))).astype(np.float32), DetectionStatus.NOTHING_FINITE),
    "float64": (np.ones((4, 4)), DetectionStatus.NOT_FLOAT32),
    "wrong shape": (np.ones((4, 2), np.float32), DetectionStatus.BAD_SHAPE),
    "no ages": (np.ones((4, 3), np.float32), DetectionStatus.BAD_SHAPE),
    "not an array": ("cloud", DetectionStatus.NOT_FLOAT32),
    "too many": (scan_of_ones(98_305), DetectionStatus.TOO_MANY_POINTS),
    "an age of NaN": (scan_of_ones(5, math.nan), DetectionStatus.BAD_AGE),
    "an age without end": (scan_of_ones(5, math.inf), DetectionStatus.BAD_AGE),
}


@pytest.mark.parametrize(("scan", "status"), BAD_SCANS.values(), ids=BAD_SCANS)
def test_a_bad_scan_is_a_status(track: Track, scan: AgedCloud, status: DetectionStatus) -> None:
    perception = Perception(track)
    (tick,) = drive(track, 20.0)[:1]
    perceived = perception.step(40_000, tick.motion, scan, None)
    assert perceived.lidar is not None
    assert perceived.lidar.status is status
    assert perceived.fused is None
    assert perceived.used is None
    assert perception.status(40_000, Source.LIDAR) is NodeStatus.INITIALIZED


def tracks_of(count: int) -> np.ndarray:
    tracks = np.zeros(count, TRACK_DTYPE)
    tracks["id"] = np.arange(1, count + 1)
    tracks["status"], tracks["mode"], tracks["range"] = 3, 1, np.linspace(5.0, 60.0, count)
    return tracks


BAD_RADAR = {
    "not tracks": (np.zeros(4), RadarStatus.NOT_TRACKS),
    "wrong shape": (np.zeros((2, 2), TRACK_DTYPE), RadarStatus.BAD_SHAPE),
    "too many": (tracks_of(TRACKS + 1), RadarStatus.TOO_MANY_TRACKS),
    "numbers twice": (np.concatenate((tracks_of(2), tracks_of(2))), RadarStatus.BAD_NUMBERS),
}


@pytest.mark.parametrize(("tracks", "status"), BAD_RADAR.values(), ids=BAD_RADAR)
def test_a_bad_radar_scan_is_a_status(track: Track, tracks: object, status: RadarStatus) -> None:
    perception = Perception(track)
    (tick,) = drive(track, 20.0)[:1]
    perceived = perception.step(30_000, tick.motion, None, tracks)
    assert perceived.radar is not None
    assert perceived.radar.status is status
    assert perception.status(30_000, Source.RADAR) is NodeStatus.INITIALIZED


def test_all_radar_tracks_valid(track: Track) -> None:
    perception = Perception(track)
    for number, tick in enumerate(drive(track, 20.0)[:40]):
        tracks = tracks_of(TRACKS) if tick.time_us % 50_000 == 30_000 else None
        if tracks is not None:
            tracks["rolling_count"] = tick.time_us // 50_000 % 2
        perceived = perception.step(tick.time_us, tick.motion, None, tracks)
        if tracks is not None:
            assert perceived.radar is not None
            assert perceived.radar.status is RadarStatus.OK, number


def test_frozen_sensors_are_noticed(track: Track) -> None:
    """The same bytes again are no scan; the next one that differs is."""
    perception = Perception(track)
    first, second = tracks_of(3), tracks_of(3)
    second["rolling_count"] = 1
    scans = [scan_of_ones(), scan_of_ones(), scan_of_ones(6)]
    statuses = []
    for number, (scan, tracks) in enumerate(zip(scans, (first, first.copy(), second), strict=True)):
        tick = drive(track, 20.0)[5 * number]
        perceived = perception.step(tick.time_us, tick.motion, scan, tracks)
        assert perceived.lidar is not None
        assert perceived.radar is not None
        statuses.append((perceived.lidar.status, perceived.radar.status))
        assert (perceived.fused is None) is (number == 1)
    good, frozen = (DetectionStatus.OK, RadarStatus.OK), (DetectionStatus.FROZEN, RadarStatus.FROZEN)
    assert statuses == [good, frozen, good]


def test_a_buffer_that_is_used_again_is_no_frozen_scan(track: Track) -> None:
    perception, tick = Perception(track), drive(track, 20.0)[0]
    points, tracks = scan_of_ones(), tracks_of(3)
    for number in range(3):
        points[0, 0] = number
        tracks["rolling_count"] = number % 2
        perceived = perception.step(50_000 * number, tick.motion, points, tracks)
        assert perceived.lidar is not None
        assert perceived.radar is not None
        assert perceived.lidar.status is DetectionStatus.OK
        assert perceived.radar.status is RadarStatus.OK


def test_frozen_for_long_is_an_error(track: Track) -> None:
    perception = Perception(track)
    scan, tracks = scan_of_ones(), tracks_of(3)
    for tick in drive(track, 20.0)[:30:5]:
        perception.step(tick.time_us, tick.motion, scan, tracks)
    assert perception.status(SILENCE_US, Source.LIDAR) is NodeStatus.OK
    assert perception.status(250_000, Source.LIDAR) is NodeStatus.ERROR
    assert perception.status(250_000, Source.RADAR) is NodeStatus.ERROR


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bad_pose_is_a_status(track: Track, bad: float) -> None:
    perception = Perception(track)
    motion = OwnMotion(Pose(bad, 0.0, 0.0), 60.0, 0.0, 0.0)
    perceived = perception.step(40_000, motion, scan_of_ones(), tracks_of(3))
    assert perceived.lidar is not None
    assert perceived.radar is not None
    assert perceived.lidar.status is DetectionStatus.BAD_POSE
    assert perceived.radar.status is RadarStatus.BAD_MOTION
    assert perceived.fused is None


def test_without_an_estimate_nothing_is_looked_at(track: Track) -> None:
    perceived = Perception(track).step(40_000, None, scan_of_ones(), tracks_of(3))
    assert (perceived.lidar, perceived.radar, perceived.fused) == (None, None, None)
    assert perceived.tracks == []


def test_time_that_goes_back_changes_nothing(track: Track) -> None:
    print("seed 3")
    perception = Perception(track)
    seen = look(perception, sense(track, SCENARIO, drive(track, 20.0), 3, ahead(track)))
    sensed = [sensed for sensed, _ in seen if sensed.scan is not None][-5]
    before = perception.step(2_000_000, None).tracks
    again = perception.step(sensed.tick.time_us, sensed.tick.motion, sensed.scan)
    assert again.used in (ScanStatus.OUT_OF_ORDER, ScanStatus.STALE)
    assert repr(perception.step(2_020_000, None).tracks) != "[]"
    assert before
