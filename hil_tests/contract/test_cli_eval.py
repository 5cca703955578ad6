"""`raceloop eval perception`: its tables and its JSON say the same, and mistakes get one line."""

from __future__ import annotations

import contextlib
import io
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_harness import Answer, Command, assert_one_line, command

import scenarios
from autonomy.detection.cloud import DetectionStatus
from autonomy.detection.radar import RadarStatus
from autonomy.perception import SILENCE_US, PerceptionConfig
from autonomy.track_files import load_track
from bridge.scenario import load_scenario
from bridge.sensors.truth import Truth
from tools.cli import main
from tools.detection_score import BINS_M, MATCH_M, SOURCES
from tools.perception_drive import CarAhead, DriveTick
from tools.perception_eval import AHEAD_M, ALONE, HORIZONS_S, WITH_CAR

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "perception.md").read_text()

run_command = pytest.fixture(command)


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Answer, dict[str, Any]]:
    """The way out of the pits."""
    file = tmp_path_factory.mktemp("eval") / "figures.json"
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        status = main(["eval", "perception", "--seconds", "17", "--seed", "2", "--out", str(file)])
    return Answer(status, out.getvalue(), ""), json.loads(file.read_text())


def rows(page: str) -> list[list[str]]:
    """Cells of the tables."""
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in page.splitlines() if line.startswith("│")]


def test_figures_are_printed_and_written(evaluated: tuple[Answer, dict[str, Any]]) -> None:
    answer, figures = evaluated
    assert answer.status == 0
    assert set(figures["detection"]) == {"at any speed", "above 100 mph"}
    printed = [row[3:6] for row in rows(answer.out) if row[1:2] and row[1] in SOURCES]
    written = {(row["source"], *row["m"]): row for row in figures["detection"]["at any speed"]}
    order = [(source, *bin_) for bin_ in BINS_M for source in SOURCES]
    names = ("average_precision", "recall", "precision")
    assert printed[: len(order)] == [[f"{written[key][name]:.2f}" for name in names] for key in order]
    assert [row["m"] for row in figures["tracking"]] == [list(bin_) for bin_ in BINS_M]
    assert list(figures["prediction_rms_m"]) == [str(horizon) for horizon in HORIZONS_S]
    assert set(figures["false"]) == {WITH_CAR.name, *(variation.name for variation in ALONE)}


def test_the_car_is_seen_and_nothing_else(evaluated: tuple[Answer, dict[str, Any]]) -> None:
    _, figures = evaluated
    for bin_ in BINS_M[1:]:
        found = {row["source"]: row for row in figures["detection"]["at any speed"] if row["m"] == list(bin_)}
        assert found["fused"]["cars"] > 20
        assert found["fused"]["recall"] > 0.5
        assert found["fused"]["average_precision"] >= max(row["average_precision"] for row in found.values())
        assert found["fused"]["position_rms_m"] < 3.0
    for name, false in figures["false"].items():
        assert false["in_the_way"] == 0, name
    assert figures["false"]["alone"]["tracks_per_minute"] == 0.0
    # Nothing of the way out of the pits is above 100 mph.
    assert all(row["cars"] == 0 for row in figures["detection"]["above 100 mph"])


def test_a_car_that_stands_has_no_figures(run_command: Command) -> None:
    answer = run_command("eval", "perception", "--seconds", "1")
    assert answer.status == 0
    assert "solo_lap, seed 1: 0 scans in motion, up to 0 km/h" in answer.out
    assert ["1", "0", "-"] in rows(answer.out)


def test_mistakes_get_one_line(run_command: Command, tmp_path: Path) -> None:
    assert_one_line(run_command("eval", "perception", "nowhere"), "nowhere", "no such scenario file")
    out = tmp_path / "nowhere" / "figures.json"
    assert_one_line(run_command("eval", "perception", "--out", out), str(out), "there is no such folder")
    for wrong in (("--seed", "-1"), ("--seed", "x"), ("--seconds", "0"), ("--seconds", "nan")):
        with pytest.raises(SystemExit) as left:
            run_command("eval", "perception", *wrong)
        assert left.value.code == 2


def test_the_other_car_moves_as_it_says() -> None:
    """Its velocity is how its place changes, in turns and on straights."""
    scenario = load_scenario(scenarios.DIRECTORY / "solo_lap.yaml")
    track = load_track(scenario.track)
    ahead = CarAhead(track)

    def place(now_us: int) -> tuple[Any, Any]:
        station, lateral = 50.0 * now_us * 1e-6, 2.0
        x, y, yaw = track.pose_at(station % track.length, lateral)
        curvature = float(track.centre.at(np.array(station))[3])
        truth = Truth(x, y, 0.0, yaw, 50.0 * (1.0 - curvature * lateral), *(0.0,) * 10)
        return ahead.at(DriveTick(now_us, truth, station, lateral, None))

    for now_us in range(1_000_000, 45_000_000, 3_170_000):
        before, (car, seen), after = place(now_us - 1000)[0], place(now_us), place(now_us + 1000)[0]
        cos, sin = math.cos(car.yaw), math.sin(car.yaw)
        velocity = np.array([cos * car.vx - sin * car.vy, sin * car.vx + cos * car.vy])
        moved = np.array([after.x - before.x, after.y - before.y]) / 0.002
        assert np.abs(moved - velocity).max() < 0.05
        turned = math.remainder(after.yaw - before.yaw, 2.0 * math.pi) / 0.002
        assert turned == pytest.approx(car.yaw_rate, abs=0.02)
        assert (seen.x, seen.y, seen.yaw, seen.velocity[:2]) == (car.x, car.y, car.yaw, (car.vx, car.vy))


def test_the_example_on_the_page_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(ROOT)
    names: dict[str, Any] = {}
    exec(compile(example, "docs/perception.md", "exec"), names)
    perceived = names["perceived"]
    assert (perceived.lidar.status, perceived.radar.status) == (DetectionStatus.OK, RadarStatus.EMPTY)
    assert (perceived.tracks, perceived.predictions) == ([], [])


def test_the_page_says_the_figures_of_the_code() -> None:
    config, ahead = PerceptionConfig(), CarAhead(load_track(ROOT / "scenarios" / "tracks" / "lvms.yaml"))
    text = " ".join(PAGE.split())
    for said in (
        f"{config.wait_us / 1000:g} ms at most; then they are used alone",
        f"{config.compensation.speed_std:g} m/s (1 sigma)",
        f"({config.fused.detection_probability:g}; {config.radar_alone.detection_probability:g} for the radar alone)",
        f"for more than {SILENCE_US / 1000:g} ms",
        f"from {ahead.nearest:g} to {ahead.farthest:g} m and back in {ahead.sweep_s:g} s",
        f"less than {AHEAD_M:g} m ahead",
        f"within {MATCH_M:g} m of the car's",
    ):
        assert said in text, said


def test_the_page_has_the_tables_as_printed() -> None:
    (block,) = re.findall(r"^```text\n(solo_lap, seed.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    cells = rows(block)
    assert [row[0] for row in cells if row[1:2] == [SOURCES[0]]] == 2 * [f"{low} to {high}" for low, high in BINS_M]
    # Long names go on in the lines below.
    first = " ".join(row[0] for row in cells)
    for name in (WITH_CAR.name, *(variation.name for variation in ALONE)):
        assert name in first
    best = [max(float(cells[i + k][3]) for k in range(3)) == float(cells[i + 2][3]) for i in range(0, 18, 3)]
    assert all(best)
