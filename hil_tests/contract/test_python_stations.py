"""Plant and autonomy as processes on a hub: how they start, what they say, and how they end."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from cli_harness import copy_scenarios, edit
from hub_process import BOUND_S, Hub, until

from autonomy.radar_inbox import RadarInbox, ReceivedScan, ScanStatus
from autonomy.status import NodeStatus
from bridge._native import ffi
from bridge.bus import CHANNELS
from bridge.realtime.cycle_log import read_cycle_log
from bridge.realtime.link import CanLink
from bridge.realtime.plant_station import PlantExit
from bridge.realtime.supervisor import Part, Start, Supervisor
from bridge.realtime.truth_file import TruthFile
from bridge.realtime.wired import Cell, WiredIo
from dbc.codec import database
from dbc.errors import ConfigurationError
from dbc.frames import Bus, Frame, iterate
from dbc.radar_tracks import TRACKS
from tools.run import find_scenario
from tools.station import BUSES, main

pytestmark = pytest.mark.realtime

SCENARIO = find_scenario("short_drive")


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    with Hub(tmp_path / "hub") as hub:
        yield hub


@pytest.fixture
def wires(tmp_path: Path) -> Iterator[WiredIo]:
    with WiredIo(tmp_path / "wires", create=True) as wires:
        yield wires


def command(name: str, hub: Hub | None, folder: Path, *more: str, scenario: Path = SCENARIO) -> tuple[str, ...]:
    words = [sys.executable, "-m", "tools.station", name, str(scenario)]
    if hub is not None:
        words += [f"--bus={CHANNELS[bus]}=hub:{hub.local}" for bus in BUSES[name]]
    if name == "plant":
        words += [f"--wired={folder / 'wires'}", f"--truth={folder / 'truth'}"]
    return (*words, f"--cycle-log={folder / name}.cycles", *more)


class Run:
    """Stations under a supervisor.

    Attributes
    ----------
    lines : what they logged: name and line.
    """

    def __init__(self, commands: dict[str, tuple[str, ...]]) -> None:
        self.lines: list[tuple[str, str]] = []
        parts = [Part(name, words, Start.PREPARES) for name, words in commands.items()]
        self.supervisor = Supervisor(parts, lambda name, line: self.lines.append((name, line)), lead_s=0.3)

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Let the run go on until a condition holds."""
        end = time.monotonic() + BOUND_S
        while not condition():
            assert time.monotonic() < end, f"waited {BOUND_S} s for {what}; logged: {self.lines}"
            self.supervisor.poll(0.01)

    def until_logged(self, words: str) -> None:
        self.until(lambda: any(words in line for _, line in self.lines), words)

    def ended(self, name: str) -> int:
        """Exit status of a station, once it has ended."""
        self.until(lambda: name not in self.supervisor.running, f"the end of {name}")
        return next(ended.status for ended in self.supervisor.ended if ended.name == name)

    def report(self) -> dict[str, object]:
        """The plant's last words."""
        return json.loads(next(line for name, line in self.lines if name == "plant" and line.startswith("{")))


@contextmanager
def running(**commands: tuple[str, ...]) -> Iterator[Run]:
    run = Run(commands)
    with run.supervisor:
        run.supervisor.start()
        yield run


def cycles(folder: Path, name: str) -> int:
    """Cycles that a station has logged; 0 while it has not made its log."""
    try:
        return len(read_cycle_log(folder / f"{name}.cycles").records)
    except ConfigurationError:
        return 0


