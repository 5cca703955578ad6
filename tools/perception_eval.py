"""`raceloop eval perception`: detection, tracking and prediction on a drive of the bench, against the truth.

The car drives a scenario. LiDARs and radar look at its road and at another car, whose distance sweeps from near to
far, and perception hears them and the own estimate as it would in the loop. Then the same drive alone, and with a track
file whose boundary is wrong: whatever is perceived there is false.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from autonomy.detection.road_objects import RoadObjects
from autonomy.frenet import FloatArray
from autonomy.messages import MPH
from autonomy.opponents.prediction import Prediction
from autonomy.opponents.tracker import TrackedObject
from autonomy.perception import Perception, PerceptionConfig
from autonomy.track import Track
from bridge.scenario import Condition, Scenario
from bridge.sensors.radar_scene import OtherCar
from bridge.surroundings import TICK_US
from dbc.errors import RaceloopError
from tools.boundary_mismatch import MISMATCHES, Mismatch
from tools.detection_score import BINS_M, MATCH_M, Sample, Score, bin_of, evaluate, rms, show
from tools.exit_status import ExitStatus
from tools.output_files import write_json
from tools.perception_drive import CarAhead, DriveTick, record_drive, sense
from tools.progress import ProgressBar
from tools.scan_bench import Times

#: 100 mph, m/s: above it the paper's figures hold.
FAST = 100.0 * MPH
#: Slower than this, nothing is evaluated, m/s.
SLOWEST = 10.0
#: Seconds ahead at which predictions are compared.
HORIZONS_S = (1, 2, 4)
#: A false track counts as in the way when it is so far ahead and so far beside the own line at most, m.
AHEAD_M, BESIDE_M = 120.0, 1.93


@dataclass(frozen=True)
class Variation:
    """How a drive is looked at.

    Attributes
    ----------
    name : for people.
    car : whether another car is there.
    mismatch : how the track file of perception differs from the track.
    estimate_boundary : see `PerceptionConfig`.
    """

    name: str
    car: bool = False
    mismatch: Mismatch = MISMATCHES[0]
    estimate_boundary: bool = True


_WRONG = next(one for one in MISMATCHES if one.name == "1.5 m in the turns")
WITH_CAR = Variation("another car ahead", car=True)
#: Drives in which every track is false.
ALONE = (
    Variation("alone"),
    Variation(f"alone, boundary off by {_WRONG.name}", mismatch=_WRONG),
    Variation("the same without its estimate", mismatch=_WRONG, estimate_boundary=False),
)


@dataclass
class TrackScore:
    """Tracks of the car in one bin of distance.

    Attributes
    ----------
    wanted : outputs with the car there.
    position, speed : m and m/s, errors of those with a track of it.
    consistency : normalised estimation error squared of position and velocity, four degrees of freedom.
    """

    wanted: int = 0
    position: list[float] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    consistency: list[float] = field(default_factory=list)


@dataclass
class Evaluation:
    """What one drive gave.

    Attributes
    ----------
    samples, fast : of detection; all, and those above 100 mph.
    tracks : by bin.
    predictions : m, errors by horizon.
    false_tracks : identities that were no car's; in_the_way : those of them that the car would have had to brake for.
    false_objects : fused objects of all scans that were no car's.
    scans, minutes : with the car in motion; fastest : its speed, m/s.
    times : processor and wall time by kind of tick.
    statuses : of scans.
    """

    samples: list[Sample] = field(default_factory=list)
    fast: list[Sample] = field(default_factory=list)
    tracks: list[TrackScore] = field(default_factory=lambda: [TrackScore() for _ in BINS_M])
    predictions: dict[int, list[float]] = field(default_factory=lambda: {horizon: [] for horizon in HORIZONS_S})
    false_tracks: set[int] = field(default_factory=set)
    in_the_way: set[int] = field(default_factory=set)
    false_objects: int = 0
    scans: int = 0
    minutes: float = 0.0
    fastest: float = 0.0
    times: dict[str, Times] = field(default_factory=dict)
    statuses: Counter[str] = field(default_factory=Counter)


def evaluate_drive(
    track: Track,
    scenario: Scenario,
    ticks: list[DriveTick],
    variation: Variation,
    seed: int,
    on_tick: Callable[[int], None] = lambda _us: None,
) -> Evaluation:
    """Let perception look at a drive.

    Parameters
    ----------
    ticks : of the drive on the track.
    seed : of all sensors.
    on_tick : is told the number of each tick.
    """
    config = PerceptionConfig(estimate_boundary=variation.estimate_boundary)
    perception = Perception(variation.mismatch.track(track), config)
    evaluation = Evaluation()
    ahead = CarAhead(track) if variation.car else None
    waiting: dict[int, deque[tuple[int, float, float]]] = {horizon: deque() for horizon in HORIZONS_S}
    for number, sensed in enumerate(sense(track, scenario, ticks, seed, ahead)):
        tick, car = sensed.tick, sensed.car
        kind = "scan" if sensed.scan is not None else "radar" if sensed.tracks is not None else "output"
        times = evaluation.times.setdefault(kind, Times(kind))
        perceived = times.take(perception.step, tick.time_us, tick.motion, sensed.scan, sensed.tracks)
        on_tick(number)
        if perceived.lidar is not None:
            evaluation.statuses[f"LiDAR {perceived.lidar.status.name}"] += 1
        if perceived.radar is not None:
            evaluation.statuses[f"radar {perceived.radar.status.name}"] += 1
        if tick.motion is None or tick.truth.vx < SLOWEST:
            continue
        evaluation.minutes += TICK_US * 1e-6 / 60.0
        evaluation.fastest = max(evaluation.fastest, tick.truth.vx)
        place = None if car is None else _seen_from(tick, car)
        if perceived.radar is not None:
            _note(evaluation, tick, place, {"radar": perceived.radar.objects})
        if perceived.lidar_objects is not None and perceived.fused is not None:
            _note(evaluation, tick, place, {"LiDAR": perceived.lidar_objects, "fused": perceived.fused.objects})
            evaluation.scans += 1
            evaluation.false_objects += _far_from(perceived.fused.objects, place)
        if perceived.tracks is not None:
            _note_tracks(evaluation, tick, car, place, perceived.tracks, track)
        if perceived.predictions is not None and car is not None:
            _note_predictions(evaluation, tick, car, perceived.predictions, waiting)
    return evaluation


def _seen_from(tick: DriveTick, car: OtherCar) -> FloatArray:
    """Middle of the car in the true vehicle frame, shape (2,), m."""
    truth = tick.truth
    cos, sin = math.cos(truth.yaw), math.sin(truth.yaw)
    dx, dy = car.x - truth.x, car.y - truth.y
    return np.array([cos * dx + sin * dy, cos * dy - sin * dx])


def _apart(car: OtherCar, x: float, y: float) -> float:
    """Distance of a place from the middle of the car, m."""
    return math.hypot(x - car.x, y - car.y)


def _note(evaluation: Evaluation, tick: DriveTick, place: FloatArray | None, found: dict[str, RoadObjects]) -> None:
    sample = Sample(place, found)
    evaluation.samples.append(sample)
    if tick.truth.vx > FAST:
        evaluation.fast.append(sample)


def _far_from(objects: RoadObjects, place: FloatArray | None) -> int:
    if place is None:
        return len(objects)
    return int(np.count_nonzero(np.hypot(objects["x"] - place[0], objects["y"] - place[1]) > MATCH_M))


def _note_tracks(
    evaluation: Evaluation,
    tick: DriveTick,
    car: OtherCar | None,
    place: FloatArray | None,
    tracks: Sequence[TrackedObject],
    track: Track,
) -> None:
    """Score the tracks of one output."""
    own = None
    if car is not None and place is not None:
        bin_ = bin_of(float(np.hypot(*place)))
        own = min(tracks, key=lambda one: _apart(car, one.x, one.y), default=None)
        if own is not None and _apart(car, own.x, own.y) > MATCH_M:
            own = None
        if bin_ is not None:
            score = evaluation.tracks[bin_]
            score.wanted += 1
            if own is not None:
                cos, sin = math.cos(car.yaw), math.sin(car.yaw)
                velocity = (car.vx * cos - car.vy * sin, car.vx * sin + car.vy * cos)
                error = np.array([own.x - car.x, own.y - car.y, own.vx - velocity[0], own.vy - velocity[1]])
                plane = own.covariance[np.ix_((0, 1, 3, 4), (0, 1, 3, 4))]
                score.position.append(math.hypot(error[0], error[1]))
                score.speed.append(math.hypot(error[2], error[3]))
                score.consistency.append(float(error @ np.linalg.solve(plane, error)))
    for one in tracks:
        if car is not None and _apart(car, one.x, one.y) <= MATCH_M:
            continue
        evaluation.false_tracks.add(one.identity)
        station, lateral = track.project(one.x, one.y)
        along = (station - tick.station) % track.length
        if 0.0 < along < AHEAD_M and abs(lateral - tick.lateral) < BESIDE_M:
            evaluation.in_the_way.add(one.identity)


def _note_predictions(
    evaluation: Evaluation,
    tick: DriveTick,
    car: OtherCar,
    predictions: Sequence[Prediction],
    waiting: dict[int, deque[tuple[int, float, float]]],
) -> None:
    """Compare what was predicted for now, and keep what is predicted of the car."""
    for horizon, kept in waiting.items():
        while kept and kept[0][0] <= tick.time_us:
            due_us, x, y = kept.popleft()
            if due_us == tick.time_us:
                evaluation.predictions[horizon].append(_apart(car, x, y))
    mine = min(predictions, key=lambda one: _apart(car, one.x[0], one.y[0]), default=None)
    if mine is None or _apart(car, mine.x[0], mine.y[0]) > MATCH_M:
        return
    for horizon, kept in waiting.items():
        place = int(np.searchsorted(mine.time, horizon - 1e-9))
        kept.append((tick.time_us + horizon * 1_000_000, float(mine.x[place]), float(mine.y[place])))


def summary_of(with_car: Evaluation, alone: dict[str, Evaluation]) -> dict[str, Any]:
    """All figures as plain numbers, for people's own programs."""
    return {
        "detection": {name: _detection_figures(samples) for name, samples in _speeds(with_car).items()},
        "tracking": [_track_figures(*pair) for pair in zip(BINS_M, with_car.tracks, strict=True)],
        "prediction_rms_m": {str(horizon): rms(errors) for horizon, errors in with_car.predictions.items()},
        "false": {name: _false_figures(one) for name, one in {WITH_CAR.name: with_car, **alone}.items()},
        "statuses": dict(sorted(with_car.statuses.items())),
        "ms": {kind: _time_figures(times) for kind, times in with_car.times.items()},
    }


