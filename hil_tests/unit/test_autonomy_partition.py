"""The partition through its only door: CAN frames in, CAN frames out."""

import math
from pathlib import Path

import numpy as np
import pytest

from autonomy.partition import AutonomyPartition
from autonomy.status import Mission, NodeStatus
from autonomy.track_files import track_from_csv
from autonomy.vehicle import VehicleLimits, load_vehicle
from dbc.codec import database
from dbc.errors import ConfigurationError
from dbc.frames import FRAME_SIZE, Bus, Station, iterate
from dbc.states import SsmState

SCENARIOS = Path(__file__).parents[2] / "scenarios"
TRACK, VEHICLE = SCENARIOS / "tracks" / "lvms.yaml", SCENARIOS / "vehicles" / "av21.yaml"
TICK_US = 10_000
NAMES = (
    "estimate_position",
    "estimate_motion",
    "estimate_quality",
    "trajectory_header",
    "trajectory_pose",
    "trajectory_motion",
    "node_status",
)
NODES = sorted(database.message("node_status").choices["node_id"])


class Rig:
    """The partition with a standing car, sensors without noise, and an SSM that says what it is told."""

    def __init__(self):
        self.partition = AutonomyPartition.from_files(TRACK, VEHICLE)
        self.plane = self.partition.track.origin.tangent_plane()
        self.pose = self.partition.track.pose_at(60.0, 5.5)
        self.position = self.geodetic(*self.pose[:2])
        self.ssm, self.ct, self.flag = SsmState.LAUNCHING, 2, 0
        self.now_us = 0
        self.gnss_a = self.gnss_b = True
        self.fix = 4

    def geodetic(self, x, y):
        """Latitude and longitude by Newton's method on the conversion under use."""
        origin = self.partition.track.origin
        latitude, longitude = origin.latitude_deg, origin.longitude_deg
        for _ in range(6):
            east, north, _ = self.plane.to_enu(latitude, longitude, origin.height)
            latitude += (y - north) / 111_000.0
            longitude += (x - east) / (111_320.0 * math.cos(math.radians(latitude)))
        return latitude, longitude

    def gnss(self, letter):
        counter = self.now_us // 50_000 & 0xFF
        return (
            database.message(f"gnss_{letter}_position").frame(*self.position)
            + database.message(f"gnss_{letter}_velocity").frame(0.0, 0.0, 0.0, 0.03, counter)
            + database.message(f"gnss_{letter}_attitude").frame(self.pose[2], 0.003, 605.0, counter)
            + database.message(f"gnss_{letter}_quality").frame(0.03, 0.03, 0.1, self.fix, 15, counter)
        )

    def inputs(self):
        counter = self.now_us // TICK_US & 0xFF
        bank, _ = self.partition.track.road_at(*self.pose[:2])
        frames = (
            database.message("imu_rates").frame(0.0, 0.0, 0.0, counter)
            + database.message("imu_specific_force").frame(0.0, -9.81 * math.sin(bank), 9.81 * math.cos(bank), counter)
            + database.message("ssm_status").frame(self.ssm, 0, 0, 0, 1, 63.05, 5.0, 8.0, counter)
            + database.message("vehicle_status").frame(self.ct, 8, 3, self.flag, 0.0, 1, 31, 0, counter)
        )
        if self.now_us % 50_000 == 0:
            frames += (self.gnss("a") if self.gnss_a else b"") + (self.gnss("b") if self.gnss_b else b"")
        return frames

    def tick(self, frames=None):
        out = self.partition.tick(self.now_us, self.inputs() if frames is None else frames)
        self.now_us += TICK_US
        return decoded(out)

    def run(self, ticks):
        return [self.tick() for _ in range(ticks)]


def decoded(out):
    """Values of the frames by message name, in order."""
    found = {name: [] for name in NAMES}
    for frame in iterate(out):
        message = database.find(frame.bus, frame.id)
        found[message.name].append(message.decode(frame.data))
    return found


def node(result, number):
    (status,) = [values for values in result["node_status"] if values[0] == number]
    return status


@pytest.fixture
def rig():
    return Rig()


