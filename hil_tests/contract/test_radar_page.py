"""docs/radar.md says what the code does: figures, verdicts, statuses, the example, the form of the printed table."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path

from autonomy.detection.fusion import Fusion, FusionConfig, SourceStatus
from autonomy.detection.radar import RadarConfig, RadarStatus, Verdict
from autonomy.detection.road_objects import Sensor
from bridge.sensors.radar import RadarErrors
from dbc.buses import DIRECTORY
from dbc.network import load_database
from dbc.radar_tracks import wire_limits
from tools.detection_score import BINS_M, MATCH_M, SOURCES

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "radar.md").read_text()
TEXT = " ".join(PAGE.split())


def test_the_example_runs(monkeypatch):
    (example,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(ROOT)
    names: dict[str, object] = {}
    exec(compile(example, "docs/radar.md", "exec"), names)
    fused = names["fused"]
    assert (fused.lidar, fused.radar) == (SourceStatus.USED, SourceStatus.USED)
    best = fused.objects[fused.objects["confidence"].argmax()]
    assert best["sensors"] == Sensor.RADAR
    assert math.isclose(best["range_rate"], -5.0, abs_tol=1.0)
    assert isinstance(names["fusion"], Fusion)


def test_figures_are_those_of_the_code():
    errors, config = RadarErrors(), RadarConfig()
    long, medium = errors.long_range, errors.medium_range
    degrees = {scan: (math.degrees(scan.half_angle), math.degrees(scan.angle_white)) for scan in (long, medium)}
    rows = dict(re.findall(r"^\| (.+?) \| ([-\de., ]+) \| .+ \|$", PAGE, re.MULTILINE))
    assert [[float(one) for one in cell.split(",")] for cell in rows.values()] == [
        [long.reach, round(degrees[long][0], 9)],
        [round(degrees[medium][0], 9)],
        [medium.reach, errors.range_min],
        [errors.range_white, errors.rate_white],
        [round(degrees[long][1], 9)],
        [round(degrees[medium][1], 9)],
        [errors.acceleration_white, errors.lateral_white],
        [errors.half_range],
        [errors.false_alarm],
        [errors.wall_gain_db, errors.mirror_gain_db],
        list(errors.clutter),
    ]
    for said in (
        f"a post every {errors.post_spacing:g} m",
        f"they coast for {errors.coast} scans",
        f"nearer than {config.range_min:g} m",
        f"faster than {config.speed_max:g} m/s",
        f"to {config.stationary_gate:g} sigmas and at least {config.stationary_speed:g} m/s",
        f"at least {config.margin:g} m inside",
        f"({-wire_limits('range_rate')[0]:g} m/s)",
        f"a gate of {100 * FusionConfig().gate_probability:g} %",
        f"STALE ({FusionConfig().stale_us / 1000:g} ms)",
        f"within {MATCH_M:g} m of a car's",
    ):
        assert said in TEXT, said


def test_the_ids_that_it_shares_with_can1():
    with (Path(__file__).parent / "layouts.csv").open(newline="", encoding="ascii") as file:
        on_can1 = {row["id"] for row in csv.DictReader(file) if row["database"] == "raptor"}
    ours = {str(message.frame_id) for message in load_database(DIRECTORY / "radar_esr.dbc").messages}
    assert f"{len(on_can1 & ours)} of the ids of CAN1" in TEXT


def test_every_verdict_and_status_is_there():
    (table,) = re.findall(r"^\| verdict \|.*?\n\n", PAGE, re.MULTILINE | re.DOTALL)
    assert re.findall(r"^\| ([A-Z_]+) ", table, re.MULTILINE) == [v.name for v in [*list(Verdict)[1:], Verdict.KEPT]]
    for status in (*RadarStatus, *SourceStatus):
        assert re.search(rf"\b{status.name}\b", PAGE), status.name


def test_the_printed_table_has_every_bin_and_source():
    (block,) = re.findall(r"^```text\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in block.splitlines() if line[:1] == "│"]
    assert [row[0] for row in rows] == [bin_ for start, end in BINS_M for bin_ in (f"{start} to {end}", "", "")]
    assert [row[1] for row in rows] == [*SOURCES] * len(BINS_M)
