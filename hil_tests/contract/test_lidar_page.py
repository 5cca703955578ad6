"""docs/lidar.md says what the code does: defaults, the law of lost echoes, the example."""

from __future__ import annotations

import inspect
import math
import re
from pathlib import Path

import numpy as np

from bridge.sensors import surfaces
from bridge.sensors.lidar import PERIOD_US
from bridge.sensors.spatial_lidar import BeamPattern, Detection

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "lidar.md").read_text()
TEXT = " ".join(PAGE.split())


def test_defaults_are_those_of_the_code():
    pattern, detection = BeamPattern(), Detection()
    low, high = pattern.elevation
    step = inspect.signature(surfaces.track_mesh).parameters["step"].default
    mesh = surfaces.boxes(surfaces.CAR_PARTS)
    length, width, _ = np.ptp(mesh.corners.reshape(-1, 3), axis=0)
    for said in (
        f"| {math.degrees(pattern.field_of_view):g} by {math.degrees(high - low):g} degrees |",
        f"| {pattern.columns} by {pattern.lines} |",
        f"| {pattern.range_min:g} to {pattern.range_max:g} m |",
        f"standard deviation | {detection.range_noise:g} m |",
        f"| gain {detection.gain / 1e6:.2f}e6 m2 |",
        f"| {surfaces.ASPHALT:g}, {surfaces.CONCRETE:g}, {surfaces.CAR_BODY:g} |",
        f"a line across every {step} m",
        f"| {surfaces.APRON_WIDTH:g} m |",
        f"| {surfaces.WALL_HEIGHT:g} m high |",
        f"| {length:g} by {width:g} m |",
        f"in the {PERIOD_US / 1000:g} ms of a scan",
    ):
        assert said in TEXT, said
    assert len(surfaces.CAR_PARTS) == 9
    assert 1.0 - math.exp(-detection.gain * 0.1 / 250.0**2) == 0.9, "9 of 10 at 250 m from a tenth"


def test_the_example_runs(monkeypatch):
    (example,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(ROOT)
    names: dict = {}
    exec(compile(example, "lidar.md", "exec"), names)
    assert len(names["scan"].cloud) == len(names["scan"].beam) > 20_000
