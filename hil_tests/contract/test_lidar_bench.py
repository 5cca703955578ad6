"""`python -m tools.lidar_bench`: its figures can be, and its peer sees the same."""

from __future__ import annotations

import re

import pytest
from rich.console import Console

import scenarios
from autonomy.track_files import load_track
from tools import lidar_bench
from tools.exit_status import ExitStatus
from tools.lidar_bench import main, measure, show


@pytest.fixture(scope="module")
def result():
    return measure(load_track(scenarios.DIRECTORY / "tracks" / "lvms.yaml"), 2, 1)


def printed(result):
    console = Console(width=120, highlight=False, color_system=None)
    with console.capture() as captured:
        met = show(console, result, 2)
    return captured.get(), met


def test_figures_are_printed_for_everything(result):
    page, _ = printed(result)
    rows = re.findall(r"^│ +([\w .]+?) +│((?: +[\d.]+ │){7})$", page, re.MULTILINE)
    assert [name for name, _ in rows] == ["SpatialLidar.scan", "beams of numpy", "numpy"]
    for _, cells in rows:
        low, mean, p99, high, *wall, runs = map(float, cells.replace("│", "").split())
        assert 0.0 < low <= mean <= high
        assert low <= p99 <= high
        assert wall[0] <= wall[1]
        assert runs in (2, 40)
    assert re.search(r"^2 scans around the lap at 60 m/s, 3 LiDARs: \d{5} to \d{5} points$", page, re.MULTILINE)


def test_the_peer_sees_the_same(result):
    assert len(result.off) > 2 * 70_000
    assert result.missed < 0.001 * len(result.off)
    assert sorted(result.off)[int(0.999 * len(result.off))] < 0.005


@pytest.mark.parametrize(("target", "met"), [(1e9, True), (0.0, False)])
def test_the_target_decides(result, monkeypatch, target, met):
    monkeypatch.setattr(lidar_bench, "TARGET_MS", target)
    page, said = printed(result)
    assert said is met
    assert ("missed)" in page) is not met


@pytest.mark.parametrize("option", ["--scans", "--rounds"])
def test_numbers_must_be_there(capsys, option):
    with pytest.raises(SystemExit) as ended:
        main([option, "0"])
    assert ended.value.code == ExitStatus.USER_ERROR
    assert capsys.readouterr().err.strip().endswith(f"{option} is 0; must be at least 1")
