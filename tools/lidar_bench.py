"""Benchmark of the spatial LiDAR: what a merged scan costs, beside the same beams in numpy (tools/lidar_scene.py).

Times are those of the processor, so that what else runs on the machine is not counted.
"""

from __future__ import annotations

import gc
import math
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.table import Table

from autonomy.frenet import FloatArray
from autonomy.track import Track
from autonomy.track_files import load_track
from bridge.sensors.lidar import AXLE_HEIGHT, MOUNTS
from bridge.sensors.spatial_lidar import BeamPattern, Motion, SpatialLidar
from bridge.sensors.surfaces import ASPHALT, track_mesh
from dbc.errors import RaceloopError
from scenarios import DIRECTORY
from tools.exit_status import ExitStatus
from tools.lidar_scene import COLUMNS, ELEVATION_DEG, LINES, LidarScene
from tools.scan_bench import LATERAL, Times, parse, scenes

TARGET_MS = 3.0  # mean
SPEED = 60.0  # m/s, of all cars
RANGE_MAX = 220.0  # m, as far as numpy looks

#: Runs of ours for one of the reference.
_RUNS = 20


@dataclass
class Measurement:
    """What was measured.

    Attributes
    ----------
    scan, same, numpy : times of all scans.
    points : of each scan.
    ratios : how many times as long numpy takes for the same beams, scan by scan.
    off : of each beam, m, how far off the reference it ends; across the surface, which the beam may graze.
    missed : beams of which only one of the two says that they meet anything.
    """

    scan: Times = field(default_factory=lambda: Times("SpatialLidar.scan"))
    same: Times = field(default_factory=lambda: Times("  beams of numpy"))
    numpy: Times = field(default_factory=lambda: Times("numpy"))
    points: list[int] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    off: list[float] = field(default_factory=list)
    missed: int = 0


def driving(track: Track, station: float, lateral: float, speed: float) -> Motion:
    """A car that drives parallel to the road, from the middle of its rear axle or outline on the ground."""
    x, y, yaw = track.pose_at(station, lateral)
    bank, _ = track.road_at_station(station)
    curvature = float(track.centre.at(np.array([station]))[3][0])
    turn = speed * curvature / (1.0 - curvature * lateral)
    rate = (0.0, -turn * math.sin(bank), turn * math.cos(bank))
    return Motion(x, y, -lateral * math.tan(bank), yaw, 0.0, -bank, (speed, 0.0, 0.0), rate)


def measure(track: Track, scans: int, rounds: int) -> Measurement:
    """Take scans all around the lap, `rounds` times over; the first round warms up and is not counted."""
    scene = LidarScene(track)
    meshes = [track_mesh(track, step=step, fence=True) for step in (4, 4, 1)]
    low, high = map(math.radians, ELEVATION_DEG)
    beams = BeamPattern(columns=COLUMNS, lines=LINES, elevation=(low, high), range_max=RANGE_MAX)
    model, same, exact = (
        SpatialLidar(mesh, np.random.default_rng(0), origin=(0.0, 0.0, -AXLE_HEIGHT), pattern=pattern)
        for mesh, pattern in zip(meshes, (BeamPattern(), beams, beams), strict=True)
    )
    result = Measurement()
    for number in range(rounds + 1):
        if number == 1:
            result = Measurement()
        gc.collect()
        gc.disable()
        for index, (station, others) in enumerate(scenes(track, scans)):
            fast, still = (
                [driving(track, *place, speed) for place in ((station, LATERAL), *others)] for speed in (SPEED, 0.0)
            )
            for _ in range(_RUNS):
                result.points.append(len(result.scan.take(model.scan, fast[0], fast[1:]).cloud))
                result.same.take(same.scan, fast[0], fast[1:])
            result.numpy.take(scene.scan, station, LATERAL, others, index)
            result.ratios.append(result.numpy.cpu[-1] / statistics.mean(result.same.cpu[-_RUNS:]))
            if number == rounds:
                _compare(result, exact.cast(still[0], still[1:]), scene.cast(station, LATERAL, others)[0])
        gc.enable()
    return result


def _compare(result: Measurement, ours: tuple[FloatArray, FloatArray], reference: FloatArray) -> None:
    """Add how far the beams of one scan end from where the reference has them end."""
    ranges, echoes = (values.ravel() for values in ours)
    seen, there = np.isfinite(ranges), np.isfinite(reference)
    result.missed += int(np.count_nonzero(seen != there))
    both = seen & there
    # No surface reflects less than asphalt, so that this is at least the sine of the incidence.
    result.off.extend((np.abs(ranges[both] - reference[both]) * echoes[both] / ASPHALT).tolist())


def show(console: Console, result: Measurement, scans: int) -> bool:
    """Print the table; returns whether the target is met."""
    points = f"{min(result.points)} to {max(result.points)} points"
    console.print(f"{scans} scans around the lap at {SPEED:g} m/s, {len(MOUNTS)} LiDARs: {points}")
    table = Table()
    table.add_column("ms per merged scan", no_wrap=True)
    for heading in ("min", "mean", "p99", "max", "wall mean", "wall max", "runs"):
        table.add_column(heading, justify="right")
    for times in (result.scan, result.same, result.numpy):
        cpu, wall = np.array(times.cpu), np.array(times.wall)
        figures = (cpu.min(), cpu.mean(), np.percentile(cpu, 99), cpu.max(), wall.mean(), wall.max())
        cells = (f"{value:.2f}" if value < 100.0 else f"{value:.0f}" for value in figures)
        table.add_row(times.name, *cells, str(len(cpu)))
    console.print(table)
    mean = statistics.mean(result.scan.cpu)
    met = mean < TARGET_MS
    console.print(f"mean ms: {mean:.2f} (target below {TARGET_MS:g}: {'met' if met else 'missed'})")
    low, median, high = min(result.ratios), statistics.median(result.ratios), max(result.ratios)
    console.print(f"numpy / the same beams: min {low:.0f}, median {median:.0f}, max {high:.0f}")
    median, most = np.percentile(np.array(result.off) * 1e3, (50.0, 99.9))
    console.print(
        f"off numpy's surfaces: median {median:.2f} mm, 99.9% within {most:.2f} mm;"
        f" {result.missed} of {len(result.off) + result.missed} beams meet something in one of the two only"
    )
    return met


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    options = parse(__doc__, 3, arguments)
    try:
        track = load_track(DIRECTORY / "tracks" / "lvms.yaml")
    except RaceloopError as error:
        print(f"lidar_bench: {error}", file=sys.stderr)
        return ExitStatus.USER_ERROR
    console = Console(highlight=False)
    met = show(console, measure(track, options.scans, options.rounds), options.scans)
    return ExitStatus.DONE if met else ExitStatus.MISSED


if __name__ == "__main__":
    sys.exit(main())
