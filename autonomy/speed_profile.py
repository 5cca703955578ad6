"""Speed along a path: the fastest that tyres, engine and brakes allow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from autonomy.frenet import FloatArray
from autonomy.vehicle import VehicleLimits


@dataclass(frozen=True)
class PathShape:
    """What the speed on a path depends on.

    Attributes
    ----------
    spacing : of the points, m. curvature, bank : shape (n,), 1/m and rad.
    """

    spacing: float
    curvature: FloatArray
    bank: FloatArray


@dataclass(frozen=True)
class ProfileLimits:
    """Limits beyond the car's own.

    Attributes
    ----------
    max_speed : m/s. max_acceleration, max_deceleration : m/s2, positive.
    friction_margin : share of the tyres' friction that may be used, 0..1.
    drive_margin : share of the engine's acceleration that may be used, 0..1.
    """

    max_speed: float
    max_acceleration: float = math.inf
    max_deceleration: float = math.inf
    friction_margin: float = 1.0
    drive_margin: float = 1.0


def corner_speeds(path: PathShape, vehicle: VehicleLimits, limits: ProfileLimits) -> FloatArray:
    """Speed limit of each point by the lateral force alone, shape (n,), m/s."""
    return np.array(
        [
            vehicle.corner_speed(k, b, limits.friction_margin, limits.max_speed)
            for k, b in zip(path.curvature.tolist(), path.bank.tolist(), strict=True)
        ]
    )


def closed_profile(path: PathShape, vehicle: VehicleLimits, limits: ProfileLimits) -> FloatArray:
    """Fastest speed on a closed path, shape (n,), m/s.

    A forward and a backward pass over the corner speeds (quasi-steady state), from the slowest corner on, whose
    speed neither pass can lower.
    """
    speed = corner_speeds(path, vehicle, limits)
    count = len(speed)
    order = (int(np.argmin(speed)) + np.arange(count + 1)) % count
    lap = PathShape(path.spacing, path.curvature[order], path.bank[order])
    speed[order] = _passes(speed[order], lap, vehicle, limits)
    return speed


def open_profile(
    path: PathShape,
    vehicle: VehicleLimits,
    limits: ProfileLimits,
    start_speed: float,
    *,
    end_speed: float | None = None,
) -> FloatArray:
    """Fastest speed on an open path from a start speed, and to an end speed if there is one, shape (n,), m/s.

    A start speed from which the path cannot be driven is lowered: compare the first value with it.
    """
    speed = corner_speeds(path, vehicle, limits)
    speed[0] = min(float(speed[0]), start_speed)
    if end_speed is not None:
        speed[-1] = min(float(speed[-1]), end_speed)
    return _passes(speed, path, vehicle, limits)


def lap_time(spacing: float, speed: FloatArray) -> float:
    """Time around a closed path whose acceleration is constant between its points, s."""
    return float(np.sum(2.0 * spacing / (speed + np.roll(speed, -1))))


def _passes(speed: FloatArray, path: PathShape, vehicle: VehicleLimits, limits: ProfileLimits) -> FloatArray:
    """Lower the speeds to what acceleration and braking between neighbours allow."""
    result, k, b = speed.tolist(), path.curvature.tolist(), path.bank.tolist()

    def acceleration(i: int, v: float) -> float:
        most = vehicle.acceleration_range(v, k[i], b[i], 0.0, limits.friction_margin)[1]
        return min(limits.max_acceleration, limits.drive_margin * most if most > 0.0 else most)

    def deceleration(i: int, v: float) -> float:
        most = -vehicle.acceleration_range(v, k[i], b[i], 0.0, limits.friction_margin)[0]
        return min(limits.max_deceleration, most)

    for i in range(len(result) - 1):
        result[i + 1] = min(result[i + 1], _travel(result[i], path.spacing, partial(acceleration, i)))
    for i in range(len(result) - 1, 0, -1):
        result[i - 1] = min(result[i - 1], _travel(result[i], path.spacing, partial(deceleration, i)))
    return np.array(result)


def _travel(speed: float, distance: float, acceleration: Callable[[float], float]) -> float:
    """Speed after a distance; the acceleration at the mean of both speeds counts (midpoint rule in v squared)."""
    ahead = math.sqrt(max(0.0, speed * speed + 2.0 * distance * acceleration(speed)))
    middle = math.sqrt(0.5 * (speed * speed + ahead * ahead))
    return math.sqrt(max(0.0, speed * speed + 2.0 * distance * acceleration(middle)))
