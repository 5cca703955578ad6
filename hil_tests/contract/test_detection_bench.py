"""`python -m tools.detection_bench`: its peers do the same work, and its figures can be."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest
from rich.console import Console
from scipy.cluster.hierarchy import fcluster, linkage

import scenarios
from autonomy.detection.geofence import Geofence
from autonomy.detection.ground_filter import GroundConfig, GroundFilter
from autonomy.track_files import load_track
from tools import detection_bench
from tools.boundary_mismatch import MISMATCHES
from tools.detection_bench import (
    PlainGeofence,
    main,
    make_scans,
    measure,
    plain_ground_filter,
    show,
    show_mismatches,
    show_quality,
)


@pytest.fixture(scope="module")
def track():
    return load_track(scenarios.DIRECTORY / "tracks" / "lvms.yaml")


@pytest.fixture(scope="module")
def scans(track):
    return make_scans(track, 2)


def test_the_plain_filters_keep_the_same_points(track, scans):
    fence = Geofence(track)
    for scan in scans:
        inside, _ = fence.apply(scan.cloud, scan.pose)
        plain = PlainGeofence(track, fence.margin).apply(scan.cloud, scan.pose)
        either = set(map(tuple, inside.tolist())) ^ set(map(tuple, plain.tolist()))
        # The tree's nearest node has no curvature: millimetres beside the fence.
        assert len(either) < 0.002 * len(inside)
        raised, _ = GroundFilter().apply(inside)
        assert len(raised) > 10
        np.testing.assert_array_equal(raised, plain_ground_filter(inside, GroundConfig()))


def test_figures_are_printed_for_everything(track, scans, monkeypatch):
    def single_linkage(cloud, distance):
        return fcluster(linkage(cloud[:, :2].astype(float), method="single"), distance, criterion="distance")

    # scikit-learn is not needed for the tests; this finds the same.
    monkeypatch.setattr(detection_bench, "plain_clustering", single_linkage)
    monkeypatch.setattr(detection_bench, "_RUNS", 2)
    console = Console(width=100, highlight=False, color_system=None)
    with console.capture() as captured:
        show(console, measure(track, scans, 1), len(scans))
    page = captured.get()
    rows = re.findall(r"^│ +([\w ,.]+?) +│((?: +[\d.]+ │){7})$", page, re.MULTILINE)
    assert [name for name, _ in rows] == [
        *("both filters", "geofence", "ground filter", "clustering", "with walls", "stubborn", "scattered"),
        *("Detector.step", "numpy, scipy", "DBSCAN"),
    ]
    for _, cells in rows:
        low, mean, p99, high, *wall, runs = map(float, cells.replace("│", "").split())
        assert 0.0 <= low <= mean <= high
        assert p99 <= high
        assert wall[0] <= wall[1]
        assert runs in (2, 4)
    assert page.count("met)") + page.count("missed)") == 4
    assert "2 scans around the lap: 60000 points" in page


def test_cars_are_told_by_their_distance(track, scans):
    console = Console(width=100, highlight=False, color_system=None)
    with console.capture() as captured:
        show_quality(console, track, scans)
    page = captured.get()
    rows = re.findall(r"^│ +(\d+ to \d+) +│ +(\d+) │ +(\d+) │ +(\S+) │ +(\S+) │$", page, re.MULTILINE)
    # The first two lists of cars: 20 m, then 38 and 66 m ahead.
    assert [row[:3] for row in rows[:2]] == [("0 to 25", "1", "1"), ("25 to 50", "1", "1")]
    assert rows[2][:2] == ("50 to 80", "1")
    assert all(0.0 < float(row[3]) <= float(row[4]) < 1.0 for row in rows[:2])
    assert page.endswith("objects that are no car: 0\n")


def test_mismatches_are_shown_without_and_with_the_estimate(track):
    console = Console(width=120, highlight=False, color_system=None)
    worst = next(mismatch for mismatch in MISMATCHES if "20 %" in mismatch.name)
    with console.capture() as captured:
        show_mismatches(console, track, 2, (MISMATCHES[0], worst))
    page = captured.get()
    rows = re.findall(
        r"^│ (.*?) +│ (with|without) +│ +([\d.]+) │ +([\d.]+) │ +([\d.]+) │ +(\d+) of (\d+) │", page, re.M
    )
    assert [row[:2] for row in rows] == [("none", "without"), ("", "with"), (worst.name, "without"), ("", "with")]
    false = [float(row[2]) for row in rows]
    assert false[2] > 0.5
    assert max(false[0], false[1], false[3]) < 0.5 * false[2]
    assert [float(rows[i][4]) for i in (0, 1, 3)] == [0.0, 0.0, 0.0]
    assert all(row[5] == row[6] for row in (rows[0], rows[1], rows[3]))
    assert "6 scans at 2 places around the lap" in page
    assert re.search(r"ms more per scan \(processor\): mean -?\d+\.\d\d, median ", page)


def test_without_scikit_learn_it_says_so(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.cluster", None)
    assert main([]) == 2
    assert capsys.readouterr().err == "detection_bench: scikit-learn is not installed: pip install 'raceloop[bench]'\n"


@pytest.mark.parametrize("option", ["--scans", "--rounds"])
def test_numbers_must_be_there(capsys, option):
    with pytest.raises(SystemExit) as ended:
        main([option, "0"])
    assert ended.value.code == 2
    assert capsys.readouterr().err.strip().endswith(f"{option} is 0; must be at least 1")
