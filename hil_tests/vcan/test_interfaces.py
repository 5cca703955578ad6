"""Interfaces that exist, that are made, and those that cannot be: for each of these the line that helps."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge.realtime.vcan import Interface, ensure_interfaces, find_interface
from dbc.errors import BusError

pytestmark = pytest.mark.vcan

OURS = ("vcan7", "vcan8")


def ip(*words: str) -> None:
    subprocess.run(["ip", "link", *words], check=True)


@pytest.fixture(autouse=True)
def _remove_ours() -> Iterator[None]:
    assert {find_interface(name) for name in OURS} == {Interface.ABSENT}
    yield
    for name in OURS:
        if find_interface(name) is not Interface.ABSENT:
            ip("del", "dev", name)


def test_those_of_the_run_are_up() -> None:
    names = [f"vcan{number}" for number in range(4)]
    ensure_interfaces(names)
    assert {find_interface(name) for name in names} == {Interface.UP}


def test_missing_ones_are_made_and_the_others_left_alone() -> None:
    ip("add", "dev", OURS[0], "type", "vcan")
    ip("set", "dev", OURS[0], "up")
    before = Path(f"/sys/class/net/{OURS[0]}/ifindex").read_text()
    ensure_interfaces(OURS)
    assert {find_interface(name) for name in OURS} == {Interface.UP}
    assert Path(f"/sys/class/net/{OURS[0]}/ifindex").read_text() == before


def test_one_that_is_down_stays_down() -> None:
    ip("add", "dev", OURS[0], "type", "vcan")
    with pytest.raises(BusError, match=r"^CAN interface vcan7 is down; run: sudo ip link set dev vcan7 up$"):
        ensure_interfaces(OURS)
    assert [find_interface(name) for name in OURS] == [Interface.DOWN, Interface.ABSENT]


def test_one_that_is_no_can_interface() -> None:
    with pytest.raises(BusError, match=r"^lo is not a CAN interface"):
        ensure_interfaces(["vcan7", "lo"])
    assert find_interface("vcan7") is Interface.ABSENT


def test_real_interface_that_is_missing_is_not_made() -> None:
    with pytest.raises(BusError, match=r"^CAN interface can7 does not exist"):
        ensure_interfaces(["can7"])
    assert find_interface("can7") is Interface.ABSENT


@pytest.mark.parametrize("name", ["vcan7 8", "vcan7/8", "vcan_with_a_long_name"])
def test_name_that_the_kernel_refuses_leaves_nothing(name: str) -> None:
    with pytest.raises(BusError, match=rf"^ip link add dev {name} type vcan: \S"):
        ensure_interfaces([OURS[0], name])
    assert find_interface(OURS[0]) is Interface.ABSENT


def test_no_command_ip(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("bridge.realtime.vcan.SYSTEM_FOLDERS", ())
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BusError, match=r"^no command ip to create vcan7; install iproute2, or use --bus hub$"):
        ensure_interfaces(OURS)
    ensure_interfaces(["vcan0"])


def test_no_permission() -> None:
    program = "import sys; from bridge.realtime.vcan import *; ensure_interfaces(sys.argv[1:])"
    powerless = ["setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin"]
    refused = subprocess.run(
        [*powerless, sys.executable, "-c", program, *OURS], check=False, capture_output=True, text=True
    )
    assert refused.returncode == 1
    assert refused.stderr.splitlines()[-1] == (
        "dbc.errors.BusError: no permission to create vcan7; run: "
        "sudo ip link add dev vcan7 type vcan && sudo ip link set dev vcan7 up && "
        "sudo ip link add dev vcan8 type vcan && sudo ip link set dev vcan8 up"
    )
    assert {find_interface(name) for name in OURS} == {Interface.ABSENT}
    subprocess.run([*powerless, sys.executable, "-c", program, "vcan0"], check=True)
