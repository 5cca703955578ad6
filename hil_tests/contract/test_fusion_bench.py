"""`python -m tools.fusion_bench`: its scores are those of hand-made cases, and its scenes hold what they say."""

from __future__ import annotations

import re

import numpy as np
import pytest

import scenarios
from autonomy.detection.road_objects import RoadObjects, Sensor, no_objects
from autonomy.track_files import load_track
from tools.detection_score import BINS_M, MATCH_M, SOURCES, Sample, average_precision, evaluate
from tools.fusion_bench import main, make_samples


def by_recall(verdicts: list[tuple[float, bool]], cars: int) -> float:
    """By the definition: at each recall the best precision at it or beyond, averaged over the cars."""
    total = 0.0
    for needed in range(1, cars + 1):
        best = 0.0
        for threshold, _ in verdicts:
            kept = [true for confidence, true in verdicts if confidence >= threshold]
            if sum(kept) >= needed:
                best = max(best, sum(kept) / len(kept))
        total += best
    return total / cars


@pytest.mark.parametrize("seed", range(30))
def test_average_precision_by_its_definition(seed: int) -> None:
    print(f"seed {seed}")
    generator = np.random.default_rng(seed)
    count = int(generator.integers(1, 12))
    verdicts = list(zip(generator.integers(1, 6, count) / 5.0, (generator.random(count) < 0.6).tolist(), strict=True))
    cars = sum(true for _, true in verdicts) + int(generator.integers(0, 3))
    assert average_precision(verdicts, cars) == pytest.approx(by_recall(verdicts, cars) if cars else 0.0)


def test_average_precision_of_the_plain_cases() -> None:
    assert average_precision([(0.9, True), (0.1, False)], 1) == 1.0
    assert average_precision([(0.9, False), (0.1, True)], 1) == 0.5
    assert average_precision([(0.9, True)], 2) == 0.5
    assert average_precision([], 3) == 0.0
    assert average_precision([(0.9, False)], 0) == 0.0


def objects(*rows: tuple[float, float, float]) -> RoadObjects:
    found = no_objects(len(rows))
    for one, (x, y, confidence) in zip(found, rows, strict=True):
        one["x"], one["y"], one["confidence"], one["sensors"] = x, y, confidence, Sensor.LIDAR
    return found


def test_scores_of_a_scene_by_hand() -> None:
    """A car at 49 m: found at 51 m it counts in its own bin; a second object of it is false where it is."""
    near = objects((51.0, 0.0, 0.5), (49.0, 3.0, 0.4), (90.0, 0.0, 0.9), (150.0, 0.0, 0.9))
    nothing = objects()
    off = objects((49.0, MATCH_M + 0.1, 0.9))
    scores = evaluate([Sample(np.array([49.0, 0.0]), dict(zip(SOURCES, (near, nothing, off), strict=True)))])
    first, second, third = scores["LiDAR"]
    assert (first.cars, first.errors, first.verdicts) == (1, [2.0], [(0.5, True), (0.4, False)])
    assert (second.cars, second.verdicts, third.verdicts) == (0, [(0.9, False)], [])
    assert (first.recall, first.precision, first.average_precision) == (1.0, 0.5, 1.0)
    assert (scores["radar"][0].cars, scores["radar"][0].recall) == (1, 0.0)
    assert (scores["fused"][0].recall, scores["fused"][0].verdicts) == (0.0, [(0.9, False)])


def test_fusion_loses_nothing_of_the_lidar_in_any_scene() -> None:
    samples = list(make_samples(load_track(scenarios.DIRECTORY / "tracks" / "lvms.yaml"), 6, 3))
    assert len(samples) == 6
    heard = 0
    for sample in samples:
        seen, fused = sample.objects["LiDAR"], sample.objects["fused"]
        assert (fused["x"][: len(seen)] == seen["x"]).all()
        assert 7.0 < np.hypot(*sample.car) < 121.0
        heard += len(sample.objects["radar"])
    assert heard > 0


def test_the_table_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--scenes", "4", "--seed", "2"]) == 0
    page = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in page.splitlines() if line.startswith("│")]
    assert [row[1] for row in rows] == [*SOURCES] * len(BINS_M)
    assert sum(int(row[2]) for row in rows) == 4 * len(SOURCES)
    for row in rows:
        assert all(0.0 <= float(cell) <= 1.0 for cell in row[3:6])
        assert re.fullmatch(r"-|\d+\.\d\d", row[6])
    assert page.startswith("4 scenes, seed 2")


@pytest.mark.parametrize("arguments", [["--scenes", "0"], ["--seed", "-1"]])
def test_arguments_out_of_range(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
