"""Tracking quality of a run: where the car was against the path that was published at the time.

The errors are those of the true pose, not of the estimate, against the newest plan on the bus, so neither the
estimator nor the planner can flatter them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SPEED_RANGES_KMH: tuple[tuple[float, float], ...] = ((0.0, 100.0), (100.0, 150.0), (150.0, float("inf")))
"""Speed ranges of the paper's table of tracking errors (solo lap)."""

DRIVING_MPS = 0.5
"""Below this the car stands; samples there would only dilute the means."""


@dataclass(frozen=True)
class PaperRow:
    """One row of the paper's solo-lap table."""

    cte_max_m: float
    cte_abs_mean_m: float
    cte_std_m: float
    yaw_error_max_rad: float


PAPER: tuple[PaperRow, ...] = (
    PaperRow(0.59, 0.15, 0.192, 0.074),
    PaperRow(0.71, 0.17, 0.214, 0.070),
    PaperRow(1.15, 0.30, 0.443, 0.067),
)
"""Solo lap at LVMS, team KAIST, per entry of `SPEED_RANGES_KMH` (paper, section "High-speed Solo Lap")."""

PAPER_TOP_SPEED_KMH = 227.2


@dataclass(frozen=True)
class Plans:
    """Published plans, ordered by time.

    Parameters
    ----------
    time_us : (n,) when the last point of each plan was on the bus.
    start : (n + 1,) index of each plan's first point in the point arrays.
    x, y, yaw, curvature : (m,) points of all plans; m, m, rad, 1/m.
    """

    time_us: NDArray[np.int64]
    start: NDArray[np.int64]
    x: Floats
    y: Floats
    yaw: Floats
    curvature: Floats


@dataclass(frozen=True)
class TrackingErrors:
    """Errors over time.

    Parameters
    ----------
    speed : (n,) m/s.
    cross_track : (n,) m, positive when the car is left of the path.
    yaw : (n,) rad, heading of the car minus heading of the path.
    """

    speed: Floats
    cross_track: Floats
    yaw: Floats


def wrap_angle(angle: Floats) -> Floats:
    """Wrap to (-pi, pi]."""
    wrapped: Floats = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return wrapped


def tracking_errors(
    time_us: NDArray[np.int64], x: Floats, y: Floats, yaw: Floats, speed: Floats, plans: Plans
) -> TrackingErrors:
    """Errors of the true pose against the newest plan, for every sample where the car drives on a plan.

    The path about its nearest point is taken as a parabola with that point's heading and curvature; with points
    at most 8 m apart on turns wider than 20 m that is exact to millimetres.

    Parameters
    ----------
    time_us, x, y, yaw, speed : (n,) true pose over time; us, m, m, rad, m/s.
    plans : what was published.
    """
    plan_index = np.searchsorted(plans.time_us, time_us, side="right") - 1
    use = (plan_index >= 0) & (speed > DRIVING_MPS)
    cross_track = np.zeros(time_us.shape)
    yaw_error = np.zeros(time_us.shape)
    for plan in np.unique(plan_index[use]):
        points = slice(int(plans.start[plan]), int(plans.start[plan + 1]))
        samples = _run(plan_index, int(plan), use)
        px, py = plans.x[points], plans.y[points]
        distance = np.hypot(x[samples, None] - px, y[samples, None] - py)
        nearest = np.argmin(distance, axis=1)
        heading = plans.yaw[points][nearest]
        curvature = plans.curvature[points][nearest]
        dx, dy = x[samples] - px[nearest], y[samples] - py[nearest]
        along = np.cos(heading) * dx + np.sin(heading) * dy
        across = -np.sin(heading) * dx + np.cos(heading) * dy
        cross_track[samples] = across - 0.5 * curvature * along**2
        yaw_error[samples] = wrap_angle(yaw[samples] - heading - curvature * along)
    return TrackingErrors(speed[use], cross_track[use], yaw_error[use])


def _run(plan_index: NDArray[np.int64], plan: int, use: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Samples of one plan: `plan_index` is sorted, so they are one run."""
    first, last = np.searchsorted(plan_index, [plan, plan + 1])
    samples: NDArray[np.int64] = np.flatnonzero(use[first:last]) + first
    return samples


def tracking_table(errors: TrackingErrors) -> list[dict[str, object]]:
    """Per speed range the figures of the paper's table; ranges without a sample have None."""
    rows: list[dict[str, object]] = []
    speed_kmh = errors.speed * 3.6
    for low, high in SPEED_RANGES_KMH:
        inside = (speed_kmh >= low) & (speed_kmh < high)
        cte, yaw = errors.cross_track[inside], errors.yaw[inside]
        some = bool(inside.any())
        rows.append(
            {
                "speed_range_kmh": [low, None if np.isinf(high) else high],
                "samples": int(inside.sum()),
                "cte_max_m": float(np.abs(cte).max()) if some else None,
                "cte_abs_mean_m": float(np.abs(cte).mean()) if some else None,
                "cte_std_m": float(cte.std()) if some else None,
                "yaw_error_max_rad": float(np.abs(yaw).max()) if some else None,
            }
        )
    return rows


def plans_from_points(
    plan_counter: NDArray[np.int64],
    index: NDArray[np.int64],
    time_us: NDArray[np.int64],
    x: Floats,
    y: Floats,
    yaw: Floats,
    curvature: Floats,
) -> Plans:
    """Cut the stream of plan points on the bus into plans: a new one begins when the counter changes.

    Parameters
    ----------
    plan_counter, index, time_us, x, y, yaw, curvature : (m,) one entry per pair of trajectory_pose and
        trajectory_motion, in bus order.

    Raises
    ------
    ValueError
        when a plan's points are not numbered 0, 1, 2 ... in order.
    """
    if plan_counter.size == 0:
        empty = np.zeros(0)
        return Plans(np.zeros(0, np.int64), np.zeros(1, np.int64), empty, empty, empty, empty)
    begins = np.flatnonzero(np.diff(plan_counter, prepend=plan_counter[0] - 1) != 0)
    start = np.append(begins, plan_counter.size)
    for first, last in pairwise(start):
        if not np.array_equal(index[first:last], np.arange(last - first)):
            raise ValueError(f"plan at {time_us[first]} us: points out of order")
    return Plans(time_us[start[1:] - 1], start, x, y, yaw, curvature)
