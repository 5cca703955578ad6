"""Perception as a part of the car: it brakes for what is there and for nothing else, and the SSM hears how it is."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest

import scenarios
from autonomy.partition import SLICED, AutonomyPartition
from autonomy.perception import Perception
from autonomy.perception_nodes import PerceptionNodes
from autonomy.status import NodeId, NodeStatus
from autonomy.track import Track
from autonomy.track_files import load_track
from bridge._native import lib
from bridge.bench import Bench
from bridge.faults import CloudFault, Drop, Fault, LidarFrozen, LidarNotFinite, LidarSilent, SensorOutage
from bridge.faults.fault import Memory
from bridge.interfaces import Road
from bridge.saved_state import SavedState
from bridge.scenario import Scenario, load_scenario
from bridge.sensors.lidar import Cloud
from dbc.codec import database
from dbc.frames import FRAME_DTYPE, Bus
from tools.reactions.states import SEEING, OperatingStates
from tools.run import build_bench, load_road, make_autonomy

BEHIND = load_scenario(scenarios.DIRECTORY / "behind_another_car.yaml")
PHANTOM = load_scenario(scenarios.DIRECTORY / "phantom.yaml")


def column(frames: np.ndarray, message: str, signal: str) -> np.ndarray:
    """A signal of all frames of a message on CAN-A."""
    codec = database.message(message)
    mine = frames[(frames["bus"] == Bus.CAN_A) & (frames["id"] == codec.frame_id)]
    place = codec.signals.index(signal)
    return np.array([codec.decode(bytes(data))[place] for data in mine["data"]])


class Drive:
    """Ticks a bench and keeps the frames of CAN-A."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.frames: list[np.ndarray] = []

    def tick(self) -> None:
        self.bench.tick()
        frames = np.frombuffer(self.bench.network.drain_log(), FRAME_DTYPE)
        self.frames.append(frames[frames["bus"] == Bus.CAN_A])

    def column(self, message: str, signal: str) -> np.ndarray:
        return column(np.concatenate(self.frames), message, signal)


def test_a_slower_car_is_followed_and_not_touched() -> None:
    """Seen from some 100 m on, it is tracked to a metre or so; the car slows down to its speed and brakes when it does.

    Distances are of the true cars. When the other one has driven away, so does this one.
    """
    print(f"seed {BEHIND.seed}")
    with build_bench(BEHIND) as bench:
        drive, (other,) = Drive(bench), bench.surroundings.opponents
        road, length = bench.surroundings.road, bench.surroundings.road.length
        gaps, speeds, errors = [], [], []
        while bench.situation.distance_m < 1400.0:
            drive.tick()
            gaps.append((other.station - bench.station + 0.5 * length) % length - 0.5 * length)
            speeds.append((bench.truth.vx, other.speed))
            assert isinstance(bench.surroundings.road, Track)
            frames = drive.frames[-1]
            if column(frames, "object_list", "object_count").any():
                x, y = (column(frames, "object_place", f"object_{axis}") for axis in ("x", "y"))
                errors.append(float(np.hypot(x - other.outline.x, y - other.outline.y).min()))
        follows = drive.column("trajectory_header", "plan_follows")
        braking = -np.diff([own for own, _ in speeds])[2500:].max() / 0.01
    gap = np.array(gaps)
    own, its = np.array(speeds).T
    assert road.length == length
    assert gap.min() > 12.0, "never nearer than 7 m, bumper to bumper"
    assert (gap > 0.0).all(), "and never past it"
    close = (gap < 70.0) & (its > 0.0)
    assert close.sum() > 500
    assert np.sqrt(np.mean(np.square(errors))) < 1.5
    assert len(errors) > 300
    assert follows.any()
    assert its[close].min() < 25.0
    assert own[2000:4000].max() > 40.0, "it has come nearer"
    assert own[close].min() < 36.0, "and has slowed down with the other one"
    assert own[-1] > 55.0, "and drives on"
    assert braking < 10.0