def evaluate_perception(
    scenario: Scenario, seed: int, console: Console, out: Path | None, seconds: float | None = None
) -> int:
    """Evaluate on a scenario and print the tables; returns the exit status.

    Parameters
    ----------
    seed : of the sensors.
    out : file for all figures as JSON; None for none.
    seconds : of the drive; None for all of it.

    Raises
    ------
    RaceloopError
        When a file that the scenario names is wrong, or the one for the figures cannot be written.
    """
    if out is not None and not out.absolute().parent.is_dir():
        raise RaceloopError(f"{out}: cannot be written: there is no such folder")
    until = None if seconds is None else Condition(time_us=round(seconds * 1e6))
    with ProgressBar(console, scenario.name, scenario.time_limit_us) as bar:
        track, ticks = record_drive(scenario, until, lambda now: bar.update(now.situation.time_us, "drives"))

    def look(variation: Variation) -> Evaluation:
        with ProgressBar(console, variation.name, len(ticks)) as bar:
            return evaluate_drive(
                track,
                scenario,
                ticks,
                variation,
                seed,
                lambda done: bar.show(done, "perceives") if done % 100 == 0 else None,
            )

    with_car = look(WITH_CAR)
    alone = {variation.name: look(variation) for variation in ALONE}
    _print(console, scenario, seed, with_car, alone)
    if out is not None:
        write_json(out, summary_of(with_car, alone))
    return ExitStatus.DONE


