"""`raceloop run`: drive a scenario, record it, sum it up."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

import scenarios
from autonomy.track import Track
from autonomy.track_files import load_track
from autonomy.vehicle import VehicleLimits, load_vehicle
from bridge import bench as lockstep
from bridge.bench import Bench
from bridge.bus import BIT_RATES, CHANNELS
from bridge.delays import MessageDelay
from bridge.faults.reading import check_faults
from bridge.interfaces import Road
from bridge.recorder import Recording
from bridge.scenario import PerceptionMode, Scenario, load_scenario
from dbc.buses import Bus
from dbc.codec import Codec, profile
from dbc.errors import ConfigurationError, RaceloopError
from dbc.states import CtState
from firmware.parameters import Offence, decode_results, load_operation
from firmware.tables import own_parameters
from tools.check_params import show_rejected
from tools.exit_status import ExitStatus
from tools.progress import ProgressBar
from tools.recorded import Recorded
from tools.safety_summary import safety_summary
from tools.summary import driving_summary, event_summary, injected_summary, show_summary, write_summary

if TYPE_CHECKING:
    from autonomy.partition import AutonomyPartition

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
    # A process without autonomy, such as the plant's station, would wait for its filters to be imported.
    from autonomy.partition import AutonomyPartition  # noqa: PLC0415

    assert isinstance(road, Track)
    perception_map = None
    if scenario.perception is PerceptionMode.FULL:
        perception_map = road if scenario.perception_map is None else load_track(scenario.perception_map)
    limits = VehicleLimits.from_parameters(scenario.vehicle, load_vehicle(scenario.vehicle))
    return AutonomyPartition(road, limits, perception_map)


def chosen_scenario(name: str | None, profile_name: str | None) -> Scenario:
    """Load a scenario, with another profile of CAN1 than its own when one is named.

    Raises
    ------
    RaceloopError
        When there is no such scenario or profile, or the file is wrong.
    """
    scenario = load_scenario(find_scenario(name))
    if profile_name is None:
        return scenario
    database = profile(profile_name)
    check_faults(scenario.path, scenario.faults, database)
    return replace(scenario, profile=database.profile)


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
    return Bench.from_scenario(scenario, partial(load_road, scenario), make_autonomy, folder)


def load_road(scenario: Scenario, path: Path) -> Track:
    """Load the track of a scenario, which must have the start on it."""
    track = load_track(path)
    station, lateral = scenario.start_s_m, scenario.start_d_m
    if station >= track.length:
        raise ConfigurationError(
            scenario.path, "start.s_m", f"is {station:g}; must be below {track.length:.1f}, the length of the lap"
        )
    node = int(station / track.centre.spacing)
    left, right = float(track.width_left[node]), float(track.width_right[node])
    if not -right <= lateral <= left:
        raise ConfigurationError(
            scenario.path, "start.d_m", f"is {lateral:g}; must be {-right:.1f} to {left:.1f}, the track's width there"
        )
    return track


def run(scenario: Scenario, folder: Path, console: Console, rt_ratio: float | None = None) -> int:
    """Run a scenario and leave recording and `summary.json` in a folder.

    Returns
    -------
    int
        Exit status: a broken safety property counts as a missed finish; a run that the firmware's verdict on the
        operation file held at full brake is the user's mistake.

    Raises
    ------
    RaceloopError
        When a file is wrong or cannot be written; nothing is left half-written.
    """
    with build_bench(scenario) as bench:
        if scenario.finish.for_us == 0 and scenario.finish.holds(bench.situation):
            raise ConfigurationError(scenario.path, "finish", "holds at power-on; must be something yet to come")
        make_folder(folder)
        bench.record_to(folder)
        with ProgressBar(console, scenario.name, scenario.time_limit_us) as bar:
            started = time.perf_counter()
            finished = bench.run(on_progress=partial(_show, bar), rt_ratio=rt_ratio)
            loop_s = time.perf_counter() - started
        with console.status("Completing the recording"):
            recording = bench.finish()
        assert recording is not None
        whole_s = time.perf_counter() - started
        offences = refused(bench)
        summary = run_summary(bench, recording, finished, offences, loop_s, whole_s, folder)
    write_summary(summary, folder / SUMMARY)
    show_summary(summary, console)
    status = conclude(scenario, finished, offences, console)
    return ExitStatus.MISSED if summary["safety"]["violations"] else status


def conclude(scenario: Scenario, finished: bool, offences: Sequence[Offence], console: Console) -> int:
    """Say what became of a run that was not interrupted; returns the exit status."""
    if offences:
        show_rejected(scenario.operation, offences, console)
        console.print("[red]Not driven[/red]: the onboard computer holds full brake until the next power-on")
        return ExitStatus.USER_ERROR
    if not finished:
        console.print(f"[red]Not finished[/red] within the scenario's {scenario.time_limit_us * 1e-6:g} s")
        return ExitStatus.MISSED
    return ExitStatus.DONE


def refused(bench: Bench) -> list[Offence]:
    """What the onboard computer has refused in the operation file."""
    answers = ((result.key, result.status, result.value) for result in bench.operator.offences)
    return list(decode_results(answers, load_operation(bench.scenario.operation), own_parameters()))


def run_summary(
    bench: Bench,
    recording: Recording,
    finished: bool,
    offences: list[Offence],
    loop_s: float,
    whole_s: float,
    folder: Path,
) -> dict[str, Any]:
    """Content of `summary.json` of a bench that has finished, with its recording."""
    simulated_s = bench.now_us * 1e-6
    delays = bench.network.delays()
    files = (recording.candump, recording.blf, recording.signals, recording.truth, folder / SUMMARY)
    return {
        "scenario": bench.scenario.name,
        "profile": bench.scenario.profile,
        "seed": bench.scenario.seed,
        "finished": finished,
        "simulated_s": simulated_s,
        "wall_s": loop_s,
        "wall_with_recording_s": whole_s,
        "real_time_factor": simulated_s / loop_s,
        "configuration": bench.operator.verdict.name,
        "offences": [asdict(offence) for offence in offences],
        "laps_s": list(bench.laps.laps_s),
        **driving_summary(Recorded(recording.signals, recording.truth)),
        **event_summary(bench.monitor),
        "safety": safety_summary(bench.safety),
        "injected": injected_summary(bench.injections),
        "buses": {
            CHANNELS[bus]: {
                "bit_rate": BIT_RATES[bus],
                "frames": statistics.frames,
                "frames_per_s": statistics.frames / simulated_s,
                "load": statistics.load,
                "load_peak": statistics.load_peak,
                "lost": statistics.lost,
                "messages": _messages(profile(bench.scenario.profile), bus, delays[bus]),
            }
            for bus, statistics in bench.network.statistics().items()
            if bus in bench.scenario.buses
        },
        "frames_lost": bench.losses,
        "frame_log_sha256": recording.frame_log_sha256,
        "folder": str(folder),
        "files": [file.name + ("/" if file.is_dir() else "") for file in files],
    }


def _messages(database: Codec, bus: Bus, delays: Iterable[MessageDelay]) -> dict[str, dict[str, Any]]:
    """What each message had to wait for the bus, and how often it is sent."""
    found = {}
    for delay in delays:
        codec = database.find(bus, delay.identifier, delay.extended)
        found[f"{delay.identifier:X}" if codec is None else codec.name] = {
            "frames": delay.frames,
            "mean_queueing_us": delay.mean_us,
            "worst_queueing_us": delay.worst_us,
            "worst_response_us": delay.worst_response_us,
            "cycle_us": 0 if codec is None else codec.cycle_us,
        }
    return found


def make_folder(folder: Path) -> None:
    """Make the folder, and see now rather than after the run whether a file can be made in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise RaceloopError(f"{folder}: cannot be the folder of the recording: {error.strerror}") from error


def _show(bar: ProgressBar, progress: lockstep.Progress) -> None:
    now = progress.situation
    try:
        state = CtState(now.ct_state).name
    except ValueError:
        state = str(now.ct_state)
    bar.update(now.time_us, f"{state:<14} {progress.speed * 3.6:5.1f} km/h  lap {now.laps}")
