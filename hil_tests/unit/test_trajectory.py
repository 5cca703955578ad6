"""Plan reception: whole plans only, whatever the bus loses, repeats or mixes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from bridge._native import ffi, lib
from dbc.codec import database

HEADER = database.message("trajectory_header")
POSE = database.message("trajectory_pose")
MOTION = database.message("trajectory_motion")
RADIUS = 233.1


class Receiver:
    def __init__(self) -> None:
        self.state = ffi.new("trajectory_receiver *")

    def push(self, frame: bytes, now_us: int = 0) -> None:
        lib.trajectory_receiver_push(self.state, ffi.cast("can_frame *", ffi.from_buffer(frame)), now_us)

    def push_all(self, frames: list[bytes], now_us: int = 0) -> None:
        for frame in frames:
            self.push(frame, now_us)

    @property
    def latest(self) -> Any:
        """Newest plan, null before the first."""
        return lib.trajectory_receiver_latest(self.state)


def plan_frames(counter: int, count: int = 32, mark: float = 0.0, spacing: float = 6.0) -> list[bytes]:
    """Header, then pose and motion of each point, on a circle whose centre is `mark` metres east."""
    frames = [HEADER.frame(counter % 16, count, 3, 1, 0, 123.4, 5000 + counter)]
    for i in range(count):
        angle = i * spacing / RADIUS
        yaw = (angle + math.pi / 2 + math.pi) % (2 * math.pi) - math.pi
        frames.append(POSE.frame(counter % 16, i, mark + RADIUS * math.cos(angle), RADIUS * math.sin(angle)))
        frames.append(MOTION.frame(counter % 16, i, yaw, 1 / RADIUS, 40.0 + 0.5 * i, 0.1))
    return frames


def centre(plan: Any, i: int) -> float:
    """Where point i says that the circle's centre lies."""
    return float(plan.points[i].x + RADIUS * math.cos(plan.points[i].yaw + math.pi / 2))


def test_plan_arrives_whole_with_its_values() -> None:
    receiver = Receiver()
    assert receiver.latest == ffi.NULL
    frames = plan_frames(7)
    receiver.push_all(frames[:20], 1000)
    receiver.push_all(frames[20:-1], 11_000)
    assert receiver.latest == ffi.NULL
    receiver.push(frames[-1], 21_000)
    plan = receiver.latest
    assert (plan.count, plan.mission, plan.plan_counter, plan.ends_in_stop) == (32, 3, 7, True)
    assert plan.received_us == 21_000
    assert plan.plan_time_ms == 5007
    assert plan.origin_s == pytest.approx(123.4, abs=0.05)
    for i in range(32):
        point = plan.points[i]
        angle = i * 6.0 / RADIUS
        assert point.x == pytest.approx(RADIUS * math.cos(angle), abs=6e-4)
        assert point.y == pytest.approx(RADIUS * math.sin(angle), abs=6e-4)
        assert point.yaw == pytest.approx(angle + math.pi / 2, abs=6e-5)
        assert point.curvature == pytest.approx(1 / RADIUS, abs=6e-6)
        assert point.speed == pytest.approx(40.0 + 0.5 * i, abs=0.011)
        assert point.bank == pytest.approx(0.1, abs=6e-4)
        assert point.s == pytest.approx(6.0 * i, abs=5e-3)
    assert receiver.state.completed == 1
    assert (receiver.state.incomplete, receiver.state.rejected, receiver.state.malformed) == (0, 0, 0)


def test_longest_plan_fits() -> None:
    receiver = Receiver()
    receiver.push_all(plan_frames(1, count=63))
    assert receiver.latest.count == 63


def test_order_of_the_points_does_not_matter() -> None:
    receiver = Receiver()
    frames = plan_frames(4)
    shuffled = frames[1:]
    np.random.default_rng(3).shuffle(shuffled)
    receiver.push_all([frames[0], *shuffled])
    assert receiver.latest.plan_counter == 4


@pytest.mark.parametrize("missing", [0, 1, 2, 33, 64])
def test_plan_with_a_frame_missing_never_shows(missing: int) -> None:
    receiver = Receiver()
    receiver.push_all(plan_frames(1, mark=0.0))
    frames = plan_frames(2, mark=1000.0)
    receiver.push_all(frames[:missing] + frames[missing + 1 :])
    assert receiver.latest.plan_counter == 1
    receiver.push_all(plan_frames(3, mark=2000.0))
    assert receiver.latest.plan_counter == 3
    assert receiver.state.completed == 2
    assert receiver.state.incomplete == (0 if missing == 0 else 1)


