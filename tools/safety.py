"""`raceloop safety`: hold a recorded run to the safety properties."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from rich.console import Console

from bridge.log_writer import CANDUMP, TRUTH
from bridge.safety.limits import SafetyLimits
from bridge.safety.monitor import SafetyMonitor
from dbc.codec import profile
from dbc.errors import ConfigurationError
from tools.dbw.log_source import read_chunks
from tools.exit_status import ExitStatus
from tools.run import SUMMARY, chosen_scenario, load_road
from tools.safety_summary import safety_summary, show_safety


def safety(folder: Path, scenario_name: str | None, console: Console) -> int:
    """Check the recording of a run and print what was found; returns the exit status.

    Parameters
    ----------
    folder : of the recording; without `truth.parquet` only what frames tell is checked.
    scenario_name : that was driven; None for what `summary.json` says.

    Raises
    ------
    RaceloopError
        When one of the files is missing or wrong, or a line of the log cannot be read.
    """
    summary = _read_summary(folder / SUMMARY)
    scenario = chosen_scenario(scenario_name or summary["scenario"], summary["profile"])
    truth = folder / TRUTH
    names, rows = _truth(truth) if truth.exists() else ((), iter(()))
    road = load_road(scenario, scenario.track)
    limits, database = SafetyLimits.of_scenario(scenario), profile(scenario.profile)
    monitor = SafetyMonitor(limits, database, names, road.boundaries())
    log = folder / CANDUMP

    def broken(frame: int, text: str) -> None:
        raise ConfigurationError(log, f"frame {frame}", text)

    row = next(rows, None)
    for frames in read_chunks(log, None, broken):
        while row is not None and row[0] <= frames["time_us"][-1]:
            monitor.add_truth(int(row[0]), row[1:])
            row = next(rows, None)
        monitor.update(frames)
    while row is not None:
        monitor.add_truth(int(row[0]), row[1:])
        row = next(rows, None)
    monitor.finish()
    block = safety_summary(monitor, round(summary["simulated_s"] * 1e6))
    show_safety(block, console)
    return ExitStatus.MISSED if block["violations"] else ExitStatus.DONE


def _read_summary(path: Path) -> dict[str, Any]:
    """Scenario, profile and length of a run."""
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(path, "", error.strerror or "cannot be read") from error
    except ValueError as error:
        raise ConfigurationError(path, "", f"is no JSON: {error}") from error
    kinds: dict[str, type | tuple[type, ...]] = {"scenario": str, "profile": str, "simulated_s": (int, float)}
    for key, kind in kinds.items():
        if not isinstance(summary, dict) or not isinstance(summary.get(key), kind):
            raise ConfigurationError(path, key, "is missing; needed is what `raceloop run` writes")
    return dict(summary)


def _truth(path: Path) -> tuple[tuple[str, ...], Iterator[NDArray[np.float64]]]:
    """Names of the plant's outputs, and a row per tick that begins with its time, us."""
    try:
        file = pq.ParquetFile(path)
    except (OSError, pa.ArrowException) as error:
        raise ConfigurationError(path, "", f"cannot be read: {' '.join(str(error).split())}") from error
    names = tuple(name for name in file.schema_arrow.names if name != "time_us")
    if len(names) == len(file.schema_arrow.names):
        raise ConfigurationError(path, "time_us", "is missing; needed is what `raceloop run` writes")

    def rows() -> Iterator[NDArray[np.float64]]:
        for batch in file.iter_batches(batch_size=4096, columns=["time_us", *names]):
            columns = [batch.column(name).to_numpy().astype(np.float64) for name in ("time_us", *names)]
            yield from np.column_stack(columns)

    return names, rows()
