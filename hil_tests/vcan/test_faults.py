"""Faults while the whole car drives on vcan0 to vcan3: full brake, and nothing lets go of it afterwards.

Under emulation time is slow and uneven, so the car lives slower and the deadlines have room; how soon the car reacts on
a machine that keeps time is tested over the hub.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from can_utils import INTERFACES
from realtime_rig import Car, car
from station_loss import LOSSES, SHUT_DOWN, SSM_BRAKES, Loss, lose_and_get_back

from bridge.realtime.placement import Placement
from dbc.buses import Bus, car_buses
from dbc.errors import RaceloopError
from tools.realtime_run import RealTimeOptions

pytestmark = pytest.mark.vcan

SLOWER = 3
PRIORITY = 50
ALLOWANCE_US = 1_000_000
HOUR_NS = 3_600_000_000_000


def options() -> RealTimeOptions:
    """Stations before observer and recorder, where this user may have it so."""
    placement = Placement(priority=PRIORITY)
    try:
        placement.check()
    except RaceloopError:
        placement = Placement()
    return RealTimeOptions(tuple(INTERFACES[bus] for bus in car_buses()), placement=placement, slower=SLOWER)


# Minutes each under emulation, where a late sensor may keep the car from starting; over the hub all are always killed.
if "RACELOOP_EVERY_LOSS" in os.environ:

    @pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.gone)
    def test_a_station_is_killed(loss: Loss, tmp_path: Path) -> None:
        with car(tmp_path, options()) as it:
            lose_and_get_back(it, loss, signal.SIGKILL, ALLOWANCE_US)


def set_interface(bus: Bus, state: str) -> None:
    subprocess.run(["ip", "link", "set", INTERFACES[bus], state], check=True)


def test_flood_and_clock_change_nothing_and_an_interface_that_goes_brakes(tmp_path: Path) -> None:
    """CAN1 goes: no command reaches the Raptor, no report the onboard computer. When it is back, both still brake."""
    with car(tmp_path, options()) as it:
        since_us = it.drive()
        assert it.flood(Bus.CAN1, 0.25) > 1000
        it.drives_on(since_us)
        if "RACELOOP_GUEST" in os.environ:  # elsewhere the wall clock is not ours to set
            clock_changes_nothing(it, since_us)
        fault_us = it.run.now_us
        set_interface(Bus.CAN1, "down")
        try:
            it.until(lambda: (it.receiver.brakes_since("raptor") or 0) > fault_us, "the Raptor's brake")
            it.until(lambda: it.says(*SSM_BRAKES), "the brake of the onboard computer")
            it.until(lambda: it.stands, "standstill")
        finally:
            set_interface(Bus.CAN1, "up")
        back_us = it.run.now_us
        it.until(lambda: it.receiver.braking("obc")[0][-1] > back_us, "commands on CAN1")
        it.until(lambda: it.says(*SHUT_DOWN), "emergency shutdown of the Raptor")
        it.watch(0.5)
        it.still_brakes(back_us, "obc", "raptor")
        assert it.stands, it.story()


def clock_changes_nothing(it: Car, since_us: int) -> None:
    """The wall clock is set on by an hour, and back."""
    for step_ns in (HOUR_NS, -HOUR_NS):
        time.clock_settime_ns(time.CLOCK_REALTIME, time.time_ns() + step_ns)
        it.watch(0.5)
        it.drives_on(since_us)
