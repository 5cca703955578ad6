"""Front radar, a Delphi (Aptiv) ESR 2.5: up to 64 tracks, 20 times a second.

Two scans overlap: medium range is wide, long range narrow. An echo of a car fluctuates from scan to scan (Swerling's
first case), so that its detection becomes less likely with distance. Besides cars the radar has stationary returns of
walls, ghosts, which are cars mirrored in a wall, and false alarms of its receiver. What it detects it keeps as a track,
under one number, for as long as it sees it.

The model is plane: height, bank and what hides behind another car do not count. Tracks travel as an array; the frames
that carry them are in `dbc.radar_tracks`, and every value has the resolution of the wire.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bridge.sensors.radar_scene import Floats, Motion, OtherCar, Walls, mounted, nearest_point
from bridge.sensors.truth import Truth
from dbc.radar_tracks import TRACK_DTYPE, TRACKS, RangeMode, Tracks, TrackStatus, on_wire, track_frames, wire_limits

PERIOD_US = 50_000
#: A scan's frames are on their way for up to 17.3 ms: they are there when the LiDARs' scan ends.
PHASE_US = 20_000
#: Ahead of the middle of the rear axle, m (AWSIM's model of the AV-21, urdf).
MOUNT_X = 1.784

#: What has noise.
_NOISY = ("range", "angle", "range_rate", "range_acceleration", "lateral_rate")


@dataclass(frozen=True)
class Scan:
    """One of the radar's two scans: field of view to each side, rad, reach, m, and 1 sigma of the angle, rad."""

    half_angle: float
    reach: float
    angle_white: float


@dataclass(frozen=True)
class RadarErrors:
    """What the radar can and cannot do.

    Attributes
    ----------
    long_range : 174 m and 10 degrees to each side (F. de Ponte Mueller, 2017); sigma of the angle ours.
    medium_range : 45 degrees to each side (elektroniknet on Delphi's ESR); reach ours; sigma of the angle that of the
        Aptiv MRR, 1 degree.
    range_min : m, ours.
    range_white, rate_white : m and m/s, 1 sigma: the accuracies that de Ponte Mueller states, 1.8 m and 0.12 m/s,
        taken as such.
    acceleration_white, lateral_white : m/s2 and m/s, 1 sigma, ours.
    false_alarm : probability that the threshold of detection is set for; ours.
    half_range : m, where a car is detected in every second scan; ours.
    wall_gain_db, mirror_gain_db : echo of a wall's post, and of a car by way of a wall, beside that of a car at that
        distance; ours.
    post_spacing : m, between reflecting parts of a wall; ours.
    clutter : false alarms per scan, in the mean, in long and in medium range; ours.
    young : hits until a track is no longer new; ours.
    coast : scans without a hit after which a track ends; ours.
    oncoming : m/s over ground along the sight, from which a track counts as coming towards us; ours.
    """

    long_range: Scan = Scan(math.radians(10.0), 174.0, math.radians(0.5))
    medium_range: Scan = Scan(math.radians(45.0), 60.0, math.radians(1.0))
    range_min: float = 1.0
    range_white: float = 1.8
    rate_white: float = 0.12
    acceleration_white: float = 1.0
    lateral_white: float = 0.5
    false_alarm: float = 1.0e-6
    half_range: float = 140.0
    wall_gain_db: float = -10.0
    mirror_gain_db: float = -12.0
    post_spacing: float = 10.0
    clutter: tuple[float, float] = (0.5, 1.0)
    young: int = 3
    coast: int = 4
    oncoming: float = 1.0

    @property
    def threshold(self) -> float:
        """Of the received power over that of the noise, at which a receiver has its false alarms."""
        return -math.log(self.false_alarm)

    def signal_to_noise(self, distance: Floats, gain_db: Floats | float = 0.0) -> Floats:
        """Mean power of an echo over that of the noise, falling with the fourth power of the distance (m)."""
        at_half = self.threshold / math.log(2.0) - 1.0
        return np.asarray(at_half * (self.half_range / distance) ** 4 * 10.0 ** (0.1 * np.asarray(gain_db)))

    def detection_probability(self, distance: Floats, gain_db: Floats | float = 0.0) -> Floats:
        r"""Probability of a detection in one scan, :math:`P_{fa}^{1 / (1 + S)}`.

        That is Swerling's first case after a square-law detector of one pulse, S being the mean signal to noise ratio
        (M. Richards, Fundamentals of Radar Signal Processing, 2005, 6.3).
        """
        return np.asarray(self.false_alarm ** (1.0 / (1.0 + self.signal_to_noise(distance, gain_db))))


