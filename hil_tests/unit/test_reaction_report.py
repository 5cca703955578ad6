"""The table of the reaction matrix: worst of each figure per fault, on paper as in the page."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from tools.reactions.cells import Cell, Matrix
from tools.reactions.report import as_row, as_text, summarise, write
from tools.reactions.run import Measurement

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "reactions.md").read_text()


def measured(name: str, state: str, **figures: Any) -> dict[str, Any]:
    cell = Cell(figures.pop("layer", "ssm"), name, state, "at")
    return as_row(Measurement(cell, injected_us=1_000_000, condition_us=1_050_000, **figures))


ROWS = [
    measured("obc_silent", "turn", layer="raptor", reaction_us=1_060_000, stop_distance_m=160.0, beyond_edge_m=2.5),
    measured("imu_timeout", "straight", speed=63.0, reaction_us=1_050_500, brake_us=1_120_000, stop_distance_m=200.25),
    measured("imu_timeout", "launch", reaction_us=1_070_000, stop_distance_m=1.5),
    measured("imu_timeout", "straight", reaction_us=1_050_400, brake_us=1_110_000, stop_distance_m=199.0),
    measured("sd_warning", "standstill"),
]


def test_a_row_counts_from_the_injection_and_from_the_condition() -> None:
    row = ROWS[1]
    assert (row["condition_ms"], row["reaction_ms"], row["brake_ms"], row["event_ms"]) == (50.0, 0.5, 70.0, None)
    assert (row["fault"], row["state"], row["speed_m_s"], row["stop_m"]) == ("imu_timeout", "straight", 63.0, 200.25)


def test_the_worst_counts_and_layers_keep_their_order() -> None:
    ssm, warning, raptor = summarise(ROWS)
    assert [one["fault"] for one in (ssm, warning, raptor)] == ["imu_timeout", "sd_warning", "obc_silent"]
    assert (ssm["cells"], ssm["reaction_ms"], ssm["brake_ms"]) == (3, 20.0, 70.0)
    assert ssm["stop_m"] == {"launch": 1.5, "pit_lane": None, "straight": 200.25, "turn": None, "braking": None}
    assert (warning["reaction_ms"], warning["brake_ms"]) == (None, None)
    assert raptor["beyond_edge_m"] == 2.5


def test_text_and_json_hold_the_same(tmp_path: Path) -> None:
    write(ROWS, tmp_path / "out")
    lines = (tmp_path / "out" / "reactions.txt").read_text().splitlines()
    assert lines[0].split()[:4] == ["fault", "cells", "condition", "reaction"]
    assert lines[1].split() == ["imu_timeout", "3", "50.0", "20.0", "70.0", "1.5", "200.2"]
    assert lines[-1] == "5 cells"
    assert "\n".join(lines) + "\n" == as_text(ROWS)
    content = json.loads((tmp_path / "out" / "reactions.json").read_text())
    assert len(content["cells"]) == 5
    assert content["faults"] == summarise(ROWS)


def test_the_page_has_every_fault_with_its_number_of_cells() -> None:
    table = re.findall(r"^```text\n(fault .*?)^```", PAGE, re.MULTILINE | re.DOTALL)[0].splitlines()
    told = [(line.split()[0], int(line.split()[1])) for line in table[1:-1]]
    counts: dict[tuple[str, str], int] = {}
    for cell in Matrix().cells():
        counts[cell.layer, cell.name] = counts.get((cell.layer, cell.name), 0) + 1
    assert told == [(name, count) for (_, name), count in counts.items()]
    assert table[-1] == f"{sum(counts.values())} cells"
