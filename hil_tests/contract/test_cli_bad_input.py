"""Broken scenarios, tracks, vehicles, DBC files, FMUs and folders: one line, exit status 2, nothing written."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_harness import Command, assert_one_line, command, copy_scenarios, edit

from bridge.bench import Bench
from dbc.buses import DATABASES, DIRECTORY
from dbc.codec import database
from plant_fmu import FMU_DIR_VARIABLE, fmu_path
from tools.cli import main

RACELOOP = Path(sys.executable).with_name("raceloop")


@pytest.fixture
def raceloop(capsys: pytest.CaptureFixture[str]) -> Command:
    return command(capsys)


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    return copy_scenarios(tmp_path / "scenarios")


@pytest.fixture
def refused(raceloop: Command, scenario: Path, tmp_path: Path) -> Callable[..., None]:
    """The scenario is refused with one line, and the folder of the recording does not appear."""
    here = Path.cwd()

    def check(*words: object) -> None:
        assert_one_line(raceloop("run", scenario, "--out", tmp_path / "out"), *words)
        assert not (tmp_path / "out").exists()
        assert Path.cwd() == here, "loading a broken FMU must not move the process"

    return check


def test_installed_command_has_no_traceback(tmp_path: Path) -> None:
    run = subprocess.run([RACELOOP, "run", "nowhere.yaml"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert run.stdout == ""
    shipped = "shipped scenarios: behind_another_car, phantom, short_drive, solo_lap"
    assert run.stderr == f"raceloop: nowhere.yaml: no such scenario file; {shipped}\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ["is empty; must be of type object"]),
        (b"- 1\n", ["is list; must be of type object"]),
        (b"just text\n", ["must be of type object"]),
        (b"name: [1\n", ["line 2", "expected ',' or ']'"]),
        (b"name: a\nname: b\n", ["line 2", "'name' is given twice"]),
        (b"name: \xff\n", ["is not UTF-8 text"]),
        (b"a: !!python/object/apply:os.system [ls]\n", ["line 1", "could not determine a constructor"]),
        (b'"two\\nlines": 1\n', ["two lines: unknown key; allowed are description, faults, finish, name"]),
    ],
    ids=["empty", "list", "text", "broken yaml", "duplicate key", "not utf-8", "code", "line break in key"],
)
def test_file_that_is_no_scenario(
    scenario: Path, refused: Callable[..., None], content: bytes, words: list[str]
) -> None:
    scenario.write_bytes(content)
    refused(scenario, *words)


def test_folder_is_no_scenario(raceloop: Command, tmp_path: Path) -> None:
    assert_one_line(raceloop("run", tmp_path, "--out", tmp_path / "out"), tmp_path, "Is a directory")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_scenario(scenario: Path, refused: Callable[..., None]) -> None:
    scenario.chmod(0)
    refused(scenario, "Permission denied")


@pytest.mark.parametrize(
    ("old", "new", "key", "allowed"),
    [
        ("seed: 20221103", "seed: many", "seed", "is 'many'; must be of type integer"),
        ("seed: 20221103", "sed: 1", "sed", "unknown key; allowed are description, faults, finish"),
        ("seed: 20221103\n", "", "seed", "is missing"),
        ("track: tracks/lvms.yaml", "track: tracks/monza.yaml", "track", "no such file: tracks/monza.yaml"),
        ("vehicles/av21.yaml", "vehicles/av99.yaml", "vehicle", "no such file: vehicles/av99.yaml"),
        ("operations/solo.yaml", "operations/none.yaml", "operation", "no such file: operations/none.yaml"),
        ("seed: 20221103", "seed: 1\nprofile: V27", "profile", "is 'V27'; allowed are V14, V26"),
        ("{fmi_version: 3}", "{fmi_version: 1}", "plant.fmi_version", "is 1; allowed are 2, 3"),
        ("{fmi_version: 3}", "{fmu: none.fmu}", "plant.fmu", "no such file: none.fmu"),
        ("{fmi_version: 3}", "{}", "plant", "must hold either fmi_version or fmu"),
        ("{sys_state: CRANK_CHECKS_PASSED, for_s", "{sys_state: CRANKY, for_s", "race_control[1].when.sys_state",
         "is 'CRANKY'; allowed are PWR_ON, SUBSYS_CON"),
        ("{laps: 2}", "{laps: -2}", "race_control[4].when.laps", "is -2; must be at least 0"),
        ("{laps: 2}", "{}", "race_control[4].when", "is empty; must hold at least one of"),
        ("track_flag: ORANGE", "track_flag: PINK", "race_control[1].set.track_flag", "allowed are RED, ORANGE"),
        ("position: 4", "position: 9", "safety_switch[2].position", "is 9; must be at most 7"),
        ("seed: 20221103", "seed: 20221103\nradar: ahead", "radar", "is 'ahead'; must be of type boolean"),
        ("seed: 20221103", "seed: 20221103\nradars: true", "radars", "unknown key; allowed are description, faults"),
        ("s_m: 20.0", "s_m: 20000.0", "start.s_m", "is 20000; must be below"),
        ("d_m: 4.0", "d_m: 400.0", "start.d_m", "is 400; must be -"),
        ("d_m: 4.0", "d_m: -.inf", "start.d_m", "is -inf; must be a finite number"),
        ("time_limit_s: 300.0", "time_limit_s: .nan", "time_limit_s", "is nan; must be a finite number"),
        ("time_limit_s: 300.0", "time_limit_s: 0", "time_limit_s", "is 0; must be more than 0"),
        ("{ct_state: CNTRL_SHUTDOWN, sys_state: PWR_OFF, standstill: true}", "{standstill: true}", "finish",
         "holds at power-on"),
    ],
)  # fmt: skip
def test_wrong_entry(scenario: Path, refused: Callable[..., None], old: str, new: str, key: str, allowed: str) -> None:
    edit(scenario, old, new)
    refused(scenario, f" {key}: ", allowed)


@pytest.mark.parametrize("realtime", [[], ["--realtime"]], ids=["lock step", "real time"])
def test_a_profile_that_there_is_not(raceloop: Command, scenario: Path, tmp_path: Path, realtime: list[str]) -> None:
    answer = raceloop("run", scenario, "--out", tmp_path / "out", "--profile", "V27", *realtime)
    assert_one_line(answer, "no profile is called 'V27'; there are V14, V26")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("tracks/lvms.yaml", "origin:", "orgin:", ["orgin"]),
        ("tracks/lvms.yaml", "origin:", "origin: [", ["line"]),
        ("vehicles/av21.yaml", "drag_area: 0.725", "drag_area: much", ["drag_area", "is 'much'; must be a number"]),
        ("vehicles/av21.yaml", "drag_area: 0.725", "drag_area: -0.725", ["drag_area", "allowed is"]),
        ("vehicles/av21.yaml", "drag_area: 0.725", "drag_area: .nan", ["drag_area", "must be a finite number"]),
        ("vehicles/av21.yaml", "drag_area: 0.725", "drag_aera: 0.725", ["drag_aera", "has no variable"]),
        ("vehicles/av21.yaml", "mass: ", "# mass: ", ["mass", "is missing"]),
        ("operations/solo.yaml", "max_speed: 63.1", "max_speed: [63.1", ["line"]),
        ("operations/solo.yaml", "max_speed: 63.1", "1: 63.1", ["line 4", "a key must be text"]),
    ],
    ids=lambda value: str(value).split("/", maxsplit=1)[0] if isinstance(value, str) else "",
)
def test_wrong_referenced_file(
    scenario: Path, refused: Callable[..., None], file: str, old: str, new: str, words: list[str]
) -> None:
    path = scenario.parent / file
    text = path.read_text()
    assert f"\n{old}" in text
    path.write_text(text.replace(f"\n{old}", f"\n{new}", 1))
    refused(path, *words)


@pytest.mark.parametrize("stem", DATABASES)
@pytest.mark.parametrize("content", [None, b"", b'VERSION ""\n'], ids=["missing", "empty", "changed"])
def test_wrong_dbc_file(
    refused: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stem: str, content: bytes | None
) -> None:
    for name in DATABASES:
        shutil.copy(DIRECTORY / f"{name}.dbc", tmp_path)
    path = tmp_path / f"{stem}.dbc"
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    monkeypatch.setattr(database, "_directory", tmp_path)
    refused(path, "No such file" if content is None else "differs from the file that the codec was built from")


def repack(target: Path, change: Callable[[str, bytes], bytes | None], fmi_version: int = 3) -> None:
    """Copy raceloop's FMU with members changed, or left out where `change` gives None."""
    with zipfile.ZipFile(fmu_path(fmi_version)) as source, zipfile.ZipFile(target, "w") as out:
        changed = 0
        for info in source.infolist():
            content = source.read(info)
            new = change(info.filename, content)
            changed += new != content
            if new is not None:
                out.writestr(info.filename, new)
        assert changed