@pytest.fixture
def complaint(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[[tuple[str, ...]], str]:
    """Runs a station in this process that refuses to start; returns the one line that it says."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the test's own process keeps its handlers
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))

    def run(words: tuple[str, ...]) -> str:
        try:
            status = main(words[3:])
        except SystemExit as leaving:
            status = leaving.code
        assert status == PlantExit.USER_ERROR, words
        said = capfd.readouterr().err
        assert said.count("\n") == 1, said
        return said.strip()

    return run


def test_a_mistake_is_one_line(
    tmp_path: Path, hub: Hub, wires: WiredIo, complaint: Callable[[tuple[str, ...]], str]
) -> None:
    del wires
    plant, autonomy = command("plant", hub, tmp_path), command("autonomy", hub, tmp_path)
    (tmp_path / "text").write_text("once upon a time")
    for words, expected in (
        (command("plant", None, tmp_path), "raceloop-plant: --bus CAN1=ADDRESS is missing"),
        ((*plant, "--bus=CAN3=hub:x"), "raceloop-plant: --bus CAN3=hub:x: must be BUS=ADDRESS; buses are CAN1, CANA"),
        ((*autonomy, "--bus=CANA=hub:x"), "raceloop-autonomy: --bus CANA=hub:x: CANA is given twice"),
        ((*autonomy, "--bus=CANA"), "raceloop-autonomy: --bus CANA: must be BUS=ADDRESS; buses are CANA, CANS"),
        ((*autonomy, "--epoch=soon"), "raceloop-autonomy: argument --epoch: is 'soon'; must be nanoseconds, or -"),
        ((*autonomy, "--period=0"), "raceloop-autonomy: argument --period: is '0'; must be a whole number"),
        ((*autonomy, "--priority=100"), "raceloop-autonomy: --priority 100: must be 1 to 99"),
        ((*autonomy, "--cpu=4095"), "raceloop-autonomy: --cpu 4095: no such core"),
        ((*autonomy, "--epoch=-"), "raceloop-autonomy: --epoch -: standard input has ''; must be nanoseconds"),
        ((*plant, f"--wired={tmp_path / 'text'}"), f"raceloop-plant: {tmp_path / 'text'}: no wires of this version"),
        ((*plant, f"--truth={tmp_path}/none/truth"), f"raceloop-plant: {tmp_path}/none/truth: cannot be the file of"),
        (command("plant", hub, tmp_path, scenario=tmp_path / "none.yaml"), f"raceloop-plant: {tmp_path}/none.yaml: "),
        (("", "", "", "radar"), "raceloop-station: argument station: invalid choice: 'radar'"),
    ):
        assert complaint(words).startswith(expected)


def with_radar(folder: Path) -> Path:
    """The scenario, of a car with the radar."""
    scenario = copy_scenarios(folder / "scenarios").with_name(SCENARIO.name)
    edit(scenario, "seed: 20221103", "seed: 20221103\nradar: true")
    return scenario


def test_a_car_with_radar_needs_its_bus(
    tmp_path: Path, hub: Hub, wires: WiredIo, complaint: Callable[[tuple[str, ...]], str]
) -> None:
    del wires
    scenario = with_radar(tmp_path)
    for name in BUSES:
        line = complaint(command(name, hub, tmp_path, scenario=scenario))
        assert line == f"raceloop-{name}: --bus CANR=ADDRESS is missing"
        line = complaint(command(name, hub, tmp_path, f"--bus=CANR=hub:{hub.local}"))
        assert line.startswith(f"raceloop-{name}: --bus CANR=hub:{hub.local}: must be BUS=ADDRESS; buses are ")


def test_the_plant_sends_whole_scans_of_the_radar_and_autonomy_hears_them(
    tmp_path: Path, hub: Hub, wires: WiredIo
) -> None:
    del wires
    more = (f"--bus=CANR=hub:{hub.local}", "--with-parent")
    scenario = with_radar(tmp_path)
    commands = {name: command(name, hub, tmp_path, *more, scenario=scenario) for name in BUSES}
    inbox, scans = RadarInbox(), list[ReceivedScan]()
    with CanLink(f"hub:{hub.local}", Bus.CAN_R) as link, running(**commands) as run:

        def heard() -> bool:
            for frame in iterate(link.receive().tobytes()):
                inbox.receive(frame.time_us, frame.id, frame.dlc, frame.flags, frame.data)
                scan = inbox.take(frame.time_us)
                scans.extend([] if scan is None else [scan])
            return len(scans) >= 5 and cycles(tmp_path, "autonomy") > 50

        run.until(heard, "five scans of the radar")
    assert {scan.status for scan in scans} == {ScanStatus.COMPLETE}
    assert sum(len(scan.tracks) for scan in scans) > 0
    records = {name: read_cycle_log(tmp_path / f"{name}.cycles").records for name in BUSES}
    with_scan = records["autonomy"]["newest_ns"][:, Bus.CAN_R] > 0
    assert np.count_nonzero(with_scan) >= 5
    assert records["autonomy"]["frames_in"][with_scan].max() >= TRACKS
    assert not records["plant"]["newest_ns"][:, Bus.CAN_R].any(), "sensors hear nothing of it"


def test_a_bus_that_is_not_there_is_one_line(
    tmp_path: Path, hub: Hub, complaint: Callable[[tuple[str, ...]], str]
) -> None:
    hub.stop()
    line = complaint(command("autonomy", hub, tmp_path))
    assert line.startswith(f"raceloop-autonomy: CANA at hub:{hub.local}: ")


def test_both_speak_in_every_slot_and_stop_when_asked(tmp_path: Path, hub: Hub, wires: WiredIo):
    commands = {name: command(name, hub, tmp_path, "--with-parent") for name in BUSES}
    heard: dict[Bus, list[Frame]] = {Bus.CAN_S: [], Bus.CAN_A: []}
    with ExitStack() as links:
        listeners = {bus: links.enter_context(CanLink(f"hub:{hub.local}", bus)) for bus in heard}

        def listen() -> None:
            for bus, link in listeners.items():
                heard[bus] += iterate(link.receive().tobytes())

        def both_have_run() -> bool:
            listen()
            return min(cycles(tmp_path, name) for name in BUSES) > 50

        with running(**commands) as run:
            run.until(both_have_run, "50 cycles of both")
            run.supervisor.stop(meanwhile=listen)
            assert [run.ended(name) for name in BUSES] == [0, 0]
            report = run.report()
        status = database.message("node_status")
        goodbye = [(node, NodeStatus.INACTIVE) for node in status.choices["node_id"]]

        def said() -> list[tuple[float, ...]]:
            listen()
            return [status.decode(frame.data)[:2] for frame in heard[Bus.CAN_A] if frame.id == status.frame_id]

        until(lambda: said()[-len(goodbye) :] == goodbye, "last words of autonomy")  # the hub has still to pass them on
        assert NodeStatus.INACTIVE not in {code for _, code in said()[: -len(goodbye)]}
    assert (report["finished"], report["reason"], report["verdict"]) == (False, "stopped", "PENDING")
    # One sample and one row of truth per slot, also of those that it was late for.
    samples = [frame for frame in heard[Bus.CAN_S] if frame.id == database.message("imu_rates").frame_id]
    with TruthFile(tmp_path / "truth") as truth:
        times_us = truth.take()[:, 0]
    lost_ms = report["lost_ms"]
    assert isinstance(lost_ms, int)
    assert len(samples) == len(times_us)
    assert times_us[-1] - times_us[0] == 10_000 * (len(times_us) - 1) + 1000 * lost_ms
    assert report["simulated_s"] == pytest.approx(0.01 * (len(times_us) - 1))
    # The plant's signals are on the wires.
    wired = ffi.new("raptor_wired_in *")
    assert wires.read(Cell.RAPTOR_IN, wired) > 0
    assert wired.battery_voltage > 10.0
    # A cycle knows when its newest frame was on each bus.
    log = read_cycle_log(tmp_path / "autonomy.cycles").records
    fresh = log[log["newest_ns"][:, Bus.CAN_S] > 0]
    assert len(fresh)
    assert np.all(fresh["newest_ns"][:, Bus.CAN_S] <= fresh["received_ns"])
    assert not log["newest_ns"][:, Bus.CAN1].any()


def test_a_plant_that_was_stopped_says_what_it_lost(tmp_path: Path, hub: Hub, wires: WiredIo):
    del wires
    with running(plant=command("plant", hub, tmp_path)) as run:
        run.until(lambda: cycles(tmp_path, "plant") > 10, "10 cycles")
        run.supervisor.kill("plant", signal.SIGSTOP)
        stopped_ns = time.monotonic_ns()
        run.until(lambda: time.monotonic_ns() - stopped_ns > 300_000_000, "0.3 s")
        run.supervisor.kill("plant", signal.SIGCONT)
        run.until_logged("of simulated time")
        before = cycles(tmp_path, "plant")
        run.until(lambda: cycles(tmp_path, "plant") > before + 10, "10 more cycles")
        run.supervisor.stop()
        assert run.ended("plant") == PlantExit.STOPPED
        lost_ms = run.report()["lost_ms"]
        assert isinstance(lost_ms, int)
        assert lost_ms >= 280
        assert ("plant", f"lost {lost_ms} ms of simulated time") in run.lines


def test_the_time_limit_ends_the_plant_with_its_status(tmp_path: Path, hub: Hub, wires: WiredIo):
    del wires
    folder = SCENARIO.parent
    text = SCENARIO.read_text().replace("time_limit_s: 40.0", "time_limit_s: 0.5")
    for key in ("track: ", "vehicle: ", "operation: "):
        text = text.replace(f"\n{key}", f"\n{key}{folder}/")
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(text)
    with running(plant=command("plant", hub, tmp_path, "--period=5000", scenario=scenario)) as run:
        assert run.ended("plant") == PlantExit.TIME_UP
        assert run.report()["reason"] == "time limit"
    # Of its own time, which ran twice as fast as the clock; a busy machine may have carried it beyond.
    with TruthFile(tmp_path / "truth") as truth:
        times_us = truth.take()[:, 0]
    assert times_us[-1] >= 500_000
    assert np.all(times_us[:-1] < 500_000)
    log = read_cycle_log(tmp_path / "plant.cycles")
    assert log.period_ns == 5_000_000
    assert log.records["slot"][-1] * 10_000 == times_us[-1]


def test_a_hub_that_goes_and_comes_is_told(tmp_path: Path, hub: Hub):
    with running(autonomy=command("autonomy", hub, tmp_path)) as run:
        run.until(lambda: cycles(tmp_path, "autonomy") > 10, "10 cycles")
        hub.stop(signal.SIGKILL)
        run.until_logged("is down")
        with Hub(tmp_path / "hub") as again:
            run.until_logged("CANA at hub:" + str(again.local) + " is up again")
            run.until_logged("CANS at hub:" + str(again.local) + " is up again")
            with CanLink(f"hub:{again.local}", Bus.CAN_A) as link:
                until(lambda: link.receive().size, "frames of autonomy")
            run.supervisor.stop()
        assert run.ended("autonomy") == 0


def test_what_a_killed_plant_wrote_is_readable(
    tmp_path: Path, hub: Hub, wires: WiredIo, monkeypatch: pytest.MonkeyPatch
):
    del wires
    unpacked = tmp_path / "unpacked"
    unpacked.mkdir()
    monkeypatch.setenv("TMPDIR", str(unpacked))  # a plant that is killed cannot remove its FMU's unpacked files
    with running(plant=command("plant", hub, tmp_path)) as run:
        run.until(lambda: cycles(tmp_path, "plant") > 20, "20 cycles")
        run.supervisor.kill("plant", signal.SIGKILL)
        assert run.ended("plant") == -signal.SIGKILL
    with TruthFile(tmp_path / "truth") as truth:
        rows = truth.take()
    log = read_cycle_log(tmp_path / "plant.cycles").records
    assert len(rows) - log["skipped"].sum() in (len(log), len(log) + 1)
    assert np.all(np.isfinite(rows))


def test_stations_do_not_outlive_their_parent(tmp_path: Path, hub: Hub):
    words = command("autonomy", hub, tmp_path, "--with-parent")
    parent = subprocess.Popen(
        [sys.executable, "-c", f"import subprocess; subprocess.run({words!r}, check=False)"], stdin=subprocess.DEVNULL
    )
    try:
        until(lambda: cycles(tmp_path, "autonomy") > 5, "5 cycles")
        station = read_cycle_log(tmp_path / "autonomy.cycles").process
        assert station != parent.pid
        assert os.path.exists(f"/proc/{station}")
    finally:
        parent.kill()
        parent.wait()
    until(lambda: not _runs(station), "the end of the station")


def _runs(process: int) -> bool:
    """False once a process has ended, be it reaped or not."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
