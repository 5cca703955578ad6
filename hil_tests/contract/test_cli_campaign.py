"""`raceloop campaign` as a user meets it: any number of workers, interrupted and killed, the same results."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from cli_harness import Answer, assert_one_line, command

import bridge
import scenarios
from tools.campaign import find_campaign
from tools.campaign_results import RESULTS
from tools.cli import make_parser

run_command = pytest.fixture(command)

FAULTS = {
    "obc_silent": {"faults": [{"fault": "silent", "station": "OBC"}]},
    "imu_noisy": {"faults": [{"fault": "noise", "message": "imu_rates", "signal": "imu_yaw_rate", "sigma": 0.05}]},
    "sd_failure": {
        "faults": [{"fault": "stuck", "message": "diagnostic_report", "signal": "sd_system_failure", "value": 1}]
    },
    "brake_weak": {
        "faults": [{"fault": "brake_fade", "factor": 0.3}],
        "excused": {"SAFE-3": "the lines get three tenths of what is asked for"},
    },
    "brake_fades": {"faults": [{"fault": "brake_fade", "factor": 0.2}]},
}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty runs at standstill and while the car drives; one fault breaks a property, and is not excused."""
    path = tmp_path_factory.mktemp("campaign") / "small.yaml"
    content = {
        "name": "small",
        "scenario": str(scenarios.DIRECTORY / "short_drive.yaml"),
        "onsets": [{"from_s": 1.5, "to_s": 9.0, "every_ms": 2500}],
        "watch_s": 0.4,
        "faults": FAULTS,
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


RUNS = 20


@pytest.fixture(scope="module")
def done(file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Page and folder of the whole campaign by one worker."""
    folder = tmp_path_factory.mktemp("done")
    run = start(file, folder, "--workers", "1", "--json", folder / "summary.json", "--junit", folder / "junit.xml")
    page, error = run.communicate()
    assert (run.returncode, error) == (1, "")
    return page, folder


def start(file: Path, folder: Path, *options: object) -> subprocess.Popen[str]:
    arguments = [sys.executable, "-m", "tools.cli", "campaign", file, "--out", folder, *options]
    return subprocess.Popen(
        [str(argument) for argument in arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"COLUMNS": "120"},
        start_new_session=True,
    )


def lines(folder: Path) -> list[str]:
    return (folder / RESULTS).read_text().splitlines()


def when_some_are_there(folder: Path, run: subprocess.Popen[str]) -> None:
    """Wait until a few results are on disk: on the file itself, as it is written."""
    while run.poll() is None and (not (folder / RESULTS).exists() or len(lines(folder)) < 3):
        time.sleep(0.002)  # the other processes need the cores


def digest(page: str) -> str:
    found = re.search(r"^Results SHA-256\n  ([0-9a-f]{64})$", page, re.MULTILINE)
    assert found is not None, page
    return found[1]


def test_page_json_and_junit_say_the_same(done: tuple[str, Path]) -> None:
    page, folder = done
    summary = json.loads((folder / "summary.json").read_text())
    assert f"{RUNS} runs of {len(FAULTS)} faults: " in page
    assert summary["runs"] == RUNS
    by_name = {fault["fault"]: fault for fault in summary["faults"]}
    assert list(by_name) == list(FAULTS)
    # The onboard computer falls silent: nobody tells, the Raptor brakes after its time-out of 100 ms.
    silent = by_name["obc_silent"]
    assert silent["reactions"] == {"none": 4}
    assert 100.0 <= silent["worst_can1_ms"] <= 220.0
    assert silent["worst_can1_ms"] < silent["worst_brake_ms"] < 350.0
    # In the table: full brake, 20 ms of debounce, 40 ms of deadline.
    failed = by_name["sd_failure"]
    assert failed["reactions"]["full_brake"] >= 2
    assert failed["worst_reaction_ms"] <= 40.0 + 10.0
    assert by_name["imu_noisy"]["violations"] == 0
    assert by_name["brake_weak"]["excused_runs"] > 0
    assert by_name["brake_weak"]["violations"] == 0
    assert by_name["brake_fades"]["violated"] == ["SAFE-3"]
    assert {run["id"].split("@")[0] for run in summary["violations"]} == {"brake_fades"}
    suite = ElementTree.fromstring((folder / "junit.xml").read_text())
    assert (suite.get("tests"), suite.get("failures")) == (str(len(FAULTS)), "1")
    assert [case.get("name") for case in suite if len(case)] == ["brake_fades"]
    assert digest(page) == summary["results_sha256"]
    assert "…" not in page


def test_the_number_of_workers_does_not_matter(done: tuple[str, Path], file: Path, tmp_path: Path) -> None:
    run = start(file, tmp_path, "--workers", "3")
    page, error = run.communicate()
    assert (run.returncode, error) == (1, "")
    assert digest(page) == digest(done[0])
    assert sorted(lines(tmp_path)) == sorted(lines(done[1]))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_what_was_interrupted_goes_on(
    done: tuple[str, Path], file: Path, tmp_path: Path, number: signal.Signals
) -> None:
    run = start(file, tmp_path, "--workers", "1")
    when_some_are_there(tmp_path, run)
    os.kill(run.pid, number)
    page, error = run.communicate()
    kept = lines(tmp_path)
    assert 3 <= len(kept) <= RUNS
    if number != signal.SIGKILL:
        assert run.returncode == 130
        assert error == ""
        assert f"Interrupted: {RUNS + 1 - len(kept)} of {RUNS} runs are left" in page
    else:  # a line may be torn as well
        with (tmp_path / RESULTS).open("a") as file_:
            file_.write('{"id": "obc_sil')
    again = start(file, tmp_path, "--workers", "2")
    page, error = again.communicate()
    assert (again.returncode, error) == (1, "")
    assert f"{len(kept) - 1} were there" in page
    assert digest(page) == digest(done[0])
    assert lines(tmp_path)[: len(kept)] == kept


@pytest.fixture
def finished(done: tuple[str, Path], tmp_path: Path) -> Path:
    shutil.copy(done[1] / RESULTS, tmp_path / RESULTS)
    return tmp_path


def changed(file: Path, folder: Path) -> Path:
    content = yaml.safe_load(file.read_text()) | {"watch_s": 0.2}
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def test_results_of_something_else_are_refused(finished: Path, file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = lines(finished)
    other = changed(file, finished)
    answer = command(capsys)("campaign", other, "--out", finished)
    assert_one_line(answer, finished / RESULTS, "line 1", "have changed", "--restart begins anew")
    assert lines(finished) == before
    (finished / RESULTS).write_text("\n".join([*before[:2], "no result", *before[2:]]) + "\n")
    assert_one_line(command(capsys)("campaign", file, "--out", finished), "line 3", "is no result", "--restart")


def test_restart_begins_anew(finished: Path, file: Path) -> None:
    run = start(changed(file, finished), finished, "--restart")
    page, error = run.communicate()
    assert (run.returncode, error) == (1, "")
    assert f"{RUNS} runs in" in page
    assert "0 were there" in page
    assert len(lines(finished)) == RUNS + 1


def results(folder: Path) -> Iterator[dict[str, object]]:
    return (json.loads(line) for line in lines(folder)[1:])


@pytest.mark.parametrize("run_id", ["brake_fades@9000", "obc_silent@6500", "imu_noisy@4000"])
def test_one_run_alone_is_the_one_of_the_campaign(
    done: tuple[str, Path], file: Path, tmp_path: Path, run_id: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (mine,) = (result for result in results(done[1]) if result["id"] == run_id)
    answer: Answer = command(capsys)("campaign", file, "--only", run_id, "--out", tmp_path / "out")
    violations = mine["violations"]
    assert isinstance(violations, list)
    assert answer.status == (1 if violations else 0)
    for one in violations:
        assert f"{one['property']} at {one['time_s']:.3f} s, frame {one['frame']}: {one['seen']}" in answer.out
    assert f"reaction {mine['reaction']}" in answer.out
    # The recording has what the campaign has seen, at the frame that it says.
    safety = command(capsys)("safety", tmp_path / "out", "--scenario", scenarios.DIRECTORY / "short_drive.yaml")
    assert safety.status == (1 if violations else 0)
    for one in violations:
        assert f"{one['time_s']:.3f} s, frame {one['frame']}: {one['seen']}" in safety.out


def test_the_page_prints_the_command_of_each_violation(done: tuple[str, Path], file: Path) -> None:
    page, _ = done
    commands = [line.strip() for line in page.splitlines() if line.startswith("  raceloop campaign")]
    assert commands
    assert all(line.startswith(f"raceloop campaign {file} --only brake_fades@") for line in commands)


PAGE = (Path(__file__).resolve().parents[2] / "docs" / "campaign.md").read_text()


def test_the_campaign_on_the_page_runs_and_its_results_have_the_keys_of_the_page(tmp_path: Path) -> None:
    (text,) = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    path = tmp_path / "brakes.yaml"
    path.write_text(text.replace("short_drive.yaml", str(scenarios.DIRECTORY / "short_drive.yaml")))
    run = start(path, tmp_path / "out", "--workers", "1")
    page, error = run.communicate()
    assert (run.returncode, error) == (0, "")
    assert "6 runs of 2 faults: no property broken" in page
    (table,) = re.findall(r"^## What comes of a run\n(.*?)^## ", PAGE, re.MULTILINE | re.DOTALL)
    told = {name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
    for result in results(tmp_path / "out"):
        assert set(result) == told | {"id", "fault", "onset_s"}
    schema = json.loads((Path(bridge.__file__).parent / "schemas" / "campaign.schema.json").read_text())
    (keys,) = re.findall(r"^## The file\n(.*?)^## ", PAGE, re.MULTILINE | re.DOTALL)
    assert set(schema["properties"]) <= set(re.findall(r"`(\w+)`", keys))


@pytest.mark.parametrize("line", [line for line in PAGE.splitlines() if line.startswith("raceloop campaign")])
def test_commands_on_the_page_parse(line: str) -> None:
    words = shlex.split(line, comments=True)[1:]
    options = make_parser().parse_args(["1" if word == "N" else word for word in words])
    assert find_campaign(options.file).exists()


def test_mistakes_are_one_line(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raceloop = command(capsys)
    assert_one_line(raceloop("campaign", "nowhere"), "nowhere", "no such campaign")
    assert_one_line(raceloop("campaign", file, "--only", "obc_silent@1"), file, "FAULT@ONSET_MS")
    (tmp_path / "file").write_text("")
    assert_one_line(raceloop("campaign", file, "--out", tmp_path / "file"), tmp_path / "file")