def test_before_launching_nothing_but_not_initialized_nodes(rig):
    for state in (SsmState.BOOT, SsmState.CONFIG_CHECK, SsmState.FULL_BRAKE):
        rig.ssm = state
        for result in rig.run(10):
            assert [v[1] for v in result.pop("node_status")] == [NodeStatus.NOT_INITIALIZED] * len(NODES)
            assert not any(result.values())


def test_silence_of_the_ssm_launches_nothing(rig):
    for _ in range(10):
        result = rig.tick(b"")
        assert {v[1] for v in result["node_status"]} == {NodeStatus.NOT_INITIALIZED}


def test_nodes_come_up_in_order(rig):
    rig.now_us = TICK_US  # the first epoch comes at 50 ms
    codes = [node(r, 0)[1] for r in rig.run(10)]
    assert codes == [NodeStatus.INITIALIZED] * 4 + [NodeStatus.OK] * 6


def test_nodes_report_every_cycle_with_a_heartbeat_that_moves(rig):
    results = rig.run(100)
    assert all(sorted(v[0] for v in r["node_status"]) == NODES for r in results)
    beats = np.array([[node(r, n)[3] for n in (0, 1)] for r in results[10:]])
    assert np.all(np.diff(beats[:, 0]) == 1)
    assert np.all(beats[5:, 1] - beats[:-5, 1] == 1)  # 20 Hz
    assert node(results[-1], 0)[1:3] == (NodeStatus.OK, 100.0)
    assert node(results[-1], 1)[1:3] == (NodeStatus.OK, 100.0)


def test_the_heartbeat_stands_when_nothing_is_computed(rig):
    rig.gnss_a = rig.gnss_b = False
    assert {node(r, 0)[3] for r in rig.run(50)} == {0}


def test_the_estimate_is_where_the_car_stands(rig):
    results = rig.run(200)
    x, y, yaw = rig.pose
    ((ex, ey, counter),) = results[-1]["estimate_position"]
    assert math.hypot(ex - x, ey - y) < 0.02
    ((vx, vy, eyaw, rate),) = results[-1]["estimate_motion"]
    assert (vx, vy, rate) == pytest.approx((0.0, 0.0, 0.0), abs=0.02)
    assert eyaw == pytest.approx(yaw, abs=0.002)
    ((_, _, source, level, a, b, deviation, quality_counter),) = results[-1]["estimate_quality"]
    assert (source, level) == (1, 3)
    assert max(a, b) < 1.0
    assert deviation == pytest.approx(0.03)
    assert counter == quality_counter


def assemble(results):
    """Whole plans: header, ticks they took, poses, motions."""
    plans = []
    for tick, result in enumerate(results):
        plans.extend((header, tick, {}, {}, [tick]) for header in result["trajectory_header"])
        for kind, column in (("trajectory_pose", 2), ("trajectory_motion", 3)):
            for values in result[kind]:
                assert values[0] == plans[-1][0][0]  # the frames of a plan never mix with those of another
                plans[-1][column][int(values[1])] = values[2:]
                plans[-1][4].append(tick)
    return plans


def test_a_plan_leaves_whole_every_50_ms_within_three_ticks(rig):
    results = rig.run(103)
    plans = assemble(results)[:-1]
    assert len(plans) >= 19
    starts = [tick for _, tick, *_ in plans]
    assert set(np.diff(starts)) == {5}
    assert [int(p[0][0]) for p in plans] == [(i + 1) % 16 for i in range(len(plans))]
    for header, start, poses, motions, ticks in plans:
        assert header[1] == len(poses) == len(motions) == 32
        assert max(ticks) - start <= 2
        assert header[6] == start * 10  # plan_time, ms
        assert header[2] == Mission.HOLD
        assert header[3] == 1.0


def test_a_tick_fits_its_share_of_the_bus(rig):
    # An 8-byte frame with 11-bit identifier has at most 135 bits with stuffing and gap: 135 us at 1 Mbit/s.
    for _ in range(100):
        out = rig.partition.tick(rig.now_us, rig.inputs())
        rig.now_us += TICK_US
        assert len(out) // FRAME_SIZE * 135e-6 < 5e-3


