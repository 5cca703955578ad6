"""`raceloop bench`: this loop and the plain loop side by side, in pairs, on the same stretch of the same scenario.

Machines are noisy, so what counts is the ratio within a pair, and its spread; the two loops take turns.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from autonomy.track_files import load_track
from bridge.bench import Bench
from bridge.interfaces import Autonomy, Road
from bridge.scenario import Condition, Scenario, load_scenario
from bridge.surroundings import TICK_US
from tools.check_bench import bench_check
from tools.plain_loop import PlainLoop
from tools.run import DEFAULT_SCENARIO, build_bench, make_autonomy

TARGET_RATIO = 10.0
TARGET_REAL_TIME = 30.0

#: Pairs of the checker and its peer, which takes some ten seconds each.
CHECK_REPEATS = 3


@dataclass(frozen=True)
class Pair:
    """Wall time per tick of both loops over the same stretch, s, and of the parts of this one."""

    ours: float
    plain: float
    plant: float
    autonomy: float
    frames_per_tick: float
    plain_frames_per_tick: float


def measure(scenario: Scenario, simulated_s: float) -> Pair:
    """Run both loops from power-on for a stretch and time it.

    Raises
    ------
    RaceloopError
        When a file of the scenario is wrong.
    """
    ticks = round(simulated_s * 1e6 / TICK_US)
    with build_bench(scenario) as bench:
        ours = _time(lambda: _finish(bench, simulated_s)) / ticks
        frames = sum(bus.frames for bus in bench.network.statistics().values())
        plant = _time_plant(bench, ticks) / ticks
    clocks: list[_ClockedAutonomy] = []
    with Bench.from_scenario(scenario, load_track, lambda *of: _clock(clocks, *of)) as bench:
        _finish(bench, simulated_s)
    autonomy = clocks[0].spent_s / ticks
    road = load_track(scenario.track)
    with PlainLoop(scenario, road, make_autonomy(scenario, road)) as loop:
        plain = (_time(lambda: _repeat(loop.tick, ticks)) - loop.unpacking_s) / ticks
        plain_frames = loop.frames
    return Pair(ours, plain, plant, autonomy, frames / ticks, plain_frames / ticks)


def _finish(bench: Bench, simulated_s: float) -> None:
    bench.run(until=Condition(time_us=round(simulated_s * 1e6)))


def _repeat(tick: Callable[[], None], ticks: int) -> None:
    for _ in range(ticks):
        tick()


def _time(stretch: Callable[[], None]) -> float:
    # What the other loop left in memory must not make this one's garbage collections slower.
    gc.collect()
    gc.freeze()
    started = time.perf_counter()
    stretch()
    elapsed = time.perf_counter() - started
    gc.unfreeze()
    return elapsed


def _time_plant(bench: Bench, ticks: int) -> float:
    """The floor under any loop: the FMU alone, from where the run left it."""
    started = time.perf_counter()
    for number in range(ticks):
        bench.plant.step(bench.now_us * 1e-6 + number * TICK_US * 1e-6, TICK_US * 1e-6)
    return time.perf_counter() - started


class _ClockedAutonomy:
    """Autonomy with a clock around it, for a run of its own: clocking costs time too."""

    def __init__(self, autonomy: Autonomy) -> None:
        self._autonomy = autonomy
        self.spent_s = 0.0

    def tick(self, now_us: int, frames: bytes, cloud: NDArray[np.float32] | None = None) -> bytes:
        started = time.perf_counter()
        out = self._autonomy.tick(now_us, frames, cloud)
        self.spent_s += time.perf_counter() - started
        return out


def _clock(clocks: list[_ClockedAutonomy], scenario: Scenario, road: Road) -> Autonomy:
    clocks.append(_ClockedAutonomy(make_autonomy(scenario, road)))
    return clocks[-1]


def bench(console: Console, repeats: int, simulated_s: float) -> int:
    """Print the tables; returns 0 when the targets are met, else 1."""
    scenario = load_scenario(DEFAULT_SCENARIO)
    measure(scenario, min(1.0, simulated_s))  # warm up: imports, caches, page faults
    pairs = [measure(scenario, simulated_s) for _ in range(repeats)]
    console.print(
        f"{scenario.name}: the first {simulated_s:g} s, {repeats} pairs, without recording,"
        f" {statistics.median(pair.frames_per_tick for pair in pairs):.1f} frames per tick"
        f" (plain loop {statistics.median(pair.plain_frames_per_tick for pair in pairs):.1f})"
    )
    tick_s = TICK_US * 1e-6
    table = Table()
    for heading in ("per tick", "min us", "median us", "max us", "times real time"):
        table.add_column(heading, justify="left" if heading == "per tick" else "right")
    for name, times in (
        ("this loop", [pair.ours for pair in pairs]),
        ("  of it autonomy", [pair.autonomy for pair in pairs]),
        ("  of it the FMU", [pair.plant for pair in pairs]),
        ("plain loop", [pair.plain for pair in pairs]),
    ):
        median = statistics.median(times)
        table.add_row(
            name, f"{min(times) * 1e6:.0f}", f"{median * 1e6:.0f}", f"{max(times) * 1e6:.0f}", f"{tick_s / median:.1f}"
        )
    console.print(table)
    ratios = [pair.plain / pair.ours for pair in pairs]
    real_time = [tick_s / pair.ours for pair in pairs]
    met = True
    for name, values, target in (
        ("plain loop / this loop", ratios, TARGET_RATIO),
        ("times real time", real_time, TARGET_REAL_TIME),
    ):
        median = statistics.median(values)
        met &= median >= target
        console.print(
            f"{name}: min {min(values):.1f}, median {median:.1f}, max {max(values):.1f}"
            f" (target {target:g}: {'met' if median >= target else 'missed'})"
        )
    met &= bench_check(scenario, min(repeats, CHECK_REPEATS), console)
    return 0 if met else 1
