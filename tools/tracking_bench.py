"""What tracking an opponent costs and how exact it is: this tracker beside filterpy's IMM and Stone Soup's PDA.

::

    python -m tools.tracking_bench

All follow the same car on the same scans and take turns scan by scan. Stone Soup takes part where it is installed:
`pip install 'raceloop[peers]'`.

- filter: three models with PDA, one track, prediction and update.
- tracker: the filter, and all that begins, confirms and ends tracks; no track is given to it.
- filterpy: IMM of three UKFs with the same models, the nearest detection, no PDA.
- Stone Soup: PDA with one model, constant velocity.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.table import Table

from autonomy.frenet import FloatArray
from autonomy.opponents.imm_pdaf import ImmPdaf, SensorModel
from autonomy.opponents.motion_models import ConstantVelocity
from autonomy.opponents.prediction import OpponentPredictor
from autonomy.opponents.tracker import OpponentTracker, TrackedObject
from autonomy.track import Track
from autonomy.track_files import load_track
from bridge.scenario import load_scenario
from tools.exit_status import ExitStatus
from tools.opponent_peers import FilterpyImm, Peer, StoneSoupPda, stone_soup_is_there
from tools.opponent_scenes import MANOEUVRES, SCAN_US, Truth, scans
from tools.run import DEFAULT_SCENARIO

TARGET_MS = 0.5

#: Errors that differ by less than this share are equal: over these runs, luck makes as much.
MARGIN = 0.01

#: 20 points of clutter in a square of 100 m.
CLUTTER = SensorModel("lidar", 0.9, 2.0e-3)
#: Each scan has the car and nothing else.
CLEAN = SensorModel("lidar", 1.0, 1.0e-12)
DEVIATION = 0.3  # m
DT = SCAN_US * 1.0e-6

#: Scan that the peers and the filter start at, from what the tracker knows then, and the first one that counts.
START, COUNTED = 20, 30

#: A car nearer than this to an estimate is followed, m.
FOLLOWED = 5.0


class OurFilter:
    """One track of the filter, as the peers have one."""

    def __init__(self, filter_: ImmPdaf, sensor: SensorModel, mean: FloatArray, covariance: FloatArray) -> None:
        self._filter, self._sensor = filter_, sensor
        self._alone = self._seen = np.ones(1, dtype=np.bool_)
        self.belief = filter_.started(mean[None], covariance[None])

    def step(self, positions: FloatArray) -> None:
        """See Peer."""
        noise = np.tile(DEVIATION**2 * np.eye(2), (len(positions), 1, 1))
        belief = self._filter.predict(self.belief, DT, self._seen)
        self.belief, association = self._filter.update(belief, positions, noise, self._sensor, self._alone)
        self._seen = association.evidence > 1.0

    @property
    def mean(self) -> FloatArray:
        """See Peer."""
        return np.asarray(self.belief.combined[0][0])


@dataclass
class Contender:
    """What was measured of one: times per scan, and errors of the estimates after each (m and m/s)."""

    wall_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    errors: list[tuple[float, float]] = field(default_factory=list)

    def time(self, work: Callable[..., object], *arguments: object) -> None:
        """Do and clock one step."""
        cpu, wall = time.thread_time_ns(), time.perf_counter_ns()
        work(*arguments)
        self.wall_ms.append((time.perf_counter_ns() - wall) * 1.0e-6)
        self.cpu_ms.append((time.thread_time_ns() - cpu) * 1.0e-6)

    def rmse(self) -> tuple[float, float]:
        """Root of the mean square errors of position (m) and velocity (m/s)."""
        position, velocity = np.sqrt(np.mean(np.square(self.errors), axis=0))
        return float(position), float(velocity)


def follow(truth: Truth, sensor: SensorModel, seed: int, contenders: dict[str, Contender]) -> None:
    """Let all follow a car once; adds to what was measured of each. Where the car is lost, the error counts."""
    filter_, tracker = ImmPdaf(), OpponentTracker()
    peers: dict[str, Peer] = {}
    nearest: FloatArray = np.full(4, np.nan)
    for k, scan in enumerate(scans(truth, np.random.default_rng(seed), sensor, DEVIATION)):
        positions = scan.centre[:, :2]
        clocked = k >= COUNTED
        for name, peer in peers.items():
            if clocked:
                contenders[name].time(peer.step, positions)
                contenders[name].errors.append(_error(peer.mean, truth.state[k]))
            else:
                peer.step(positions)
        if clocked:
            contenders["tracker"].time(tracker.update, scan.time_us, scan, sensor)
            nearest = _nearest(tracker.objects(scan.time_us), truth.state[k], nearest)
            contenders["tracker"].errors.append(_error(nearest, truth.state[k]))
        else:
            tracker.update(scan.time_us, scan, sensor)
        if k == START:
            mean, covariance = _start(tracker.objects(scan.time_us), truth.state[k])
            peers["filter"] = OurFilter(filter_, sensor, mean, covariance)
            peers["filterpy"] = FilterpyImm(filter_, mean, covariance, DEVIATION, DT)
            if "Stone Soup" in contenders:
                # The one model has to cope with manoeuvres, as those of the others do.
                model = ConstantVelocity(acceleration_noise=5.0)
                gate = filter_.gate_probability
                peers["Stone Soup"] = StoneSoupPda(model, sensor, gate, mean, covariance, DEVIATION, DT)


def _error(estimate: FloatArray, truth: FloatArray) -> tuple[float, float]:
    off = estimate[:4] - truth[:4]
    return float(np.hypot(off[0], off[1])), float(np.hypot(off[2], off[3]))


def _start(objects: Iterable[TrackedObject], truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance (x, y, vx, vy, turn rate) of the object that follows the car."""
    car = min(objects, key=lambda each: np.hypot(each.x - truth[0], each.y - truth[1]))
    plane = np.ix_([0, 1, 3, 4, 5], [0, 1, 3, 4, 5])
    return np.array([car.x, car.y, car.vx, car.vy, car.yaw_rate]), car.covariance[plane]


