"""docs/detection.md says what the code does: thresholds, statuses, the example."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from autonomy.detection.boundary_estimate import BoundaryConfig, BoundaryStatus
from autonomy.detection.cloud import POINTS_MAX, RANGE, DetectionStatus
from autonomy.detection.confirmation import GATE
from autonomy.detection.detector import DetectionConfig
from autonomy.detection.ground_filter import lib

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "detection.md").read_text()
TEXT = " ".join(PAGE.split())


def test_thresholds_are_those_of_the_code():
    config = DetectionConfig()
    ground, clustering, shape = config.ground, config.clustering, config.shape
    assert (ground.points_threshold, clustering.points_min) == (1, 3)
    for said in (
        f"at least {config.margin:g} m inside its boundaries",
        f"cells of {ground.cell_size:g} m with more than one point and more than {ground.height_threshold:g} m",
        f"the steepest road, {ground.slope_max_deg:g} degrees",
        f"cells with more than {ground.foot_points} points lose those that are not {ground.height_threshold:g} m",
        f"linked over at most {clustering.link_distance:g} m, three or more together",
        f"at most {clustering.join_along:g} m along and {clustering.join_across:g} m across",
        f"to {shape.length:g} m by {shape.width:g} m",
        f"within {shape.yaw_range_deg:g} degrees of the road",
        f"up to {POINTS_MAX:,} points",
        f"is {RANGE:g} m or more away",
        f"more than {lib.CONNECTIVITY_TRIALS_MAX:,} pairs",
        f"the nearest {lib.CLUSTERS_OBJECTS_MAX}",
    ):
        assert said in TEXT, said


def test_thresholds_of_the_boundary_are_those_of_the_code():
    config = BoundaryConfig()
    for said in (
        f"the seen wall less {config.margin:g} m",
        f"from {config.inward:g} m inside the file's boundary to {config.outward:g} m outside",
        f"{config.dense} or more within 0.4 m",
        f"within {config.near:g} m of the line",
        f"at least {config.run:g} m long without a gap of more than {config.gap:g} m",
        f"up to {config.beyond:g} m past",
        f"{config.gain:g} of the way per scan, at most {config.rate:g} m",
        f"{config.memory} scans",
        f"{GATE:g} m from scan to scan",
    ):
        assert said in TEXT, said
    for status in BoundaryStatus:
        assert f"`{status.name}`" in TEXT


def test_every_status_is_there():
    (table,) = re.findall(r"^\| status \|.*?\n\n", PAGE, re.MULTILINE | re.DOTALL)
    assert set(re.findall(r"\b[A-Z][A-Z_0-9]+\b", table)) == {status.name for status in DetectionStatus}


def test_the_example_runs(monkeypatch):
    (example,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(ROOT)
    names = {"cloud": np.zeros((1, 3), dtype=np.float32)} | dict.fromkeys(("x", "y", "yaw", "pitch", "roll"), 0.0)
    exec(compile(example, "detection.md", "exec"), names)
    assert names["found"].status is DetectionStatus.OK
