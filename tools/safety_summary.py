"""What the safety monitor of a run says: the block of `summary.json`, and its lines on the page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape

from bridge.safety.monitor import SafetyMonitor, properties

_SHOWN = 20
"""Occasions on the page; the others are in the file."""


def safety_summary(monitor: SafetyMonitor, until_us: int | None = None) -> dict[str, Any]:
    """What was checked, and where it did not hold up to a time; the monitor has finished."""
    end_us = math.inf if until_us is None else until_us
    return {
        "properties": list(monitor.checked),
        "frames": monitor.frames,
        "excursion_m": monitor.excursion_m,
        "violations": [
            {
                "property": one.property_id,
                "time_s": one.time_us * 1e-6,
                "frame": one.frame,
                "seen": one.seen,
                "allowed": one.allowed,
            }
            for one in monitor.violations
            if one.time_us <= end_us
        ],
    }


def show_safety(block: Mapping[str, Any], console: Console) -> None:
    """Print one line when all properties held, else one per occasion."""
    violations, known = block["violations"], properties()
    if block["excursion_m"] > 0.0:
        console.print(f"[red]Off the track[/red] by {block['excursion_m']:.2f} m while nobody could steer: no promise")
    if not violations:
        console.print(f"Safety: {len(block['properties'])} properties held on {block['frames']} frames")
        return
    for one in violations[:_SHOWN]:
        console.print(
            f"[red]Safety {one['property']}[/red] {one['time_s']:.3f} s, frame {one['frame']}:"
            f" {escape(one['seen'])}; allowed: {escape(one['allowed'])}"
        )
    if len(violations) > _SHOWN:
        console.print(f"[red]and {len(violations) - _SHOWN} more[/red]")
    for name in dict.fromkeys(one["property"] for one in violations):
        console.print(f"{name}: {escape(known[name].text)}")
    broken = len({one["property"] for one in violations})
    held = len(block["properties"]) - broken
    console.print(f"[red]Safety: {broken} properties violated[/red], {held} held on {block['frames']} frames")