def describe(old: str, new: str) -> Callable[[str, bytes], bytes]:
    """Change the model description."""

    def change(name: str, content: bytes) -> bytes:
        return content.replace(old.encode(), new.encode()) if name == "modelDescription.xml" else content

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (describe('name="wheel_speed_fl"', 'name="wheel_sped_fl"'), ["has no variable 'wheel_speed_fl'", "output"]),
        (describe('name="starter"', 'name="starte"'), ["has no variable 'starter'", "input"]),
        (describe('name="mass"', 'name="masse"'), ["has no variable 'mass'", "av21.yaml"]),
        (describe('fmiVersion="3.0"', 'fmiVersion="4.0"'), ["FMI 4.0; allowed are FMI 2 and 3"]),
        (describe("CoSimulation", "ModelExchange"), ["only co-simulation"]),
        (describe("<fmiModelDescription", "<"), ["not an FMU"]),
        (lambda name, content: None if name == "modelDescription.xml" else content, ["not an FMU"]),
        (lambda name, content: None if name.endswith(".so") else content, ["cannot be loaded"]),
        (lambda name, content: b"no library" if name.endswith(".so") else content, ["cannot be loaded"]),
    ],
    ids=[
        "output missing", "input missing", "parameter missing", "version", "model exchange", "broken xml",
        "no description", "no library", "broken library",
    ],
)  # fmt: skip
def test_wrong_fmu(
    scenario: Path, refused: Callable[..., None], change: Callable[[str, bytes], bytes | None], words: list[str]
) -> None:
    path = scenario.parent / "car.fmu"
    repack(path, change)
    edit(scenario, "{fmi_version: 3}", "{fmu: car.fmu}")
    refused(path, *words)


