"""What a run achieved: `summary.json` and the page that the terminal shows."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bridge.bus import CHANNELS
from bridge.faults import Injection
from bridge.monitor import FaultEvent, RunMonitor
from dbc.buses import DEFAULT_PROFILE, Bus
from dbc.errors import RaceloopError
from firmware.tables import own_faults
from tools.realtime_summary import show_real_time
from tools.recorded import Recorded
from tools.safety_summary import show_safety
from tools.tracking import PAPER, PAPER_TOP_SPEED_KMH, TrackingErrors, tracking_errors, tracking_table

YAW_BAND_RAD = 0.02
"""The paper states the share of yaw errors inside this band (97 %)."""

WIDTH = 80
"""Columns of the page."""


_NOT_DRIVEN: Mapping[str, Any] = {
    "top_speed_kmh": None,
    "top_lateral_acceleration_mps2": None,
    "distance_m": None,
    "tracking": None,
    "yaw_error_share_in_band": None,
    "cross_track_share_left": None,
    "plans": None,
    "plans_behind_a_car": None,
    "times_behind_a_car": None,
}
"""Of a run without a plant."""


def driving_summary(recorded: Recorded) -> dict[str, Any]:
    """How the car drove: speed, distance, tracking."""
    truth = recorded.truth
    if truth["time_us"].size == 0:
        return dict(_NOT_DRIVEN)
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
        **_following(recorded),
    }


def _following(recorded: Recorded) -> dict[str, int]:
    """How often another car made a plan slower, and how many times in a row that was."""
    follows = recorded.message("trajectory_header")["plan_follows"] > 0
    return {
        "plans": int(follows.size),
        "plans_behind_a_car": int(follows.sum()),
        "times_behind_a_car": int(np.count_nonzero(follows & ~np.concatenate(([False], follows[:-1])))),
    }


def _tracking_shares(errors: TrackingErrors) -> dict[str, float | None]:
    if errors.speed.size == 0:
        return {"yaw_error_share_in_band": None, "cross_track_share_left": None}
    return {
        "yaw_error_share_in_band": float(np.mean(np.abs(errors.yaw) <= YAW_BAND_RAD)),
        "cross_track_share_left": float(np.mean(errors.cross_track > 0.0)),
    }


def event_summary(monitor: RunMonitor, until_us: int | None = None) -> dict[str, Any]:
    """What happened up to a time: changes of state, faults, figures of the onboard computer's executive."""
    end_us = math.inf if until_us is None else until_us
    return {
        **{
            key: [
                {"time_s": change.time_us * 1e-6, "before": change.before, "state": change.after}
                for change in monitor.transitions
                if change.machine == machine and change.time_us <= end_us
            ]
            for key, machine in (
                ("ssm_transitions", "ssm"),
                ("ct_state_transitions", "ct"),
                ("sys_state_transitions", "sys"),
            )
        },
        "faults": _faults(event for event in monitor.faults if event.time_us <= end_us),
        "executive": {
            "frames": monitor.executive_frames,
            "overruns": monitor.executive_overruns,
            "late_frames": monitor.executive_late_frames,
        },
    }


def injected_summary(injections: Iterable[Injection]) -> list[dict[str, Any]]:
    """What was injected, in the order of the scenario file."""
    return [
        {
            "text": str(injection),
            "fault": injection.fault.kind,
            "seed": injection.seed,
            "count": injection.count,
            "first_s": _seconds(injection.first_us),
            "last_s": _seconds(injection.last_us),
            "ended_s": _seconds(injection.ended_us),
        }
        for injection in injections
    ]


def _seconds(time_us: int | None) -> float | None:
    return None if time_us is None else time_us * 1e-6


def _faults(events: Iterable[FaultEvent]) -> list[dict[str, Any]]:
    """Every fault that became active, with when it cleared."""
    table = {fault.id: fault for fault in own_faults()}
    faults: list[dict[str, Any]] = []
    active: dict[int, dict[str, Any]] = {}
    for event in events:
        time_s = event.time_us * 1e-6
        if event.active:
            fault = table.get(event.fault_id)  # a tap may send what the firmware never would
            row = {
                "fault": fault.name if fault else f"fault {event.fault_id}",
                "reaction": fault.reaction if fault else "unknown",
                "time_s": time_s,
                "cleared_s": None,
            }
            faults.append(row)
            active[event.fault_id] = row
        elif event.fault_id in active:
            active.pop(event.fault_id)["cleared_s"] = time_s
    return faults


def write_summary(summary: Mapping[str, Any], path: Path) -> None:
    """Write `summary.json`; under a temporary name first, so that a reader never sees half of it.

    Raises
    ------
    RaceloopError
        When it cannot be written; nothing is left half-written.
    """
    partial = path.with_suffix(".partial")
    try:
        partial.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise RaceloopError(f"{path}: cannot be written: {error.strerror}") from error


