"""Noise of sensors: white noise on a slowly drifting bias, drawn in blocks from a seeded generator."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

#: Samples drawn at once: large enough to make a sample cost next to nothing, small enough to be drawn in no time.
BLOCK = 1024


class DriftingNoise:
    r"""White noise plus a first-order Gauss-Markov process, independent per channel.

    The drift follows :math:`b_{k+1} = a b_k + \sigma_b \sqrt{1 - a^2}\, w_k` with :math:`a = \exp(-\Delta t / \tau)`
    (Gelb, Applied Optimal Estimation, 1974, section 2.3); it starts in its stationary distribution, so that every
    run begins with a bias.

    Parameters
    ----------
    generator : source of randomness; owned by this object from now on.
    white : standard deviation of the white part per channel, in the unit of the channel.
    drift : standard deviation of the drift per channel.
    time_constant_s, period_s : correlation time of the drift and time between samples, s.
    """

    def __init__(
        self,
        generator: np.random.Generator,
        white: Sequence[float],
        drift: Sequence[float],
        time_constant_s: float,
        period_s: float,
    ) -> None:
        self._generator = generator
        self._white = np.asarray(white, dtype=np.float64)
        self._drift = np.asarray(drift, dtype=np.float64)
        self._decay = math.exp(-period_s / time_constant_s)
        self._state: list[float] = (self._drift * generator.standard_normal(len(self._drift))).tolist()
        self._samples: NDArray[np.float64] = np.empty((0, len(self._white)))
        self._place = 0

    def next(self) -> list[float]:
        """Next sample, one value per channel."""
        if self._place == len(self._samples):
            self._samples, self._place = self.block(BLOCK), 0
            self._samples.flags.writeable = False
        sample: list[float] = self._samples[self._place].tolist()
        self._place += 1
        return sample

    def block(self, count: int) -> NDArray[np.float64]:
        """Next samples as an array of shape (count, channels)."""
        shape = (count, len(self._white))
        innovation = self._drift * math.sqrt(1.0 - self._decay**2) * self._generator.standard_normal(shape)
        # Plain numbers: scipy's filter would cost each process that has sensors a second to import.
        state, decay, rows = self._state, self._decay, []
        for row in innovation.tolist():
            state = [decay * before + change for before, change in zip(state, row, strict=True)]
            rows.append(state)
        self._state, drift = state, np.array(rows)
        white = self._white * self._generator.standard_normal(shape)
        result: NDArray[np.float64] = drift + white
        return result
