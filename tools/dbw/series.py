"""Arithmetic on series of values that come piece by piece."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_Number = TypeVar("_Number", np.float64, np.int64)


def steps(values: NDArray[_Number], before: float) -> NDArray[_Number]:
    """Difference of each value to the one before it; `before` is the one before the first."""
    differences = np.empty_like(values)
    differences[0] = values[0] - before
    np.subtract(values[1:], values[:-1], out=differences[1:])
    return differences
