"""What perception says on CAN-A, read back with cantools."""

import math

import cantools
import numpy as np
import pytest

from autonomy.messages import ObjectWriter, PerceptionStatusWriter, SensorNoticeWriter
from autonomy.opponents.tracker import TrackedObject
from autonomy.status import NodeId, NodeStatus, SensorId
from dbc.buses import DIRECTORY
from dbc.frames import Bus, Station, iterate

MESSAGES = cantools.database.load_file(DIRECTORY / "autonomy.dbc")


def read(frames):
    """Name and values of each frame."""
    found = []
    for frame in iterate(frames):
        assert (frame.bus, frame.sender, frame.flags) == (Bus.CAN_A, Station.AUTONOMY, 0)
        message = MESSAGES.get_message_by_frame_id(frame.id)
        found.append((message.name, message.decode(frame.data, decode_choices=False)))
    return found


def car(identity, x=100.0, y=-50.0, vx=60.0, vy=-20.0, covariance=None, existence=0.97, time_us=1_000_000):
    spread = np.eye(6) if covariance is None else covariance
    size = np.array([4.9, 1.9, 1.2])
    return TrackedObject(identity, time_us, time_us, x, y, 0.5, vx, vy, 0.0, 0.0, spread, size, np.ones(3), existence)


@pytest.mark.parametrize("node", [n for n in NodeId if n >= NodeId.LIDAR_DETECTION])
def test_status_of_a_node_of_perception(node):
    writer = PerceptionStatusWriter(node)
    for beat in (0, 1, 65_535, 65_536):
        writer.heartbeat = beat
        ((name, values),) = read(writer.frame(NodeStatus.INITIALIZED, 0.75))
        assert name == "perception_status"
        assert values == {
            "perception_id": node,
            "perception_status_code": NodeStatus.INITIALIZED,
            "perception_reliability": 75.0,
            "perception_heartbeat": beat % 65_536,
            "perception_execution_time": 0,
        }


@pytest.mark.parametrize(
    ("sequence", "size", "age_us", "sent"),
    [
        (7, 81_234, 12_999, (7, 81_234, 12)),
        (65_537, 64, 0, (1, 64, 0)),
        (0, 1 << 30, 10**12, (0, (1 << 24) - 1, 65_535)),
    ],
)
def test_notice_of_a_scan(sequence, size, age_us, sent):
    ((name, values),) = read(SensorNoticeWriter(SensorId.RADAR).frame(sequence, size, age_us))
    assert name == "sensor_notice"
    assert tuple(values.values()) == (SensorId.RADAR, *sent)


def test_a_list_has_six_objects_at_most_in_the_order_given():
    objects = [car(identity, x=float(identity)) for identity in (510, 511, 512, 513, 3, 2, 1)]
    for count in range(len(objects) + 1):
        (head, values), *rest = read(ObjectWriter().frames(objects[:count], 1_020_000))
        sent = min(count, 6)
        assert head == "object_list"
        assert values == {"object_list_counter": 1, "object_count": sent, "object_age": 20 if count else 0}
        assert [name for name, _ in rest] == ["object_place", "object_motion"] * sent
        places = [v for name, v in rest if name == "object_place"]
        assert [v["object_track"] for v in places] == [510, 511, 0, 1, 3, 2][:sent]
        assert [v["object_x"] for v in places] == pytest.approx([one.x for one in objects[:sent]])
        for kind in ("place", "motion"):
            mine = [v for name, v in rest if name == f"object_{kind}"]
            assert [v[f"object_{kind}_index"] for v in mine] == list(range(sent))
            assert {v[f"object_{kind}_counter"] for v in mine} <= {1}


def test_the_frames_of_a_list_share_a_counter_that_the_next_one_has_not():
    writer, counters = ObjectWriter(), []
    for _ in range(40):
        values = [values for _, values in read(writer.frames([car(1), car(2)], 1_000_000))]
        (counter,) = {v for each in values for key, v in each.items() if key.endswith("counter")}
        counters.append(counter)
    assert counters == [number % 16 for number in range(1, 41)]


@pytest.mark.parametrize("seed", range(20))
def test_an_object_within_the_resolution(seed):
    """The deviation is the root of the largest eigenvalue, by numpy."""
    print("seed", seed)
    generator = np.random.default_rng(seed)
    root = np.zeros((6, 6))
    root[:2, :2] = generator.uniform(-2.0, 2.0, (2, 2))
    x, y = generator.uniform(-8000.0, 8000.0, 2)
    vx, vy = generator.uniform(-90.0, 90.0, 2)
    one = car(5, x, y, vx, vy, root @ root.T, generator.uniform())
    _, (_, place), (_, motion) = read(ObjectWriter().frames([one], one.time_us))
    assert (place["object_x"], place["object_y"]) == pytest.approx((x, y), abs=0.000_501)
    sent = motion["object_velocity_east"], motion["object_velocity_north"]
    assert sent == pytest.approx((vx, vy), abs=0.002_501)
    deviation = math.sqrt(np.linalg.eigvalsh(one.covariance[:2, :2])[-1])
    assert motion["object_deviation"] == pytest.approx(deviation, abs=0.005_01)
    assert motion["object_existence"] == pytest.approx(100.0 * one.existence, abs=0.2501)


def test_values_beyond_the_wire_saturate():
    one = car(5, 1.0e5, -1.0e5, 400.0, -400.0, 900.0 * np.eye(6))
    (_, head), (_, place), (_, motion) = read(ObjectWriter().frames([one], one.time_us + 10**12))
    assert head["object_age"] == 65_535
    assert (place["object_x"], place["object_y"]) == pytest.approx((8388.607, -8388.608))
    sent = motion["object_velocity_east"], motion["object_velocity_north"], motion["object_deviation"]
    assert sent == pytest.approx((163.835, -163.84, 10.23))
