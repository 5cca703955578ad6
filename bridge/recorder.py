"""Records a run: frames and truth go to a writer process (:mod:`bridge.log_writer`) on another core."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from threading import Thread

import numpy as np
from numpy.typing import NDArray

from bridge.log_writer import (
    ABORT_RECORD,
    BLF,
    CANDUMP,
    END_RECORD,
    FRAMES_RECORD,
    PARTIAL,
    RECORD,
    SIGNALS,
    TRUTH,
    TRUTH_RECORD,
)
from dbc.buses import DEFAULT_PROFILE
from dbc.errors import RaceloopError

_ROWS = 512

#: Records that may wait for the writer: some 30 MB, a minute of a run. Beyond, the loop waits for the writer.
_QUEUE_RECORDS = 256


@dataclass(frozen=True)
class Recording:
    """A finished recording.

    Attributes
    ----------
    candump, blf : raw frames of all buses.
    signals : folder with one Parquet file per message.
    truth : Parquet file of the plant's outputs every tick.
    frame_log_sha256 : SHA-256 of the candump file.
    """

    candump: Path
    blf: Path
    signals: Path
    truth: Path
    frame_log_sha256: str


class Recorder:
    """Streams a run to its files; they appear when `finish` returns, or never.

    Parameters
    ----------
    folder : of the recording; created when missing.
    names, units : of the plant's outputs.
    profile : that CAN1 has, for its signals.
    keep : a run that cannot be repeated: when this process dies, what it has given is put into place.

    Raises
    ------
    RaceloopError
        From any method, when the files cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        names: Sequence[str],
        units: Sequence[str],
        profile: str = DEFAULT_PROFILE,
        keep: bool = False,
    ) -> None:
        self._folder = folder
        self._rows: NDArray[np.float64] = np.empty((_ROWS, len(names) + 1))
        self._row_count = 0
        options = json.dumps(
            {
                "folder": str(folder.absolute()),
                "names": list(names),
                "units": list(units),
                "profile": profile,
                "keep": keep,
            }
        )
        self._process = subprocess.Popen(
            [sys.executable, "-m", "bridge.log_writer", options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            process_group=0,  # a signal for all of us is not for the writer: we decide what becomes of the recording
        )
        # The writer is slower than a burst of the loop; a thread keeps its pipe full and the loop out of it.
        self._records: Queue[bytes | None] = Queue(_QUEUE_RECORDS)
        self._broken = False
        self._feeder = Thread(target=self._feed, name="recorder", daemon=True)
        self._feeder.start()

    def add_frames(self, frames: NDArray[np.void]) -> None:
        """Append frames in order of time; array of `FRAME_DTYPE`."""
        self._send(FRAMES_RECORD, frames.tobytes())

    def add_truth(self, time_us: int, outputs: NDArray[np.float64]) -> None:
        """Append the plant's outputs at one time."""
        row = self._rows[self._row_count]
        row[0] = time_us
        row[1:] = outputs
        self._row_count += 1
        if self._row_count == _ROWS:
            self.flush()

    def save_state(self) -> None:
        """What is with the writer cannot be taken back.

        Raises
        ------
        RaceloopError
            Always.
        """
        raise RaceloopError(
            f"{self._folder}: a run that is being recorded cannot be saved; record from a saved state on"
        )

    def flush(self) -> None:
        """Hand over the truth so far, which otherwise waits for more."""
        if self._row_count:
            self._send(TRUTH_RECORD, self._rows[: self._row_count].tobytes())
            self._row_count = 0

    def finish(self) -> Recording:
        """Wait for the writer and return the recording."""
        self.flush()
        self._send(END_RECORD, b"")
        output, complaint = self._wait()
        if self._process.returncode != 0:
            raise self._failed(complaint)
        digest = json.loads(output)["frame_log_sha256"]
        folder = self._folder
        return Recording(folder / CANDUMP, folder / BLF, folder / SIGNALS, folder / TRUTH, digest)

    def abort(self) -> None:
        """End without a recording: what was written is removed. Safe at any time."""
        if self._process.returncode is None:
            self._records.put(RECORD.pack(ABORT_RECORD, 0))
            self._wait()

    def _send(self, kind: bytes, payload: bytes) -> None:
        if self._broken:
            raise self._failed(self._wait()[1])
        self._records.put(RECORD.pack(kind, len(payload)) + payload)

    def _wait(self) -> tuple[bytes, bytes]:
        """End the stream and wait for the writer's last words."""
        self._records.put(None)
        self._feeder.join()
        self._process.stdin = None  # the feeder has closed it
        return self._process.communicate()

    def _feed(self) -> None:
        stream = self._process.stdin
        assert stream is not None
        while (record := self._records.get()) is not None:
            if not self._broken:  # a dead writer is noticed at the next record; until then the queue must not fill up
                try:
                    stream.write(record)
                except BrokenPipeError:
                    self._broken = True
        with suppress(BrokenPipeError):
            stream.close()

    def _failed(self, complaint: bytes) -> RaceloopError:
        shutil.rmtree(self._folder / PARTIAL, ignore_errors=True)  # a writer that was killed could not
        lines = complaint.decode("utf-8", "replace").strip().splitlines()
        return RaceloopError(lines[-1] if lines else f"{self._folder}: the recording's writer ended unexpectedly")
