"""The truth of one tick as sensor models read it."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple


class Truth(NamedTuple):
    """True motion of the centre of gravity. SI units, ISO 8855 vehicle axes, east-north-up track frame."""

    x: float
    y: float
    yaw: float
    vx: float
    vy: float
    yaw_rate: float
    roll: float
    specific_force_x: float
    specific_force_y: float
    specific_force_z: float
    distance: float


class TruthReader:
    """Picks the truth out of the plant's outputs.

    Parameters
    ----------
    names : names of the outputs, in their order.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._pick = itemgetter(*(list(names).index(field) for field in Truth._fields))

    def read(self, outputs: list[float]) -> Truth:
        """Truth from the values of all outputs."""
        return Truth._make(self._pick(outputs))