def _print(console: Console, scenario: Scenario, seed: int, with_car: Evaluation, alone: dict[str, Evaluation]) -> None:
    fastest = with_car.fastest * 3.6
    console.print(f"{scenario.name}, seed {seed}: {with_car.scans} scans in motion, up to {fastest:.0f} km/h")
    for name, samples in _speeds(with_car).items():
        console.print(f"Detection, {name}; an object is true within {MATCH_M:g} m")
        show(console, evaluate(samples))
    table = _table("Tracks of the car, m", "there", "tracked", "RMS m off", "RMS m/s off", "NEES of 4")
    for pair in zip(BINS_M, with_car.tracks, strict=True):
        figures = _track_figures(*pair)
        table.add_row(
            "{} to {}".format(*figures["m"]),
            str(figures["wanted"]),
            _shown(figures["tracked"], ".1%"),
            *(_shown(figures[name]) for name in ("position_rms_m", "speed_rms_mps", "nees")),
        )
    console.print(table)
    table = _table("Predicted, s before", "times", "RMS m off")
    for horizon, errors in with_car.predictions.items():
        table.add_row(str(horizon), str(len(errors)), _shown(rms(errors)))
    console.print(table)
    table = _table("What is no car", "minutes", "objects per scan", "tracks per minute", "in the way")
    for name, one in {WITH_CAR.name: with_car, **alone}.items():
        figures = _false_figures(one)
        table.add_row(
            name,
            f"{figures['minutes']:.2f}",
            _shown(figures["objects_per_scan"], ".3f"),
            _shown(figures["tracks_per_minute"]),
            str(figures["in_the_way"]),
        )
    console.print(table)
    table = _table("Tick with, ms of the processor", "mean", "p99", "max", "ticks")
    for kind, times in with_car.times.items():
        figures = _time_figures(times)
        table.add_row(kind, *(f"{figures[name]:.2f}" for name in ("mean", "p99", "max")), str(len(times.cpu)))
    console.print(table)