def _nearest(objects: Iterable[TrackedObject], truth: FloatArray, before: FloatArray) -> FloatArray:
    """State of the object that follows the car; where none does, the last one, whose error grows."""
    states = [np.array([each.x, each.y, each.vx, each.vy]) for each in objects]
    near = [state for state in states if _error(state, truth)[0] < FOLLOWED]
    return min(near, key=lambda state: _error(state, truth)[0], default=before)


def names() -> list[str]:
    """Who takes part."""
    return ["filter", "tracker", "filterpy", *(["Stone Soup"] if stone_soup_is_there() else [])]


def measure(sensor: SensorModel, runs: int) -> dict[str, dict[str, Contender]]:
    """By manoeuvre and name, over seeded runs."""
    measured = {}
    for manoeuvre, drive in MANOEUVRES.items():
        measured[manoeuvre] = {name: Contender() for name in names()}
        truth = drive()
        for seed in range(runs):
            follow(truth, sensor, seed, measured[manoeuvre])
    return measured


def measure_prediction(track: Track, cars: int, steps: int) -> Contender:
    """Predict cars that are seen anew at each step."""
    predictor, contender = OpponentPredictor(track), Contender()
    for k in range(steps):
        objects = []
        for car in range(cars):
            x, y, yaw = track.pose_at(50.0 * car + 60.0 * DT * k, 2.0)
            vx, vy = 60.0 * np.cos(yaw), 60.0 * np.sin(yaw)
            zero = np.zeros((6, 6)), np.ones(3), np.ones(3), 1.0
            objects.append(TrackedObject(car, SCAN_US * k, SCAN_US * k, x, y, 0.0, vx, vy, yaw, 0.0, *zero))
        contender.time(predictor.step, SCAN_US * k, objects)
    return contender


