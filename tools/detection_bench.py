"""Time detection on synthetic scans, beside what one would write with numpy, scipy and scikit-learn.

::

    python -m tools.detection_bench

Every scan is filtered and clustered some times here, then once by the peers, on the same data. Times are those of the
processor, so that what else runs on the machine is not counted; those of the wall clock stand beside them.
"""

from __future__ import annotations

import gc
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from autonomy.detection.cloud import POINTS_MAX, RANGE, Cloud, DetectionStatus, Pose
from autonomy.detection.clustering import Clustering, ClusteringConfig
from autonomy.detection.detector import Detector
from autonomy.detection.geofence import Geofence
from autonomy.detection.ground_filter import GroundConfig, GroundFilter
from autonomy.track import Track
from autonomy.track_files import load_track
from dbc.errors import RaceloopError
from scenarios import DIRECTORY
from tools.boundary_mismatch import FOUND_M, MISMATCHES, Mismatch, evaluate, make_drives
from tools.exit_status import ExitStatus
from tools.lidar_scene import LidarScene, Scan
from tools.scan_bench import LATERAL, Times, parse, scenes

TARGET_FILTER_MS = 1.0  # mean of geofence and ground filter together
TARGET_CLUSTERING_MS = 2.0  # mean
TARGET_CLUSTERING_MAX_MS = 10.0
TARGET_RATIO = 10.0  # DBSCAN over clustering, median

_RANGES_M = ((0, 25), (25, 50), (50, 80))

#: Runs of ours for one of the peers.
_RUNS = 20


class PlainGeofence:
    """The geofence with a k-d tree of the centre line."""

    def __init__(self, track: Track, margin: float) -> None:
        from scipy.spatial import cKDTree  # noqa: PLC0415

        line = track.centre
        self._line = np.column_stack((line.x, line.y))
        self._tree = cKDTree(self._line)
        self._normal = np.column_stack((-np.sin(line.heading), np.cos(line.heading)))
        self._left, self._right = track.width_left - margin, track.width_right - margin

    def apply(self, cloud: Cloud, pose: Pose) -> Cloud:
        """Points on the track."""
        from scipy.spatial.transform import Rotation  # noqa: PLC0415

        cloud = cloud[(np.abs(cloud) < RANGE).all(axis=1)]
        turned = Rotation.from_euler("ZYX", [pose.yaw, pose.pitch, pose.roll]).apply(cloud.astype(float))
        place = turned[:, :2] + [pose.x, pose.y]
        _, node = self._tree.query(place)
        lateral = np.einsum("ij,ij->i", place - self._line[node], self._normal[node])
        return np.asarray(cloud[(lateral < self._left[node]) & (-lateral < self._right[node])])


def plain_ground_filter(cloud: Cloud, config: GroundConfig) -> Cloud:
    """The ground filter with numpy's sorting."""
    column, row = np.floor(cloud[:, :2].T / config.cell_size).astype(np.int64)
    key = row * 100_000 + column
    order = np.lexsort((cloud[:, 2], key))
    sorted_key = key[order]
    starts = np.flatnonzero(np.concatenate(([True], np.diff(sorted_key) > 0))) if len(cloud) else np.empty(0, int)
    sizes = np.diff(np.append(starts, len(cloud)))
    low, high = cloud[order[starts]], cloud[order[starts + sizes - 1]]
    reach = np.hypot(high[:, 0] - low[:, 0], high[:, 1] - low[:, 1])
    slope = np.tan(np.radians(config.slope_max_deg))
    is_object = (sizes > config.points_threshold) & (high[:, 2] - low[:, 2] - slope * reach > config.height_threshold)
    places = order[np.repeat(is_object, sizes)]
    points, low = cloud[places], np.repeat(low[is_object], sizes[is_object], axis=0)
    height = points[:, 2] - low[:, 2] - slope * np.hypot(*(points - low)[:, :2].T)
    few = np.repeat(sizes[is_object] <= config.foot_points, sizes[is_object])
    return np.asarray(cloud[np.sort(places[few | (height > config.height_threshold)])])