def _speeds(evaluation: Evaluation) -> dict[str, list[Sample]]:
    return {"at any speed": evaluation.samples, "above 100 mph": evaluation.fast}


def _table(*names: str) -> Table:
    return Table(*(Column(name, justify="right" if place else "left") for place, name in enumerate(names)))


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _shown(value: float | None, form: str = ".2f") -> str:
    return "-" if value is None else format(value, form)


def _detection_figures(samples: Sequence[Sample]) -> list[dict[str, Any]]:
    rows = []
    for source, scores in evaluate(samples).items():
        for (low, high), score in zip(BINS_M, scores, strict=True):
            rows.append(_score_figures(source, (low, high), score))
    return rows


def _score_figures(source: str, bin_: tuple[int, int], score: Score) -> dict[str, Any]:
    return {
        "source": source,
        "m": list(bin_),
        "cars": score.cars,
        "average_precision": score.average_precision,
        "recall": score.recall,
        "precision": score.precision,
        "position_rms_m": score.position_rms,
    }


def _track_figures(bin_: tuple[int, int], score: TrackScore) -> dict[str, Any]:
    return {
        "m": list(bin_),
        "wanted": score.wanted,
        "tracked": _share(len(score.position), score.wanted),
        "position_rms_m": rms(score.position),
        "speed_rms_mps": rms(score.speed),
        "nees": float(np.mean(score.consistency)) if score.consistency else None,
    }


def _false_figures(evaluation: Evaluation) -> dict[str, Any]:
    return {
        "minutes": evaluation.minutes,
        "objects_per_scan": _share(evaluation.false_objects, evaluation.scans),
        "tracks_per_minute": _share(len(evaluation.false_tracks), evaluation.minutes),
        "in_the_way": len(evaluation.in_the_way),
    }


def _time_figures(times: Times) -> dict[str, float]:
    mean, p99, most = float(np.mean(times.cpu)), float(np.percentile(times.cpu, 99.0)), max(times.cpu)
    return {"mean": mean, "p99": p99, "max": most}