class Key(NamedTuple):
    """Who an echo is, the same in every scan.

    Attributes
    ----------
    source : car, ghost or wall.
    number : of the car, or of the post in the wall.
    wall : that mirrors, if any does.
    """

    source: str
    number: int
    wall: int = -1


class Echoes(NamedTuple):
    """What comes back from some points, without errors.

    Attributes
    ----------
    keys : one of each.
    tracks : TRACK_DTYPE, shape (n,); id and status are not set.
    gain_db : shape (n,), see `RadarErrors`.
    """

    keys: list[Key]
    tracks: Tracks
    gain_db: Floats


class Detections(NamedTuple):
    """What one scan found.

    Attributes
    ----------
    keys : one of each; None for a false alarm.
    tracks : TRACK_DTYPE, shape (n,), as the wire carries them; id and status are not set.
    """

    keys: list[Key | None]
    tracks: Tracks


@dataclass
class _Slot:
    key: Key | None
    values: Tracks  # of shape (1,)
    hits: int = 1
    misses: int = 0


class Tracker:
    """Gives detections their numbers, and keeps them for as long as they are seen.

    A number that has become free is given away again last.

    Parameters
    ----------
    errors : see `RadarErrors`.
    """

    def __init__(self, errors: RadarErrors) -> None:
        self._errors = errors
        self._slots: dict[int, _Slot] = {}
        self._free = list(range(1, TRACKS + 1))
        self._scans = 0

    def step(self, detections: Detections, kept: set[Key]) -> Tracks:
        """Tracks after one more scan, by number.

        Parameters
        ----------
        detections : where there are not enough numbers for the new ones, the first get them.
        kept : who may be kept without a detection; others are out of sight.
        """
        found = {key: row for row, key in enumerate(detections.keys) if key is not None}
        missed = []
        for number, slot in self._slots.items():
            row = None if slot.key is None else found.pop(slot.key, None)
            if row is None:
                missed.append(number)
            else:
                slot.values, slot.hits, slot.misses = detections.tracks[row : row + 1], slot.hits + 1, 0
        coasting = self._coast(missed, kept)
        for number in missed:
            if number not in coasting:
                del self._slots[number]
                self._free.append(number)
        for row, key in enumerate(detections.keys):
            if self._free and (key is None or key in found):
                self._slots[self._free.pop(0)] = _Slot(key, detections.tracks[row : row + 1])
        self._scans += 1
        tracks = np.zeros(len(self._slots), dtype=TRACK_DTYPE)
        for row, number in enumerate(sorted(self._slots)):
            tracks[row] = self._slots[number].values[0]
            tracks[row]["id"], tracks[row]["status"] = number, self._status(self._slots[number])
        tracks["rolling_count"] = self.rolling_count
        return tracks

    @property
    def rolling_count(self) -> int:
        """Of the newest scan; 0 before the first."""
        return self._scans % 2

    def _coast(self, missed: Sequence[int], kept: set[Key]) -> set[int]:
        """Move tracks without a detection on by their range rates; those that are still in view."""
        on = [(number, self._slots[number]) for number in missed]
        on = [(n, slot) for n, slot in on if slot.key in kept and slot.misses < self._errors.coast]
        if not on:
            return set()
        moved = np.concatenate([slot.values for _, slot in on])
        moved["range"] += moved["range_rate"] * PERIOD_US * 1e-6
        moved = on_wire(moved)
        seen = coverage(self._errors, moved["range"], moved["angle"]) != RangeMode.NONE
        for row, (_, slot) in enumerate(on):
            slot.misses += 1
            slot.values = moved[row : row + 1]
        return {number for (number, _), in_view in zip(on, seen.tolist(), strict=True) if in_view}

    def _status(self, slot: _Slot) -> TrackStatus:
        if slot.misses:
            return TrackStatus.NEW_COASTED if slot.hits <= self._errors.young else TrackStatus.COASTED
        if slot.hits == 1:
            return TrackStatus.NEW
        return TrackStatus.NEW_UPDATED if slot.hits <= self._errors.young else TrackStatus.UPDATED


