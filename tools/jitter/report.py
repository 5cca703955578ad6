"""Shows measurements side by side: tables and histograms for the terminal, a picture, and everything as JSON."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from tools.jitter.figures import Figures
from tools.jitter.histogram import (
    FIRST_DECADE,
    LAST_DECADE,
    Panel,
    Series,
    bin_counts,
    svg_picture,
    text_axis,
    text_histogram,
)
from tools.jitter.machine import Machine
from tools.jitter.measurement import Measurement, Row, WorstCycle, rationed_at_ms

#: Columns of the page.
WIDTH = 80

_LABEL, _CELL = 27, 6
_JSON_BINS_PER_DECADE = 20

# Targets.
LATENESS_RATIO = 1.5
PERIOD_RSD = 0.05
SPACING_ERROR_US = 1000.0


@dataclass(frozen=True)
class Target:
    """A target, and whether a measurement met it; None when it had too few samples to tell."""

    text: str
    met: bool | None


def targets(measurement: Measurement) -> list[Target]:
    """The targets of this project for one measurement."""
    lateness, period = measurement.cycles.lateness.figures(), measurement.cycles.period.figures()
    error = measurement.spacing_error.figures()
    result = [Target(f"skipped cycles: {measurement.cycles.skipped}, wanted 0", measurement.cycles.skipped == 0)]
    machine = None if measurement.machine is None else measurement.machine.figures().p99_9
    if machine is not None and lateness.p99_9 is not None:
        ratio = lateness.p99_9 / machine
        text = f"wake-up p99.9 / cyclictest's: {ratio:.2f}, wanted at most {LATENESS_RATIO:g}"
        result.append(Target(text, ratio <= LATENESS_RATIO))
    else:
        result.append(Target("wake-up p99.9 / cyclictest's", None))
    if period.rsd is not None:
        result.append(Target(f"period RSD: {period.rsd:.4f}, wanted at most {PERIOD_RSD:g}", period.rsd <= PERIOD_RSD))
    if error.p99_9 is not None:
        text = f"spacing error p99.9: {error.p99_9:.0f} us, wanted below {SPACING_ERROR_US:.0f}"
        result.append(Target(text, error.p99_9 < SPACING_ERROR_US))
    else:
        result.append(Target("spacing error p99.9", None))
    return result


def show(measurements: Sequence[Measurement], console: Console) -> None:
    """Print tables, histograms, worst cycles and targets; at most `WIDTH` columns wide but for long names."""
    lines = [*_table(measurements), "", *_histograms(measurements)]
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)
    for measurement in measurements:
        console.print()
        for line in _counts(measurement):
            console.print(line, markup=False, soft_wrap=True)
        for target in targets(measurement):
            verdict = {None: "not told", True: "[green]met[/green]", False: "[red]missed[/red]"}[target.met]
            console.print(f"  {escape(target.text)}: {verdict}", soft_wrap=True)


def picture(title: str, measurements: Sequence[Measurement]) -> str:
    """The histograms as SVG, a column per measurement."""
    return svg_picture(title, [_panels(measurement) for measurement in measurements])


def as_json(settings: Mapping[str, Any], machine: Machine, measurements: Iterable[Measurement]) -> dict[str, Any]:
    """Everything that was found."""
    edges = np.logspace(FIRST_DECADE, LAST_DECADE, (LAST_DECADE - FIRST_DECADE) * _JSON_BINS_PER_DECADE + 1)
    return {
        "settings": dict(settings),
        "machine": asdict(machine),
        "histogram_edges_us": [round(float(edge), 4) for edge in edges],
        "runs": [_run_as_json(measurement) for measurement in measurements],
    }


def _table(measurements: Sequence[Measurement]) -> list[str]:
    columns = [measurement.quantities() for measurement in measurements]
    head = "".join(name.rjust(_CELL) for name in ("min", "mean", "p50", "p99", "p99.9", "max", "RSD"))
    lines = ["us".ljust(_LABEL + _condition_width(measurements)) + head]
    for place, quantity in enumerate(columns[0]):
        lines.append(quantity.title)
        rows = [{row.label: row for row in quantities[place].rows} for quantities in columns]
        for label, run, row in _side_by_side(measurements, rows):
            lines.append(label + run + "".join(cell.rjust(_CELL) for cell in _cells(row.distribution.figures())))
    return lines


def _histograms(measurements: Sequence[Measurement]) -> list[str]:
    """Lines of blocks for all that is pictured, and their axis."""
    columns = [[picture for quantity in m.quantities() if (picture := quantity.pictured)] for m in measurements]
    axis = " " * (_LABEL + _condition_width(measurements) + 1) + text_axis()
    lines = [axis]
    for place, (title, _) in enumerate(columns[0]):
        lines.append(title)
        rows = [{row.label: row for row in pictures[place][1]} for pictures in columns]
        for label, run, row in _side_by_side(measurements, rows):
            lines.append(f"{label}{run} {text_histogram(row.distribution)}".rstrip())
    return [*lines, axis]


def _side_by_side(
    measurements: Sequence[Measurement], rows: Sequence[Mapping[str, Row]]
) -> Iterator[tuple[str, str, Row]]:
    """Each row of each measurement, those of one label together: label and condition, both padded, and the row."""
    width = _condition_width(measurements)
    for label in dict.fromkeys(label for of_one in rows for label in of_one):
        first = True
        for measurement, of_one in zip(measurements, rows, strict=True):
            if label in of_one:
                indent = "    " if of_one[label].part else "  "
                shown = (indent + label if first else "").ljust(_LABEL)
                yield shown, measurement.condition.ljust(width) if width else "", of_one[label]
                first = False


def _condition_width(measurements: Sequence[Measurement]) -> int:
    """Columns for the condition; none when there is one only."""
    return max(len(measurement.condition) for measurement in measurements) if len(measurements) > 1 else 0


def _cells(figures: Figures) -> list[str]:
    times = (figures.minimum, figures.mean, figures.p50, figures.p99, figures.p99_9, figures.maximum)
    return [*map(_time, times), "-" if figures.rsd is None else f"{figures.rsd:.3f}"[:5]]


def _time(value: float | None) -> str:
    """Five columns: microseconds, or seconds where those do not fit."""
    if value is None:
        return "-"
    if value < 999.95:
        return f"{value:.1f}"
    return f"{value:.0f}" if value < 99_999.5 else f"{value / 1e6:.2f}s"


def _counts(measurement: Measurement) -> list[str]:
    """What is no time: counts, remarks, worst cycles, the other stations."""
    cycles = measurement.cycles
    lines = [
        f"{measurement.condition}: {cycles.count} cycles, {cycles.skipped} skipped, {cycles.overruns} overruns",
        f"  {len(measurement.command_ns)} frames {measurement.ecu.command} on the bus;"
        f" {cycles.refused} frames refused by the kernel",
    ]
    for note in measurement.notes:
        lines += textwrap.wrap(note, WIDTH, initial_indent="  ", subsequent_indent="  ")
    lines.append("  worst cycles, us from the deadline to the last frame with the kernel:")
    worst = measurement.worst()
    for cycle in worst:
        lines += _worst_lines(cycle)
    if (place := rationed_at_ms(worst)) is not None:
        text = f"all of them are {place:g} ms into 100 ms: so does a host stop a machine whose processors it rations"
        lines += textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent="  ")
    for name, station in measurement.stations.items():
        lateness, execution = station.lateness.figures(), station.execution.figures()
        text = (
            f"{name}: {station.count} cycles, {station.skipped} skipped; us late p50 {_time(lateness.p50)},"
            f" p99.9 {_time(lateness.p99_9)}, max {_time(lateness.maximum)}; run p50 {_time(execution.p50)},"
            f" max {_time(execution.maximum)}"
        )
        lines += textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent="    ")
    return lines


def _worst_lines(cycle: WorstCycle) -> list[str]:
    times = f" (preemptions: {cycle.preemptions})" if cycle.preemptions else ""
    faults = f", {cycle.page_faults} page faults" if cycle.page_faults else ""
    parts = (
        f"timer {cycle.timer:.0f}, waiting {cycle.queued:.0f}, program {cycle.processor:.0f},"
        f" off the core {cycle.preempted:.0f}{times}{faults}"
    )
    tasks = ", ".join(f"{name} {time_us}" for name, time_us in cycle.tasks.items())
    return [
        f"    cycle {cycle.slot} at {cycle.time_s:.3f} s on core {cycle.cpu}: {cycle.response:.0f},"
        f" mostly {cycle.cause}",
        *textwrap.wrap(parts, WIDTH, initial_indent="      ", subsequent_indent="        "),
        *textwrap.wrap(f"tasks: {tasks or 'none'}", WIDTH, initial_indent="      ", subsequent_indent="        "),
    ]


def _panels(measurement: Measurement) -> list[Panel]:
    return [
        Panel(
            f"{quantity.pictured[0]}, {measurement.condition}",
            tuple(Series(row.label, row.distribution) for row in quantity.pictured[1]),
        )
        for quantity in measurement.quantities()
        if quantity.pictured
    ]


def _run_as_json(measurement: Measurement) -> dict[str, Any]:
    log = measurement.cycles.log
    return {
        "condition": measurement.condition,
        "cycles": measurement.cycles.count,
        "skipped": measurement.cycles.skipped,
        "overruns": measurement.cycles.overruns,
        "frames_refused": measurement.cycles.refused,
        "command_frames": len(measurement.command_ns),
        "priority": log.priority,
        "cpu": log.cpu,
        "period_us": log.period_ns / 1000.0,
        "notes": list(measurement.notes),
        "quantities": [
            {
                "title": quantity.title,
                "rows": [
                    {
                        "label": row.label,
                        "part": row.part,
                        **asdict(row.distribution.figures()),
                        "histogram": bin_counts(row.distribution, _JSON_BINS_PER_DECADE).tolist(),
                    }
                    for row in quantity.rows
                ],
            }
            for quantity in measurement.quantities()
        ],
        "worst_cycles": [{**asdict(cycle), "tasks": dict(cycle.tasks)} for cycle in measurement.worst()],
        "stations": {
            name: {
                "cycles": station.count,
                "skipped": station.skipped,
                "wake_up_lateness": asdict(station.lateness.figures()),
                "execution_time": asdict(station.execution.figures()),
            }
            for name, station in measurement.stations.items()
        },
        "targets": [asdict(target) for target in targets(measurement)],
    }
