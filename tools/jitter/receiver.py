"""The independent receiver: hears buses, sends nothing, keeps everything with the kernel's stamps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bridge.realtime.link import CanLink
from dbc.frames import FRAME_DTYPE


class Receiver:
    """Keeps the frames of several buses.

    Parameters
    ----------
    links : one per bus, without filters.
    """

    def __init__(self, links: Sequence[CanLink]) -> None:
        self._links = links
        self._pieces: list[NDArray[np.void]] = [np.zeros(0, FRAME_DTYPE)]

    def poll(self) -> None:
        """Take what has come in; to be called often enough that no queue fills up."""
        for link in self._links:
            frames = link.receive()
            if frames.size:
                self._pieces.append(frames)

    @property
    def lost(self) -> int:
        """Frames that did not get here, as far as kernel or hub tell."""
        return sum(link.statistics.overflows for link in self._links)

    def frames(self) -> NDArray[np.void]:
        """All that was heard, in order of time; array of `FRAME_DTYPE`."""
        everything = np.concatenate(self._pieces)
        ordered: NDArray[np.void] = everything[np.argsort(everything["time_us"], kind="stable")]
        return ordered
