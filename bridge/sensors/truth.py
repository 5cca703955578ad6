"""The truth of one tick as sensor models read it."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Truth(NamedTuple):
    """True motion of the centre of gravity. SI units, ISO 8855 vehicle axes, east-north-up track frame.

    `roll` and `pitch` are the body's to the horizon, `body_roll` and `body_pitch` its share of them: the body to the
    road. Velocity, yaw rate and specific force are in the road's axes.
    """

    x: float
    y: float
    z: float
    yaw: float
    vx: float
    vy: float
    yaw_rate: float
    roll: float
    pitch: float
    body_roll: float
    body_pitch: float
    specific_force_x: float
    specific_force_y: float
    specific_force_z: float
    distance: float

    @property
    def road_roll(self) -> float:
        """Roll of the road under the car, positive with the left side up, rad."""
        return self.roll - self.body_roll

    @property
    def road_pitch(self) -> float:
        """Pitch of the road under the car, positive downhill, rad."""
        return self.pitch - self.body_pitch


class TruthReader:
    """Picks the truth out of the plant's outputs.

    Parameters
    ----------
    names : names of the outputs, in their order.
    """

    def __init__(self, names: Sequence[str]) -> None:
        places = [list(names).index(field) for field in Truth._fields]
        self._pick = itemgetter(*places)
        self._end = max(places) + 1

    def read(self, outputs: NDArray[np.float64]) -> Truth:
        """Truth from the values of all outputs."""
        return Truth._make(self._pick(outputs[: self._end].tolist()))
