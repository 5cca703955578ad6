"""What a real-time run says about its own time: cycles of the stations, frames that were lost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from bridge.realtime.cycle_log import CycleLog, read_cycle_log
from tools.jitter.figures import Distribution, cycle_times, overruns, skipped_cycles


def station_summary(log: CycleLog) -> dict[str, Any]:
    """Cycles of one station: counts, and where their time went in microseconds."""
    records = log.records
    times = cycle_times(records, log.period_ns)
    return {
        "priority": log.priority,
        "cpu": log.cpu,
        "cycles": log.overwritten + len(records),
        "skipped": skipped_cycles(records),
        "overruns": overruns(records, log.period_ns),
        "frames_in": int(records["frames_in"].sum()),
        "frames_out": int(records["frames_out"].sum()),
        "refused": int(records["refused"].sum()),
        "lateness_us": asdict(Distribution.of(times.lateness).figures()),
        "execution_us": asdict(Distribution.of(times.execution).figures()),
        "period_us": asdict(Distribution.of(times.period).figures()),
    }


def stations_summary(folder: Path) -> dict[str, dict[str, Any]]:
    """All cycle logs of a folder, by the names of their files."""
    return {log.stem: station_summary(read_cycle_log(log)) for log in sorted(folder.glob("*.cycles"))}


def show_real_time(block: Mapping[str, Any], console: Console) -> None:
    """Print a row per station, and what was lost."""
    console.print(_station_table(block["stations"]))
    refused = sum(station["refused"] for station in block["stations"].values())
    outages = sum(block["outages"].values())
    console.print(
        f"Frames refused by full queues: {refused}, recorded out of order: {block['out_of_order']};"
        f" bus outages: {outages}"
    )


def _station_table(stations: Mapping[str, Mapping[str, Any]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("\nstation", no_wrap=True)
    headings = (
        "\ncycles",
        "\nskipped",
        "\nover",
        "wake-up late, us\np50/p99/p99.9/max",
        "run time, us\np50/p99/max",
        "period\nRSD",
    )
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for name, station in stations.items():
        late, run = station["lateness_us"], station["execution_us"]
        table.add_row(
            name,
            *(str(station[key]) for key in ("cycles", "skipped", "overruns")),
            _row(late[key] for key in ("p50", "p99", "p99_9", "maximum")),
            _row(run[key] for key in ("p50", "p99", "maximum")),
            _number(station["period_us"]["rsd"], 4),
        )
    return table


def _row(values: Iterable[float | None]) -> str:
    return "/".join(map(_microseconds, values))


def _microseconds(value: float | None) -> str:
    """A whole number; milliseconds, and said so, where it has more than five digits."""
    return _number(value, 0) if value is None or value < 99_999.5 else f"{value * 1e-3:.0f}ms"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
