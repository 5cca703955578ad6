"""Tracks of opponents: when they begin, when they count and when they end, around the filter of `imm_pdaf`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from autonomy.frenet import FloatArray, wrap_angle
from autonomy.opponents.imm_pdaf import Belief, ImmPdaf, Integers, Mask, SensorModel
from autonomy.opponents.motion_models import STATES, VX, VY, ConstantVelocity


class Scan(NamedTuple):
    """Detections of one sensor at one time, track frame.

    Attributes
    ----------
    time_us : when it was measured.
    centre : (n, 3), m.
    size : (n, 3), length, width and height, m.
    covariance : (n, 3, 3), of the centre, m2. A sensor that sees no height states a large variance of z.
    """

    time_us: int
    centre: FloatArray
    size: FloatArray
    covariance: FloatArray


class ScanStatus(IntEnum):
    """What became of a scan, from best to worst."""

    USED = 0
    EMPTY = 1  # used: nothing was seen
    PARTLY_USED = 2  # detections that are not finite, not plausible or too many were left out
    MALFORMED = 3  # refused: not arrays of numbers of the stated shapes
    OUT_OF_ORDER = 4  # refused: older than what was used already
    STALE = 5  # refused: too old
    FROM_THE_FUTURE = 6  # refused


class TrackedObject(NamedTuple):
    """An opponent at one time, track frame.

    Attributes
    ----------
    identity : number of the track, never used twice.
    time_us : of this estimate. seen_us : of the last scan that held the object.
    x, y, z : m, centre. vx, vy : m/s.
    yaw : rad, direction of the velocity; at less than `TrackerLimits.yaw_speed` the one before. yaw_rate : rad/s.
    covariance : (6, 6), of x, y, z, vx, vy and yaw rate.
    size : (3,), length, width, height, m.
    model_weights : (m,), probabilities of the motion models.
    existence : probability that there is a car, by the score and even odds before the first scan.
    """

    identity: int
    time_us: int
    seen_us: int
    x: float
    y: float
    z: float
    vx: float
    vy: float
    yaw: float
    yaw_rate: float
    covariance: FloatArray
    size: FloatArray
    model_weights: FloatArray
    existence: float


@dataclass(frozen=True)
class TrackerLimits:
    """Figures of the track logic. Those marked TUM are of TUM's tracker of the same series (FusionTracking).

    A track's score is the logarithm of the likelihood of all its scans with the car there over that without it, and a
    sequential probability ratio test decides (S. Blackman, R. Popoli, Modern Tracking Systems, 1999, 6.2).

    Attributes
    ----------
    false_alarm, missed_alarm : probabilities that the test takes clutter for a car, and a car for clutter.
    hits : scans that speak for the track until it is confirmed, at least (TUM: 5).
    held_us : without such a scan, after which a track ends (TUM: 2 s).
    deviation : 1 sigma of the position, m, beyond which a track ends: its gate would take in anything (TUM: 5 m).
    claim_probability : of being a track's, from which a detection begins no track.
    step_us : between two of the three detections that begin a track, at most.
    speed, acceleration : of a car, at most, m/s and m/s2.
    start_speed, start_turn_rate : 1 sigma at the start, m/s and rad/s.
    overlap_along, overlap_across : m; centres nearer than that, along and across the heading, are one car's. Cars
        are 4.9 m by 1.9 m.
    height_noise : m per sqrt(s), wander of z.
    size_share : of a new detection in the size.
    yaw_speed : m/s, see TrackedObject.yaw.
    stale_us : age of a scan, at most (TUM: delay up to 0.4 s). future_us : ahead of the clock, at most.
    least_deviation, most_deviation : m, 1 sigma of a usable detection in any direction of the plane, and of z.
    extent : m, largest coordinate.
    tracks, detections : at most that many.
    """

    false_alarm: float = 1.0e-6
    missed_alarm: float = 0.02
    hits: int = 5
    held_us: int = 2_000_000
    deviation: float = 5.0
    claim_probability: float = 0.1
    step_us: int = 150_000
    speed: float = 90.0
    acceleration: float = 30.0
    start_speed: float = 40.0
    start_turn_rate: float = 0.3
    overlap_along: float = 4.0
    overlap_across: float = 1.5
    height_noise: float = 0.5
    size_share: float = 0.1
    yaw_speed: float = 5.0
    stale_us: int = 500_000
    future_us: int = 10_000
    least_deviation: float = 0.01
    most_deviation: float = 1000.0
    extent: float = 1.0e5
    tracks: int = 32
    detections: int = 512

    @property
    def confirming_score(self) -> float:
        """Score from which a track is one."""
        return math.log((1.0 - self.missed_alarm) / self.false_alarm)

    @property
    def refuting_score(self) -> float:
        """Score below which a tentative track is none."""
        return math.log(self.missed_alarm / (1.0 - self.false_alarm))


class _Detections(NamedTuple):
    """Usable detections of a scan."""

    time_us: int
    centre: FloatArray
    size: FloatArray
    covariance: FloatArray

    def only(self, chosen: Mask | Integers) -> _Detections:
        return _Detections(self.time_us, self.centre[chosen], self.size[chosen], self.covariance[chosen])


_NOTHING = _Detections(0, np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3)))


class _Candidates(NamedTuple):
    """What of a sensor may become a track: free detections of its last scan, pairs of such of its last two scans."""

    free: _Detections = _NOTHING
    first: _Detections = _NOTHING
    second: _Detections = _NOTHING


class _Tracks(NamedTuple):
    """All tracks, oldest first; each array has one row per track."""

    belief: Belief
    height: FloatArray
    height_variance: FloatArray
    size: FloatArray
    yaw: FloatArray
    score: FloatArray
    identity: Integers
    hits: Integers
    confirmed: Mask
    seen_us: Integers

    def only(self, chosen: Mask | Integers) -> _Tracks:
        parts: Any = (part[chosen] for part in self[1:])
        return _Tracks(self.belief.only(chosen), *parts)

    def joined(self, other: _Tracks) -> _Tracks:
        pairs: Any = zip(self[1:], other[1:], strict=True)
        parts: Any = map(np.concatenate, pairs)
        return _Tracks(self.belief.joined(other.belief), *parts)


class OpponentTracker:
    """Tracks opponents from scans of detections.

    Bad input is answered with a status; what was known before stays as it is.

    Parameters
    ----------
    filter_ : IMM-UKF-PDAF to use.
    limits : of the track logic.
    """

    def __init__(self, filter_: ImmPdaf | None = None, limits: TrackerLimits | None = None) -> None:
        self._filter = filter_ or ImmPdaf()
        self._limits = limits or TrackerLimits()
        none = np.empty(0)
        belief = self._filter.started(np.empty((0, STATES)), np.empty((0, STATES, STATES)))
        whole = np.empty(0, dtype=np.int64)
        self._tracks = _Tracks(belief, none, none, np.empty((0, 3)), none, none, whole, whole, none > 0.0, whole)
        self._candidates: dict[str, _Candidates] = {}
        # Of centre, size and covariance of a usable detection, row by row.
        least, most = self._limits.least_deviation**2, self._limits.most_deviation**2
        extent = self._limits.extent
        self._lowest = np.array([*[-extent] * 3, *[0.0] * 3, *np.where(np.eye(3).ravel() > 0.0, least, -most)])
        self._highest = np.array([*[extent] * 6, *[most] * 9])
        self._time_us = -1
        self._next_identity = 1

    def update(self, now_us: int, scan: Scan, sensor: SensorModel) -> ScanStatus:
        """Use one scan.

        Parameters
        ----------
        now_us : time of the tick.
        scan : of one sensor; scans come in the order of their times. Two sensors' of the same time may follow.
        sensor : that made it.

        Returns
        -------
        What became of it.
        """
        status, detections = self._checked(now_us, scan)
        if status >= ScanStatus.MALFORMED:
            return status
        time_us = detections.time_us
        gap_us, self._time_us = time_us - self._time_us, time_us
        if gap_us > self._limits.held_us:
            self._tracks = self._tracks.only(self._tracks.confirmed & False)
        free = detections
        if len(self._tracks.identity):
            claimed = self._use(detections, gap_us, sensor)
            free = detections.only(claimed < self._limits.claim_probability)
            self._drop_lost(time_us)
            self._drop_doubles()
        self._begin(free, sensor.name)
        return status

    def objects(self, now_us: int) -> list[TrackedObject]:
        """Confirmed tracks, extrapolated to the time of the tick; changes nothing.

        Those that no scan has held for `held_us` are left out, so none outlives its sensors.
        """
        limits, tracks = self._limits, self._tracks
        now_us = max(now_us, self._time_us)
        chosen = tracks.confirmed & (now_us - tracks.seen_us <= limits.held_us)
        if not chosen.any():
            return []
        tracks = tracks.only(chosen)
        dt = (now_us - self._time_us) * 1.0e-6
        belief = self._filter.extrapolate(tracks.belief, dt) if dt > 0.0 else tracks.belief
        mean, plane = belief.combined
        yaw = _yaw(mean, tracks.yaw, limits.yaw_speed)
        covariance = np.zeros((len(mean), STATES + 1, STATES + 1))
        rows = np.array([0, 1, 3, 4, 5])
        covariance[:, rows[:, None], rows] = plane
        covariance[:, 2, 2] = tracks.height_variance + limits.height_noise**2 * dt
        existence = 1.0 / (1.0 + np.exp(-tracks.score))
        return [
            TrackedObject(
                identity=int(tracks.identity[i]),
                time_us=now_us,
                seen_us=int(tracks.seen_us[i]),
                x=x,
                y=y,
                z=float(tracks.height[i]),
                vx=vx,
                vy=vy,
                yaw=wrap_angle(float(yaw[i])),
                yaw_rate=yaw_rate,
                covariance=covariance[i],
                size=tracks.size[i],
                model_weights=belief.weight[i],
                existence=float(existence[i]),
            )
            for i, (x, y, vx, vy, yaw_rate) in enumerate(mean.tolist())
        ]

    def _checked(self, now_us: int, scan: Scan) -> tuple[ScanStatus, _Detections]:
        """Status, and the usable detections unless the scan is refused."""
        limits = self._limits
        try:
            time_us = int(scan.time_us)
            arrays = [np.asarray(part) for part in scan[1:]]
            if any(array.dtype.kind not in "fiu" for array in arrays):
                return ScanStatus.MALFORMED, _NOTHING
            # Copies: some are kept until the next scan, and the caller may use its arrays again.
            centre, size, covariance = (array.astype(np.float64) for array in arrays)
        except (TypeError, ValueError, OverflowError, IndexError, AttributeError):
            return ScanStatus.MALFORMED, _NOTHING
        count = len(centre) if centre.ndim else 0
        shapes = centre.shape, size.shape, covariance.shape
        if shapes != ((count, 3), (count, 3), (count, 3, 3)):
            return ScanStatus.MALFORMED, _NOTHING
        if time_us > now_us + limits.future_us:
            return ScanStatus.FROM_THE_FUTURE, _NOTHING
        if time_us < self._time_us:
            return ScanStatus.OUT_OF_ORDER, _NOTHING
        if time_us < now_us - limits.stale_us:
            return ScanStatus.STALE, _NOTHING
        detections = _Detections(time_us, centre, size, covariance)
        usable = self._usable(detections)
        if usable.all() and count <= limits.detections:
            return (ScanStatus.USED if count else ScanStatus.EMPTY), detections
        return ScanStatus.PARTLY_USED, detections.only(np.flatnonzero(usable)[: limits.detections])

    def _usable(self, detections: _Detections) -> Mask:
        """Which detections are finite and plausible; comparisons with NaN are false."""
        covariance = detections.covariance
        values = np.concatenate((detections.centre, detections.size, covariance.reshape(-1, 9)), axis=1)
        inside: Mask = np.all((values >= self._lowest) & (values <= self._highest), axis=1)
        with np.errstate(all="ignore"):
            least = self._limits.least_deviation**2
            xx, xy, yx, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 0], covariance[:, 1, 1]
            # The smaller eigenvalue of the plane's part.
            inside &= ((xx - least) * (yy - least) >= xy * xy) & (np.abs(xy - yx) <= 1.0e-6 * (xx + yy))
        return inside

    def _use(self, detections: _Detections, gap_us: int, sensor: SensorModel) -> FloatArray:
        """Carry all tracks on to a scan and use it; returns for each detection the probability that it is a track's."""
        limits, tracks, dt = self._limits, self._tracks, gap_us * 1.0e-6
        # A track that was not seen keeps its models: random motion stays where it is, and without detections that say
        # otherwise its growing share would hold back a car that is only hidden.
        seen_before = tracks.seen_us == detections.time_us - gap_us
        belief = self._filter.predict(tracks.belief, dt, seen_before)
        position, noise = detections.centre[:, :2], detections.covariance[:, :2, :2]
        belief, association = self._filter.update(belief, position, noise, sensor, tracks.confirmed)
        probability = association.probability
        # The height is a Kalman filter of its own with the probabilities that the plane found: the moments of the
        # mixture over which detection it was.
        variance = tracks.height_variance[:, None] + limits.height_noise**2 * dt
        inverse = 1.0 / (variance + detections.covariance[:, 2, 2])
        off = inverse * (detections.centre[:, 2] - tracks.height[:, None])
        pull = (probability * off).sum(axis=1)
        shrink = (probability * (inverse - off * off)).sum(axis=1) + pull * pull
        variance = variance[:, 0]
        seen = probability.sum(axis=1)
        size = probability @ detections.size - seen[:, None] * tracks.size
        hit = association.evidence > 1.0
        hits = tracks.hits + hit
        score = np.minimum(tracks.score + np.log(association.evidence), limits.confirming_score)
        self._tracks = _Tracks(
            belief,
            tracks.height + variance * pull,
            variance - variance * variance * shrink,
            tracks.size + limits.size_share * size,
            _yaw(belief.combined[0], tracks.yaw, limits.yaw_speed),
            score,
            tracks.identity,
            hits,
            tracks.confirmed | ((score >= limits.confirming_score) & (hits >= limits.hits)),
            np.where(hit, detections.time_us, tracks.seen_us),
        )
        claimed: FloatArray = probability.max(axis=0, initial=0.0)
        return claimed

    def _drop_lost(self, time_us: int) -> None:
        """End tracks that were not seen for long, that are none, or that nobody knows where they are."""
        limits, tracks = self._limits, self._tracks
        kept = time_us - tracks.seen_us <= limits.held_us
        kept &= tracks.confirmed | (tracks.score >= limits.refuting_score)
        covariance = tracks.belief.combined[1]
        kept &= np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]) <= limits.deviation**2
        if not kept.all():
            self._tracks = tracks.only(kept)

    def _drop_doubles(self) -> None:
        """Of two tracks of one car, end the younger; a tentative one is younger than any confirmed one."""
        tracks = self._tracks
        count = len(tracks.identity)
        if count < 2:
            return
        position = tracks.belief.combined[0][:, :2]
        same = self._overlaps(position, position)
        rank = np.argsort(np.argsort(~tracks.confirmed, kind="stable"))
        double: Mask = np.any(same & (rank[:, None] < rank), axis=0)
        if double.any():
            self._tracks = tracks.only(~double)

    def _overlaps(self, position: FloatArray, points: FloatArray) -> Mask:
        """Which points (n, 2) lie where cars at the tracks' positions (t, 2) are: (t, n)."""
        yaw = self._tracks.yaw[:, None]
        off = points - position[:, None, :]
        cos, sin = np.cos(yaw), np.sin(yaw)
        along, across = off[..., 0] * cos + off[..., 1] * sin, off[..., 1] * cos - off[..., 0] * sin
        return (np.abs(along) < self._limits.overlap_along) & (np.abs(across) < self._limits.overlap_across)

    def _begin(self, free: _Detections, sensor: str) -> None:
        """Begin tracks from free detections of three scans of a sensor in a row that lie as a car's do."""
        limits, tracks = self._limits, self._tracks
        before, first, second = self._candidates.get(sensor, _Candidates())
        self._candidates[sensor] = _Candidates(free)
        step = (free.time_us - before.time_us) * 1.0e-6
        if not 0.0 < step <= limits.step_us * 1.0e-6:
            return
        # Pairs of detections at most as far apart as a car drives between them.
        noise = _variance(before)[:, None] + _variance(free)
        reach = limits.speed * step + 3.0 * np.sqrt(noise)
        earlier, later = np.nonzero(_squared_distance(before.centre, free.centre) <= reach * reach)
        pairs = before.only(earlier[: limits.detections]), free.only(later[: limits.detections])
        self._candidates[sensor] = _Candidates(free, *pairs)
        if not (len(first.centre) and len(free.centre)):
            return
        # A third detection where the pair's velocity leads, give or take noise and acceleration.
        ratio = step / ((second.time_us - first.time_us) * 1.0e-6)
        distance = _squared_distance(second.centre + ratio * (second.centre - first.centre), free.centre)
        noise = (1.0 + ratio) ** 2 * _variance(second) + ratio**2 * _variance(first)
        reach = limits.acceleration * step**2 + 3.0 * np.sqrt(noise[:, None] + _variance(free))
        pair = np.argmin(distance, axis=0)
        third = np.arange(len(free.centre))
        near = distance[pair, third] <= reach[pair, third] ** 2
        if near.any() and len(tracks.identity):
            near &= ~self._overlaps(tracks.belief.combined[0][:, :2], free.centre[:, :2]).any(axis=0)
        third = third[near][: limits.tracks - len(tracks.identity)]
        if len(third):
            pair = pair[third]
            self._tracks = tracks.joined(self._born(first.only(pair), second.only(pair), free.only(third)))
            self._drop_doubles()

    def _born(self, *detections: _Detections) -> _Tracks:
        """Tracks from a few detections each: a Kalman filter that starts with a velocity of 0 +- start_speed."""
        limits, last = self._limits, detections[-1]
        count = len(last.centre)
        mean: FloatArray = np.zeros((count, STATES))
        covariance: FloatArray = np.zeros((count, STATES, STATES))
        covariance[:] = np.diag([0.0, 0.0, limits.start_speed**2, limits.start_speed**2, limits.start_turn_rate**2])
        mean[:, :2] = detections[0].centre[:, :2]
        covariance[:, :2, :2] = detections[0].covariance[:, :2, :2]
        model = ConstantVelocity()
        for before, now in pairwise(detections):
            mean, covariance = model.predict(mean, covariance, (now.time_us - before.time_us) * 1.0e-6)
            cross = covariance[:, :, :2]
            gain = cross @ np.linalg.inv(covariance[:, :2, :2] + now.covariance[:, :2, :2])
            mean = mean + (gain @ (now.centre[:, :2] - mean[:, :2])[..., None])[..., 0]
            covariance = covariance - gain @ cross.swapaxes(-1, -2)
            covariance = 0.5 * (covariance + covariance.swapaxes(-1, -2))
        identity = np.arange(self._next_identity, self._next_identity + count)
        self._next_identity += count
        return _Tracks(
            self._filter.started(mean, covariance),
            last.centre[:, 2],
            last.covariance[:, 2, 2],
            last.size,
            np.arctan2(mean[:, VY], mean[:, VX]),
            np.zeros(count),
            identity,
            np.full(count, len(detections)),
            np.zeros(count, dtype=np.bool_),
            np.full(count, last.time_us),
        )


def _squared_distance(one: FloatArray, other: FloatArray) -> FloatArray:
    """Of points (m, 3) and (n, 3) in the plane, (m, n)."""
    x, y = other[:, 0] - one[:, 0, None], other[:, 1] - one[:, 1, None]
    return x * x + y * y


def _variance(detections: _Detections) -> FloatArray:
    """Mean of the variances in x and y, (n,)."""
    return 0.5 * (detections.covariance[:, 0, 0] + detections.covariance[:, 1, 1])


def _yaw(mean: FloatArray, before: FloatArray, yaw_speed: float) -> FloatArray:
    """Directions of velocities (t, 5), or where those are too small to have one, the ones before."""
    moving = np.hypot(mean[:, VX], mean[:, VY]) >= yaw_speed
    return np.where(moving, np.arctan2(mean[:, VY], mean[:, VX]), before)