def test_equal_repetition_is_harmless_and_counted() -> None:
    receiver = Receiver()
    frames = plan_frames(5)
    receiver.push_all([*frames[:10], frames[5], frames[6], *frames[10:]])
    assert receiver.latest.plan_counter == 5
    assert receiver.state.repeated == 2


@pytest.mark.parametrize("frame", [POSE.frame(5, 2, 1.0, 2.0), MOTION.frame(5, 2, 0.0, 0.0, 1.0, 0.0)])
def test_contradiction_ends_the_plan(frame: bytes) -> None:
    receiver = Receiver()
    frames = plan_frames(5)
    receiver.push_all([*frames[:20], frame, *frames[20:]])
    assert receiver.latest == ffi.NULL
    assert receiver.state.incomplete == 1


def test_counter_that_came_round_does_not_complete_an_old_plan() -> None:
    """Plan 3 loses its tail; sixteen plans later its namesake loses its header. Their points must not meet."""
    receiver = Receiver()
    old, new = plan_frames(3, mark=0.0), plan_frames(3, mark=1000.0)
    receiver.push_all(old[:-8], 0)
    receiver.push_all(new[-8:], 800_000)
    assert receiver.latest == ffi.NULL
    assert receiver.state.incomplete == 1
    assert receiver.state.rejected == 8


@pytest.mark.parametrize("seed", range(20))
def test_no_storm_of_losses_and_delays_mixes_plans(seed: int) -> None:
    print(f"seed {seed}")
    random = np.random.default_rng(seed)
    receiver = Receiver()
    stream = [(50 * n, frame) for n in range(60) for frame in plan_frames(n, count=8, mark=1000.0 * n)]
    kept = [item for item in stream if random.random() > 0.02]
    kept += [kept[i] for i in random.integers(0, len(kept), 20)]
    late = [
        (t + (40 * random.random() if random.random() < 0.02 else 0.0) + 1e-6 * i, f) for i, (t, f) in enumerate(kept)
    ]
    seen = 0
    for t, frame in sorted(late, key=lambda item: item[0]):
        receiver.push(frame, int(1000 * t))
        plan = receiver.latest
        if plan != ffi.NULL and receiver.state.completed > seen:
            seen = receiver.state.completed
            centres = [centre(plan, i) for i in range(plan.count)]
            assert max(centres) - min(centres) < 0.1
    assert seen > 20
    assert receiver.state.incomplete > 0


def test_frames_that_are_no_plan_are_left_alone() -> None:
    receiver = Receiver()
    frames = plan_frames(1)
    broken = bytearray(frames[1])
    broken[13] = 4  # data length
    remote = bytearray(frames[1])
    remote[14] = 2  # remote flag
    other_bus = bytearray(frames[1])
    other_bus[12] = 0
    status = database.message("node_status").frame(0, 0, 100.0, 1, 10)
    receiver.push_all([frames[0], bytes(broken), bytes(remote), bytes(other_bus), status, *frames[1:]])
    assert receiver.latest.plan_counter == 1
    assert receiver.state.rejected == 2


@pytest.mark.parametrize("count", [0, 1])
def test_plan_too_short_to_be_a_path_is_refused(count: int) -> None:
    receiver = Receiver()
    receiver.push_all(plan_frames(1, count=count))
    assert receiver.latest == ffi.NULL
    assert receiver.state.rejected == 1 + 2 * count


def test_points_that_are_no_path_are_refused() -> None:
    receiver = Receiver()
    frames = plan_frames(2)
    frames[21] = POSE.frame(2, 10, 0.0, 0.0)  # the centre of the circle
    receiver.push_all(frames)
    assert receiver.latest == ffi.NULL
    assert receiver.state.malformed == 1


def test_plan_in_use_survives_the_next_one_being_received() -> None:
    receiver = Receiver()
    receiver.push_all(plan_frames(1, mark=0.0))
    plan = receiver.latest
    before = bytes(ffi.buffer(plan, ffi.sizeof("trajectory")))
    receiver.push_all(plan_frames(2, mark=500.0)[:-1])
    assert bytes(ffi.buffer(receiver.latest, ffi.sizeof("trajectory"))) == before