def plain_filters(geofence: PlainGeofence, cloud: Cloud, pose: Pose, config: GroundConfig) -> Cloud:
    """Both filters."""
    return plain_ground_filter(geofence.apply(cloud, pose), config)


def plain_clustering(cloud: Cloud, distance: float) -> NDArray[np.int64]:
    """Labels by scikit-learn's DBSCAN, which with one point to a core is the same as single linkage."""
    from sklearn.cluster import DBSCAN  # noqa: PLC0415

    return np.asarray(DBSCAN(eps=distance, min_samples=1).fit(cloud[:, :2]).labels_)


def stubborn_cloud() -> Cloud:
    """As many points as clustering takes where its boxes tell nothing, so that it has to try all pairs of them."""
    count = 2890
    one, other = ((0.1, 0.555), (0.5, 0.02)), ((1.05, 1.13), (0.57, 1.67))
    rows = [near for near, _ in (one, other) for _ in range(count)] + [far for _, far in (one, other)]
    return np.column_stack((np.array(rows), np.zeros(len(rows)))).astype(np.float32)


def make_scans(track: Track, count: int) -> list[Scan]:
    """Scans from all around the lap."""
    scene = LidarScene(track)
    scans = []
    for number, (station, cars) in enumerate(scenes(track, count)):
        scans.append(scene.scan(station, LATERAL, cars, seed=number))
    return scans


@dataclass
class Measurement:
    """All times, the sizes of the clouds, and how many times as long DBSCAN takes, scan by scan."""

    filters: Times = field(default_factory=lambda: Times("both filters"))
    geofence: Times = field(default_factory=lambda: Times("  geofence"))
    ground: Times = field(default_factory=lambda: Times("  ground filter"))
    clustering: Times = field(default_factory=lambda: Times("clustering"))
    step: Times = field(default_factory=lambda: Times("Detector.step"))
    unfenced: Times = field(default_factory=lambda: Times("  with walls"))
    stubborn: Times = field(default_factory=lambda: Times("  stubborn"))
    scattered: Times = field(default_factory=lambda: Times("  scattered"))
    plain_filters: Times = field(default_factory=lambda: Times("numpy, scipy"))
    dbscan: Times = field(default_factory=lambda: Times("DBSCAN"))
    raw: list[int] = field(default_factory=list)
    fenced: list[int] = field(default_factory=list)
    raised: list[int] = field(default_factory=list)
    walls: list[int] = field(default_factory=list)
    filter_ratios: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)