class Radar:
    """The front radar.

    Parameters
    ----------
    walls : closed lines of points, each of shape (n, 2), m, in the track frame.
    cg_to_rear_axle : m.
    generator : source of everything random.
    errors : see `RadarErrors`.
    """

    def __init__(
        self,
        walls: Sequence[NDArray[np.floating]],
        cg_to_rear_axle: float,
        generator: np.random.Generator,
        errors: RadarErrors | None = None,
    ) -> None:
        self.errors = errors or RadarErrors()
        self._walls = Walls(walls, self.errors.post_spacing)
        self._x = MOUNT_X - cg_to_rear_axle
        self._generator = generator
        self._tracker = Tracker(self.errors)

    def due(self, now_us: int) -> bool:
        """Whether a scan belongs to this tick."""
        return now_us % PERIOD_US == PHASE_US

    def emit(self, truth: Truth, cars: Sequence[OtherCar] = ()) -> bytes:
        """Frames of this tick's scan for CAN-R, see `scan` and `dbc.radar_tracks.track_frames`."""
        tracks = self.scan(truth, cars)
        return track_frames(tracks, self._tracker.rolling_count)

    def scan(self, truth: Truth, cars: Sequence[OtherCar] = ()) -> Tracks:
        """Tracks of this tick, of which there may be none.

        Parameters
        ----------
        truth : of the own car.
        cars : the others, in the same order in every scan.

        Returns
        -------
        ndarray of TRACK_DTYPE, shape (n,), n up to 64
            In the order of their numbers.
        """
        sensor = mounted(truth, self._x)
        echoes = find_echoes(self.errors, self._walls, sensor, truth.yaw, cars)
        parts = detect(self.errors, echoes, self._generator), false_alarms(self.errors, self._generator)
        keys, tracks = [*parts[0].keys, *parts[1].keys], np.concatenate([part.tracks for part in parts])
        sight = truth.yaw + tracks["angle"]
        closing = sensor.velocity[0] * np.cos(sight) + sensor.velocity[1] * np.sin(sight)
        tracks["oncoming"] = tracks["range_rate"] + closing < -self.errors.oncoming
        nearest = np.argsort(tracks["range"], kind="stable")
        return self._tracker.step(Detections([keys[row] for row in nearest], tracks[nearest]), set(echoes.keys))


