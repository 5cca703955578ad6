"""Evaluate LiDAR alone, radar alone and both fused, by distance, on synthetic scenes of the Las Vegas oval.

::

    python -m tools.fusion_bench

One car ahead in each scene. The LiDARs' scan is that of `tools.lidar_scene`; the radar has watched the car for some
scans before, so that its tracks are as old as they would be.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence

import numpy as np
from rich.console import Console

from autonomy.detection.cloud import Pose
from autonomy.detection.detector import Detector
from autonomy.detection.fusion import Fusion, FusionConfig, SensorObjects
from autonomy.detection.radar import OwnMotion, RadarConfig, RadarDetector
from autonomy.detection.road_objects import lidar_objects, no_objects
from autonomy.track import Track
from autonomy.track_files import load_track
from bridge.sensors.radar import MOUNT_X, PERIOD_US, Radar
from bridge.sensors.radar_scene import OtherCar
from bridge.sensors.truth import Truth
from dbc.errors import RaceloopError
from scenarios import DIRECTORY
from tools.detection_score import MATCH_M, SOURCES, Sample, evaluate, show
from tools.exit_status import ExitStatus
from tools.lidar_scene import LidarScene

_OWN_SPEED, _CAR_SPEED = 60.0, 55.0  # m/s
_OWN_LATERAL = -1.0  # m
_RADAR_SCANS = 12
_NEAREST_M, _FARTHEST_M = 8.0, 120.0


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