def measure(track: Track, scans: Sequence[Scan], rounds: int) -> Measurement:
    """Measure everything on every scan, `rounds` times over; the first round warms up and is not counted."""
    geofence, ground, clustering = Geofence(track), GroundFilter(), Clustering()
    detector = Detector(track)
    plain_geofence = PlainGeofence(track, geofence.margin)
    room = np.empty_like(scans[0].cloud, shape=(max(len(scan.cloud) for scan in scans), 3))
    stubborn = stubborn_cloud()
    scattered = np.random.default_rng(0).uniform(-100.0, 100.0, (POINTS_MAX, 3)).astype(np.float32)
    result = Measurement()
    for number in range(rounds + 1):
        if number == 1:
            result = Measurement()
        gc.collect()
        gc.disable()
        for scan in scans:
            cloud, pose = scan.cloud, scan.pose
            for _ in range(_RUNS):
                inside, fence = result.geofence.take(geofence.apply, cloud, pose, room)
                raised, _ = result.ground.take(ground.apply, inside, room)
                result.clustering.take(clustering.apply, raised)
                result.step.take(detector.step, cloud, pose)
            for of in ("cpu", "wall"):
                parts = (getattr(result.geofence, of)[-_RUNS:], getattr(result.ground, of)[-_RUNS:])
                getattr(result.filters, of).extend(a + b for a, b in zip(*parts, strict=True))
            plain = result.plain_filters.take(plain_filters, plain_geofence, cloud, pose, ground.config)
            result.filter_ratios.append(result.plain_filters.cpu[-1] / statistics.mean(result.filters.cpu[-_RUNS:]))
            if len(raised):
                labels = result.dbscan.take(plain_clustering, raised, clustering.config.link_distance)
                result.ratios.append(result.dbscan.cpu[-1] / statistics.mean(result.clustering.cpu[-_RUNS:]))
                _compare(raised, labels, clustering.config.link_distance)
            # A point on the edge of fence or cell may go either way, and decide for those in its cell.
            assert abs(len(plain) - len(raised)) <= 0.02 * len(raised) + 20
            walls, _ = ground.apply(cloud)
            found = result.unfenced.take(clustering.apply, walls)
            assert found.status is not DetectionStatus.TOO_DENSE
            assert result.stubborn.take(clustering.apply, stubborn).status is DetectionStatus.OK
            assert result.scattered.take(clustering.apply, scattered).status is DetectionStatus.OK
            result.raw.append(len(cloud))
            result.fenced.append(fence.kept)
            result.raised.append(len(raised))
            result.walls.append(len(walls))
        gc.enable()
    return result


def _compare(cloud: Cloud, labels: NDArray[np.int64], distance: float) -> None:
    """DBSCAN has to find what the first step of ours finds."""
    first_step = Clustering(ClusteringConfig(distance, 1, distance, distance)).apply(cloud)
    pairs = set(zip(labels.tolist(), first_step.labels.tolist(), strict=True))
    assert len(pairs) == len(set(labels.tolist())) == len(first_step.objects)


def show(console: Console, result: Measurement, scans: int) -> bool:
    """Print the tables; returns whether the targets are met."""
    console.print(
        f"{scans} scans around the lap: {statistics.median(result.raw):.0f} points, inside the geofence"
        f" {min(result.fenced)} to {max(result.fenced)}, without ground {min(result.raised)} to {max(result.raised)},"
        f" with the walls {min(result.walls)} to {max(result.walls)}"
    )
    table = Table()
    table.add_column("ms per scan", no_wrap=True)
    for heading in ("min", "mean", "p99", "max", "wall mean", "wall max", "runs"):
        table.add_column(heading, justify="right")
    for times in (
        *(result.filters, result.geofence, result.ground),
        *(result.clustering, result.unfenced, result.stubborn, result.scattered),
        *(result.step, result.plain_filters, result.dbscan),
    ):
        cpu, wall = np.array(times.cpu), np.array(times.wall)
        figures = (cpu.min(), cpu.mean(), np.percentile(cpu, 99), cpu.max(), wall.mean(), wall.max())
        table.add_row(times.name, *(f"{value:.2f}" for value in figures), str(len(cpu)))
    console.print(table)
    met = True
    for name, value, target in (
        ("geofence + ground filter, mean ms", statistics.mean(result.filters.cpu), TARGET_FILTER_MS),
        ("clustering, mean ms", statistics.mean(result.clustering.cpu), TARGET_CLUSTERING_MS),
        ("clustering, max ms", max(result.clustering.cpu), TARGET_CLUSTERING_MAX_MS),
    ):
        met &= value < target
        console.print(f"{name}: {value:.2f} (target below {target:g}: {'met' if value < target else 'missed'})")
    median = statistics.median(result.ratios)
    met &= median >= TARGET_RATIO
    console.print(
        f"DBSCAN / clustering: {_spread(result.ratios)}"
        f" (target {TARGET_RATIO:g}: {'met' if median >= TARGET_RATIO else 'missed'})"
    )
    console.print(f"numpy, scipy / geofence + ground filter: {_spread(result.filter_ratios)}")
    return met