def show_summary(summary: Mapping[str, Any], console: Console) -> None:
    """Print the page, at most `WIDTH` columns wide but for names of files."""
    layout = "" if summary["profile"] == DEFAULT_PROFILE else f", CAN1 in {summary['profile']}"
    console.print(f"[bold]{escape(summary['scenario'])}[/bold], seed {summary['seed']}{layout}")
    real_time = summary.get("real_time")
    if real_time is None:
        console.print(
            f"{summary['simulated_s']:.2f} s simulated in {summary['wall_s']:.2f} s:"
            f" {summary['real_time_factor']:.1f} times real time"
        )
    else:
        slower = real_time["slower"]
        pace = "in real time" if slower == 1 else f"{slower} times slower than real time"
        console.print(f"{summary['simulated_s']:.2f} s {pace}, buses over {real_time['bus']}")
    if summary["tracking"] is not None:
        _show_driving(summary, console)
    console.print(_bus_table(summary["buses"]), width=WIDTH)
    console.print()
    if real_time is None:
        console.print(_delay_table(summary["buses"]), width=WIDTH)
        console.print()
    for name, key in (("SSM", "ssm"), ("ct_state", "ct_state"), ("sys_state", "sys_state")):
        console.print(_states(name, summary[f"{key}_transitions"]))
    for injected in summary.get("injected", []):
        console.print(f"[yellow]Injected[/yellow] {escape(injected['text'])}")
    for fault in summary["faults"]:
        cleared = "" if fault["cleared_s"] is None else f", cleared {fault['cleared_s']:.3f} s"
        console.print(f"[red]Fault[/red] {fault['time_s']:.3f} s: {fault['fault']} ({fault['reaction']}){cleared}")
    executive = summary["executive"]
    console.print(
        f"Faults: {len(summary['faults'])}; OBC executive: {executive['frames']} frames,"
        f" {executive['overruns']} overruns, {executive['late_frames']} late"
    )
    show_safety(summary["safety"], console)
    if real_time is not None:
        console.print()
        show_real_time(real_time, console)
    console.print(f"frames.log SHA-256\n  {summary['frame_log_sha256']}")
    console.print(f"Files in {summary['folder']}: {', '.join(summary['files'])}", markup=False)


def _show_driving(summary: Mapping[str, Any], console: Console) -> None:
    laps = ", ".join(f"{lap:.3f} s" for lap in summary["laps_s"]) or "none"
    console.print(f"Laps: {laps}; top speed {summary['top_speed_kmh']:.1f} km/h (paper {PAPER_TOP_SPEED_KMH})\n")
    console.print("Errors of the true pose against the published path (paper's figures in brackets)")
    console.print(_tracking_table(summary["tracking"]), width=WIDTH)
    inside, left = summary["yaw_error_share_in_band"], summary["cross_track_share_left"]
    if inside is not None:
        console.print(
            f"Yaw error within {YAW_BAND_RAD} rad: {inside:.1%} (paper 97 %); left of the path: {left:.1%} (87 %)"
        )
    if CHANNELS[Bus.CAN_R] in summary["buses"]:
        console.print(
            f"Slower for another car: {summary['times_behind_a_car']} times,"
            f" in {summary['plans_behind_a_car']} of {summary['plans']} plans"
        )
    console.print()


def _table(*headings: str) -> Table:
    """Right-aligned columns, no frame, so that it fits a narrow terminal."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def _tracking_table(rows: Iterable[Mapping[str, Any]]) -> Table:
    table = _table("km/h", "CTE max m", "CTE mean m", "CTE std m", "yaw max rad", "n")
    for row, paper in zip(rows, PAPER, strict=True):
        low, high = row["speed_range_kmh"]
        cells = [f"> {low:g}" if high is None else f"{low:g}-{high:g}"]
        for figure in ("cte_max_m", "cte_abs_mean_m", "cte_std_m", "yaw_error_max_rad"):
            ours, theirs = row[figure], getattr(paper, figure)
            if ours is None:
                cells.append(f"- ({theirs:g})")
            else:
                colour = "green" if ours <= theirs else "red"
                cells.append(f"[{colour}]{ours:.3f}[/{colour}] ({theirs:g})")
        table.add_row(*cells, str(row["samples"]))
    return table


def _bus_table(buses: Mapping[str, Mapping[str, Any]]) -> Table:
    table = _table("bus", "bit/s", "frames", "frames/s", "mean load", "peak in 10 ms", "lost")
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


def _delay_table(buses: Mapping[str, Mapping[str, Any]]) -> Table:
    """Of each bus the message whose slowest frame needs the largest part of its cycle."""
    table = _table("bus", "slowest for its cycle", "waits ms", "through ms", "cycle ms", "in time")
    for name, bus in buses.items():
        cyclic = {key: message for key, message in bus["messages"].items() if message["cycle_us"]}
        if not cyclic:
            continue
        in_time = sum(message["worst_response_us"] <= message["cycle_us"] for message in cyclic.values())
        key, worst = max(cyclic.items(), key=lambda item: item[1]["worst_response_us"] / item[1]["cycle_us"])
        table.add_row(
            name,
            key,
            f"{worst['worst_queueing_us'] / 1000:.2f}",
            f"{worst['worst_response_us'] / 1000:.2f}",
            f"{worst['cycle_us'] / 1000:g}",
            f"{in_time} of {len(cyclic)}",
        )
    return table


def _states(title: str, transitions: Sequence[Mapping[str, Any]]) -> str:
    """The states with the times at which they were entered, s."""
    if not transitions:
        return f"{title}: no change"
    steps = [transitions[0]["before"], *(f"{change['state']} {change['time_s']:.2f}" for change in transitions)]
    # Break lines between steps only.
    joined = " > ".join(step.replace(" ", "\0") for step in steps)
    return textwrap.fill(f"{title}: {joined}", WIDTH, subsequent_indent="  ", break_on_hyphens=False).replace("\0", " ")
