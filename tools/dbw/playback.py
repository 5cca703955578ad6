"""A recording in steps of its own time, to be played."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from dbc.frames import FRAME_DTYPE


def steps(chunks: Iterable[NDArray[np.void]], step_us: int) -> Iterator[tuple[NDArray[np.void], int]]:
    """Cut a recording into steps.

    Parameters
    ----------
    chunks : arrays of `FRAME_DTYPE`, in the order of the recording.
    step_us : length of a step.

    Yields
    ------
    frames, time
        Those of a step, none when nothing was recorded in it, and its end: microseconds since the first frame. A time
        that goes back counts as none passed.
    """
    empty = np.zeros(0, FRAME_DTYPE)
    first_us: int | None = None
    reached_us = end_us = 0
    for frames in chunks:
        times = frames["time_us"].astype(np.int64)
        if first_us is None:
            first_us, end_us = int(times[0]), step_us
        times = np.maximum.accumulate(np.maximum(times - first_us, reached_us))
        reached_us = int(times[-1])
        begin = 0
        while end_us <= reached_us:
            stop = int(np.searchsorted(times, end_us))
            yield (frames[begin:stop] if stop > begin else empty), end_us
            begin, end_us = stop, end_us + step_us
        if begin < len(frames):
            yield frames[begin:], reached_us
