"""Node monitor: status codes, progress and reliability."""

from __future__ import annotations

import pytest
from obc_harness import cast_frames

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import Flag, iterate

LIMITS = {"timeout_ms": 100, "heartbeat_timeout_ms": 250, "min_reliability": 50.0}
PLANNING = lib.NODE_PLANNING


class Nodes:
    """A node monitor and a clock."""

    def __init__(self) -> None:
        self.c = ffi.new("node_monitor *")
        self.limits = ffi.new("node_limits *", LIMITS)
        self.now_us = 0

    def push(self, code: int = 0, heartbeat: int = 0, reliability: float = 100.0, node: int = PLANNING) -> None:
        message = "perception_status" if lib.NODE_PERCEPTION <= node < lib.NODE_COUNT else "node_status"
        self.push_frame(database.message(message).frame(node, code, reliability, heartbeat, 0))

    def push_frame(self, frame: bytes) -> None:
        array, _ = cast_frames(frame)
        lib.node_monitor_push(self.c, array, self.now_us)

    def check(self, node: int = PLANNING) -> dict[str, object]:
        health = lib.node_monitor_check(self.c, node, self.limits, self.now_us)
        return {name: getattr(health, name) for name in ("status_code", "ok", "failed", "stalled", "unreliable")}


HEALTHY = {"status_code": 0, "ok": True, "failed": False, "stalled": False, "unreliable": False}


def test_nobody_is_healthy_before_the_first_status() -> None:
    for node in range(lib.NODE_COUNT):
        assert Nodes().check(node) == {
            "status_code": 255, "ok": False, "failed": True, "stalled": True, "unreliable": True,
        }  # fmt: skip


@pytest.mark.parametrize(
    ("code", "ok", "failed"),
    [(0, True, False), (64, False, False), (100, False, False), (128, False, False), (200, False, True),
     (255, False, True), (1, False, True), (127, False, True), (201, False, True), (254, False, True)],
)  # fmt: skip
def test_status_codes(code: int, ok: bool, failed: bool) -> None:
    nodes = Nodes()
    nodes.push(code)
    assert nodes.check() == HEALTHY | {"status_code": code, "ok": ok, "failed": failed}


def test_silence_is_death_and_ends_with_the_next_status() -> None:
    nodes = Nodes()
    nodes.push()
    nodes.now_us = 100_000
    assert nodes.check() == HEALTHY
    nodes.now_us += 1
    assert nodes.check() == HEALTHY | {"status_code": 255, "ok": False, "failed": True}
    nodes.push(heartbeat=1)
    assert nodes.check() == HEALTHY


def test_presence_without_progress_is_a_stall() -> None:
    nodes = Nodes()
    for nodes.now_us in range(0, 260_001, 10_000):
        nodes.push(heartbeat=41)
        assert nodes.check()["stalled"] == (nodes.now_us > 250_000)
    nodes.push(heartbeat=40)
    assert nodes.check() == HEALTHY, "any change is progress"


def test_heartbeat_wraps() -> None:
    nodes = Nodes()
    nodes.push(heartbeat=65535)
    nodes.now_us = 240_000
    nodes.push(heartbeat=0)
    nodes.now_us = 300_000
    assert nodes.check() == HEALTHY


@pytest.mark.parametrize(("reliability", "unreliable"), [(50.0, False), (49.5, True), (0.0, True), (127.5, False)])
def test_reliability(reliability: float, unreliable: bool) -> None:
    nodes = Nodes()
    nodes.push(reliability=reliability)
    assert nodes.check()["unreliable"] == unreliable


@pytest.mark.parametrize("node", range(lib.NODE_COUNT))
def test_nodes_are_told_apart(node: int) -> None:
    nodes = Nodes()
    for number in range(lib.NODE_COUNT):
        nodes.push(200 if number == node else 0, node=number)
    for number in range(lib.NODE_COUNT):
        assert nodes.check(number) == (
            HEALTHY | {"status_code": 200, "ok": False, "failed": True} if number == node else HEALTHY
        )


@pytest.mark.parametrize("node", range(lib.NODE_COUNT))
def test_a_node_reports_in_its_own_message_only(node: int) -> None:
    other = "node_status" if node >= lib.NODE_PERCEPTION else "perception_status"
    nodes = Nodes()
    nodes.push_frame(database.message(other).frame(node, 0, 100.0, 1, 0))
    assert nodes.c.rejected == 1
    assert nodes.check(node)["failed"]


def test_frames_that_are_not_to_be_used_are_counted() -> None:
    nodes = Nodes()
    good = next(iterate(database.message("node_status").frame(PLANNING, 0, 100.0, 1, 0)))
    bad = [good._replace(dlc=7), good._replace(flags=int(Flag.REMOTE)), good._replace(flags=int(Flag.ERROR))]
    for frame in bad:
        nodes.push_frame(frame.pack())
    nodes.push(node=lib.NODE_COUNT)
    nodes.push(node=255)
    assert nodes.c.rejected == 5
    assert nodes.check()["failed"]
