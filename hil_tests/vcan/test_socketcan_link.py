"""A link to a SocketCAN interface: filters, stamps, error frames, full queues, an interface that vanishes."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import time
from collections.abc import Iterator
from time import monotonic_ns

import pytest
from link_ends import LIMIT_S, Link, frame
from own_interface import Interface, Node, run

from bridge._native import ffi, lib
from dbc.frames import Bus, Flag, Frame

pytestmark = pytest.mark.vcan


@pytest.fixture
def interface() -> Iterator[Interface]:
    interface = Interface()
    interface.create()
    interface.up()
    yield interface
    subprocess.run(["ip", "link", "delete", interface.name], check=False, capture_output=True)


@pytest.fixture
def link() -> Iterator[Link]:
    link = Link()
    yield link
    link.close()


@pytest.fixture
def node(interface: Interface) -> Iterator[Node]:
    node = Node(interface)
    yield node
    node.socket.close()


def plain(frames: list[Frame]) -> list[tuple[int, int, bytes]]:
    return [(one.id, one.flags, one.data[: one.dlc]) for one in frames]


# --- opening ---


def test_no_interface(interface: Interface, link: Link):
    interface.delete()
    assert link.open(interface.address) == errno.ENODEV
    assert link.open("socketcan:a_name_that_is_too_long") == errno.ENODEV
    assert "ip link add" in ffi.string(lib.can_link_error_text(errno.ENODEV)).decode()


def test_an_interface_that_is_no_can_bus(link: Link):
    assert link.open("socketcan:lo") == errno.ENODEV


def test_an_interface_that_is_down(interface: Interface, link: Link):
    interface.down()
    assert link.open(interface.address) == errno.ENETDOWN
    assert "ip link set" in ffi.string(lib.can_link_error_text(errno.ENETDOWN)).decode()
    assert link.c.state == lib.CAN_LINK_CLOSED


# --- frames ---


def test_sent_frames_are_on_the_bus_as_they_are(interface: Interface, link: Link, node: Node):
    assert link.open(interface.address) == 0
    frames = [
        frame(0x123, b"\x01\x02\x03"),
        frame(0x7FF, b"12345678"),
        frame(0x1ABCDEF0, b"x", flags=Flag.EXTENDED),
        frame(0x100, flags=Flag.REMOTE),
        frame(0x1, bus=Bus.CAN3),
        *(frame(i, bytes([i])) for i in range(100)),
    ]
    assert link.send(*frames) == len(frames) - 1
    assert node.receive() == (0x123, b"\x01\x02\x03")
    assert node.receive() == (0x7FF, b"12345678")
    assert node.receive() == (0x1ABCDEF0 | socket.CAN_EFF_FLAG, b"x")
    assert node.receive() == (0x100 | socket.CAN_RTR_FLAG, b"")
    for i in range(100):
        assert node.receive() == (i, bytes([i]))
    assert node.rest() == []
    assert link.statistics == {"sent": 104}


def test_received_frames_are_those_on_the_bus(interface: Interface, link: Link, node: Node):
    assert link.open(interface.address, bus=Bus.CAN_A) == 0
    node.send(0x123, b"\x01\x02\x03")
    node.send(0x1ABCDEF0 | socket.CAN_EFF_FLAG, b"12345678")
    node.send(0x100 | socket.CAN_RTR_FLAG, length=4)
    frames = link.receive_until(3)
    assert plain(frames) == [
        (0x123, 0, b"\x01\x02\x03"),
        (0x1ABCDEF0, Flag.EXTENDED, b"12345678"),
        (0x100, Flag.REMOTE, bytes(4)),
    ]
    assert {(one.bus, one.sender) for one in frames} == {(Bus.CAN_A, 0)}
    assert link.statistics == {"received": 3}


def test_filters(interface: Interface, link: Link, node: Node):
    assert link.open(interface.address, filters=[(0x123, False), (0x124, True)]) == 0
    deaf = Link()
    assert deaf.open(interface.address, filters=[]) == 0
    for can_id in range(0x120, 0x128):
        node.send(can_id)
        node.send(can_id | socket.CAN_EFF_FLAG)
        node.send(can_id | socket.CAN_RTR_FLAG)
    node.send(0x123, b"end")
    assert plain(link.receive_until(3)) == [(0x123, 0, b""), (0x124, Flag.EXTENDED, b""), (0x123, 0, b"end")]
    assert deaf.receive() == []
    deaf.close()


def test_as_many_filters_as_a_link_holds(interface: Interface, link: Link, node: Node):
    filters = [(3 * i, i % 2 == 0) for i in range(lib.CAN_LINK_FILTERS_MAX)]
    assert link.open(interface.address, filters=filters) == 0
    for can_id in range(3 * lib.CAN_LINK_FILTERS_MAX):
        node.send(can_id)
    frames = link.receive_until(len(filters) // 2)
    assert [one.id for one in frames] == [can_id for can_id, extended in filters if not extended]


def test_error_frames_pass_every_filter(interface: Interface, link: Link, node: Node):
    assert link.open(interface.address, filters=[]) == 0
    node.send(socket.CAN_ERR_FLAG | 0x40, bytes(8))  # bus off
    assert plain(link.receive_until(1)) == [(0x40, Flag.ERROR, bytes(8))]
    assert link.statistics == {"received": 1, "error_frames": 1}


def test_a_link_hears_its_neighbour_and_not_itself(interface: Interface, link: Link):
    neighbour = Link()
    assert link.open(interface.address) == 0
    assert neighbour.open(interface.address) == 0
    link.send(frame(1), frame(2))
    neighbour.send(frame(3))
    assert [one.id for one in neighbour.receive_until(2)] == [1, 2]
    assert [one.id for one in link.receive_until(1)] == [3]
    neighbour.close()


def test_what_does_not_fit_waits(interface: Interface, link: Link, node: Node):
    assert link.open(interface.address) == 0
    for i in range(200):
        node.send(i)
    assert [one.id for one in link.receive(70)] == list(range(70))
    assert [one.id for one in link.receive(70)] == list(range(70, 140))
    assert [one.id for one in link.receive(70)] == list(range(140, 200))
    assert link.receive(70) == []


# --- stamps ---


def test_a_stamp_is_the_time_on_the_bus_not_that_of_reading(interface: Interface, link: Link, node: Node):
    epoch_ns = monotonic_ns() - 5_000_000
    assert link.open(interface.address, epoch_ns=epoch_ns) == 0
    assert link.c.stamps
    link.receive()
    bounds = []
    for i in range(40):
        begin_ns = monotonic_ns()
        node.send(i)
        bounds.append((begin_ns, monotonic_ns()))
        end_ns = monotonic_ns() + 1_000_000
        while monotonic_ns() < end_ns:
            pass
    frames = link.receive_until(40)
    slack_us = 50  # what the two clocks may be torn apart by while both are read
    for one, (begin_ns, end_ns) in zip(frames, bounds, strict=True):
        assert (begin_ns - epoch_ns) // 1000 - slack_us <= one.time_us <= (end_ns - epoch_ns) // 1000 + slack_us
    assert frames == sorted(frames, key=lambda one: one.time_us)


def test_frames_before_the_epoch_are_at_0(interface: Interface, link: Link, node: Node):
    assert link.open(interface.address, epoch_ns=monotonic_ns() + 10**12) == 0
    node.send(1)
    assert [one.time_us for one in link.receive_until(1)] == [0]


if "RACELOOP_GUEST" in os.environ:  # the wall clock of a machine that others use is not ours to set

    @pytest.mark.parametrize("step_ns", [-3600 * 10**9, -(10**9), 10**9, 3600 * 10**9])
    def test_a_step_of_the_wall_clock_moves_no_frame(interface: Interface, link: Link, node: Node, step_ns: int):
        epoch_ns = monotonic_ns() - 5_000_000
        assert link.open(interface.address, epoch_ns=epoch_ns) == 0
        link.receive()
        begin_ns = monotonic_ns()
        node.send(1)
        time.clock_settime_ns(time.CLOCK_REALTIME, time.time_ns() + step_ns)
        try:
            node.send(2)
            end_ns = monotonic_ns()
            frames = link.receive_until(2)
        finally:
            time.clock_settime_ns(time.CLOCK_REALTIME, time.time_ns() - step_ns)
        slack_us = 50
        for one in frames:
            assert (begin_ns - epoch_ns) // 1000 - slack_us <= one.time_us <= (end_ns - epoch_ns) // 1000 + slack_us
        assert link.statistics["clock_steps"] == 1
        link.receive()
        assert link.statistics["clock_steps"] == 2


# --- queues ---


def test_a_full_send_queue_refuses_and_the_link_stays_up(interface: Interface, link: Link, node: Node):
    assert link.open(interface.address) == 0
    run("tc", "qdisc", "replace", "dev", interface.name, "root", "pfifo", "limit", "0")
    assert link.send(frame(1), frame(2), frame(3, bus=Bus.CAN3)) == 0
    assert (link.c.state, link.c.last_error) == (lib.CAN_LINK_UP, errno.ENOBUFS)
    run("tc", "qdisc", "del", "dev", interface.name, "root")
    assert link.send(frame(4)) == 1
    assert node.receive() == (4, b"")
    assert link.statistics == {"refused": 2, "sent": 1}


def test_what_the_receive_queue_loses_is_counted(interface: Interface, link: Link):
    sender = Link()
    assert link.open(interface.address) == 0
    assert sender.open(interface.address) == 0
    burst = [frame(0x100, bytes(8))] * 100
    for _ in range(200):
        assert sender.send(*burst) == 100
    frames = len(link.receive_until(1000))
    while more := len(link.receive()):
        frames += more
    assert frames < 20_000  # so that this test tests something
    sender.send(frame(0x101))  # the kernel tells with the next frame
    assert [one.id for one in link.receive_until(1)] == [0x101]
    assert link.statistics == {"received": frames + 1, "overflows": 20_000 - frames}
    sender.close()


# --- outages ---


def test_an_interface_that_goes_down_and_up(interface: Interface, link: Link):
    assert link.open(interface.address, filters=[(0x11, False)]) == 0
    interface.down()
    link.receive_until_state(lib.CAN_LINK_DOWN)
    assert link.c.last_error == errno.ENETDOWN
    assert link.send(frame(1), frame(2, bus=Bus.CAN3)) == 0
    assert link.receive() == []
    assert link.statistics == {"outages": 1, "undelivered": 1}
    interface.up()
    link.receive_until_state(lib.CAN_LINK_UP)
    node = Node(interface)
    node.send(0x10)
    node.send(0x11)
    assert [one.id for one in link.receive_until(1)] == [0x11]
    assert link.send(frame(3)) == 1
    assert node.receive() == (3, b"")
    assert link.statistics == {"outages": 1, "undelivered": 1, "received": 1, "sent": 1}
    node.socket.close()


def test_an_interface_that_is_deleted_and_created_anew(interface: Interface, link: Link):
    assert link.open(interface.address, filters=[(0x11, False)]) == 0
    interface.delete()
    link.receive_until_state(lib.CAN_LINK_DOWN)
    assert link.send(frame(1)) == 0
    assert link.c.last_error == errno.ENODEV
    interface.create()
    assert link.receive() == []
    interface.up()
    link.receive_until_state(lib.CAN_LINK_UP)
    node = Node(interface)
    node.send(0x10)
    node.send(0x11)
    assert [one.id for one in link.receive_until(1)] == [0x11]
    assert link.send(frame(3)) == 1
    assert node.receive() == (3, b"")
    assert link.statistics == {"outages": 1, "undelivered": 1, "received": 1, "sent": 1}
    node.socket.close()


@pytest.mark.parametrize("deleted", [False, True])
def test_an_outage_between_two_looks_is_noticed(interface: Interface, link: Link, deleted: bool):
    assert link.open(interface.address) == 0
    if deleted:
        interface.delete()
        interface.create()
    else:
        interface.down()
    interface.up()
    link.receive()
    link.receive_until_state(lib.CAN_LINK_UP)
    node = Node(interface)
    node.send(0x11)
    assert [one.id for one in link.receive_until(1)] == [0x11]
    assert link.statistics == {"outages": 1, "received": 1}
    node.socket.close()


@pytest.mark.parametrize("deleted", [False, True])
def test_sending_alone_notices_an_outage_and_its_end(interface: Interface, link: Link, deleted: bool):
    assert link.open(interface.address) == 0
    if deleted:
        interface.delete()
    else:
        interface.down()
    assert link.send(frame(1), frame(2)) == 0
    assert link.c.state == lib.CAN_LINK_DOWN
    assert link.statistics == {"outages": 1, "undelivered": 2}
    if deleted:
        interface.create()
    interface.up()
    end_ns = monotonic_ns() + int(LIMIT_S * 1e9)
    while link.send(frame(3)) == 0:
        assert monotonic_ns() < end_ns
    assert link.c.state == lib.CAN_LINK_UP
