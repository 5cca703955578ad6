"""Cores and priorities: what each process gets, and what is refused."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from bridge.realtime.placement import Placement, Role
from dbc.errors import RaceloopError


def test_without_wishes_nothing_is_asked_for():
    assert [Placement().options(role) for role in Role] == [[], [], [], []]
    Placement().check()


def test_priorities_fall_from_the_ecus_to_autonomy():
    placement = Placement(priority=80)
    given = {role: placement.options(role) for role in Role}
    assert given == {
        Role.ECU: ["--priority", "80"],
        Role.HUB: ["--priority", "79"],
        Role.PLANT: ["--priority", "78"],
        Role.AUTONOMY: ["--priority", "77"],
    }


def test_priorities_stay_above_zero():
    assert [Placement(priority=2).options(role)[1] for role in Role] == ["2", "1", "1", "1"]


def test_ecus_and_hub_share_the_core_that_nothing_else_gets():
    placement = Placement(cpu=1)
    assert placement.options(Role.ECU) == placement.options(Role.HUB) == ["--cpu", "1"]
    assert placement.options(Role.PLANT) == placement.options(Role.AUTONOMY) == []
    assert placement.other_cores({0, 1, 2, 3}) == {0, 2, 3}
    assert placement.other_cores({1}) == {1}, "a machine with one core has no other"
    assert Placement().other_cores({0, 1}) == {0, 1}


def test_this_process_leaves_the_core_and_comes_back():
    before = os.sched_getaffinity(0)
    core = min(before)
    with Placement(cpu=core).on_other_cores():
        assert os.sched_getaffinity(0) == (before - {core} or before)
    assert os.sched_getaffinity(0) == before


def test_a_core_that_does_not_exist():
    with pytest.raises(RaceloopError, match=r"^--cpu 4096: no such core for this process; allowed are \d"):
        Placement(cpu=4096).check()


@pytest.mark.parametrize("priority", [0, -1, 100])
def test_a_priority_that_does_not_exist(priority: int):
    with pytest.raises(RaceloopError, match=rf"^--priority {priority}: must be 1 to 99$"):
        Placement(priority=priority).check()


def test_a_priority_without_permission():
    """An ordinary user, who has none unless the machine was set up for it."""
    code = """
import os, resource
from bridge.realtime.placement import Placement
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.geteuid() == 0:
    os.setgroups([])
    os.setresgid(65534, 65534, 65534)
    os.setresuid(65534, 65534, 65534)
try:
    Placement(priority=50).check()
except Exception as error:
    print(error)
print(os.sched_getscheduler(0) == os.SCHED_OTHER)
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    words, ordinary = answer.stdout.splitlines()
    assert words.startswith("--priority 50: not permitted; run as root, or allow it with 'ulimit -r 50'")
    assert ordinary == "True"