def show_quality(console: Console, track: Track, scans: Sequence[Scan]) -> None:
    """Print which cars are found, and how far the middle of each is from where it is."""
    detector = Detector(track)
    errors: dict[int, list[float]] = {place: [] for place in range(len(_RANGES_M))}
    others = 0
    for scan in scans:
        centres = detector.step(scan.cloud, scan.pose).cars.centre
        apart = np.hypot(*(centres[:, None, :] - scan.cars[None, :, :2]).transpose(2, 0, 1))
        others += int(np.count_nonzero(apart.min(axis=1, initial=np.inf) > FOUND_M))
        for car, distance in enumerate(np.hypot(scan.cars[:, 0], scan.cars[:, 1]).tolist()):
            place = next(i for i, (_, end) in enumerate(_RANGES_M) if distance < end)
            errors[place].append(float(apart[:, car].min(initial=np.inf)))
    table = Table("cars at, m", "there", "found", "median m off", "max m off")
    for place, (start, end) in enumerate(_RANGES_M):
        found = [error for error in errors[place] if error <= FOUND_M]
        figures = (f"{statistics.median(found):.2f}", f"{max(found):.2f}") if found else ("-", "-")
        table.add_row(f"{start} to {end}", str(len(errors[place])), str(len(found)), *figures)
    for column in table.columns[1:]:
        column.justify = "right"
    console.print(table)
    console.print(f"objects that are no car: {others}")


def show_mismatches(console: Console, track: Track, places: int, mismatches: Sequence[Mismatch] = MISMATCHES) -> None:
    """Print what wrong boundaries and poses do to detection, without and with the estimate of the boundary."""
    drives = make_drives(LidarScene(track), places)
    table = Table("boundary or pose off by", "estimate")
    for heading in ("false per scan", "as cars", "confirmed", "cars found", "confirmed"):
        table.add_column(heading, justify="right")
    extra: list[float] = []
    for mismatch in mismatches:
        plain, solved = (evaluate(track, mismatch, drives, estimating) for estimating in (False, True))
        extra += [b - a for a, b in zip(plain.cpu_ms, solved.cpu_ms, strict=True)]
        for estimate, score in (("without", plain), ("with", solved)):
            table.add_row(
                mismatch.name if score is plain else "",
                estimate,
                *(f"{n / score.scans:.3f}" for n in (score.false, score.false_fitting, score.false_confirmed)),
                f"{score.found} of {score.cars}",
                f"{score.confirmed} of {score.cars_again}",
            )
    console.print(f"{sum(map(len, drives))} scans at {places} places around the lap, cars nearer than 50 m:")
    console.print(table)
    low, median, high = np.percentile(extra, (5, 50, 95))
    console.print(
        f"estimate, ms more per scan (processor): mean {statistics.mean(extra):.2f}, median {median:.2f},"
        f" 5 to 95 % {low:.2f} to {high:.2f}"
    )


def _spread(values: list[float]) -> str:
    return f"min {min(values):.1f}, median {statistics.median(values):.1f}, max {max(values):.1f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    options = parse(__doc__, 5, arguments)
    try:
        import sklearn.cluster  # noqa: F401, PLC0415

        track = load_track(DIRECTORY / "tracks" / "lvms.yaml")
    except ImportError:
        print("detection_bench: scikit-learn is not installed: pip install 'raceloop[bench]'", file=sys.stderr)
        return ExitStatus.USER_ERROR
    except RaceloopError as error:
        print(f"detection_bench: {error}", file=sys.stderr)
        return ExitStatus.USER_ERROR
    console = Console(highlight=False)
    scans = make_scans(track, options.scans)
    show_quality(console, track, scans)
    show_mismatches(console, track, options.scans)
    met = show(console, measure(track, scans, options.rounds), options.scans)
    return ExitStatus.DONE if met else ExitStatus.MISSED


if __name__ == "__main__":
    sys.exit(main())
