"""Prediction of where tracked opponents will be: along the track, as they are (paper, future trajectory prediction).

An opponent keeps its offset from the centre line and its speed along it, and stays on the track. The last prediction is
propagated while perception is silent, and cleared when that takes too long (paper, Algorithm 2; its condition is
printed the wrong way round).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from autonomy.frenet import FloatArray, Projector
from autonomy.opponents.tracker import TrackedObject
from autonomy.track import Track

_EXTENT = 1.0e6  # m and m/s, of an object that can be projected


@dataclass(frozen=True)
class PredictionLimits:
    """Figures of the prediction; the first three are the paper's.

    Attributes
    ----------
    horizon_s, step_s : of a prediction.
    kept_us : without new perception, for which a prediction is propagated.
    half_width : m, of a car: its side stays on the track.
    outside : m; a centre farther outside of the boundary than this is not on the track and gets no prediction.
    same_along, same_across : m along and beside the centre line; a prediction without new perception that near to one
        with it is of the same car, which has a new track, and is cleared.
    """

    horizon_s: float = 4.0
    step_s: float = 0.1
    kept_us: int = 2_000_000
    half_width: float = 0.95
    outside: float = 3.0
    same_along: float = 4.0
    same_across: float = 1.5


class Prediction(NamedTuple):
    """Predicted way of one opponent, from the time of the tick on; arrays of shape (41,).

    Attributes
    ----------
    identity : number of its track.
    time_us : of the first point. seen_us : of the perception that it rests on.
    time : s from the first point. s, d : m, along and to the left of the centre line; s in [0, length).
    x, y : m. yaw : rad, along the centre line, in (-pi, pi]. speed : m/s over ground.
    """

    identity: int
    time_us: int
    seen_us: int
    time: FloatArray
    s: FloatArray
    d: FloatArray
    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    speed: FloatArray


class _Course(NamedTuple):
    """What is kept of an opponent: where it was at a time, and its speed along the centre line."""

    seen_us: int
    time_us: int
    s: float
    d: float
    speed: float


class OpponentPredictor:
    """Predicts all opponents.

    Parameters
    ----------
    track : to stay on.
    limits : figures.
    """

    def __init__(self, track: Track, limits: PredictionLimits | None = None) -> None:
        self._track = track
        self._limits = limits or PredictionLimits()
        # One of its own: searches of others would throw its hint away.
        self._projector = Projector(track.centre)
        self._courses: dict[int, _Course] = {}
        count = round(self._limits.horizon_s / self._limits.step_s) + 1
        self._times = np.arange(count) * self._limits.step_s

    def step(self, now_us: int, objects: Iterable[TrackedObject]) -> list[Prediction]:
        """Predict from now on.

        Parameters
        ----------
        now_us : time of the tick.
        objects : that the tracker knows now. One is new perception when a scan has held it since the last call with
            it; else, or if it is not there, its last prediction is propagated.

        Returns
        -------
        Predictions by identity. Objects that are not finite, not on the track, or seen later than now are left
        out.
        """
        seen = [tracked for tracked in objects if self._is_new(now_us, tracked)]
        fresh = self._perceive(seen) if seen else set()
        kept_us = self._limits.kept_us
        self._courses = {
            identity: course
            for identity, course in sorted(self._courses.items())
            if 0 <= now_us - course.seen_us <= kept_us
        }
        if fresh:
            self._clear_doubles(now_us, fresh)
        return self._predictions(now_us)

    def _is_new(self, now_us: int, tracked: TrackedObject) -> bool:
        known = self._courses.get(tracked.identity)
        plausible = all(abs(value) <= _EXTENT for value in (tracked.x, tracked.y, tracked.vx, tracked.vy))
        return plausible and tracked.seen_us <= now_us and (known is None or tracked.seen_us > known.seen_us)

    def _perceive(self, seen: list[TrackedObject]) -> set[int]:
        """Note the courses of objects; returns the identities of those that are on the track."""
        limits = self._limits
        place = np.array([self._projector.project(tracked.x, tracked.y) for tracked in seen])
        s, d = place[:, 0], place[:, 1]
        _, _, heading, curvature = self._track.centre.at(s)
        left, right = self._widths(s)
        on_track = (d >= -right - limits.outside) & (d <= left + limits.outside)
        velocity = np.array([(tracked.vx, tracked.vy) for tracked in seen])
        along = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
        fresh = set()
        for i in np.flatnonzero(on_track):
            progress = float(along[i] / (1.0 - curvature[i] * d[i]))
            course = _Course(seen[i].seen_us, seen[i].time_us, float(s[i]), float(d[i]), progress)
            self._courses[seen[i].identity] = course
            fresh.add(seen[i].identity)
        return fresh

    def _clear_doubles(self, now_us: int, fresh: set[int]) -> None:
        """Clear what rests on old perception where new perception has a car."""
        limits, length = self._limits, self._track.length
        here = {identity: self._station(course, now_us) for identity, course in self._courses.items()}
        for identity in self._courses.keys() - fresh:
            course = self._courses[identity]
            for other in sorted(fresh & self._courses.keys()):
                along = math.remainder(here[identity] - here[other], length)
                beside = course.d - self._courses[other].d
                if abs(along) < limits.same_along and abs(beside) < limits.same_across:
                    del self._courses[identity]
                    break

    @staticmethod
    def _station(course: _Course, now_us: int) -> float:
        return course.s + course.speed * (now_us - course.time_us) * 1.0e-6

    def _predictions(self, now_us: int) -> list[Prediction]:
        if not self._courses:
            return []
        start = np.array([self._station(course, now_us) for course in self._courses.values()])
        progress = np.array([course.speed for course in self._courses.values()])[:, None]
        offset = np.array([course.d for course in self._courses.values()])[:, None]
        s = (start[:, None] + progress * self._times) % self._track.length
        left, right = self._widths(s)
        half = self._limits.half_width
        # Where the track is narrower than a car, its middle.
        middle = 0.5 * (left - right)
        d = np.clip(offset, np.minimum(half - right, middle), np.maximum(left - half, middle))
        x, y, heading, curvature = self._track.centre.at(s)
        sin, cos = np.sin(heading), np.cos(heading)
        speed = progress * (1.0 - curvature * d)
        yaw = np.arctan2(sin, cos)
        x, y = x - d * sin, y + d * cos
        return [
            Prediction(identity, now_us, course.seen_us, self._times, s[i], d[i], x[i], y[i], yaw[i], speed[i])
            for i, (identity, course) in enumerate(self._courses.items())
        ]

    def _widths(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances of the left and the right boundary from the centre line, linear between its nodes, m."""
        track = self._track
        position = s / track.centre.spacing
        whole = np.floor(position)
        fraction = position - whole
        i = whole.astype(np.int64) % track.centre.count
        j = (i + 1) % track.centre.count
        left, right = track.width_left, track.width_right
        return left[i] + fraction * (left[j] - left[i]), right[i] + fraction * (right[j] - right[i])