def show_times(console: Console, title: str, rows: Iterable[tuple[str, Contender]]) -> None:
    """Print a table of times; the processor's are those that other programs on the machine do not lengthen."""
    table = Table(title, "mean", "median", "p99", "max", "mean, processor")
    for name, contender in rows:
        wall = contender.wall_ms
        values = (np.mean(wall), *np.percentile(wall, [50, 99, 100]), np.mean(contender.cpu_ms))
        table.add_row(name, *(f"{value:.3f}" for value in values))
    console.print(table)


def show_errors(console: Console, title: str, measured: dict[str, dict[str, Contender]]) -> bool:
    """Print a table of errors; tells whether both of ours are no worse than each peer over all manoeuvres."""
    table = Table(title, *names())
    for manoeuvre, contenders in measured.items():
        table.add_row(manoeuvre, *("{:.3f}  {:.2f}".format(*contenders[name].rmse()) for name in names()))
    overall = {name: _together(measured, name).rmse() for name in names()}
    table.add_row("all", *("{:.3f}  {:.2f}".format(*overall[name]) for name in names()))
    console.print(table)
    return all(overall[name][0] <= (1.0 + MARGIN) * overall[peer][0] for name in names()[:2] for peer in names()[2:])


def _together(measured: dict[str, dict[str, Contender]], name: str) -> Contender:
    together = Contender()
    for contenders in measured.values():
        together.wall_ms += contenders[name].wall_ms
        together.cpu_ms += contenders[name].cpu_ms
        together.errors += contenders[name].errors
    return together


def bench(console: Console, runs: int) -> bool:
    """Measure and print all; tells whether the targets were met."""
    follow(MANOEUVRES["turn"](), CLUTTER, 0, {name: Contender() for name in names()})  # warm up: imports, caches
    clutter, clean = measure(CLUTTER, runs), measure(CLEAN, runs)
    together = {name: _together(clutter, name) for name in names()}
    console.print(
        f"{len(MANOEUVRES)} manoeuvres, {runs} runs each, {len(together['filter'].wall_ms)} scans;"
        " one car, detected with 0.9, sigma 0.3 m, in 20 points of clutter per 100 m x 100 m"
    )
    show_times(console, "one scan, ms", together.items())
    track = load_track(load_scenario(DEFAULT_SCENARIO).track)
    show_times(
        console,
        "prediction of all, ms",
        [(f"{cars} cars", measure_prediction(track, cars, 100 * runs)) for cars in (1, 5)],
    )
    better = show_errors(console, "RMSE in clutter, m and m/s", clutter)
    equal = show_errors(console, "RMSE without clutter, m and m/s", clean)
    met = better and equal
    for name in ("filter", "tracker"):
        mean = float(np.mean(together[name].wall_ms))
        met &= mean < TARGET_MS
        verdict = "met" if mean < TARGET_MS else "missed"
        console.print(f"{name}: {mean:.3f} ms per scan in the mean (target {TARGET_MS:g}: {verdict})")
        for peer in names()[2:]:
            ratio = np.mean(together[peer].wall_ms) / mean
            console.print(f"  {peer} / {name}: {ratio:.1f}")
    verdict = "met" if better and equal else "missed"
    console.print(f"RMSE of the position over all manoeuvres no worse than the peers', to {MARGIN:.0%}: {verdict}")
    if not stone_soup_is_there():
        console.print("Stone Soup is not installed and took no part: pip install 'raceloop\\[peers]'")
    return met


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=10, metavar="N", help="seeded runs per manoeuvre (default: 10)")
    options = parser.parse_args(arguments)
    if options.runs < 1:
        parser.error(f"--runs is {options.runs}; must be at least 1")
    return ExitStatus.DONE if bench(Console(highlight=False), options.runs) else ExitStatus.MISSED


if __name__ == "__main__":
    sys.exit(main())
