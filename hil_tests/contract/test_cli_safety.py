"""What `raceloop run` and `raceloop safety` say of safety properties, and that docs/safety.md has them all."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from cli_harness import Answer, Command, assert_one_line, command, copy_scenarios, edit

from bridge.safety.limits import SafetyLimits
from bridge.safety.monitor import properties
from bridge.scenario import Scenario
from dbc.codec import database
from tools.cli import main

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "safety.md").read_text()

run_command = pytest.fixture(command)


def drive(folder: Path) -> tuple[Answer, Path]:
    """Two seconds from power-on, to SUBSYS_CON and a standing car."""
    scenario = copy_scenarios(folder / "scenarios")
    edit(scenario, "finish: {ct_state: CNTRL_SHUTDOWN, sys_state: PWR_OFF, standstill: true}", "finish: {time_s: 1.5}")
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        status = main(["run", str(scenario), "--out", str(folder / "out")])
    return Answer(status, out.getvalue(), ""), folder / "out"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Answer, Path]:
    return drive(tmp_path_factory.mktemp("safety"))


@pytest.fixture
def folder(recorded: tuple[Answer, Path], tmp_path: Path) -> Path:
    """A recording to be changed."""
    for name in ("frames.log", "truth.parquet", "summary.json"):
        shutil.copy(recorded[1] / name, tmp_path / name)
    return tmp_path


def test_the_page_has_every_property() -> None:
    rows = re.findall(r"^\| (SAFE-\d+) \| (.+) \| (.+) \|$", PAGE, re.MULTILINE)
    assert rows == [(one.id, one.text, one.source) for one in properties().values()]
    assert list(properties()) == [f"SAFE-{number}" for number in range(1, len(rows) + 1)]


def test_clean_run(recorded: tuple[Answer, Path]) -> None:
    answer, out = recorded
    assert answer.status == 0
    lines = len((out / "frames.log").read_text().splitlines())
    assert f"\nSafety: 17 properties held on {lines} frames\n" in answer.out
    block = json.loads((out / "summary.json").read_text())["safety"]
    assert block == {"properties": list(properties()), "frames": lines, "excursion_m": 0.0, "violations": []}


def test_a_violation_fails_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A car that is sound, held to a limit that it does not know of."""
    of_scenario = SafetyLimits.of_scenario

    def tighter(scenario: Scenario) -> SafetyLimits:
        return replace(of_scenario(scenario), max_speed=60.0)

    monkeypatch.setattr(SafetyLimits, "of_scenario", tighter)
    answer, out = drive(tmp_path)
    assert answer.status == 1
    (one,) = json.loads((out / "summary.json").read_text())["safety"]["violations"]
    assert one["property"] == "SAFE-9"
    assert one["seen"] == "ssm_max_speed is 63.1 in ssm_state NOMINAL"
    assert one["allowed"] == "at most 60"
    line = (out / "frames.log").read_text().splitlines()[one["frame"]]
    codec = database.message("ssm_status")
    assert line.startswith(f"({one['time_s']:.6f}) CANA {codec.frame_id:03X}#")
    assert f"Safety SAFE-9 {one['time_s']:.3f} s, frame {one['frame']}: {one['seen']}; allowed: {one['allowed']}" in (
        answer.out
    )
    assert "Safety: 1 properties violated, 16 held on " in answer.out


def test_recording_that_is_clean(recorded: tuple[Answer, Path], run_command: Command) -> None:
    """The finish of the scenario plays no part."""
    answer = run_command("safety", recorded[1])
    assert answer.status == 0
    lines = len((recorded[1] / "frames.log").read_text().splitlines())
    assert answer.out == f"Safety: 17 properties held on {lines} frames\n"


def test_recording_with_a_violation(folder: Path, run_command: Command) -> None:
    """A command that is half a full brake, in the middle of the log."""
    codec = database.message("brake_pressure_cmd")
    lines = (folder / "frames.log").read_text().splitlines()
    (number,) = [
        number
        for number, line in enumerate(lines)
        if f" CAN1 {codec.frame_id:03X}#" in line and 0.5 <= float(line[1:].split(")")[0]) < 0.51
    ]
    head, tail = lines[number].split("#")
    data, *rest = tail.split(" ")
    (pressure, counter) = codec.decode(bytes.fromhex(data))
    assert pressure == 4500.0
    lines[number] = f"{head}#{' '.join([codec.encode(3000.0, counter).hex().upper(), *rest])}"
    (folder / "frames.log").write_text("\n".join(lines) + "\n")
    answer = run_command("safety", folder)
    assert answer.status == 1
    assert re.search(
        r"^Safety SAFE-1 0\.50\d s, frame \d+: brake_pressure_cmd is 3000 in ssm_state LAUNCHING", answer.out, re.M
    )
    assert "Safety: 1 properties violated, 16 held" in answer.out


def test_recording_without_truth(folder: Path, run_command: Command) -> None:
    (folder / "truth.parquet").unlink()
    answer = run_command("safety", folder)
    assert (answer.status, answer.out[:26]) == (0, "Safety: 13 properties held")


def test_recordings_that_are_none(folder: Path, run_command: Command) -> None:
    summary = folder / "summary.json"
    good = summary.read_text()
    assert_one_line(run_command("safety", folder / "nothing"), "summary.json", "No such file")
    summary.write_text("{")
    assert_one_line(run_command("safety", folder), "summary.json", "no JSON")
    summary.write_text("{}")
    assert_one_line(run_command("safety", folder), "summary.json", "scenario")
    summary.write_text(good)
    assert_one_line(run_command("safety", folder, "--scenario", "other"), "other", "no such scenario")
    (folder / "truth.parquet").write_text("x")
    assert_one_line(run_command("safety", folder), "truth.parquet", "cannot be read")
    (folder / "truth.parquet").unlink()
    with (folder / "frames.log").open("a") as log:
        log.write("not a frame\n")
    assert_one_line(run_command("safety", folder), "frames.log", "not a frame")


@pytest.mark.parametrize(
    ("key", "line", "words"),
    [
        ("brake_bandwidth", "brake_bandwidth: 0.0", "must be above 0"),
        ("brake_front_share", "brake_front_share: 1.0", "must be below 1"),
        ("brake_delay", "", "is missing"),
    ],
)
def test_vehicle_without_brakes(folder: Path, run_command: Command, key: str, line: str, words: str) -> None:
    scenario = copy_scenarios(folder / "scenarios")
    vehicle = folder / "scenarios/vehicles/av21.yaml"
    vehicle.write_text(re.sub(rf"^{key}: .*", line, vehicle.read_text(), flags=re.MULTILINE))
    assert_one_line(run_command("safety", folder, "--scenario", scenario), "av21.yaml", key, words)
