"""The whole car as processes on vcan0 to vcan3: from power-on to motion and to a stop, as candump and cantools see it.

Under emulation everything is slow, so the car lives slower; what happens is asserted, not when.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from can.io.canutils import CanutilsLogReader
from can_utils import INTERFACES, candump, until
from realtime_rig import quick_scenario

from bridge.bus import CHANNELS
from bridge.realtime.placement import Placement
from dbc.buses import DIRECTORY, Bus, car_buses
from dbc.codec import database
from dbc.errors import RaceloopError
from dbc.states import CtState, SsmState, SysState

pytestmark = pytest.mark.vcan

RACELOOP = Path(sys.executable).with_name("raceloop")
SLOWER = 3
PRIORITY = 50
LIMIT_S = 500.0
"""For start, drive and recording together."""
END_MARK = 0x7F0
"""Identifier that nobody on the buses uses."""
FULL_BRAKE_KPA, STEERED_BRAKE_KPA = 4500.0, 3500.0


@dataclass(frozen=True)
class Drive:
    """A run and what candump wrote of it, by bus."""

    status: int
    summary: dict[str, Any]
    recorded: dict[Bus, list[can.Message]]
    witnessed: dict[Bus, list[can.Message]]

    def values(self, message: str, signal: str) -> list[float]:
        """A signal as cantools decodes it out of candump's log."""
        codec = database.message(message)
        loaded = cantools.database.load_file(DIRECTORY / f"{codec.database}.dbc").get_message_by_name(message)
        return [
            loaded.decode(frame.data, decode_choices=False)[signal]
            for frame in self.witnessed[codec.bus]
            if frame.arbitration_id == codec.frame_id
        ]


def priority() -> list[str]:
    """Stations before observer and recorder, where this user may have it so."""
    try:
        Placement(priority=PRIORITY).check()
    except RaceloopError:
        return []
    return ["--priority", str(PRIORITY)]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    folder = tmp_path_factory.mktemp("drive")
    scenario = quick_scenario(folder, chequered_m=2.0)
    log, out = folder / "candump.log", folder / "out"
    command = [RACELOOP, "run", scenario, "--realtime", "--bus", "socketcan", "--slower", str(SLOWER), "--out", out]
    command += priority()
    with log.open("w") as output, candump(output):
        # A group of its own, so that nothing of it outlives a test that fails.
        with subprocess.Popen(command, text=True, stdout=subprocess.PIPE, start_new_session=True) as run:
            try:
                summary_page, _ = run.communicate(timeout=LIMIT_S)
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(run.pid, signal.SIGKILL)
        for interface in INTERFACES.values():
            subprocess.run(["cansend", interface, f"{END_MARK:X}#"], check=True)
        until(lambda: log.read_text().count(f" {END_MARK:X}#") == len(INTERFACES), "candump to have heard all")
    print(summary_page)
    return Drive(
        status=run.returncode,
        summary=json.loads((out / "summary.json").read_text()),
        recorded=by_bus(out / "frames.log", CHANNELS),
        witnessed=by_bus(log, INTERFACES),
    )


def by_bus(log: Path, channels: Mapping[Bus, str]) -> dict[Bus, list[can.Message]]:
    frames: dict[str, list[can.Message]] = {channel: [] for channel in channels.values()}
    with CanutilsLogReader(log) as reader:
        for frame in reader:
            if frame.arbitration_id != END_MARK:
                frames[frame.channel].append(frame)
    return {bus: frames[channel] for bus, channel in channels.items()}


def test_the_car_drives_and_stops(drive: Drive) -> None:
    assert drive.status == 0
    assert drive.summary["finished"]
    assert drive.summary["real_time"]["failures"] == []
    assert drive.summary["real_time"]["bus"] == "socketcan"
    speed = drive.values("wheel_speed_report", "wheel_speed_FL")
    assert max(speed) > 5.0
    assert speed[0] == 0.0
    assert speed[-1] < 1.0


def test_foreign_programs_see_the_run_up(drive: Drive) -> None:
    """In the order of the states, each of which is seen."""
    assert_in_order(drive.values("ssm_status", "ssm_state"), SsmState.LAUNCHING, SsmState.NOMINAL)
    assert_in_order(
        drive.values("ct_report", "ct_state"),
        CtState.INITIALIZED,
        CtState.ACT_TEST,
        CtState.CRANKREADY,
        CtState.CRANKING,
        CtState.RACEREADY,
        CtState.INIT_DRIVING,
        CtState.CAUTION,
        CtState.CNTRL_SHUTDOWN,
    )
    assert_in_order(
        drive.values("misc_report", "sys_state"),
        SysState.ACT_TESTING,
        SysState.CRANKREADY,
        SysState.CRANKING,
        SysState.ENG_IDLE,
        SysState.DRIVING,
        SysState.SHUT_ENG,
        SysState.PWR_OFF,
    )


def assert_in_order(seen: list[float], *states: int) -> None:
    first = [seen.index(state) for state in states]
    assert first == sorted(first)


def test_full_brake_is_on_the_bus_before_the_launch_and_at_the_end(drive: Drive) -> None:
    pressure = drive.values("brake_pressure_cmd", "brake_pressure_cmd")
    assert pressure[0] == FULL_BRAKE_KPA
    assert min(pressure) < 0.5 * FULL_BRAKE_KPA
    assert set(pressure[-5:]) <= {STEERED_BRAKE_KPA, FULL_BRAKE_KPA}


def test_candump_and_the_recording_have_the_same_frames(drive: Drive) -> None:
    """In the same order as far as one station sent them: two at a time may reach two listeners in either order."""
    assert drive.summary["frames_lost"] == 0
    for bus in car_buses():
        witnessed, recorded = (by_identifier(frames[bus]) for frames in (drive.witnessed, drive.recorded))
        assert sum(map(len, witnessed.values())) > 1000
        assert witnessed == recorded


def by_identifier(frames: list[can.Message]) -> dict[tuple[int, bool], list[bytes]]:
    sorted_out: dict[tuple[int, bool], list[bytes]] = {}
    for frame in frames:
        sorted_out.setdefault((frame.arbitration_id, frame.is_extended_id), []).append(bytes(frame.data))
    return sorted_out


def test_the_recording_has_the_time_of_the_car(drive: Drive) -> None:
    """Which lives slower than candump's clock."""
    for bus in car_buses():
        spans = [frames[-1].timestamp - frames[0].timestamp for frames in (drive.witnessed[bus], drive.recorded[bus])]
        assert spans[0] / spans[1] == pytest.approx(SLOWER, rel=0.01)