def coverage(errors: RadarErrors, distance: NDArray[np.floating], angle: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Which of the scans covers each place, as `RangeMode`; distance in m, angle in rad."""
    rounding = 1e-9
    seen = np.zeros(np.shape(distance), dtype=np.uint8)
    for scan, mode in ((errors.medium_range, RangeMode.MEDIUM_RANGE), (errors.long_range, RangeMode.LONG_RANGE)):
        inside = (distance >= errors.range_min - rounding) & (distance <= scan.reach + rounding)
        seen |= (inside & (np.abs(angle) <= scan.half_angle + rounding)).astype(np.uint8) * np.uint8(mode)
    return seen


def find_echoes(errors: RadarErrors, walls: Walls, sensor: Motion, yaw: float, cars: Sequence[OtherCar]) -> Echoes:
    """Everything in view, without errors: cars, ghosts, walls.

    Parameters
    ----------
    sensor, yaw : motion of the radar, and where it looks, rad.
    cars : the others.
    """
    reach = max(errors.long_range.reach, errors.medium_range.reach)
    segments = walls.near(sensor.place, reach)
    keys: list[Key] = []
    parts: list[tuple[Motion, float, float]] = []
    for number, car in enumerate(cars):
        point = nearest_point(car, sensor.place[None])
        keys.append(Key("car", number))
        parts.append((Motion(*(each[0] for each in point)), 0.0, car.width))
        for line, image in walls.images(sensor.place, car, segments):
            keys.append(Key("ghost", number, line))
            parts.append((image, errors.mirror_gain_db, car.width))
    posts = np.flatnonzero(np.hypot(*(walls.posts - sensor.place).T) < reach)
    keys += [Key("wall", int(post)) for post in posts]
    still = np.zeros(2)
    parts += [(Motion(walls.posts[post], still, still), errors.wall_gain_db, 0.0) for post in posts]
    if not parts:
        return Echoes([], np.zeros(0, dtype=TRACK_DTYPE), np.empty(0))
    motion = Motion(*(np.array([getattr(part[0], name) for part in parts]) for name in Motion._fields))
    tracks = _seen(motion.away_from(sensor), yaw)
    tracks["width"] = [part[2] for part in parts]
    tracks["mode"] = coverage(errors, tracks["range"], tracks["angle"])
    mirrored = np.array([key.source == "ghost" for key in keys])
    hidden = ~mirrored & walls.hide(np.broadcast_to(sensor.place, motion.place.shape), motion.place, segments)
    rows = np.flatnonzero((tracks["mode"] != RangeMode.NONE) & ~hidden)
    return Echoes([keys[row] for row in rows], tracks[rows], np.array([part[1] for part in parts])[rows])


def detect(errors: RadarErrors, echoes: Echoes, generator: np.random.Generator) -> Detections:
    """Draw which echoes exceed the threshold, and what is measured of them; what then is out of view is lost."""
    true = echoes.tracks
    power = generator.exponential(1.0 + errors.signal_to_noise(true["range"], echoes.gain_db))
    noise = generator.standard_normal((5, len(true)))
    is_long = (true["mode"] & np.uint8(RangeMode.LONG_RANGE)) != 0
    angle_white = np.where(is_long, errors.long_range.angle_white, errors.medium_range.angle_white)
    whites = (errors.range_white, angle_white, errors.rate_white, errors.acceleration_white, errors.lateral_white)
    measured = true.copy()
    for name, white, draw in zip(_NOISY, whites, noise, strict=True):
        measured[name] += white * draw
    measured = on_wire(measured)
    measured["mode"] = coverage(errors, measured["range"], measured["angle"])
    rows = np.flatnonzero((power > errors.threshold) & (measured["mode"] != RangeMode.NONE))
    return Detections([echoes.keys[row] for row in rows], measured[rows])


def false_alarms(errors: RadarErrors, generator: np.random.Generator) -> Detections:
    """Draw detections of nothing: a Poisson number, in range, angle and range rate uniform over what is measured."""
    found = []
    slowest, fastest = wire_limits("range_rate")
    for scan, mean in zip((errors.long_range, errors.medium_range), errors.clutter, strict=True):
        draws = generator.random((3, generator.poisson(mean)))
        tracks = np.zeros(draws.shape[1], dtype=TRACK_DTYPE)
        tracks["range"] = errors.range_min + draws[0] * (scan.reach - errors.range_min)
        tracks["angle"] = (2.0 * draws[1] - 1.0) * scan.half_angle
        tracks["range_rate"] = slowest + draws[2] * (fastest - slowest)
        found.append(tracks)
    tracks = on_wire(np.concatenate(found))
    tracks["mode"] = coverage(errors, tracks["range"], tracks["angle"])
    return Detections([None] * len(tracks), tracks)


def _seen(motion: Motion, yaw: float) -> Tracks:
    """What an ideal radar measures of points that move relative to it."""
    place, velocity, acceleration = motion
    distance = np.maximum(np.hypot(*place.T), 1e-6)
    sight = place / distance[:, None]
    rate = np.einsum("ij,ij->i", velocity, sight)
    speed2 = np.einsum("ij,ij->i", velocity, velocity)
    angle = np.arctan2(sight[:, 1], sight[:, 0]) - yaw
    tracks = np.zeros(len(place), dtype=TRACK_DTYPE)
    tracks["range"], tracks["range_rate"] = distance, rate
    tracks["angle"] = np.arctan2(np.sin(angle), np.cos(angle))
    tracks["range_acceleration"] = np.einsum("ij,ij->i", acceleration, sight) + (speed2 - rate**2) / distance
    tracks["lateral_rate"] = sight[:, 0] * velocity[:, 1] - sight[:, 1] * velocity[:, 0]
    return tracks
