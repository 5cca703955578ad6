"""The whole car on V26: it drives as on V14, its recording is clean by V26 and by no other, and replays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from bridge.monitor import RunMonitor
from bridge.replay import replay_obc
from bridge.scenario import Condition, load_scenario
from dbc.codec import profile
from dbc.frames import Bus
from tools.dbw.conformance import Conformance
from tools.dbw.findings import Rule
from tools.run import build_bench, find_scenario

PROFILES = ("V14", "V26")

#: The short drive is over before it.
END_US = 18_500_000

#: Frames of so much time fit into the network's log.
PIECE_US = 500_000


@dataclass
class Run:
    """Frames, and the plant's outputs at the end of each piece."""

    name: str
    log: NDArray[np.void]
    truth: NDArray[np.float64]
    monitor: RunMonitor

    def __post_init__(self) -> None:
        self._columns = profile(self.name).decode_columns(self.log)
        self.messages = set(self._columns)

    def column(self, message: str, signal: str) -> NDArray[np.float64]:
        return self._columns[message][signal][1]

    def found(self, name: str) -> set[tuple[Rule, str]]:
        """Rule and message of each finding, by a profile."""
        conformance = Conformance(profile(name))
        conformance.update(self.log)
        conformance.finish()
        return {(place.rule, place.message) for place in conformance.findings}


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    scenario = load_scenario(find_scenario("short_drive"))
    found = {}
    for name in PROFILES:
        monitor, frames, truth = RunMonitor(profile(name)), [], []
        with build_bench(replace(scenario, profile=name)) as bench:
            for end_us in range(PIECE_US, END_US + 1, PIECE_US):
                assert bench.run(until=Condition(time_us=end_us))
                frames.append(bench.network.drain_log())
                truth.append(bench.plant.outputs.copy())
                monitor.update(frames[-1])
            assert bench.losses == 0
        found[name] = Run(name, np.concatenate(frames), np.array(truth), monitor)
    return found


def test_the_car_drives_the_same(runs: dict[str, Run]) -> None:
    """Every value that moves it survives the translation, so that the truth is the same to the last bit."""
    old, new = (runs[name] for name in PROFILES)
    assert np.array_equal(old.truth, new.truth)
    assert np.ptp(old.truth[:, 0]) > 50.0
    states = [
        [(change.machine, change.before, change.after) for change in run.monitor.transitions] for run in (old, new)
    ]
    assert states[0] == states[1]
    assert [new.monitor.state(machine) for machine in ("ssm", "ct", "sys")] == ["NOMINAL", "CNTRL_SHUTDOWN", "PWR_OFF"]
    assert [run.monitor.faults for run in (old, new)] == [[], []]


def test_can1_carries_v26_and_the_other_buses_are_as_ever(runs: dict[str, Run]) -> None:
    old, new = (runs[name].log for name in PROFILES)
    lengths = {message.frame_id: message.length for message in profile("V26") if message.bus == Bus.CAN1}
    can1 = new[new["bus"] == Bus.CAN1]
    assert np.array_equal(can1["dlc"], [lengths[int(frame_id)] for frame_id in can1["id"]])
    assert set(np.unique(can1["id"])) == set(np.unique(old[old["bus"] == Bus.CAN1]["id"]))
    for bus in (Bus.CAN3, Bus.CAN_A, Bus.CAN_S):
        for field in ("id", "data", "time_us"):
            assert np.array_equal(old[old["bus"] == bus][field], new[new["bus"] == bus][field]), (bus, field)


def test_commands_and_reports_say_the_same(runs: dict[str, Run]) -> None:
    old, new = (runs[name] for name in PROFILES)
    brake = old.column("brake_pressure_cmd", "brake_pressure_cmd")
    assert np.array_equal(new.column("brake_pressure_cmd", "F_brake_pressure_cmd"), brake)
    assert np.abs(new.column("brake_pressure_cmd", "R_brake_pressure_cmd") - brake * 46 / 54).max() <= 0.5
    assert brake.max() > 2000
    angle = old.column("steering_report", "steering_motor_ang_avg_fdbk")
    assert np.array_equal(new.column("steering_report_extd", "average_steering_ang_fdbk"), angle)
    assert np.ptp(angle) > 50
    for message in profile("V14"):
        if message.bus != Bus.CAN1 or message.name not in old.messages:
            continue
        shared = set(message.signals) & set(profile("V26").message(message.name).signals)
        for signal in shared:
            assert np.array_equal(old.column(message.name, signal), new.column(message.name, signal)), signal


def test_the_steering_rate_is_that_of_the_motor(runs: dict[str, Run]) -> None:
    """The angle's steps of half a degree, summed over 200 ms, against the rate's integral over the same time."""
    angle = runs["V26"].column("steering_report_extd", "primary_steering_angle_fbk")
    turned = np.cumsum(runs["V26"].column("steering_report", "primary_steering_angular_rate")) * 0.01
    assert np.ptp(angle) > 50
    assert np.abs((angle[20:] - angle[:-20]) - (turned[20:] - turned[:-20])).max() < 0.6


def test_a_recording_is_clean_by_its_own_profile_and_no_other(runs: dict[str, Run]) -> None:
    assert runs["V14"].found("V14") == set()
    assert runs["V26"].found("V26") == set()
    assert runs["V14"].found("V26") == {
        (Rule.SHORT, "steering_report"),
        (Rule.SHORT, "misc_report"),
        (Rule.MISSING, "steering_report"),
        (Rule.MISSING, "misc_report"),
        (Rule.STUCK, "brake_pressure_cmd"),
    }
    found = runs["V26"].found("V14")
    assert {(Rule.LONG, "steering_report"), (Rule.LONG, "misc_report"), (Rule.STUCK, "brake_pressure_cmd")} <= found


def test_a_recording_replays_by_its_own_profile_and_no_other(runs: dict[str, Run]) -> None:
    replay = replay_obc(runs["V26"].log, profile("V26"))
    assert replay.identical
    assert len(replay.recorded) > 10_000
    assert not replay_obc(runs["V26"].log, profile("V14")).identical
