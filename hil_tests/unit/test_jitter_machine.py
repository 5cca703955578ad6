"""What the machine is, and whether a measurement may have what it asks for."""

from __future__ import annotations

import os
import time
from dataclasses import replace

import pytest
from burner import burning

from bridge.realtime.placement import Placement
from dbc.errors import RaceloopError
from tools.jitter.command import _placement
from tools.jitter.machine import busy_share, look_at_machine


def test_machine_is_this_one():
    machine = look_at_machine()
    assert set(machine.cores) == os.sched_getaffinity(0)
    assert os.uname().release in machine.kernel
    assert machine.processor
    assert machine.preempt_rt == ("PREEMPT_RT" in os.uname().version)


def test_a_core_that_others_use_is_busy():
    core = max(os.sched_getaffinity(0))
    with burning(core):
        assert busy_share({core}, 0.5) > 0.9


def test_busy_share_is_a_share():
    started = time.monotonic()
    assert 0.0 <= busy_share(os.sched_getaffinity(0), 0.05) <= 1.0
    assert time.monotonic() - started >= 0.05
    assert busy_share({4095}, 0.0) == 0.0


def test_core_and_priority_as_wanted(monkeypatch: pytest.MonkeyPatch):
    tried = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda *arguments: tried.append(arguments[1]))
    machine = look_at_machine()
    first, last = machine.cores[0], machine.cores[-1]
    assert _placement(Placement(80, first), machine) == (Placement(80, first), [])
    assert _placement(Placement(80, None), machine) == (Placement(80, last), [])
    assert _placement(Placement(None, None), machine) == (Placement(None, last), [])
    assert os.SCHED_FIFO in tried


def test_priority_that_is_refused_is_left_out_and_said(monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    machine = look_at_machine()
    placement, (remark,) = _placement(Placement(80, None), machine)
    assert placement == Placement(None, machine.cores[-1])
    assert "--priority 80: not permitted" in remark
    assert remark.endswith("measured without")


def test_core_that_is_not_there_is_refused():
    machine = replace(look_at_machine(), cores=(0, 4095))
    with pytest.raises(RaceloopError, match="--cpu 4095: no such core"):
        _placement(Placement(None, None), machine)
