"""Whether the estimate's covariance is true, and what a step costs: NEES and NIS over seeded runs, processor time.

::

    python -m tools.estimation_bench

Normalised squares of errors and innovations, averaged over the runs at each time, against the two-sided 95 % bounds
of chi-square (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4): first
with sensors that are what the filter assumes, then with the bench's, on a lap on paper and on the plant's. Beside the
localiser's cost that of filterpy's ExtendedKalmanFilter, one per receiver, on the same samples in turns.
"""

from __future__ import annotations

import argparse
import gc
import math
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import binom, chi2, t

from autonomy.estimation import VE, YAW, FilterTuning, GnssFilter, GnssSample, ImuSample, level
from autonomy.frenet import FloatArray
from autonomy.localisation import Localiser
from tools.estimation_peer import PlainLocaliser
from tools.estimation_scene import (
    LAP_S,
    TICK_S,
    TICK_US,
    Course,
    Road,
    Tick,
    assumed_sensors,
    bench_sensors,
    drive,
    on_paper,
    road,
    solo_lap,
)
from tools.exit_status import ExitStatus
from tools.scan_bench import Times

TARGET_MS = 0.3
INSIDE = 0.95
#: The share of time inside its bounds may leave its own once in so many studies.
ONCE_IN = 1000

#: What is looked at: rows of the error state, and how many they are.
PARTS = {
    "all 11": slice(0, 11),
    "position": slice(0, VE),
    "velocity": slice(VE, YAW),
    "heading": slice(YAW, 5),
}
INNOVATION, REPORTED = "innovation", "reported"


class Run(NamedTuple):
    """One run of a filter.

    Attributes
    ----------
    squares : normalised, at its epochs, shape (n,), by part.
    refused : epochs outside the gate.
    mean_squares : of the errors of position, m2, velocity, m2/s2, and heading, rad2.
    """

    squares: dict[str, FloatArray]
    refused: int
    mean_squares: tuple[float, float, float]


@dataclass(frozen=True)
class Consistency:
    """Normalised squares over runs.

    Attributes
    ----------
    degrees : of freedom; the mean to be expected.
    mean, low, high : over all times and runs, and the bounds of the average over the runs at one time.
    half_width : of the mean's 95 % interval, by Student's t from the scatter of the runs, which are independent.
    share : of the times at which the average is inside the bounds.
    effective : number of independent times that tell as much.
    far : the average is somewhere where that of a consistent filter, at any of the times, is once in `ONCE_IN` studies.
    """

    degrees: int
    mean: float
    half_width: float
    low: float
    high: float
    share: float
    effective: float
    far: bool

    @property
    def allowed(self) -> tuple[float, float]:
        """Least and largest share of a consistent filter, but for once in `ONCE_IN`."""
        return share_bounds(self.effective)

    @property
    def consistent(self) -> bool:
        """Whether the share is what it has to be, and no average is far off.

        The share alone would let errors pass that stay: a run with such tells as much as one time does, and one may be
        outside. The bounds of all times together need no independence (Bonferroni).
        """
        low, high = self.allowed
        return low <= self.share <= high and not self.far


