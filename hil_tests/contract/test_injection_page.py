"""docs/injection.md does what it says; the plug-in fails what it should, and keeps what it promises."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from cli_harness import assert_one_line, command

import scenarios
from bridge.faults.reading import KINDS

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "injection.md").read_text()


def block(language: str) -> str:
    found = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert len(found) == 1
    return str(found[0])


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """short_drive with the page's faults."""
    content = yaml.safe_load((scenarios.DIRECTORY / "short_drive.yaml").read_text())
    for key in ("track", "vehicle", "operation"):
        content[key] = str(scenarios.DIRECTORY / content[key])
    content |= yaml.safe_load(block("yaml")) | {"time_limit_s": 11.0}
    path = tmp_path / "faulty.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_the_run_prints_and_records_what_the_page_says(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answer = command(capsys)("run", scenario, "--out", tmp_path / "out")
    assert answer.status == 1  # the car never gets to the scenario's finish
    injected = [line for line in answer.out.splitlines() if line.startswith("Injected")]
    assert injected == block("text").splitlines() != []
    recorded = json.loads((tmp_path / "out" / "summary.json").read_text())["injected"]
    assert [f"Injected {row['text']}" for row in recorded] == injected
    assert [(row["fault"], row["count"], row["seed"]) for row in recorded] == [("hang", 50, 20221103), ("noise", 50, 1)]
    assert recorded[0]["first_s"] == pytest.approx(10.36)
    assert recorded[0]["ended_s"] == pytest.approx(10.86)


def test_faults_do_not_go_with_real_time_nor_with_another_profile(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raceloop = command(capsys)
    assert_one_line(raceloop("run", scenario, "--realtime", "--out", tmp_path / "out"), scenario, "faults", "lock step")
    content = yaml.safe_load(scenario.read_text())
    content["faults"] = [{"fault": "freeze", "message": "steering_report", "signal": "steering_motor_ang_avg_fdbk"}]
    scenario.write_text(yaml.safe_dump(content))
    assert_one_line(raceloop("run", scenario, "--profile", "V26", "--out", tmp_path / "out"), "faults[0]", "no signal")
    assert not (tmp_path / "out").exists()


def test_the_page_names_every_fault_and_every_key() -> None:
    named = set(re.findall(r"`([a-z_]+)`", PAGE))
    assert set(KINDS) <= named
    assert all(kind.__doc__ and fields(kind) is not None for kind in KINDS.values())


FAILING = """
from bridge.faults import SensorOutage
import pytest

def test_unexpected_fault(bench):
    bench.run_for(1.0)
    bench.inject(SensorOutage(sensor="gnss_a"))
    bench.run_for(0.3)

@pytest.mark.raceloop(speed=3)
def test_wrong_marker(bench):
    pass
"""


def pytest_run(folder: Path, text: str, *options: str) -> str:
    (folder / "test_mine.py").write_text(text)
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--strict-markers", *options, "test_mine.py"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.stderr == ""
    return run.stdout


def test_the_test_on_the_page_passes(tmp_path: Path) -> None:
    assert "3 passed" in pytest_run(tmp_path, block("python"))


def test_what_fails_keeps_log_and_seed(tmp_path: Path) -> None:
    output = pytest_run(tmp_path, FAILING, "--raceloop-seed=7", f"--basetemp={tmp_path / 'kept'}")
    assert re.search(r"^1 failed, (\d+ warnings?, )?1 error in", output, re.MULTILINE)
    assert re.search(r"the bench is not in order: unexpected fault gnss_a_timeout at 1\.\d+ s", output)
    assert "marker raceloop: speed is unknown; allowed are scenario, profile, seed" in output
    assert "scenario short_drive, seed 7, at 1.30 s" in output
    assert re.search(r"^injected: 1\.000 s: sensor_outage sensor=gnss_a; \d+ times, to the end$", output, re.MULTILINE)
    assert "again: pytest test_mine.py::test_unexpected_fault --raceloop-seed=7" in output
    (log,) = [Path(line.removeprefix("log: ")) for line in output.splitlines() if line.startswith("log: ")]
    assert log.is_relative_to(tmp_path / "kept")
    assert log.stat().st_size > 0
    assert (log.parent / "truth.parquet").exists()
