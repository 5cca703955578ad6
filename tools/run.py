"""`raceloop run`: drive a scenario, record it, sum it up."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

import scenarios
from autonomy.partition import AutonomyPartition
from autonomy.track import Track
from autonomy.track_files import load_track
from autonomy.vehicle import VehicleLimits, load_vehicle
from bridge import bench as lockstep
from bridge.bench import Bench
from bridge.bus import BIT_RATES, CHANNELS
from bridge.interfaces import Road
from bridge.recorder import Recording
from bridge.scenario import Scenario, load_scenario
from bridge.states import CtState
from dbc.codec import database
from dbc.errors import ConfigurationError, RaceloopError
from tools.recorded import Recorded
from tools.summary import driving_summary, show_summary, write_summary

DEFAULT_SCENARIO = scenarios.DIRECTORY / "solo_lap.yaml"
SUMMARY = "summary.json"


def find_scenario(name: str | None) -> Path:
    """A scenario by its path, or by the name of one that comes with raceloop.

    Raises
    ------
    ConfigurationError
        When there is neither.
    """
    if name is None:
        return DEFAULT_SCENARIO
    path = Path(name)
    if path.exists():
        return path
    shipped = scenarios.DIRECTORY / f"{name}.yaml"
    if shipped.exists():
        return shipped
    known = ", ".join(sorted(file.stem for file in scenarios.DIRECTORY.glob("*.yaml")))
    raise ConfigurationError(name, "", f"no such scenario file; shipped scenarios: {known}")


def make_autonomy(scenario: Scenario, road: Road) -> AutonomyPartition:
    """The autonomy of this project for a scenario; the road is the track it was loaded from.

    Raises
    ------
    ConfigurationError
        When the vehicle file lacks what planning needs.
    """
    assert isinstance(road, Track)
    return AutonomyPartition(road, VehicleLimits.from_parameters(scenario.vehicle, load_vehicle(scenario.vehicle)))


def build_bench(scenario: Scenario, folder: Path | None = None) -> Bench:
    """The bench of a scenario with the autonomy of this project.

    Parameters
    ----------
    scenario : what to run.
    folder : of the recording; None for no recording.

    Raises
    ------
    RaceloopError
        When a file that the scenario names is wrong.
    """
    return Bench.from_scenario(scenario, load_track, make_autonomy, folder)


def run(scenario_name: str | None, folder: Path, console: Console, rt_ratio: float | None = None) -> int:
    """Run a scenario and leave recording and `summary.json` in a folder.

    Returns
    -------
    int
        Exit status: 0 when the scenario reached its finish, 1 when its time ran out.

    Raises
    ------
    RaceloopError
        When a file is wrong or cannot be written; nothing is left half-written.
    """
    database.check_sources()
    scenario = load_scenario(find_scenario(scenario_name))
    _make_folder(folder)
    with build_bench(scenario, folder) as bench:
        with _progress(console, scenario) as on_progress:
            started = time.perf_counter()
            finished = bench.run(on_progress=on_progress, rt_ratio=rt_ratio)
            loop_s = time.perf_counter() - started
        with console.status("Completing the recording"):
            recording = bench.finish()
        assert recording is not None
        whole_s = time.perf_counter() - started
        summary = _summary(bench, recording, finished, loop_s, whole_s, folder)
    write_summary(summary, folder / SUMMARY)
    show_summary(summary, console)
    if not finished:
        console.print(f"[red]Not finished[/red] within the scenario's {scenario.time_limit_us * 1e-6:g} s")
    return 0 if finished else 1


def _summary(
    bench: Bench, recording: Recording, finished: bool, loop_s: float, whole_s: float, folder: Path
) -> dict[str, Any]:
    simulated_s = bench.now_us * 1e-6
    files = (recording.candump, recording.blf, recording.signals, recording.truth, folder / SUMMARY)
    return {
        "scenario": bench.scenario.name,
        "seed": bench.scenario.seed,
        "finished": finished,
        "simulated_s": simulated_s,
        "wall_s": loop_s,
        "wall_with_recording_s": whole_s,
        "real_time_factor": simulated_s / loop_s,
        "laps_s": list(bench.laps.laps_s),
        **driving_summary(Recorded(recording.signals, recording.truth)),
        "buses": {
            CHANNELS[bus]: {
                "bit_rate": BIT_RATES[bus],
                "frames": statistics.frames,
                "frames_per_s": statistics.frames / simulated_s,
                "load": statistics.load,
                "load_peak": statistics.load_peak,
                "lost": statistics.lost,
            }
            for bus, statistics in bench.network.statistics().items()
        },
        "frames_lost": bench.losses,
        "frame_log_sha256": recording.frame_log_sha256,
        "folder": str(folder),
        "files": [file.name + ("/" if file.is_dir() else "") for file in files],
    }


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RaceloopError(f"{folder}: cannot be the folder of the recording: {error.strerror}") from error


@contextmanager
def _progress(console: Console, scenario: Scenario) -> Iterator[Any]:
    """Progress by simulated time against the scenario's limit, with what the car is doing."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[state]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(scenario.name, total=scenario.time_limit_us, state="")

        def show(progress: lockstep.Progress) -> None:
            now = progress.situation
            try:
                state = CtState(now.ct_state).name
            except ValueError:
                state = str(now.ct_state)
            bar.update(
                task,
                completed=now.time_us,
                state=f"{now.time_us * 1e-6:6.1f} s  {state:<14} {progress.speed * 3.6:5.1f} km/h  lap {now.laps}",
            )

        yield show
