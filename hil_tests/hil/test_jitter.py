"""`raceloop jitter` with real processes: what it measures is there, and nothing is left when it ends in any way.

Times are not judged here: machines that run tests are busy.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from perfetto.protos.perfetto.trace import perfetto_trace_pb2 as perfetto

import scenarios
from bridge.realtime.cycle_log import cycles_written
from tools.cli import main
from tools.jitter import cyclictest, load
from tools.jitter.background import find_program

pytestmark = pytest.mark.realtime

BOUND_S = 120.0
"""Generous: waits end as soon as what they wait for has happened."""

has_cyclictest = pytest.mark.skipif(find_program("cyclictest") is None, reason="cyclictest is not installed")
has_stress_ng = pytest.mark.skipif(find_program("stress-ng") is None, reason="stress-ng is not installed")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The command in this process; gives what it printed."""
    status = main(["jitter", *map(str, arguments)])
    captured = capsys.readouterr()
    assert (status, captured.err) == (0, ""), captured.out
    return captured.out


def rows(run: dict[str, Any], title: str) -> dict[str, dict[str, Any]]:
    (quantity,) = (quantity for quantity in run["quantities"] if quantity["title"].startswith(title))
    return {row["label"]: row for row in quantity["rows"]}


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """The onboard computer, idle and under load: page and folder."""
    folder = tmp_path_factory.mktemp("jitter") / "out"
    command = [sys.executable, "-m", "tools.cli", "jitter", "--seconds", "1", "--load", "cpu", "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=BOUND_S, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout, folder


@has_cyclictest
@has_stress_ng
def test_onboard_computer_idle_and_under_load(measured: tuple[str, Path]):
    page, folder = measured
    assert sorted(path.name for path in folder.iterdir()) == ["jitter.json", "jitter.pftrace", "jitter.svg"]
    content = json.loads((folder / "jitter.json").read_text())
    assert content["settings"]["ecu"] == "obc"
    assert [run["condition"] for run in content["runs"]] == ["idle", "cpu load"]
    for run in content["runs"]:
        assert 90 < run["cycles"] + run["skipped"] <= 100
        assert run["cpu"] == max(content["machine"]["cores"])
        lateness = rows(run, "Wake-up lateness")
        assert list(lateness) == ["raceloop-obc", "waiting for the core", "cyclictest"]
        assert lateness["raceloop-obc"]["count"] == run["cycles"]
        assert lateness["cyclictest"]["count"] > 50
        assert lateness["cyclictest"]["minimum"] >= 0.0
        spacing = rows(run, "Spacing of brake_pressure_cmd")
        assert list(spacing) == ["raceloop-obc", "python-can send_periodic", "plain Python loop"]
        assert spacing["raceloop-obc"]["count"] == run["command_frames"] - 1
        # 100 frames in 1 s; whoever sends on a busy machine may be some short.
        assert all(50 < row["count"] < 110 for row in spacing.values())
        ages = rows(run, "Age of input")
        assert set(ages) == {"from CAN-S (sensors)", "from CAN-A (estimate)"}
        assert all(row["minimum"] > 0.0 and row["count"] > 50 for row in ages.values())
        assert len(run["worst_cycles"]) == 5
        assert set(run["worst_cycles"][0]["tasks"]) >= {"receive", "control", "dbw"}
    assert "cpu load: " in page
    ElementTree.parse(folder / "jitter.svg")
    trace = perfetto.Trace.FromString((folder / "jitter.pftrace").read_bytes())
    names = {packet.track_descriptor.process.process_name for packet in trace.packet}
    assert {"obc, idle", "obc, cpu load"} <= names


def test_raptor_at_a_thousand_hertz(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    path = tmp_path / "figures.json"
    page = run(capsys, "--ecu", "raptor", "--rate", 1000, "--seconds", 1, "--priority", 0, "--json", path)
    assert page.startswith("raceloop-raptor, 1000 Hz, 1 s, without real-time priority on core ")
    assert list(tmp_path.iterdir()) == [path]
    (idle,) = json.loads(path.read_text())["runs"]
    assert 0 < idle["cycles"] + idle["skipped"] <= 1000
    assert idle["priority"] is None
    assert idle["period_us"] == 1000.0
    assert list(rows(idle, "Age of input")) == ["from CAN1 (commands)"]


def test_without_programs_of_others_their_columns_are_left_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for module in (cyclictest, load):
        monkeypatch.setattr(module, "find_program", lambda _name: None)
    path = tmp_path / "figures.json"
    page = run(capsys, "--ecu", "space-drive", "--seconds", 1, "--load", "all", "--json", path)
    lines = page.splitlines()
    assert "stress-ng is not installed, so there is no load: apt install stress-ng" in lines
    assert any("cyclictest is not installed" in line and "apt install" in page for line in lines)
    (idle,) = json.loads(path.read_text())["runs"]
    assert "cyclictest" not in rows(idle, "Wake-up lateness")
    assert 90 < idle["cycles"] + idle["skipped"] <= 100


def test_priority_that_is_not_permitted(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuse(_process: int, _policy: int, _parameters: os.sched_param) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    path = tmp_path / "figures.json"
    page = run(capsys, "--seconds", 0.5, "--json", path)
    assert "--priority 80: not permitted" in page
    assert "measured without" in page
    assert json.loads(path.read_text())["runs"][0]["priority"] is None


@pytest.fixture
def brief_scenario(tmp_path: Path) -> Path:
    """The solo lap's first three seconds."""
    text = (scenarios.DIRECTORY / "solo_lap.yaml").read_text()
    head, finish = text.split("\nfinish:", 1)
    for folder in ("tracks", "vehicles", "operations"):
        head = head.replace(f"{folder}/", f"{scenarios.DIRECTORY}/{folder}/")
    rest = finish.split("\n", 1)[1]
    path = tmp_path / "brief.yaml"
    path.write_text(f"{head}\nfinish: {{time_s: 3.0}}\n{rest}")
    return path


def test_whole_loop(capsys: pytest.CaptureFixture[str], tmp_path: Path, brief_scenario: Path):
    out = tmp_path / "out"
    page = run(capsys, "--scenario", brief_scenario, "--out", out)
    assert "in the whole loop, solo_lap" in page
    (idle,) = json.loads((out / "jitter.json").read_text())["runs"]
    assert set(idle["stations"]) == {"plant", "autonomy", "raptor", "space-drive"}
    assert 280 < idle["cycles"] + idle["skipped"] <= 302
    ages = rows(idle, "Age of input")
    by_estimate, from_estimate = ages["sensors, by the estimate"], ages["from CAN-A (estimate)"]
    assert by_estimate["count"] > 200
    assert by_estimate["p50"] >= from_estimate["p50"]
    assert list(rows(idle, "Spacing of")) == ["raceloop-obc"]
    trace = perfetto.Trace.FromString((out / "jitter.pftrace").read_bytes())
    tracks = [packet.track_descriptor for packet in trace.packet if packet.HasField("track_descriptor")]
    assert {"CAN1", "CAN3", "CAN-A", "CAN-S"} <= {track.name for track in tracks}
    assert {"plant, idle", "obc, idle"} <= {track.process.process_name for track in tracks}


class Started:
    """The command as a process, which can be told from others, with all that it starts, by its environment."""

    def __init__(self, *arguments: str) -> None:
        self._mark = f"RACELOOP_TEST={uuid.uuid4().hex}"
        name, value = self._mark.split("=")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tools.cli", "jitter", *arguments],
            env=os.environ | {name: value},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def processes(self) -> dict[int, str]:
        """All processes of it that are alive, by their programs."""
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if self._mark.encode() in (folder / "environ").read_bytes().split(b"\0"):
                    found[int(folder.name)] = Path(os.readlink(folder / "exe")).name
            except OSError:
                continue
        return found

    def wait_for(self, program: str) -> int:
        """The process of a program, once it is there."""
        end = time.monotonic() + BOUND_S
        while True:
            for process, name in self.processes().items():
                if name == program:
                    return process
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < end, f"waited {BOUND_S} s for {program}"
            time.sleep(0.05)

    def folder(self) -> Path:
        """Folder of the files that its processes share, when the ECU is there."""
        command = Path(f"/proc/{self.wait_for('raceloop-obc')}/cmdline").read_text().split("\0")
        (log,) = (word for word in command if word.startswith("--cycle-log="))
        return Path(log.removeprefix("--cycle-log=")).parent

    def wait_for_cycles(self) -> None:
        """Wait until ECU and player are on their buses and cycle: from now on a measurement goes on."""
        logs = [self.folder() / f"{name}.cycles" for name in ("obc", "player")]
        end = time.monotonic() + BOUND_S
        while not all(cycles_written(log) for log in logs):
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < end, f"waited {BOUND_S} s for cycles"
            time.sleep(0.05)

    def end(self) -> tuple[int, str, str]:
        """Status and words of the command, when it and all that it started have ended."""
        out, error = self.process.communicate(timeout=BOUND_S)
        end = time.monotonic() + BOUND_S
        while left := self.processes():
            assert time.monotonic() < end, left
            time.sleep(0.01)
        return self.process.returncode, out, error


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Started]]:
    all_started = []

    def go(*arguments: str) -> Started:
        all_started.append(Started("--out", str(tmp_path / "out"), *arguments))
        return all_started[-1]

    yield go
    for started in all_started:
        for process in started.processes():
            os.kill(process, signal.SIGKILL)
        started.process.communicate()


@has_cyclictest
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "terminated"])
def test_interrupted(start: Callable[..., Started], tmp_path: Path, number: int):
    started = start("--rate", "10", "--seconds", "300")
    shared = started.folder()
    assert shared.is_dir()
    for program in ("raceloop-hub", "cyclictest"):
        started.wait_for(program)
    started.process.send_signal(number)
    assert started.end() == (130, "", "raceloop: interrupted; nothing was written\n")
    assert list((tmp_path / "out").iterdir()) == []
    assert not shared.exists()


@has_cyclictest
def test_killed_command_leaves_no_process(start: Callable[..., Started]):
    started = start("--rate", "10", "--seconds", "300")
    shared = started.folder()
    started.wait_for("cyclictest")
    started.process.kill()
    started.end()
    shutil.rmtree(shared.parent)  # it had no chance to


@pytest.mark.parametrize("program", ["raceloop-obc", "raceloop-hub"])
def test_part_that_dies(start: Callable[..., Started], tmp_path: Path, program: str):
    started = start("--rate", "10", "--seconds", "300")
    started.wait_for_cycles()
    os.kill(started.wait_for(program), signal.SIGKILL)
    status, out, error = started.end()
    assert (status, out) == (2, "")
    assert len(error.splitlines()) == 1, error
    assert f"{program.removeprefix('raceloop-')} was ended by SIGKILL" in error
    assert list((tmp_path / "out").iterdir()) == []
