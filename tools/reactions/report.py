"""The reaction matrix as a table: per fault the worst times, and what the car needs to stop."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bridge.faults.provocations import LAYERS, OPERATING_STATES
from tools.reactions.run import Measurement

#: Operating states in which the car moves.
_MOVING = tuple(state for state in OPERATING_STATES if state != "standstill")

Row = Mapping[str, Any]


def as_row(measured: Measurement) -> dict[str, Any]:
    """A measurement in plain numbers: times in ms, from the injection or from the condition on."""

    def since(then_us: int | None, from_us: int) -> float | None:
        return None if then_us is None else round((then_us - from_us) / 1000.0, 3)

    return {
        "layer": measured.cell.layer,
        "fault": measured.cell.name,
        "state": measured.cell.state,
        "duration": measured.cell.duration,
        "speed_m_s": round(measured.speed, 2),
        "condition_ms": since(measured.condition_us, measured.injected_us),
        "event_ms": since(measured.event_us, measured.condition_us),
        "reaction_ms": since(measured.reaction_us, measured.condition_us),
        "brake_ms": since(measured.brake_us, measured.condition_us),
        "stop_m": None if measured.stop_distance_m is None else round(measured.stop_distance_m, 2),
        "beyond_edge_m": round(measured.beyond_edge_m, 2),
    }


def summarise(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Per fault the number of cells and the worst of every figure, in the order of the layers and of the rows."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["layer"], row["fault"]), []).append(row)
    ordered = sorted(groups.items(), key=lambda group: LAYERS.index(group[0][0]))
    return [
        {
            "layer": layer,
            "fault": fault,
            "cells": len(cells),
            **{name: _worst(cells, name) for name in ("condition_ms", "reaction_ms", "brake_ms", "beyond_edge_m")},
            "stop_m": {state: _worst((one for one in cells if one["state"] == state), "stop_m") for state in _MOVING},
        }
        for (layer, fault), cells in ordered
    ]


def as_text(rows: Iterable[Row]) -> str:
    """The table for people; an empty field was not measured because there is nothing to measure."""
    rows = list(rows)
    heads = ("fault", "cells", "condition", "reaction", "brakes", *_MOVING, "beyond")
    lines = [
        (
            one["fault"],
            str(one["cells"]),
            *(_figure(one[name]) for name in ("condition_ms", "reaction_ms", "brake_ms")),
            *(_figure(one["stop_m"][state]) for state in _MOVING),
            _figure(one["beyond_edge_m"] or None, 2),
        )
        for one in summarise(rows)
    ]
    widths = [max(len(line[column]) for line in (heads, *lines)) for column in range(len(heads))]
    shown = [
        "  ".join(
            [line[0].ljust(widths[0]), *(text.rjust(width) for text, width in zip(line[1:], widths[1:], strict=True))]
        )
        for line in (heads, *lines)
    ]
    return "\n".join([*(line.rstrip() for line in shown), f"{len(rows)} cells"]) + "\n"


def write(rows: Iterable[Row], folder: Path) -> None:
    """Leave `reactions.txt`, the table, and `reactions.json`, every cell and the table, in a folder."""
    rows = sorted(rows, key=lambda row: LAYERS.index(row["layer"]))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "reactions.txt").write_text(as_text(rows), encoding="utf-8")
    content = {"cells": rows, "faults": summarise(rows)}
    (folder / "reactions.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _worst(cells: Iterable[Row], name: str) -> float | None:
    return max((cell[name] for cell in cells if cell[name] is not None), default=None)


def _figure(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f}"