@pytest.mark.parametrize("state", ["straight", "turn"])
def test_the_emergency_stop_goes_by_the_wall_in_spatial_scans(driven: OperatingStates, state: str) -> None:
    """At 227 km/h both receivers are lost: the car stops on the track, by the wall and not by a full brake."""
    bench = driven.at(state)
    assert bench.truth.vx > 62.0
    for sensor in ("gnss_a", "gnss_b"):
        bench.inject(SensorOutage(sensor=sensor))
    lateral, states = [], set()
    while bench.truth.vx > 0.1 and len(lateral) < 1500:
        bench.tick()
        lateral.append(bench.surroundings.road.project(bench.truth.x, bench.truth.y)[1])
        states.add(int(bench.obc.ssm_output.state))
    assert bench.truth.vx <= 0.1
    assert np.abs(lateral).max() < 6.4, "with both wheels inside of 7.45 m"
    assert states <= {lib.SSM_NOMINAL, lib.SSM_DEGRADED, lib.SSM_EMERGENCY}
    assert lib.SSM_EMERGENCY in states


@pytest.fixture(scope="module")
def driven() -> Iterator[OperatingStates]:
    states = OperatingStates(SEEING)
    yield states
    states.close()


@pytest.fixture
def phantom() -> Scenario:
    """To the exit of the second turn; the drive through the turns takes 45 s."""
    return replace(
        PHANTOM, finish=replace(PHANTOM.finish, sys_state=None, ct_state=None, standstill=None, distance_m=1000.0)
    )


def without_estimate(scenario: Scenario, road: Road) -> AutonomyPartition:
    """Autonomy whose geofence believes the map."""
    autonomy = make_autonomy(scenario, road)
    assert scenario.perception_map is not None
    config = replace(SLICED, estimate_boundary=False)
    autonomy.perception = PerceptionNodes(Perception(load_track(scenario.perception_map), config))
    return autonomy


def test_a_wrong_map_makes_no_phantom(phantom: Scenario) -> None:
    """By the map the wall is on the track. The walls that are seen tell better: no plan is slower for it."""
    with build_bench(phantom) as bench:
        drive = Drive(bench)
        while bench.situation.distance_m < 1000.0:
            drive.tick()
        assert bench.truth.vx > 50.0
    assert not drive.column("trajectory_header", "plan_follows").any()


def test_the_same_map_brakes_the_car_that_believes_it(phantom: Scenario) -> None:
    """What the test above would not notice if the map were right."""
    with Bench.from_scenario(phantom, partial(load_road, phantom), without_estimate) as bench:
        drive = Drive(bench)
        while bench.situation.distance_m < 1000.0:
            drive.tick()
    assert drive.column("trajectory_header", "plan_follows").sum() > 20


@pytest.fixture(scope="module")
def stood() -> Iterator[tuple[Bench, SavedState]]:
    """A car with perception that stands, all nodes well."""
    with build_bench(BEHIND) as bench:
        for _ in range(100):
            bench.tick()
        yield bench, bench.save()


@pytest.fixture
def standing(stood: tuple[Bench, SavedState]) -> Drive:
    bench, state = stood
    bench.restore(state)
    drive = Drive(bench)
    drive.tick()
    return drive


def statuses(drive: Drive) -> dict[NodeId, NodeStatus]:
    """Newest status of each node of perception."""
    nodes = drive.column("perception_status", "perception_id")[-4:]
    codes = drive.column("perception_status", "perception_status_code")[-4:]
    return {NodeId(int(node)): NodeStatus(int(code)) for node, code in zip(nodes, codes, strict=True)}


OK, ERROR = NodeStatus.OK, NodeStatus.ERROR
WELL = dict.fromkeys((NodeId.LIDAR_DETECTION, NodeId.RADAR_DETECTION, NodeId.TRACKING, NodeId.PREDICTION), OK)
BLIND = {
    "silent": (LidarSilent(), {NodeId.LIDAR_DETECTION: ERROR}),
    "frozen": (LidarFrozen(), {NodeId.LIDAR_DETECTION: ERROR}),
    "no numbers": (LidarNotFinite(), {NodeId.LIDAR_DETECTION: ERROR}),
    "radar, a frame less": (Drop(message="Target7"), {NodeId.RADAR_DETECTION: ERROR}),
}


