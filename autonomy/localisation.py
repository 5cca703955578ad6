"""The estimate that leaves: the better of two filters, without a jump when it changes.

The quality checker follows the Mahalanobis distance between each filter's prediction and its receiver's epochs
(paper, localisation section). Distances of white noise scatter about 2.1 with five measurements; spikes, drift and
a receiver that lies about its accuracy show as larger ones, a lost receiver as an age.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from autonomy.estimation import FilterTuning, GnssFilter, GnssSample, ImuSample, LevelMotion, level
from autonomy.frenet import wrap_angle


class Quality(IntEnum):
    """Quality level of the estimate; the numbers of estimate_quality_level."""

    LOST = 0
    BAD = 1
    DEGRADED = 2
    GOOD = 3


@dataclass(frozen=True)
class QualityLimits:
    """Ranges of the quality checker. Ages in microseconds since the last epoch that was used."""

    good_distance: float = 3.5
    degraded_distance: float = 5.0
    good_age_us: int = 160_000
    degraded_age_us: int = 500_000
    bad_age_us: int = 2_000_000
    good_deviation: float = 0.3  # m
    degraded_deviation: float = 1.0  # m
    agreement: float = 6.0  # of both filters' positions, in standard deviations
    imu_age_us: int = 60_000
    switch_margin: float = 1.5  # of the distances, to leave a filter of the same level
    switch_dwell_us: int = 1_000_000  # for which the margin must hold
    restart_us: int = 1_000_000  # a filter that has used no epoch for so long starts again from its receiver
    jump: float = 0.05  # m; a correction beyond it fades in as a switch does
    settle_s: float = 0.7  # time constant of fading


class Estimate(NamedTuple):
    """Estimate of the car's motion, plan view.

    Attributes
    ----------
    x, y, yaw : track frame, m and rad.
    vx, vy : m/s along and across the heading, horizontal. yaw_rate : of the heading, rad/s.
    ax, ay : m/s2 along and across the heading, horizontal, gravity removed.
    source : 1 GNSS A, 2 GNSS B.
    quality : level of the filter in use.
    distance_a, distance_b : smoothed Mahalanobis distances; infinite while a receiver is not there.
    deviation : 1 sigma of the worse coordinate of the position, m, the drift of the receiver with it.
    """

    x: float
    y: float
    yaw: float
    vx: float
    vy: float
    yaw_rate: float
    ax: float
    ay: float
    source: int
    quality: Quality
    distance_a: float
    distance_b: float
    deviation: float


class _Receiver:
    """One filter with the record of its receiver."""

    SMOOTHING = 0.2  # share of a new distance
    LARGEST_DISTANCE = 50.0

    def __init__(self, tuning: FilterTuning, limits: QualityLimits) -> None:
        self.filter = GnssFilter(tuning)
        self._limits = limits
        self.distance = math.inf
        self._stated_deviation = math.inf
        self._used_us = 0
        self.quality = Quality.LOST

    def predict(self, motion: LevelMotion, dt: float) -> None:
        if self.filter.started:
            self.filter.predict(motion, dt)

    def take(self, now_us: int, gnss: GnssSample) -> None:
        if not all(map(math.isfinite, gnss)):
            return
        if not self.filter.started or now_us - self._used_us > self._limits.restart_us:
            self.filter.start(gnss)
            # A fresh start proves nothing yet: it begins as degraded and has to earn a better level.
            self.distance = self._limits.good_distance + 0.5
            self._used_us = now_us
        else:
            if self.filter.update(gnss):
                self._used_us = now_us
            self.distance += self.SMOOTHING * (min(self.filter.distance, self.LARGEST_DISTANCE) - self.distance)
        self._stated_deviation = max(gnss.std_x, gnss.std_y)

    def judge(self, now_us: int) -> None:
        limits = self._limits
        age = now_us - self._used_us
        # The filter's is true, but a receiver that calls itself bad is not good while the filter still knows better.
        deviation = max(self.filter.position_deviation, self._stated_deviation)
        if not self.filter.started or age > limits.bad_age_us:
            self.quality = Quality.LOST
            self.distance = math.inf
        elif age <= limits.good_age_us and self.distance <= limits.good_distance and deviation <= limits.good_deviation:
            self.quality = Quality.GOOD
        elif (
            age <= limits.degraded_age_us
            and self.distance <= limits.degraded_distance
            and deviation <= limits.degraded_deviation
        ):
            self.quality = Quality.DEGRADED
        else:
            self.quality = Quality.BAD


class Localiser:
    """Runs both filters and picks one.

    Parameters
    ----------
    road : bank and grade (rad) at a position in the track frame.
    """

    # A filter that gets its epochs carries its covariance on with them; one that does not, this often.
    COASTING_S = 0.05

    def __init__(
        self,
        road: Callable[[float, float], tuple[float, float]],
        tuning: FilterTuning | None = None,
        limits: QualityLimits | None = None,
    ) -> None:
        self._limits = limits or QualityLimits()
        self._road = road
        self._receivers = tuple(_Receiver(tuning or FilterTuning(), self._limits) for _ in range(2))
        self._active = -1
        self._imu: ImuSample | None = None
        self._imu_us = 0
        self._last_us = -1
        self._preferred_since_us = -1
        # Estimate minus filter in use: x, y, ve, vn, yaw. Not 0 only while a switch or a jump fades.
        self._offset = (0.0, 0.0, 0.0, 0.0, 0.0)

    def step(
        self, now_us: int, imu: ImuSample | None, gnss_a: GnssSample | None, gnss_b: GnssSample | None
    ) -> Estimate | None:
        """Take what arrived in this tick.

        Parameters
        ----------
        now_us : time of the tick.
        imu, gnss_a, gnss_b : new samples, or None.

        Returns
        -------
        The estimate for now_us, or None before the first epoch.
        """
        dt = (now_us - self._last_us) * 1.0e-6 if self._last_us >= 0 else 0.0
        self._last_us = now_us
        if imu is not None:
            self._imu, self._imu_us = imu, now_us
        if self._imu is not None and self._active >= 0 and dt > 0.0:
            reference = self._receivers[self._active].filter
            bank, grade = self._road(reference.x, reference.y)
            motion = level(self._imu, bank, grade)
            for receiver in self._receivers:
                receiver.predict(motion, dt)
        for index, (receiver, gnss) in enumerate(zip(self._receivers, (gnss_a, gnss_b), strict=True)):
            if gnss is not None:
                before = self._state() if index == self._active else None
                receiver.take(now_us, gnss)
                if before is not None and math.dist(before[:2], self._state()[:2]) > self._limits.jump:
                    self._keep(before)
            elif receiver.filter.coasted > self.COASTING_S:
                receiver.filter.propagate_covariance()
            receiver.judge(now_us)
        self._fade(dt)
        self._choose(now_us)
        return self._estimate(now_us) if self._active >= 0 else None

    def _choose(self, now_us: int) -> None:
        a, b = self._receivers
        if self._active < 0:
            if a.filter.started or b.filter.started:
                self._active = 0 if a.quality >= b.quality else 1
            return
        mine, other = (a, b) if self._active == 0 else (b, a)
        nearer = other.quality == mine.quality and other.distance < mine.distance - self._limits.switch_margin
        if not nearer:
            self._preferred_since_us = -1
        elif self._preferred_since_us < 0:
            self._preferred_since_us = now_us
        dwelt = nearer and now_us - self._preferred_since_us >= self._limits.switch_dwell_us
        if other.quality > mine.quality or dwelt:
            state = self._state()
            self._active = 1 - self._active
            self._preferred_since_us = -1
            self._keep(state)

    def _state(self) -> tuple[float, float, float, float, float]:
        """Position, velocity and heading as the estimate has them."""
        f = self._receivers[self._active].filter
        dx, dy, de, dn, dyaw = self._offset
        return f.x + dx, f.y + dy, f.velocity_east + de, f.velocity_north + dn, f.yaw + dyaw

    def _keep(self, state: tuple[float, float, float, float, float]) -> None:
        """Go on from a state; the offset to the filter in use then fades."""
        f = self._receivers[self._active].filter
        x, y, east, north, yaw = state
        self._offset = (x - f.x, y - f.y, east - f.velocity_east, north - f.velocity_north, wrap_angle(yaw - f.yaw))

    def _fade(self, dt: float) -> None:
        if self._offset != (0.0, 0.0, 0.0, 0.0, 0.0):
            keep = math.exp(-dt / self._limits.settle_s)
            dx, dy, de, dn, dyaw = self._offset
            self._offset = (keep * dx, keep * dy, keep * de, keep * dn, keep * dyaw)
            if max(map(abs, self._offset)) < 1.0e-5:
                self._offset = (0.0, 0.0, 0.0, 0.0, 0.0)

    def _quality(self, now_us: int) -> Quality:
        mine, other = self._receivers[self._active], self._receivers[1 - self._active]
        if now_us - self._imu_us > self._limits.imu_age_us:
            return min(mine.quality, Quality.BAD)
        if mine.quality == Quality.GOOD and other.quality == Quality.GOOD:
            apart = math.hypot(mine.filter.x - other.filter.x, mine.filter.y - other.filter.y)
            deviations = mine.filter.position_deviation, other.filter.position_deviation
            if apart > self._limits.agreement * math.hypot(*deviations):
                return Quality.DEGRADED
        return mine.quality

    def _estimate(self, now_us: int) -> Estimate:
        f = self._receivers[self._active].filter
        x, y, east, north, yaw = self._state()
        cos, sin = math.cos(yaw), math.sin(yaw)
        return Estimate(
            x=x,
            y=y,
            yaw=wrap_angle(yaw),
            vx=east * cos + north * sin,
            vy=north * cos - east * sin,
            yaw_rate=f.yaw_rate,
            ax=f.ax,
            ay=f.ay,
            source=self._active + 1,
            quality=self._quality(now_us),
            distance_a=self._receivers[0].distance,
            distance_b=self._receivers[1].distance,
            deviation=f.position_deviation,
        )
