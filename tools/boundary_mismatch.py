"""Track files that are wrong about their boundary, and poses that are off: what makes a geofence pass walls.

The scans are of the real track; only what detection is told differs, so one set of scans serves every mismatch. Three
scans to a place, as a car that drives takes them, and cars around it, some of them beside the wall.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from autonomy.detection.boundary_estimate import BoundaryEstimate
from autonomy.detection.cloud import Pose
from autonomy.detection.confirmation import Confirmation
from autonomy.detection.detector import Detector
from autonomy.frenet import FloatArray
from autonomy.track import Track
from tools.lidar_scene import LidarScene, Scan

#: Scans in a row at each place.
SCANS_IN_A_ROW = 3

#: Cars around each place: stations from the car with the LiDARs on, and lateral offsets, m. The wall stands at -7.45.
_CARS = (
    ((20.0, 2.0), (44.0, -3.0)),
    ((-1.5, 3.0), (35.0, 0.0)),
    ((24.0, -5.6), (-9.0, -5.9)),
    ((12.0, 0.5), (30.0, -2.0), (-14.0, 3.0)),
    (),
)
#: An object whose middle is so far from every car's is false; nearer ones may be a part of it.
FALSE_M = 3.5
#: A car is found when an object's middle is so near to its own.
FOUND_M = 2.0
#: Cars that count are nearer.
NEAR_M = 50.0

_PERIOD_S = 0.05
_SPEED, _SPEED_OF_OTHERS = 65.0, 60.0  # m/s


Cars = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Mismatch:
    """How what detection is told differs from what is there.

    Attributes
    ----------
    name : for people.
    outward : of a track, at each of its nodes, how far the right boundary of the file lies outside the real one, m.
    left : of the pose, m.
    turn_deg : of the pose, to the left.
    """

    name: str
    outward: Callable[[Track], FloatArray]
    left: float = 0.0
    turn_deg: float = 0.0

    def track(self, real: Track) -> Track:
        """The track as its file has it."""
        return Track(
            f"{real.name}, {self.name}",
            real.origin,
            real.centre,
            width_left=real.width_left,
            width_right=real.width_right + self.outward(real),
            bank=real.bank,
            grade=real.grade,
            walled=real.walled,
        )

    def pose(self, real: Pose) -> Pose:
        """The pose as the estimate has it."""
        return replace(
            real,
            x=real.x - self.left * math.sin(real.yaw),
            y=real.y + self.left * math.cos(real.yaw),
            yaw=real.yaw + math.radians(self.turn_deg),
        )


def _none(track: Track) -> FloatArray:
    return np.zeros(track.centre.count)


def _in_turns(shift: float) -> Callable[[Track], FloatArray]:
    """As far as this where the turns are tightest, less with less curvature, m."""

    def outward(track: Track) -> FloatArray:
        curvature = np.abs(track.centre.curvature)
        return np.asarray(shift * curvature / curvature.max())

    return outward


def _scaled(factor: float) -> Callable[[Track], FloatArray]:
    return lambda track: (factor - 1.0) * track.width_right


def _turned_sections(length: float, blend: float, turn_deg: float) -> Callable[[Track], FloatArray]:
    """Every other section of the file turned about its beginning, and led back over some metres."""

    def outward(track: Track) -> FloatArray:
        along = np.mod(track.centre.stations, 2.0 * length)
        end = math.tan(math.radians(turn_deg)) * length
        return np.interp(along, [0.0, length, length + blend], [0.0, end, 0.0])

    return outward


#: The first is none: boundary and pose are right.
MISMATCHES = (
    Mismatch("none", _none),
    *(Mismatch(f"{shift:g} m in the turns", _in_turns(shift)) for shift in (0.5, 1.0, 1.5, 2.0, 2.5)),
    Mismatch("outer half 20 % too wide", _scaled(1.2)),
    Mismatch("sections of 200 m turned by 0.7 deg", _turned_sections(200.0, 30.0, 0.7)),
    Mismatch("pose 0.3 m, 0.5 deg left", _none, 0.3, 0.5),
    Mismatch("pose 0.3 m left, 0.5 deg right", _none, 0.3, -0.5),
    Mismatch("1.5 m in the turns, pose off", _in_turns(1.5), 0.3, 0.5),
)


class OpenWall(LidarScene):
    """A track whose outer wall stands back along a part of it, as at a pit entry.

    Parameters
    ----------
    track : as it is.
    begin, end : stations, m, 0 <= begin < end <= length; between them the wall stands back.
    back : m; where the beams do not reach it, there is none.
    """

    def __init__(self, track: Track, begin: float, end: float, back: float) -> None:
        super().__init__(track)
        stations = track.centre.stations
        self._back = np.where((stations >= begin) & (stations < end), back, 0.0)

    def road(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """As that of `LidarScene`, with the outer wall farther away in the opening."""
        height, left, outer, inner = super().road(x, y)
        return height, left, outer + self._back[self.nearest_node(x, y)], inner


def scans_in_a_row(scene: LidarScene, station: float, cars: Cars, seed: int) -> list[Scan]:
    """Scans of a car that drives 1 m right of the centre line, from a station on, and of cars that drive.

    Parameters
    ----------
    cars : stations from the car with the LiDARs on at the first scan, and lateral offsets, m.
    seed : of the first scan; each has its own.
    """
    scans = []
    for number in range(SCANS_IN_A_ROW):
        own, others = (station + number * _PERIOD_S * speed for speed in (_SPEED, _SPEED_OF_OTHERS))
        scans.append(scene.scan(own, -1.0, [(others + ahead, lateral) for ahead, lateral in cars], seed + number))
    return scans


def make_drives(scene: LidarScene, places: int) -> list[list[Scan]]:
    """Scans in a row at places all around the lap."""
    spacing = scene.track.length / places
    return [
        scans_in_a_row(scene, (place + 0.5) * spacing, _CARS[place % len(_CARS)], SCANS_IN_A_ROW * place)
        for place in range(places)
    ]


@dataclass
class Score:
    """What detection made of drives.

    Attributes
    ----------
    scans : in all.
    false : objects that are no car.
    false_fitting : those of them that pass the cross-check as cars.
    false_confirmed : those of them that are there in two of three scans.
    cars, found : cars nearer than NEAR_M, in all scans, and those of them that an object is at.
    cars_again, confirmed : likewise but for the first scan of each drive, with confirmed objects.
    cpu_ms : of each step of the detector.
    """

    scans: int = 0
    false: int = 0
    false_fitting: int = 0
    false_confirmed: int = 0
    cars: int = 0
    found: int = 0
    cars_again: int = 0
    confirmed: int = 0
    cpu_ms: list[float] = field(default_factory=list)


def evaluate(real: Track, mismatch: Mismatch, drives: Sequence[Sequence[Scan]], estimating: bool) -> Score:
    """Let a detector that is told wrong see all drives, with the estimate of the boundary or without.

    Each drive begins with nothing known.
    """
    track = mismatch.track(real)
    boundary = BoundaryEstimate(track) if estimating else None
    detector, score = Detector(track, boundary=boundary), Score()
    for drive in drives:
        confirmation = Confirmation()
        if boundary is not None:
            boundary.forget()
        for number, scan in enumerate(drive):
            pose = mismatch.pose(scan.pose)
            begin = time.process_time_ns()
            seen = detector.step(scan.cloud, pose).cars
            score.cpu_ms.append((time.process_time_ns() - begin) * 1e-6)
            confirmed = confirmation.step(seen.centre, pose)
            apart = np.hypot(*(seen.centre[:, None, :] - scan.cars[None, :, :2]).transpose(2, 0, 1))
            false = apart.min(axis=1, initial=np.inf) > FALSE_M
            score.scans += 1
            score.false += int(np.count_nonzero(false))
            score.false_fitting += int(np.count_nonzero(false & seen.fits))
            score.false_confirmed += int(np.count_nonzero(false & confirmed))
            near = np.hypot(scan.cars[:, 0], scan.cars[:, 1]) < NEAR_M
            at = apart[:, near] < FOUND_M
            score.cars += int(np.count_nonzero(near))
            score.found += int(np.count_nonzero(at.any(axis=0)))
            if number > 0:
                score.cars_again += int(np.count_nonzero(near))
                score.confirmed += int(np.count_nonzero(at[confirmed].any(axis=0)))
    return score