def test_fmu_of_fmi_1(scenario: Path, refused: Callable[..., None]) -> None:
    path = scenario.parent / "car.fmu"
    repack(path, describe('fmiVersion="2.0"', 'fmiVersion="1.0"'), fmi_version=2)
    edit(scenario, "{fmi_version: 3}", "{fmu: car.fmu}")
    refused(path, "FMI 1.0; allowed are FMI 2 and 3")


@pytest.mark.parametrize("content", [b"", b"no archive", None], ids=["empty", "text", "cut off"])
def test_fmu_that_is_no_archive(scenario: Path, refused: Callable[..., None], content: bytes | None) -> None:
    path = scenario.parent / "car.fmu"
    whole = fmu_path(3).read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if content is None else content)
    edit(scenario, "{fmi_version: 3}", "{fmu: car.fmu}")
    refused(path, "not an FMU")


def test_own_fmu_missing(refused: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FMU_DIR_VARIABLE, str(tmp_path))
    refused("raceloop_plant_fmi3.fmu not found", tmp_path, "build the project")


@pytest.mark.parametrize("below", ["", "deeper"])
def test_folder_is_a_file(raceloop: Command, tmp_path: Path, below: str) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("mine\n")
    assert_one_line(raceloop("run", "--out", blocked / below), blocked, "cannot be the folder of the recording")
    assert blocked.read_text() == "mine\n"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_folder_that_may_not_be_written(raceloop: Command, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert_one_line(raceloop("run", "--out", tmp_path), tmp_path, "Permission denied")


def test_disk_that_fills_up(scenario: Path, tmp_path: Path) -> None:
    """A limit on the size of files stands for the full disk; the run ends with its first piece that is refused."""
    edit(scenario, "time_limit_s: 300.0", "time_limit_s: 20.0")
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))  # noqa: E731
    run = subprocess.run(
        [RACELOOP, "run", scenario, "--out", tmp_path / "out"],
        preexec_fn=limit,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (run.returncode, run.stdout) == (2, "")
    assert len(run.stderr.splitlines()) == 1, run.stderr
    assert "cannot write the recording" in run.stderr
    assert list((tmp_path / "out").iterdir()) == []


def test_summary_that_cannot_be_written(raceloop: Command, scenario: Path, tmp_path: Path) -> None:
    edit(scenario, "time_limit_s: 300.0", "time_limit_s: 0.5")
    (tmp_path / "summary.json").mkdir()
    assert_one_line(raceloop("run", scenario, "--out", tmp_path), tmp_path / "summary.json", "cannot be written")
    assert not (tmp_path / "summary.partial").exists()


def test_interrupted_run_leaves_nothing(
    raceloop: Command, scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tick = Bench.tick

    def interrupted(bench: Bench) -> None:
        tick(bench)
        if bench.now_us == 500_000:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Bench, "tick", interrupted)
    answer = raceloop("run", scenario, "--out", tmp_path / "out")
    assert (answer.status, answer.out) == (130, "")
    assert answer.error == "raceloop: interrupted; nothing was written\n"
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "required: command"),
        (["drive"], "invalid choice"),
        (["run", "--rt-ratio", "fast"], "is 'fast'; must be a number above 0"),
        (["run", "--rt-ratio", "-1"], "is '-1'; must be a number above 0"),
        (["run", "--rt-ratio", "nan"], "is 'nan'; must be a number above 0"),
        (["bench", "--repeats", "0"], "is '0'; must be a whole number of at least 1"),
        (["bench", "--repeats", "2.5"], "is '2.5'; must be a whole number of at least 1"),
        (["bench", "--simulated-s", "inf"], "is 'inf'; must be a number above 0"),
        (["check-params"], "required: file"),
    ],
)
def test_wrong_arguments(capsys: pytest.CaptureFixture[str], arguments: list[str], words: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error