@pytest.mark.parametrize(("fault", "failed"), BLIND.values(), ids=BLIND)
def test_a_sensor_that_fails_is_told(standing: Drive, fault: Fault, failed: dict[NodeId, NodeStatus]) -> None:
    """Its detection alone is in ERROR, 150 ms after the last good scan; when the sensor is back it is well again."""
    assert statuses(standing) == WELL
    injection = standing.bench.inject(fault)
    for _ in range(10):
        standing.tick()
    assert statuses(standing) == WELL
    for _ in range(15):
        standing.tick()
    assert statuses(standing) == WELL | failed
    injection.cancel()
    for _ in range(12):
        standing.tick()
    assert statuses(standing) == WELL


@dataclass(frozen=True, kw_only=True)
class Instead(CloudFault):
    """Something else comes in place of scans."""

    comes: Any

    def scan(self, cloud: Cloud, memory: Memory) -> Any:  # noqa: ARG002
        return self.comes


NO_SCANS = {
    "no points": np.empty((0, 4), np.float32),
    "no ages": np.ones((10, 3), np.float32),
    "one row": np.ones(4, np.float32),
    "one number": np.float32(1.0),
    "other numbers": np.ones((10, 4)),
    "ages without end": np.full((10, 4), np.inf, np.float32),
    "too many": np.ones((200_000, 4), np.float32),
    "a text": "cloud",
}


@pytest.mark.parametrize("comes", NO_SCANS.values(), ids=NO_SCANS)
def test_what_is_no_scan_is_the_failure_of_its_detection_and_of_nothing_else(standing: Drive, comes: object) -> None:
    injection = standing.bench.inject(Instead(comes=comes))
    for _ in range(25):
        standing.tick()
    assert injection.count == 5
    assert statuses(standing) == WELL | {NodeId.LIDAR_DETECTION: ERROR}
    wall = standing.column("node_status", "node_id") == NodeId.WALL
    assert set(standing.column("node_status", "node_status_code")[wall]) == {OK}
    injection.cancel()
    for _ in range(12):
        standing.tick()
    assert statuses(standing) == WELL


def test_both_sensors_lost_is_the_failure_of_all(standing: Drive) -> None:
    standing.bench.inject(LidarSilent())
    standing.bench.inject(Drop(message="Target7"))
    for _ in range(25):
        standing.tick()
    assert set(statuses(standing).values()) == {ERROR}


def test_notices_tell_size_and_age(standing: Drive) -> None:
    """20 a second of each sensor: some 60,000 points as they come, 64 frames from one tick to the next but one."""
    standing.frames.clear()
    for _ in range(100):
        standing.tick()
    sensor = standing.column("sensor_notice", "sensor_id")
    size, age = (standing.column("sensor_notice", f"sensor_{name}") for name in ("data_size", "sample_age"))
    assert ((sensor == 3).sum(), (sensor == 4).sum()) == (20, 20)
    assert (size[sensor == 3] > 40_000).all()
    assert (age[sensor == 3] == 20).all()
    assert set(size[sensor == 4]) == {64.0}
    assert age[sensor == 4].max() <= 20.0
    sequence = standing.column("sensor_notice", "sensor_sequence")
    assert set(np.diff(sequence[sensor == 3])) == {1.0}


def test_a_frozen_scan_has_no_new_number(standing: Drive) -> None:
    standing.bench.inject(LidarFrozen())
    for _ in range(5):
        standing.tick()
    standing.frames.clear()
    for _ in range(50):
        standing.tick()
    sensor, sequence = (standing.column("sensor_notice", f"sensor_{name}") for name in ("id", "sequence"))
    assert len(set(sequence[sensor == 3])) == 1
    assert len(set(sequence[sensor == 4])) == 10


def test_a_saved_state_goes_on_the_same(stood: tuple[Bench, SavedState]) -> None:
    bench, state = stood

    def on() -> bytes:
        bench.restore(state)
        for _ in range(30):
            bench.tick()
        return bytes(bench.network.drain_log())

    first = on()
    assert on() == first
    assert len(first) > 10_000


def test_objects_are_sent_fifty_times_a_second(standing: Drive) -> None:
    standing.frames.clear()
    for _ in range(100):
        standing.tick()
    count = standing.column("object_list", "object_count")
    assert len(count) == 50
    assert math.isclose(count.max(), 0.0), "nobody is near"
