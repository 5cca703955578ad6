"""Evaluate LiDAR alone, radar alone and both fused, by distance, on synthetic scenes of the Las Vegas oval.

::

    python -m tools.fusion_bench

One car ahead in each scene. The LiDARs' scan is that of `tools.lidar_scene`; the radar has watched the car for some
scans before, so that its tracks are as old as they would be. An object is true when its middle is near the car's; of
several, the most credible one counts and the others are false.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from autonomy.detection.cloud import Pose
from autonomy.detection.detector import Detector
from autonomy.detection.fusion import Fusion, FusionConfig, SensorObjects
from autonomy.detection.radar import OwnMotion, RadarConfig, RadarDetector
from autonomy.detection.road_objects import RoadObjects, lidar_objects, no_objects
from autonomy.frenet import FloatArray
from autonomy.track import Track
from autonomy.track_files import load_track
from bridge.sensors.radar import MOUNT_X, PERIOD_US, Radar
from bridge.sensors.radar_scene import OtherCar
from bridge.sensors.truth import Truth
from dbc.errors import RaceloopError
from scenarios import DIRECTORY
from tools.exit_status import ExitStatus
from tools.lidar_scene import LidarScene

#: The paper's bins, m.
BINS_M = ((0, 50), (50, 100), (100, 120))
#: How near to a car's middle an object's has to be, m: the gate in which TUM's tracker matches.
MATCH_M = 5.0
SOURCES = ("LiDAR", "radar", "fused")

_OWN_SPEED, _CAR_SPEED = 60.0, 55.0  # m/s
_OWN_LATERAL = -1.0  # m
_RADAR_SCANS = 12
_NEAREST_M, _FARTHEST_M = 8.0, 120.0


@dataclass(frozen=True)
class Sample:
    """One scene: middle of the car, shape (2,), m, and the objects of each source, in one vehicle frame."""

    car: FloatArray
    objects: dict[str, RoadObjects]


@dataclass
class Score:
    """What a source made of the scenes of one bin.

    Attributes
    ----------
    cars : that were there.
    errors : m, of those that were found.
    verdicts : confidence of every object, and whether it is true.
    """

    cars: int = 0
    errors: list[float] = field(default_factory=list)
    verdicts: list[tuple[float, bool]] = field(default_factory=list)

    @property
    def recall(self) -> float:
        """Found of those that were there."""
        return len(self.errors) / self.cars if self.cars else 0.0

    @property
    def precision(self) -> float:
        """True objects of all."""
        return len(self.errors) / len(self.verdicts) if self.verdicts else 0.0

    @property
    def average_precision(self) -> float:
        """See `average_precision`."""
        return average_precision(self.verdicts, self.cars)


def average_precision(verdicts: Sequence[tuple[float, bool]], cars: int) -> float:
    """Area under the precision over recall, precision being the best at that recall or beyond (PASCAL VOC 2010).

    Objects of the same confidence come in together.
    """
    if not cars or not verdicts:
        return 0.0
    ordered = sorted(verdicts, key=lambda verdict: -verdict[0])
    confidence = np.array([one for one, _ in ordered])
    last = np.append(np.flatnonzero(np.diff(confidence)), len(ordered) - 1)
    true = np.cumsum([is_true for _, is_true in ordered])[last]
    precision = np.maximum.accumulate((true / (last + 1.0))[::-1])[::-1]
    return float(np.sum(np.diff(true, prepend=0) / cars * precision))


def make_samples(track: Track, count: int, seed: int) -> Iterator[Sample]:
    """Scenes from all around the lap, the car at any distance; everything random follows from the seed."""
    scene, walls = LidarScene(track), track.walls()
    detector = Detector(track)
    generator = np.random.default_rng(seed)
    # The frame of the scenes begins at the rear axle.
    radar_config, fusion_config = RadarConfig(mount_x=MOUNT_X), FusionConfig(mount_x=MOUNT_X)
    for number in range(count):
        station = (number + generator.random()) * track.length / count
        ahead = generator.uniform(_NEAREST_M, _FARTHEST_M)
        lateral = generator.uniform(-3.0, 3.0)
        scan = scene.scan(station, _OWN_LATERAL, [(station + ahead, lateral)], int(generator.integers(2**31)))
        radar = Radar(walls, 0.0, np.random.default_rng(generator.integers(2**31)))
        radar_detector = RadarDetector(track, radar_config)
        heard = no_objects()
        for k in range(_RADAR_SCANS):
            before_s = (_RADAR_SCANS - 1 - k) * 1e-6 * PERIOD_US
            own_station = station - before_s * _OWN_SPEED
            x, y, yaw = track.pose_at(own_station, _OWN_LATERAL)
            yaw_rate = _OWN_SPEED * float(track.centre.at(np.array(own_station))[3])
            car = OtherCar(*track.pose_at(station + ahead - before_s * _CAR_SPEED, lateral), _CAR_SPEED)
            truth = Truth(x, y, 0.0, yaw, _OWN_SPEED, 0.0, yaw_rate, *(0.0,) * 8)
            motion = OwnMotion(Pose(x, y, yaw), _OWN_SPEED, 0.0, yaw_rate)
            heard = radar_detector.step(k * PERIOD_US, radar.scan(truth, [car]), motion).objects
        seen = lidar_objects(detector.step(scan.cloud, scan.pose))
        fused = Fusion(fusion_config).step(0, SensorObjects(0, seen), SensorObjects(0, heard), yaw_rate)
        yield Sample(scan.cars[0, :2], dict(zip(SOURCES, (seen, heard, fused.objects), strict=True)))


def evaluate(samples: Sequence[Sample]) -> dict[str, list[Score]]:
    """Score of each source in each bin. What is false counts where it is; what is beyond the bins does not count."""
    scores = {source: [Score() for _ in BINS_M] for source in SOURCES}
    for sample in samples:
        for source, found in sample.objects.items():
            off = np.hypot(found["x"] - sample.car[0], found["y"] - sample.car[1])
            # The most credible of those that are near enough; of equally credible ones the nearest.
            near = np.flatnonzero(off <= MATCH_M).tolist()
            best = min(near, key=lambda row: (-found["confidence"][row], off[row]), default=None)
            place = _bin_of(float(np.hypot(*sample.car)))
            if place is not None:
                scores[source][place].cars += 1
            for row, one in enumerate(found):
                here = place if row == best else _bin_of(float(np.hypot(one["x"], one["y"])))
                if here is not None:
                    scores[source][here].verdicts.append((float(one["confidence"]), row == best))
                    if row == best:
                        scores[source][here].errors.append(float(off[row]))
    return scores


def show(console: Console, scores: dict[str, list[Score]]) -> None:
    """Print the table."""
    table = Table(Column("m", no_wrap=True), "", "cars", "AP", "recall", "precision", "median m off", "RMS m off")
    for column in table.columns[2:]:
        column.justify = "right"
    for place, (start, end) in enumerate(BINS_M):
        for source in SOURCES:
            score = scores[source][place]
            errors = (
                (f"{statistics.median(score.errors):.2f}", f"{float(np.sqrt(np.mean(np.square(score.errors)))):.2f}")
                if score.errors
                else ("-", "-")
            )
            figures = (score.average_precision, score.recall, score.precision)
            bin_ = f"{start} to {end}" if source == SOURCES[0] else ""
            table.add_row(bin_, source, str(score.cars), *(f"{figure:.2f}" for figure in figures), *errors)
    console.print(table)


def _bin_of(distance: float) -> int | None:
    return next((place for place, (start, end) in enumerate(BINS_M) if start <= distance < end), None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200, metavar="N", help="around the lap (default: 200)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of everything random (default: 1)")
    options = parser.parse_args(arguments)
    if options.scenes < 1 or options.seed < 0:
        parser.error("--scenes must be at least 1, --seed at least 0")
    try:
        track = load_track(DIRECTORY / "tracks" / "lvms.yaml")
    except RaceloopError as error:
        print(f"fusion_bench: {error}", file=sys.stderr)
        return ExitStatus.USER_ERROR
    console = Console(highlight=False)
    console.print(f"{options.scenes} scenes, seed {options.seed}; an object is true within {MATCH_M:g} m")
    show(console, evaluate(list(make_samples(track, options.scenes, options.seed))))
    return ExitStatus.DONE


if __name__ == "__main__":
    sys.exit(main())