def test_frames_are_the_partitions_own(rig):
    out = b"".join(rig.partition.tick(t * TICK_US, rig.inputs()) for t in range(10))
    for frame in iterate(out):
        assert (frame.bus, frame.sender, frame.dlc, frame.flags) == (Bus.CAN_A, Station.AUTONOMY, 8, 0)


def test_driving_is_planned_only_when_ssm_and_car_allow(rig):
    rig.run(20)
    for ssm, ct, moves in ((2, 8, False), (3, 6, False), (3, 8, True), (5, 8, False), (6, 8, False), (4, 9, True)):
        rig.ssm, rig.ct = ssm, ct
        rig.run(10)
        (header, _, _, motions, _), *_ = assemble(rig.run(10)[(5 - rig.now_us // TICK_US % 5) % 5 :])
        assert any(m[2] > 0.0 for m in motions.values()) == moves, (ssm, ct)
        assert (header[2] in (Mission.PIT_OUT, Mission.RACE, Mission.CAUTION)) == moves


def test_loss_of_both_receivers_shows_as_error(rig):
    rig.run(100)
    rig.gnss_a = rig.gnss_b = False
    results = rig.run(300)
    assert node(results[10], 0)[1] == NodeStatus.OK
    assert node(results[-1], 0)[1:3] == (NodeStatus.ERROR, 0.0)
    assert results[-1]["estimate_quality"][0][3] == 0.0
    reliability = [node(r, 0)[2] for r in results]
    assert reliability == sorted(reliability, reverse=True)


def test_a_receiver_without_fix_is_not_used(rig):
    rig.fix = 0
    assert {node(r, 0)[1] for r in rig.run(50)} == {NodeStatus.INITIALIZED}


def test_an_epoch_is_only_used_whole(rig):
    """Frames of different epochs, or with one part missing, make no sample."""
    keep = {database.message(f"gnss_{r}_attitude").frame_id for r in "ab"}
    for _ in range(50):
        frames = b"".join(f.pack() for f in iterate(rig.inputs()) if f.id not in keep)
        assert node(rig.tick(frames), 0)[1] == NodeStatus.INITIALIZED


def test_damaged_and_foreign_frames_are_dropped(rig):
    rig.run(20)
    reference = [rig.tick()["estimate_position"] for _ in range(5)]
    short = database.message("imu_rates").frame(6.0, 6.0, 6.0, 0)
    bad = [
        next(iterate(short))._replace(dlc=4).pack(),
        next(iterate(short))._replace(flags=2).pack(),
        next(iterate(short))._replace(bus=Bus.CAN1).pack(),
        next(iterate(short))._replace(id=0x7FF).pack(),
        b"\0" * 7,
    ]
    for extra in bad:
        result = rig.tick(rig.inputs() + extra)
        ((x, y, _),) = result["estimate_position"]
        assert math.hypot(x - reference[-1][0][0], y - reference[-1][0][1]) < 0.01
        assert result["estimate_motion"][0][3] == pytest.approx(0.0, abs=0.01)
    assert rig.partition.malformed_frames == 3


def test_two_partitions_give_the_same_bytes():
    outputs = []
    for _ in range(2):
        rig = Rig()
        rig.ssm, rig.ct = SsmState.NOMINAL, 8
        out = b""
        for _ in range(60):
            out += rig.partition.tick(rig.now_us, rig.inputs())
            rig.now_us += TICK_US
        outputs.append(out)
    assert outputs[0] == outputs[1]


def test_a_track_without_origin_is_refused(tmp_path):
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    np.savetxt(
        tmp_path / "ring.csv",
        np.column_stack((300 * np.cos(angle), 300 * np.sin(angle), 0 * angle + 7, 0 * angle + 7)),
        delimiter=",",
    )
    with pytest.raises(ConfigurationError, match="origin"):
        AutonomyPartition(
            track_from_csv(tmp_path / "ring.csv"), VehicleLimits.from_parameters(VEHICLE, load_vehicle(VEHICLE))
        )


def test_a_track_too_narrow_for_the_car_is_refused(tmp_path):
    text = TRACK.read_text().replace("7.45", "1.5")
    (tmp_path / "narrow.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match="narrow"):
        AutonomyPartition.from_files(tmp_path / "narrow.yaml", VEHICLE)
