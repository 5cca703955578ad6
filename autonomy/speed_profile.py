"""Speed along a path: the fastest that tyres, engine and brakes allow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from autonomy.frenet import FloatArray
from autonomy.vehicle import VehicleLimits


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


def corner_speeds(curvature: FloatArray, bank: FloatArray, vehicle: VehicleLimits, limits: ProfileLimits) -> FloatArray:
    """Speed limit of each point by the lateral force alone, shape (n,), m/s."""
    return np.array(
        [
            vehicle.corner_speed(k, b, limits.friction_margin, limits.max_speed)
            for k, b in zip(curvature.tolist(), bank.tolist(), strict=True)
        ]
    )


def closed_profile(
    spacing: float, curvature: FloatArray, bank: FloatArray, vehicle: VehicleLimits, limits: ProfileLimits
) -> FloatArray:
    """Fastest speed on a closed path.

    Forward and backward passes over the corner speeds (quasi-steady state), each twice around so that the start
    does not matter.

    Parameters
    ----------
    spacing : of the points, m.
    curvature, bank : shape (n,), 1/m and rad.

    Returns
    -------
    Speed at the points, shape (n,), m/s.
    """
    speed = corner_speeds(curvature, bank, vehicle, limits)
    lap = np.concatenate((speed, speed))
    start = int(np.argmin(speed))
    order = np.arange(start, start + len(speed) + 1)
    k, b = np.append(curvature, curvature)[order], np.append(bank, bank)[order]
    # From the slowest corner, which no pass can lower, once around is enough.
    passed = _backward(_forward(lap[order], spacing, k, b, vehicle, limits), spacing, k, b, vehicle, limits)
    result = np.empty_like(speed)
    result[order[:-1] % len(speed)] = passed[:-1]
    return result


def open_profile(
    spacing: float,
    curvature: FloatArray,
    bank: FloatArray,
    vehicle: VehicleLimits,
    limits: ProfileLimits,
    start_speed: float,
    end_speed: float | None = None,
) -> FloatArray:
    """Fastest speed on an open path from a given start speed, and to an end speed if there is one.

    Parameters and returns as closed_profile. A start speed from which the end speed cannot be reached is lowered:
    compare the first value with it.
    """
    speed = corner_speeds(curvature, bank, vehicle, limits)
    speed[0] = min(speed[0], start_speed)
    if end_speed is not None:
        speed[-1] = min(speed[-1], end_speed)
    speed = _forward(speed, spacing, curvature, bank, vehicle, limits)
    return _backward(speed, spacing, curvature, bank, vehicle, limits)


def lap_time(spacing: float, speed: FloatArray) -> float:
    """Time around a closed path whose acceleration is constant between its points, s."""
    return float(np.sum(2.0 * spacing / (speed + np.roll(speed, -1))))


def _forward(
    speed: FloatArray, spacing: float, curvature: FloatArray, bank: FloatArray, vehicle: VehicleLimits,
    limits: ProfileLimits,
) -> FloatArray:
    result, k, b = speed.tolist(), curvature.tolist(), bank.tolist()
    for i in range(len(result) - 1):

        def acceleration(v: float, i: int = i) -> float:
            most = vehicle.acceleration_range(v, k[i], b[i], 0.0, limits.friction_margin)[1]
            return min(limits.max_acceleration, limits.drive_margin * most if most > 0.0 else most)

        result[i + 1] = min(result[i + 1], _travel(result[i], spacing, acceleration))
    return np.array(result)


def _backward(
    speed: FloatArray, spacing: float, curvature: FloatArray, bank: FloatArray, vehicle: VehicleLimits,
    limits: ProfileLimits,
) -> FloatArray:
    result, k, b = speed.tolist(), curvature.tolist(), bank.tolist()
    for i in range(len(result) - 1, 0, -1):

        def deceleration(v: float, i: int = i) -> float:
            most = -vehicle.acceleration_range(v, k[i], b[i], 0.0, limits.friction_margin)[0]
            return min(limits.max_deceleration, most)

        result[i - 1] = min(result[i - 1], _travel(result[i], spacing, deceleration))
    return np.array(result)


def _travel(speed: float, distance: float, acceleration: Callable[[float], float]) -> float:
    """Speed after a distance; the acceleration at the mean of both speeds counts (midpoint rule in v squared)."""
    ahead = math.sqrt(max(0.0, speed * speed + 2.0 * distance * acceleration(speed)))
    middle = math.sqrt(0.5 * (speed * speed + ahead * ahead))
    return math.sqrt(max(0.0, speed * speed + 2.0 * distance * acceleration(middle)))
