"""The ECUs' executables on a real CAN interface: they meet, survive its outages, and leave full brake behind."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from time import monotonic

import pytest
from ecu_processes import Ecu, mistake_of
from link_ends import LIMIT_S
from own_interface import Interface, Node

from dbc.buses import Bus
from dbc.codec import database

pytestmark = pytest.mark.vcan


@pytest.fixture
def interface() -> Iterator[Interface]:
    interface = Interface()
    interface.create()
    interface.up()
    yield interface
    subprocess.run(["ip", "link", "delete", interface.name], check=False, capture_output=True)


@pytest.fixture
def node(interface: Interface) -> Iterator[Node]:
    node = Node(interface)
    yield node
    node.socket.close()


def values(node: Node, message: str) -> dict[str, float]:
    """Values of the next frame of a message on the bus."""
    codec = database.message(message)
    end = monotonic() + LIMIT_S
    while monotonic() < end:
        can_id, data = node.receive()
        if can_id == codec.frame_id:
            return dict(zip(codec.signals, codec.decode(data.ljust(8, b"\0")), strict=True))
    raise AssertionError(f"no {message}")


def raptor(interface: Interface, folder: Path) -> Ecu:
    return Ecu("raptor", folder, {Bus.CAN3: interface.address})


def space_drive(interface: Interface, folder: Path) -> Ecu:
    return Ecu("space-drive", folder, {Bus.CAN3: interface.address})


def test_an_interface_that_is_missing_or_down_is_named(interface: Interface):
    assert mistake_of("obc", "--bus=CAN1=socketcan:no_such").startswith(
        "CAN1 at socketcan:no_such: no such CAN interface: ip link add"
    )
    interface.down()
    assert mistake_of("obc", f"--bus=CAN1={interface.address}").startswith(
        f"CAN1 at {interface.address}: the interface is down: ip link set"
    )


def test_raptor_and_space_drive_meet(interface: Interface, node: Node, tmp_path: Path):
    with raptor(interface, tmp_path) as one, space_drive(interface, tmp_path) as other:
        end = monotonic() + LIMIT_S
        while not values(node, "stat_brk_1")["ip_sgnl_vald"]:
            assert monotonic() < end
        assert values(node, "req_brake_pos")["contrl_pos_brk"] == 4096  # 4500 of 6000 kPa
        assert (one.stop(), other.stop()) == (0, 0)
        for ecu in (one, other):
            counts = ecu.counts("CAN3")
            assert counts["sent"] > 0
            assert counts["received"] > 0
            assert counts["refused"] == counts["outages"] == counts["from a second sender"] == 0


def test_a_stopped_space_drive_leaves_its_emergency_brake_on_the_bus(interface: Interface, node: Node, tmp_path: Path):
    codec = database.message("stat_brk_1")
    place = codec.signals.index("emr_brk")
    with space_drive(interface, tmp_path) as ecu:
        assert values(node, "stat_brk_1")["emr_brk"] == 0
        assert ecu.stop() == 0
    last = [data for can_id, data in node.rest() if can_id == codec.frame_id][-1]
    assert codec.decode(last)[place] == 1


@pytest.mark.parametrize("deleted", [False, True])
def test_an_interface_that_goes_and_comes(interface: Interface, tmp_path: Path, deleted: bool):
    with space_drive(interface, tmp_path) as ecu:
        if deleted:
            interface.delete()
        else:
            interface.down()
        ecu.wait_for_line(f"CAN3: {interface.address} went down: ")
        if deleted:
            interface.create()
        interface.up()
        ecu.wait_for_line(f"CAN3: {interface.address} is up again after ")
        node = Node(interface)
        values(node, "stat_brk_1")
        node.socket.close()
        assert ecu.stop() == 0
        counts = ecu.counts("CAN3")
        assert counts["outages"] == 1
        assert counts["undelivered"] > 0
        assert len(ecu.log) == 6, ecu.log


def test_a_second_sender_is_named_once(interface: Interface, node: Node, tmp_path: Path):
    with space_drive(interface, tmp_path) as ecu:
        for _ in range(10):
            node.send(0x81, bytes(8))
        ecu.wait_for_line("CAN3: another station sends stat_brk_1 (0x81): is a second space-drive on the bus?")
        assert ecu.stop() == 0
        assert len(ecu.lines("another station")) == 1
        assert ecu.counts("CAN3")["from a second sender"] == 10