def normalised(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Normalised squares: errors (n, k) by covariances (n, k, k), shape (n,)."""
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]))


def effective_times(squares: FloatArray) -> float:
    r"""How many independent times tell as much about the share inside as these.

    The average over many runs is nearly Gaussian; r_l be its correlation over l epochs, which is that of one run's.
    To be between two bounds is an even function of it: its Hermite series has no first term, so its own correlation
    is r_l^2 at most, and the variance of the share that of n / (1 + 2 \sum r_l^2) independent times at most.

    Parameters
    ----------
    squares : shape (runs, n); r_l is measured over runs and times, up to where it is lost in noise.
    """
    runs, count = squares.shape
    centred = squares - squares.mean(axis=0)
    power = float(np.mean(centred**2))
    total = 0.0
    for lag in range(1, count):
        correlation = float(np.mean(centred[:, lag:] * centred[:, :-lag])) / power
        if correlation < 2.0 / math.sqrt(runs * (count - lag)):
            break
        total += (1.0 - lag / count) * correlation**2
    return float(count / (1.0 + 2.0 * total))


def share_bounds(times: float) -> tuple[float, float]:
    """Bounds of the share of independent times inside 95 % bounds, from the binomial distribution."""
    whole = max(1, math.floor(times))
    low, high = (_quantile(binom, probability, whole, INSIDE) for probability in (0.5 / ONCE_IN, 1.0 - 0.5 / ONCE_IN))
    return low / whole, high / whole


def _quantile(distribution: Any, probability: float, *shape: float) -> float:
    return float(distribution.ppf(probability, *shape))


def consistency(squares: FloatArray, degrees: int) -> Consistency:
    """Judge normalised squares, shape (runs, n); two runs at least."""
    runs = len(squares)
    average = squares.mean(axis=0)
    low, high = (_quantile(chi2, 0.5 + side * INSIDE / 2, degrees * runs) / runs for side in (-1, 1))
    rare = 0.5 / ONCE_IN / len(average)
    least, most = (_quantile(chi2, probability, degrees * runs) / runs for probability in (rare, 1.0 - rare))
    return Consistency(
        degrees=degrees,
        mean=float(average.mean()),
        half_width=_quantile(t, 0.5 + INSIDE / 2, runs - 1) * float(squares.mean(axis=1).std(ddof=1)) / math.sqrt(runs),
        low=low,
        high=high,
        share=float(np.mean((average >= low) & (average <= high))),
        effective=effective_times(squares),
        far=bool(np.any((average < least) | (average > most))),
    )


def follow(
    states: FloatArray,
    samples: Sequence[tuple[ImuSample, GnssSample | None]],
    road_at: Road,
    tuning: FilterTuning | None = None,
) -> Run:
    """Let one filter follow the car.

    Parameters
    ----------
    states : true ones, tick by tick, as the filter orders them: all 11, or the five of the motion.
    samples : what is sensed of it, tick by tick.
    road_at : the map's bank and grade.
    """
    f = GnssFilter(tuning or FilterTuning())
    ticks, estimates, covariances, distances, refused = [], [], [], [], 0
    for k, (imu, gnss) in enumerate(samples):
        if f.started:
            f.predict(level(imu, *road_at(f.x, f.y)), TICK_S)
        if gnss is None:
            continue
        if not f.started:
            f.start(gnss)
            # Over no time: the first step then averages with the motion of this tick.
            f.predict(level(imu, *road_at(f.x, f.y)), 0.0)
            continue
        refused += not f.update(gnss)
        ticks.append(k)
        covariances.append(f.covariance)
        distances.append(f.distance)
        motion = (f.x, f.y, f.velocity_east, f.velocity_north, f.yaw)
        estimates.append((*motion, f.bias_ax, f.bias_ay, f.bias_yaw_rate, *f.drifts))
    count = states.shape[1]
    errors = states[ticks] - np.array(estimates)[:, :count]
    errors[:, YAW] = np.arctan2(np.sin(errors[:, YAW]), np.cos(errors[:, YAW]))
    covariance = np.array(covariances)
    squares = {
        name: normalised(errors[:, part], covariance[:, part, part])
        for name, part in PARTS.items()
        if part.stop <= count
    }
    place, velocity, yaw = (
        float(np.mean(np.sum(errors[:, PARTS[name]] ** 2, axis=1))) for name in ("position", "velocity", "heading")
    )
    return Run(squares | {INNOVATION: np.square(distances)}, refused, (place, velocity, yaw))


def reported(course: Course, ticks: Sequence[Tick]) -> FloatArray:
    """Squares of the position errors of the estimate that leaves, by its own deviation; every fifth tick."""
    localiser, squares = Localiser(course.road), []
    for k, tick in enumerate(ticks):
        estimate = localiser.step(k * TICK_US, *tick)
        if estimate is not None and k % 5 == 0 and k > 0:
            x, y = course.state[k, :2].tolist()
            squares.append(((estimate.x - x) ** 2 + (estimate.y - y) ** 2) / estimate.deviation**2)
    return np.array(squares)


def study(runs: Sequence[Run]) -> dict[str, Consistency]:
    """Judge each part over the runs."""
    degrees = {name: part.stop - part.start for name, part in PARTS.items()} | {INNOVATION: 5, REPORTED: 2}
    return {name: consistency(np.array([run.squares[name] for run in runs]), degrees[name]) for name in runs[0].squares}


def assumed_runs(seconds: float, seeds: Sequence[int], louder: float = 1.0) -> list[Run]:
    """Runs with sensors that are what the filter assumes, see `assumed_sensors`."""
    motion, tuning, runs = drive(seconds), FilterTuning(), []
    for seed in seeds:
        ticks, hidden = assumed_sensors(motion, tuning, np.random.default_rng(seed), louder)
        states = np.column_stack((motion.state, hidden))
        runs.append(follow(states, [(tick.imu, tick.gnss_a) for tick in ticks], road, tuning))
    return runs


def bench_runs(course: Course, seeds: Sequence[int]) -> tuple[list[Run], list[Run]]:
    """Runs with the bench's sensors: of receiver A's filter, with the estimate's errors, and of receiver B's."""
    both = []
    for seed in seeds:
        ticks = bench_sensors(course, seed)
        a = follow(course.state, [(tick.imu, tick.gnss_a) for tick in ticks], course.road)
        b = follow(course.state, [(tick.imu, tick.gnss_b) for tick in ticks], course.road)
        a.squares[REPORTED] = reported(course, ticks)
        both.append((a, b))
    return [a for a, _ in both], [b for _, b in both]


def show_study(console: Console, title: str, runs: Sequence[Run]) -> bool:
    """Print a table; tells whether every part is consistent."""
    console.print(f"{title}: {len(runs[0].squares[INNOVATION])} epochs, {sum(run.refused for run in runs)} refused")
    table = Table("NEES, NIS", "dof", "mean", "bounds", "in %", "allowed", "times")
    for column in table.columns[1:]:
        column.justify, column.no_wrap = "right", True
    results = study(runs)
    for name, one in results.items():
        least, most = one.allowed
        table.add_row(
            name,
            str(one.degrees),
            f"{one.mean:.2f} ± {one.half_width:.2f}",
            f"{one.low:.2f} {one.high:.2f}",
            f"{100 * one.share:.1f}",
            f"{100 * least:.1f} {100 * most:.1f}",
            f"{one.effective:.0f}",
        )
    console.print(table)
    place, velocity, yaw = np.sqrt(np.mean([run.mean_squares for run in runs], axis=0))
    console.print(f"RMS: position {place:.4f} m, velocity {velocity:.4f} m/s, heading {yaw:.5f} rad")
    failed = [name for name, one in results.items() if not one.consistent]
    console.print(f"Consistent: {'all but ' + ', '.join(failed) if failed else 'yes'}")
    return not failed


def measure(laps: int, seed: int) -> tuple[list[Times], list[float]]:
    """Times of the localiser and of the plain filters, step by step in turns, and their ratio lap by lap."""
    course = on_paper(LAP_S)
    times, ratios = [Times("Localiser.step"), Times("plain filterpy")], []
    for lap in range(laps + 1):
        ticks = bench_sensors(course, seed + lap)
        localiser, plain = Localiser(road), PlainLocaliser(road)
        this = [Times(one.name) for one in times]
        gc.collect()
        gc.disable()
        for k, tick in enumerate(ticks):
            works: list[tuple[Times, Callable[..., object], tuple[object, ...]]] = [
                (this[0], localiser.step, (k * TICK_US, *tick)),
                (this[1], plain.step, tuple(tick)),
            ]
            for one, work, arguments in works if k % 2 else reversed(works):
                one.take(work, *arguments)
        gc.enable()
        if lap:  # the first one warms up
            for one, more in zip(times, this, strict=True):
                one.cpu += more.cpu
                one.wall += more.wall
            ratios.append(statistics.mean(this[1].cpu) / statistics.mean(this[0].cpu))
    return times, ratios


def show_times(console: Console, times: Sequence[Times], ratios: Sequence[float]) -> bool:
    """Print the table; tells whether the target was met."""
    table = Table("a step, ms of the processor", "mean", "median", "p99", "max")
    for column in table.columns[1:]:
        column.justify = "right"
    for one in times:
        values = (statistics.mean(one.cpu), *np.percentile(one.cpu, [50, 99, 100]))
        table.add_row(one.name, *(f"{value:.3f}" for value in values))
    console.print(table)
    mean = statistics.mean(times[0].cpu)
    console.print(
        f"plain filterpy / Localiser.step, lap by lap: min {min(ratios):.2f}, median {statistics.median(ratios):.2f},"
        f" max {max(ratios):.2f}"
    )
    met = mean < TARGET_MS
    console.print(f"Localiser.step: {mean:.3f} ms in the mean (target {TARGET_MS:g}: {'met' if met else 'missed'})")
    return met


#: Default, least value and meaning of each option.
_OPTIONS = {
    "runs": (100, 2, "of each study"),
    "seconds": (round(LAP_S), 1, "that a run lasts"),
    "seed": (1, 0, "of the first run, the others follow"),
    "laps": (5, 1, "that are clocked"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    for name, (default, _, what) in _OPTIONS.items():
        parser.add_argument(f"--{name}", type=int, default=default, metavar="N", help=f"{what} (default: {default})")
    options = parser.parse_args(arguments)
    for name, (_, least, _) in _OPTIONS.items():
        if getattr(options, name) < least:
            parser.error(f"--{name} is {getattr(options, name)}; must be at least {least}")
    console = Console(highlight=False)
    seeds = range(options.seed, options.seed + options.runs)
    console.print(f"{options.runs} runs of {options.seconds} s, seeds {seeds[0]} to {seeds[-1]}")
    consistent = [show_study(console, "Sensors as the filter assumes", assumed_runs(options.seconds, seeds))]
    for name, runs in zip("AB", bench_runs(on_paper(options.seconds), seeds), strict=True):
        consistent.append(show_study(console, f"The bench's sensors, receiver {name}", runs))
    # The road is the map's and the plant is the filter's model only nearly: printed, not judged.
    for name, runs in zip("AB", bench_runs(solo_lap(options.seconds), seeds), strict=True):
        show_study(console, f"The bench's sensors on the solo lap, receiver {name}", runs)
    console.print(
        f"{options.laps} laps of {LAP_S:g} s with the bench's sensors, IMU at 100 Hz, both receivers at 20 Hz"
    )
    quick = show_times(console, *measure(options.laps, options.seed))
    return ExitStatus.DONE if all(consistent) and quick else ExitStatus.MISSED


if __name__ == "__main__":
    sys.exit(main())
