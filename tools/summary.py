"""What a run achieved, from its recording: `summary.json` and the page that the terminal shows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from firmware.tables import load_faults
from tools.recorded import Recorded
from tools.tracking import PAPER, PAPER_TOP_SPEED_KMH, TrackingErrors, tracking_errors, tracking_table

YAW_BAND_RAD = 0.02
"""The paper states the share of yaw errors inside this band (97 %)."""


def driving_summary(recorded: Recorded) -> dict[str, Any]:
    """The figures that the recording alone holds: speed, tracking, states, faults, executive."""
    truth = recorded.truth
    speed = np.hypot(truth["vx"], truth["vy"])
    errors = tracking_errors(
        truth["time_us"].astype(np.int64), truth["x"], truth["y"], truth["yaw"], speed, recorded.plans()
    )
    return {
        "top_speed_kmh": float(speed.max() * 3.6),
        "top_lateral_acceleration_mps2": float(np.abs(truth["ay"]).max()),
        "distance_m": float(truth["distance"][-1]),
        "tracking": tracking_table(errors),
        **_tracking_shares(errors),
        "ssm_transitions": _transitions(recorded, "ssm_status", "ssm_state"),
        "ct_state_transitions": _transitions(recorded, "ct_report", "ct_state"),
        "sys_state_transitions": _transitions(recorded, "misc_report", "sys_state"),
        "faults": _faults(recorded),
        "executive": _executive(recorded),
    }


def _tracking_shares(errors: TrackingErrors) -> dict[str, float | None]:
    if errors.speed.size == 0:
        return {"yaw_error_share_in_band": None, "cross_track_share_left": None}
    return {
        "yaw_error_share_in_band": float(np.mean(np.abs(errors.yaw) <= YAW_BAND_RAD)),
        "cross_track_share_left": float(np.mean(errors.cross_track > 0.0)),
    }


def _transitions(recorded: Recorded, message: str, signal: str) -> list[dict[str, Any]]:
    return [{"time_s": change.time_s, "state": change.value} for change in recorded.changes(message, signal)]


def _faults(recorded: Recorded) -> list[dict[str, Any]]:
    """Every fault that became active, with when it cleared."""
    names = {fault.id: fault for fault in load_faults()}
    events = recorded.message("fault_event")
    faults: list[dict[str, Any]] = []
    open_faults: dict[int, dict[str, Any]] = {}
    for time_us, identifier, active in zip(
        events["time_us"], events["fault_id"].astype(int), events["fault_active"].astype(bool), strict=True
    ):
        time_s = float(time_us) * 1e-6
        if active:
            fault = names.get(int(identifier))
            row: dict[str, Any] = {
                "fault": fault.name if fault else f"fault {identifier}",
                "reaction": fault.reaction if fault else "unknown",
                "time_s": time_s,
                "cleared_s": None,
            }
            faults.append(row)
            open_faults[int(identifier)] = row
        elif (row_open := open_faults.pop(int(identifier), None)) is not None:
            row_open["cleared_s"] = time_s
    return faults


def _executive(recorded: Recorded) -> dict[str, Any]:
    statistics = recorded.message("executive_statistics")
    if statistics["time_us"].size == 0:
        return {"frames": 0, "overruns": 0, "late_frames": 0}
    return {
        "frames": int(statistics["executive_frames"][-1]),
        "overruns": int(statistics["executive_overruns"][-1]),
        "late_frames": int(statistics["executive_late_frames"][-1]),
    }


def write_summary(summary: dict[str, Any], path: Path) -> None:
    """Write `summary.json`; under a temporary name first, so that a reader never sees half of it."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n")
    partial.replace(path)


def show_summary(summary: dict[str, Any], console: Console) -> None:
    """Print the page."""
    laps = ", ".join(f"{lap:.3f} s" for lap in summary["laps_s"]) or "none"
    console.print(
        f"\n[bold]{summary['scenario']}[/bold]  seed {summary['seed']}, {summary['simulated_s']:.2f} s simulated"
        f" in {summary['wall_s']:.2f} s: {summary['real_time_factor']:.1f} times real time"
    )
    console.print(f"Laps: {laps}    Top speed: {summary['top_speed_kmh']:.1f} km/h (paper {PAPER_TOP_SPEED_KMH})")
    console.print(_tracking_table(summary["tracking"]))
    inside, left = summary["yaw_error_share_in_band"], summary["cross_track_share_left"]
    if inside is not None:
        console.print(
            f"Yaw errors within {YAW_BAND_RAD} rad: {inside:.1%} (paper 97 %)"
            f"    Cross-track errors to the left: {left:.1%} (paper 87 %)"
        )
    console.print(_bus_table(summary["buses"]))
    console.print(_states("SSM", summary["ssm_transitions"]))
    console.print(_states("ct_state", summary["ct_state_transitions"]))
    console.print(_states("sys_state", summary["sys_state_transitions"]))
    for fault in summary["faults"]:
        console.print(f"[red]Fault[/red] {fault['time_s']:.3f} s: {fault['fault']} ({fault['reaction']})")
    executive = summary["executive"]
    console.print(
        f"Faults: {len(summary['faults'])}    OBC executive: {executive['frames']} frames,"
        f" {executive['overruns']} overruns, {executive['late_frames']} late"
    )
    console.print(f"Frame log SHA-256: {summary['frame_log_sha256']}")
    console.print(f"Files: {summary['folder']}: {', '.join(summary['files'])}")


def _tracking_table(rows: list[dict[str, Any]]) -> Table:
    table = Table(
        title="Tracking of the published path by the true pose (paper's figure in brackets)", title_justify="left"
    )
    for heading in ("speed km/h", "CTE max m", "CTE |mean| m", "CTE std m", "yaw error max rad", "samples"):
        table.add_column(heading, justify="right")
    for row, paper in zip(rows, PAPER, strict=True):
        low, high = row["speed_range_kmh"]
        cells = [f"{low:g} to {high:g}" if high is not None else f"above {low:g}"]
        for key in ("cte_max_m", "cte_abs_mean_m", "cte_std_m", "yaw_error_max_rad"):
            ours, theirs = row[key], getattr(paper, key)
            if ours is None:
                cells.append(f"- ({theirs:g})")
            else:
                colour = "green" if ours <= theirs else "red"
                cells.append(f"[{colour}]{ours:.3f}[/{colour}] ({theirs:g})")
        table.add_row(*cells, str(row["samples"]))
    return table


def _bus_table(buses: dict[str, dict[str, Any]]) -> Table:
    table = Table(title="Buses", title_justify="left")
    for heading in ("bus", "bit/s", "frames", "frames/s", "load mean", "load peak (10 ms)", "lost"):
        table.add_column(heading, justify="right")
    for name, bus in buses.items():
        table.add_row(
            name,
            str(bus["bit_rate"]),
            str(bus["frames"]),
            f"{bus['frames_per_s']:.0f}",
            f"{bus['load']:.1%}",
            f"{bus['load_peak']:.1%}",
            str(bus["lost"]),
        )
    return table


def _states(title: str, transitions: list[dict[str, Any]]) -> str:
    steps = " -> ".join(f"{change['state']} {change['time_s']:.2f}" for change in transitions)
    return f"{title} (s): {steps or 'none'}"
