"""Whether a point is on the track: by cross-sections between its two edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

FloatArray = NDArray[np.floating]


class TrackEdges:
    """The two edges of a closed track, as cross-sections.

    Parameters
    ----------
    left, right : shape (n, 2), m; points across from each other, closer along the track than it is wide.
    """

    def __init__(self, left: FloatArray, right: FloatArray) -> None:
        self._middle = 0.5 * (left + right)
        across = left - right
        width = np.hypot(across[:, 0], across[:, 1])
        self._half_width = 0.5 * width
        self._across = across / width[:, None]
        self._sections = cKDTree(self._middle)

    def beyond(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """How far points are beyond the nearer edge, m; negative between the edges.

        Parameters
        ----------
        x, y : shape (n,), m, in the track frame.
        """
        points = np.column_stack((x, y))
        _, section = self._sections.query(points)
        offset = np.einsum("ij,ij->i", points - self._middle[section], self._across[section])
        beyond: FloatArray = np.abs(offset) - self._half_width[section]
        return beyond
