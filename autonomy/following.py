"""How fast a car may be behind another one: a speed for every place and time of a plan.

A speed is allowed when the car can slow down from it to the other one's speed, at a comfortable deceleration b, in what
is left of the gap beyond the distance that it keeps: v^2 = v_other^2 + 2 b (gap - distance), by the braking distances
that P. G. Gipps compares (A behavioural car-following model for computer simulation, 1981).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from autonomy.opponents.prediction import Prediction
from autonomy.race_path import Path, RacePath


@dataclass(frozen=True)
class FollowSettings:
    """Figures of distance keeping; all ours.

    Attributes
    ----------
    length, corridor : m; of a car, and beside the path, where another car's middle is in the way: two half widths of
        1.93 m and a metre.
    standstill_gap : m, between two cars that stand; headway : s, of driving on top.
    deceleration : m/s2, comfortable; hard_deceleration : at most.
    jerk : m/s3, with which a plan brakes for another car.
    ahead : m, of cars that count.
    """

    length: float = 4.9
    corridor: float = 3.0
    standstill_gap: float = 6.0
    headway: float = 0.5
    deceleration: float = 4.0
    hard_deceleration: float = 8.0
    jerk: float = 15.0
    ahead: float = 200.0


class CarAhead(NamedTuple):
    """A car that is ahead now, at equal steps of time.

    Attributes
    ----------
    identity : of its track.
    step_s : from one entry to the next.
    distance : m along the path, from the own front end to the rear of the car.
    speed : m/s, 0 at least.
    """

    identity: int
    step_s: float
    distance: Sequence[float]
    speed: Sequence[float]


def cars_ahead(
    predictions: Iterable[Prediction], race_path: RacePath, path: Path, node: float, settings: FollowSettings
) -> list[CarAhead]:
    """Cars that are ahead and at some time of their prediction in the way.

    A race line goes from one side of the track to the other, so a car that is beside it now may be on it soon; whoever
    does not overtake stays behind it.

    Parameters
    ----------
    predictions : of now, on the track of the path.
    race_path, path : nodes that the plan runs along.
    node : position of the own car among them.
    """
    found = []
    for prediction in predictions:
        nodes = race_path.nodes_at(prediction.s)
        beside = prediction.d - np.interp(nodes, np.arange(race_path.count), path.track_offset, period=race_path.count)
        half = 0.5 * race_path.count
        first = math.fmod(float(nodes[0]) - node + 3.0 * half, race_path.count) - half
        moved = np.unwrap(nodes, period=race_path.count) - nodes[0]
        distance = (first + moved) * race_path.spacing - settings.length
        in_way = bool((np.abs(beside) < settings.corridor).any())
        if first > 0.0 and distance[0] < settings.ahead and in_way:
            speed = np.maximum(prediction.speed, 0.0)
            step_s = float(prediction.time[1] - prediction.time[0])
            found.append(CarAhead(prediction.identity, step_s, distance.tolist(), speed.tolist()))
    return found


def speed_behind(cars: Iterable[CarAhead], time_s: float, way: float, settings: FollowSettings) -> float:
    """Speed that a plan may have at a time, after it has come some way; infinite when nobody is ahead.

    Parameters
    ----------
    time_s, way : from the beginning of the plan, s and m.
    """
    allowed = math.inf
    for car in cars:
        last = len(car.distance) - 1
        place = min(time_s / car.step_s, last)
        i = int(place)
        speed = car.speed[i]
        distance = car.distance[i] + (time_s - i * car.step_s) * speed
        room = distance - way - settings.standstill_gap - settings.headway * speed
        allowed = min(allowed, math.sqrt(max(0.0, speed * speed + 2.0 * settings.deceleration * room)))
    return allowed
