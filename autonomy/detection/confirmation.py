"""Objects that are there in two of three scans: the second line against false ones, which come and go."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from autonomy.detection.cloud import Pose
from autonomy.frenet import FloatArray

#: m in the track frame from one scan to the next: 90 m/s at 20 Hz, and half a metre.
GATE = 5.0


class Confirmation:
    """Remembers where objects were in the last two scans; that is all of its state.

    Parameters
    ----------
    gate : m, how far an object may have moved on since the scan before.

    Raises
    ------
    ValueError
        When the gate is not positive and finite.
    """

    def __init__(self, gate: float = GATE) -> None:
        if not 0.0 < gate < math.inf:
            raise ValueError(f"gate is {gate:g}; must be above 0 and finite")
        self._gate = gate
        self._before: deque[FloatArray] = deque(maxlen=2)

    def step(self, centres: FloatArray, pose: Pose) -> NDArray[np.bool_]:
        """Take in a scan; whether each object was there in one of the two scans before as well.

        Parameters
        ----------
        centres : shape (n, 2), m, in the vehicle frame; n may be 0, and is for a scan that failed.
        pose : of the car when the scan was taken; where it is not finite, the scan is one without objects.
        """
        confirmed = np.zeros(len(centres), dtype=np.bool_)
        if not pose.finite:
            self._before.append(np.empty((0, 2)))
            return confirmed
        cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
        places = centres @ np.array([[cos, sin], [-sin, cos]]) + [pose.x, pose.y]
        for back, before in enumerate(reversed(self._before), start=1):
            if len(before):
                apart = places[:, None, :] - before[None, :, :]
                nearest = np.einsum("ijk,ijk->ij", apart, apart).min(axis=1)
                confirmed |= nearest <= (back * self._gate) ** 2
        self._before.append(places)
        return confirmed
