"""Keeps a run in memory, and records it only when it proves to be worth it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bridge.recorder import Recorder, Recording
from dbc.frames import FRAME_DTYPE


class DeferredRecorder:
    """As `Recorder`, but nothing is written, and no process started, before `finish`.

    Parameters
    ----------
    folder : of the recording; made by `finish`.
    names, units : of the plant's outputs.
    profile : that CAN1 has.

    Attributes
    ----------
    frames, truth : kept so far, in pieces and by time.
    """

    def __init__(self, folder: Path, names: Sequence[str], units: Sequence[str], profile: str) -> None:
        self._folder = folder
        self._names = names
        self._units = units
        self._profile = profile
        self.frames: list[NDArray[np.void]] = []
        self.truth: list[tuple[int, NDArray[np.float64]]] = []

    def add_frames(self, frames: NDArray[np.void]) -> None:
        """Keep frames in order of time; array of `FRAME_DTYPE`."""
        self.frames.append(frames)

    def add_truth(self, time_us: int, outputs: NDArray[np.float64]) -> None:
        """Keep the plant's outputs at one time."""
        self.truth.append((time_us, outputs.copy()))

    def forget(self, until_us: int) -> None:
        """Drop what was before a time."""
        frames: NDArray[np.void] = np.concatenate([np.empty(0, FRAME_DTYPE), *self.frames])
        self.frames[:] = [frames[frames["time_us"] >= max(until_us, 0)]]
        self.truth[:] = [row for row in self.truth if row[0] >= until_us]

    def save_state(self) -> tuple[list[NDArray[np.void]], list[tuple[int, NDArray[np.float64]]]]:
        """What was kept so far, see `bridge.saved_state`."""
        return self.frames.copy(), self.truth.copy()

    def restore_state(self, state: tuple[list[NDArray[np.void]], list[tuple[int, NDArray[np.float64]]]]) -> None:
        """Go on from there."""
        self.frames[:], self.truth[:] = state

    def finish(self) -> Recording:
        """Write the recording.

        Raises
        ------
        RaceloopError
            When the files cannot be written.
        """
        recorder = Recorder(self._folder, self._names, self._units, self._profile)
        for frames in self.frames:
            recorder.add_frames(frames)
        for time_us, outputs in self.truth:
            recorder.add_truth(time_us, outputs)
        return recorder.finish()

    def abort(self) -> None:
        """Forget the run."""
        self.frames.clear()
        self.truth.clear()
