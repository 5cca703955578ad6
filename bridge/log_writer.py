"""Writes a recording: frame logs through python-can, decoded signals and truth as Parquet.

Runs as a process of its own (:mod:`bridge.recorder` starts it), so that formatting costs the loop nothing. All
times are simulated, so two runs of one scenario give identical bytes. Files appear under their names only when the
whole recording is complete.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from struct import Struct
from typing import Any, BinaryIO

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from can.io.blf import BLFWriter
from can.io.canutils import CanutilsLogWriter
from numpy.typing import NDArray

from bridge.bus import CHANNELS
from dbc.codec import Codec, profile
from dbc.errors import RaceloopError
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, FRAME_STRUCT, Flag

#: Names inside the folder of a recording.
CANDUMP, BLF, SIGNALS, TRUTH = "frames.log", "frames.blf", "signals", "truth.parquet"
#: Folder in it where the recording grows.
PARTIAL = ".partial"

#: One record from the recorder: kind and length, then that many bytes.
RECORD = Struct("<cQ")
FRAMES_RECORD, TRUTH_RECORD, END_RECORD, ABORT_RECORD = b"F", b"T", b"E", b"A"

#: Frames, and rows of truth, that make one row group.
_FRAMES_PER_GROUP = 1 << 18
_ROWS_PER_GROUP = 1 << 14


class FrameLogs:
    """Candump and BLF logs of the same frames.

    Parameters
    ----------
    folder : where to write.
    """

    def __init__(self, folder: Path) -> None:
        self._candump = CanutilsLogWriter(folder / CANDUMP)
        self._blf = BLFWriter(folder / BLF, compression_level=1)
        # BLF keeps times relative to the first frame and, for times that are no dates, forgets the first one.
        self._blf.start_timestamp = 0.0
        self._message = can.Message()
        self._set_flags(0)
        self._names = {int(bus): name for bus, name in CHANNELS.items()}

    def write(self, frames: bytes) -> None:
        """Append frames, which must be in order of time."""
        # One message object for all frames, its flags touched only when they change: this is the writer's hot path.
        message, names = self._message, self._names
        candump, blf = self._candump.on_message_received, self._blf.on_message_received
        for time_us, identifier, bus, dlc, flags, _sender, data in FRAME_STRUCT.iter_unpack(frames):
            if flags != self._flags:
                self._set_flags(flags)
            message.timestamp = time_us * 1e-6
            message.arbitration_id = identifier
            message.dlc = dlc
            message.data = data[:dlc]
            message.channel = names[bus]
            candump(message)
            message.channel = bus  # BLF counts channels from 1: CAN1 is channel 1
            blf(message)

    def _set_flags(self, flags: int) -> None:
        self._flags = flags
        self._message.is_extended_id = bool(flags & Flag.EXTENDED)
        self._message.is_remote_frame = bool(flags & Flag.REMOTE)
        self._message.is_error_frame = bool(flags & Flag.ERROR)

    def close(self) -> None:
        """Finish both files."""
        self._candump.stop()
        self._blf.stop()


class SignalTables:
    """One Parquet file per message: time_us and its signals, with their units in the metadata of the fields.

    Parameters
    ----------
    folder : where to write; must exist.
    database : messages of the profile that CAN1 has.
    """

    def __init__(self, folder: Path, database: Codec) -> None:
        self._database = database
        self._folder = folder
        self._writers: dict[str, pq.ParquetWriter] = {}

    def write(self, frames: bytes) -> None:
        """Append a row group per message."""
        for name, signals in self._database.decode_columns(np.frombuffer(frames, dtype=FRAME_DTYPE)).items():
            writer = self._writers.get(name)
            if writer is None:
                writer = self._writers[name] = self._open(name)
            times = next(iter(signals.values()))[0]
            columns = [pa.array(times.astype(np.int64)), *(pa.array(values) for _, values in signals.values())]
            writer.write_table(pa.Table.from_arrays(columns, schema=writer.schema))

    def close(self) -> None:
        """Finish all files."""
        for writer in self._writers.values():
            writer.close()

    def _open(self, name: str) -> pq.ParquetWriter:
        facts = self._database.facts(name)
        units = {item.name: item.unit or "" for item in facts.message.signals}
        fields = [_field("time_us", pa.int64(), "us")]
        fields += [
            _field(signal_name, pa.float64(), units[signal_name])
            for signal_name in self._database.message(name).signals
        ]
        metadata = {"message": name, "bus": CHANNELS[facts.bus], "id": str(facts.message.frame_id)}
        return pq.ParquetWriter(
            self._folder / f"{name}.parquet", pa.schema(fields, metadata=metadata), compression="zstd"
        )


class TruthTable:
    """Outputs of the plant over time.

    Parameters
    ----------
    path : file to write.
    names, units : of the columns behind time_us.
    """

    def __init__(self, path: Path, names: Sequence[str], units: Sequence[str]) -> None:
        fields = [_field("time_us", pa.int64(), "us")]
        fields += [_field(name, pa.float64(), unit) for name, unit in zip(names, units, strict=True)]
        self._schema = pa.schema(fields)
        self._writer = pq.ParquetWriter(path, self._schema, compression="zstd")

    @property
    def width(self) -> int:
        """Columns."""
        return len(self._schema)

    def write(self, rows: NDArray[np.float64]) -> None:
        """Append a row group; shape (n, width), time in microseconds first."""
        columns = [pa.array(rows[:, 0].astype(np.int64))]
        columns += [pa.array(np.ascontiguousarray(rows[:, place])) for place in range(1, self.width)]
        self._writer.write_table(pa.Table.from_arrays(columns, schema=self._schema))

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


class LogWriter:
    """A whole recording, written aside and put into place by `finish`.

    Parameters
    ----------
    folder : of the recording; created when missing.
    names, units : of the plant's outputs.
    database : messages of the profile that CAN1 has.
    """

    def __init__(self, folder: Path, names: Sequence[str], units: Sequence[str], database: Codec) -> None:
        self._folder = folder
        self._partial = folder / PARTIAL
        shutil.rmtree(self._partial, ignore_errors=True)  # left by a run that was killed
        (self._partial / SIGNALS).mkdir(parents=True)
        self._logs = FrameLogs(self._partial)
        self._signals = SignalTables(self._partial / SIGNALS, database)
        self._truth = TruthTable(self._partial / TRUTH, names, units)
        self._frames = bytearray()
        self._rows = bytearray()

    def add_frames(self, frames: bytes) -> None:
        """Append frames in order of time."""
        self._logs.write(frames)
        self._frames += frames
        while len(self._frames) >= _FRAMES_PER_GROUP * FRAME_SIZE:
            self._signals.write(bytes(self._frames[: _FRAMES_PER_GROUP * FRAME_SIZE]))
            del self._frames[: _FRAMES_PER_GROUP * FRAME_SIZE]

    def add_truth(self, rows: bytes) -> None:
        """Append rows of doubles: time in microseconds, then the outputs."""
        self._rows += rows
        size = _ROWS_PER_GROUP * self._truth.width * 8
        while len(self._rows) >= size:
            self._write_truth(bytes(self._rows[:size]))
            del self._rows[:size]

    def finish(self) -> str:
        """Put the recording into place; returns the SHA-256 of the candump log."""
        if self._frames:
            self._signals.write(bytes(self._frames))
        if self._rows:
            self._write_truth(bytes(self._rows))
        self._close()
        with (self._partial / CANDUMP).open("rb") as log:
            digest = hashlib.file_digest(log, "sha256").hexdigest()
        for name in (CANDUMP, BLF, SIGNALS, TRUTH):
            final = self._folder / name
            if final.is_dir():
                shutil.rmtree(final)
            (self._partial / name).replace(final)
        self._partial.rmdir()
        return digest

    def abort(self) -> None:
        """Remove what was written."""
        self._close()
        shutil.rmtree(self._partial, ignore_errors=True)

    def _write_truth(self, rows: bytes) -> None:
        self._truth.write(np.frombuffer(rows, dtype=np.float64).reshape(-1, self._truth.width))

    def _close(self) -> None:
        self._logs.close()
        self._signals.close()
        self._truth.close()


def _field(name: str, kind: pa.DataType, unit: str) -> pa.Field:
    return pa.field(name, kind, nullable=False, metadata={"unit": unit})


def serve(stream: BinaryIO, writer: LogWriter, keep: bool) -> str | None:
    """Write records from a stream until the one that ends it.

    Parameters
    ----------
    keep : what to do when the stream breaks off, because whoever recorded has died: finish what there is.

    Returns
    -------
    str or None
        SHA-256 of the candump log, or None: there is to be no recording.
    """
    while len(header := stream.read(RECORD.size)) == RECORD.size:
        kind, length = RECORD.unpack(header)
        payload = stream.read(length)
        if len(payload) < length:
            break
        if kind == FRAMES_RECORD:
            writer.add_frames(payload)
        elif kind == TRUTH_RECORD:
            writer.add_truth(payload)
        elif kind == ABORT_RECORD:
            return None
        elif kind == END_RECORD:
            return writer.finish()
    return writer.finish() if keep else None


def main(arguments: Sequence[str]) -> int:
    """Entry of the writer process: the recording's description as JSON, records on standard input."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # when the terminal goes, the end of the stream decides
    options: dict[str, Any] = json.loads(arguments[0])
    folder = Path(options["folder"])
    try:
        writer = LogWriter(folder, options["names"], options["units"], profile(options["profile"]))
        try:
            digest = serve(sys.stdin.buffer, writer, options["keep"])
        except BaseException:
            writer.abort()
            raise
        if digest is None:
            writer.abort()
            return 1
    except (OSError, pa.ArrowException, RaceloopError) as error:
        print(f"{folder}: cannot write the recording: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    print(json.dumps({"frame_log_sha256": digest}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
