"""Recordings: what python-can, cantools and pyarrow read back is what was on the buses, byte for byte every time."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import can
import cantools
import numpy as np
import pyarrow.parquet as pq
import pytest
from can.io.blf import BLFReader
from can.io.canutils import CanutilsLogReader

from bridge.bus import CHANNELS
from bridge.recorder import Recorder, Recording
from bridge.replay import read_log
from dbc.buses import DATABASES, DIRECTORY
from dbc.codec import database
from dbc.errors import ConfigurationError, RaceloopError
from dbc.frames import FRAME_DTYPE, Bus, Flag

SEED = 99
NAMES, UNITS = ["x", "vx"], ["m", "m/s"]


def random_frames(count: int, seed: int = SEED) -> np.ndarray:
    """Frames of all messages with random data, in order of time."""
    print(f"seed {seed}")
    generator = np.random.default_rng(seed)
    messages = list(database)
    frames = np.zeros(count, dtype=FRAME_DTYPE)
    frames["time_us"] = np.cumsum(generator.integers(1, 400, count))
    for place, choice in enumerate(generator.integers(0, len(messages), count)):
        message = messages[choice]
        frames[place]["id"], frames[place]["bus"], frames[place]["dlc"] = message.frame_id, message.bus, message.length
        frames[place]["flags"] = Flag.EXTENDED * message.extended
        frames[place]["data"][: message.length] = generator.integers(0, 256, message.length)
    return frames


def record(folder: Path, frames: np.ndarray, chunk: int = 700, rows: int = 2000) -> Recording:
    recorder = Recorder(folder, NAMES, UNITS)
    for start in range(0, len(frames), chunk):
        recorder.add_frames(frames[start : start + chunk])
    for row in range(rows):
        recorder.add_truth(row * 10_000, np.array([row * 0.5, -row]))
    return recorder.finish()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_candump_and_blf_hold_every_frame(tmp_path: Path):
    frames = random_frames(3000)
    recording = record(tmp_path, frames)
    names = {int(bus): name for bus, name in CHANNELS.items()}
    for reader, channel in (
        (CanutilsLogReader(recording.candump), lambda bus: names[bus]),
        (BLFReader(recording.blf), lambda bus: bus),
    ):
        with reader:
            messages = list(reader)
        assert len(messages) == len(frames)
        for frame, message in zip(frames, messages, strict=True):
            assert round(message.timestamp * 1e6) == frame["time_us"]
            assert message.arbitration_id == frame["id"]
            assert message.channel == channel(frame["bus"])
            assert bytes(message.data) == frame["data"][: frame["dlc"]].tobytes()
            assert message.is_extended_id == bool(frame["flags"])


def test_logs_read_back_as_frames(tmp_path: Path):
    frames = random_frames(2000)
    recording = record(tmp_path, frames)
    assert read_log(recording.candump).tobytes() == frames.tobytes()
    assert read_log(recording.blf).tobytes() == frames.tobytes()


def test_unusual_frames_keep_their_kind(tmp_path: Path):
    frames = np.zeros(4, dtype=FRAME_DTYPE)
    frames["time_us"] = [5000, 6000, 7000, 8000]  # later than a millisecond: BLF must not lose the first one's time
    frames["id"] = [0x18DAF110, 0x123, 0x7FF, 0x001]
    frames["flags"] = [Flag.EXTENDED, Flag.REMOTE, 0, 0]
    frames["bus"] = [Bus.CAN1, Bus.CAN3, Bus.CAN_A, Bus.CAN_S]
    frames["dlc"] = [8, 0, 0, 3]
    frames["data"][0] = range(8)
    frames["data"][3][:3] = [1, 2, 3]
    recording = record(tmp_path, frames)
    for log in (read_log(recording.candump), read_log(recording.blf)):
        assert log.tobytes() == frames.tobytes()


def test_hash_is_that_of_the_candump_file(tmp_path: Path):
    recording = record(tmp_path, random_frames(500))
    assert recording.frame_log_sha256 == hashlib.sha256(recording.candump.read_bytes()).hexdigest()


def test_signals_are_what_cantools_decodes_with_units(tmp_path: Path):
    frames = random_frames(4000)
    recording = record(tmp_path, frames)
    databases = {bus: cantools.database.load_file(DIRECTORY / f"{stem}.dbc") for stem, bus in DATABASES.items()}
    seen = 0
    for path in recording.signals.iterdir():
        message = database.message(path.stem)
        reference = databases[message.bus].get_message_by_name(path.stem)
        table = pq.read_table(path)
        chosen = frames[(frames["bus"] == message.bus) & (frames["id"] == message.frame_id)]
        seen += len(chosen)
        assert table.column("time_us").to_pylist() == chosen["time_us"].tolist()
        decoded = [
            reference.decode(frame["data"][: message.length].tobytes(), decode_choices=False, scaling=True)
            for frame in chosen
        ]
        for signal in reference.signals:
            assert table.schema.field(signal.name).metadata[b"unit"].decode() == (signal.unit or "")
            expected = [row[signal.name] for row in decoded]
            assert table.column(signal.name).to_pylist() == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert seen == len(frames)


def test_truth_has_its_columns_and_units(tmp_path: Path):
    table = pq.read_table(record(tmp_path, random_frames(10), rows=20_000).truth)
    assert table.column_names == ["time_us", *NAMES]
    assert [field.metadata[b"unit"] for field in table.schema] == [b"us", b"m", b"m/s"]
    assert table.column("time_us").to_numpy().tolist() == list(range(0, 20_000 * 10_000, 10_000))
    assert np.array_equal(table.column("vx").to_numpy(), -np.arange(20_000.0))


def test_bytes_do_not_depend_on_the_run_or_on_chunks(tmp_path: Path):
    frames = random_frames(5000)
    first = record(tmp_path / "a", frames, chunk=700)
    second = record(tmp_path / "b", frames, chunk=1)
    assert first.frame_log_sha256 == second.frame_log_sha256
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    frames["data"][17, 0] ^= 1
    assert record(tmp_path / "c", frames).frame_log_sha256 != first.frame_log_sha256


def test_a_new_recording_replaces_the_old_one(tmp_path: Path):
    record(tmp_path, random_frames(3000))
    frames = random_frames(3, seed=SEED + 1)
    record(tmp_path, frames)
    fresh = tmp_path / "fresh"
    record(fresh, frames)
    expected = contents(fresh)
    assert {name: data for name, data in contents(tmp_path).items() if not name.startswith("fresh")} == expected


def test_nothing_is_there_before_the_end_or_after_an_abort(tmp_path: Path):
    recorder = Recorder(tmp_path, NAMES, UNITS)
    recorder.add_frames(random_frames(1000))
    assert not [path for path in tmp_path.glob("*") if not path.name.startswith(".")]
    recorder.abort()
    recorder.abort()
    assert list(tmp_path.iterdir()) == []


def test_abort_leaves_the_recording_before_alone(tmp_path: Path):
    record(tmp_path, random_frames(100))
    before = contents(tmp_path)
    recorder = Recorder(tmp_path, NAMES, UNITS)
    recorder.add_frames(random_frames(100, seed=1))
    recorder.abort()
    assert contents(tmp_path) == before


def test_folder_that_cannot_be_written_gives_one_line(tmp_path: Path):
    (tmp_path / "file").write_text("in the way")
    recorder = Recorder(tmp_path / "file" / "out", NAMES, UNITS)
    with pytest.raises(RaceloopError, match="cannot write the recording") as caught:
        recorder.finish()
    assert "\n" not in str(caught.value)
    assert str(tmp_path / "file" / "out") in str(caught.value)


def test_death_of_the_writer_is_reported(tmp_path: Path):
    recorder = Recorder(tmp_path, NAMES, UNITS)
    os.kill(recorder._process.pid, 9)
    recorder._process.wait()
    frames = random_frames(2000)
    with pytest.raises(RaceloopError, match="ended unexpectedly"):
        add_until_refused(recorder, frames)
    recorder.abort()
    assert list(tmp_path.iterdir()) == []


def add_until_refused(recorder: Recorder, frames: np.ndarray) -> None:
    """A pipe's death is noticed at a later write: add until then, or finish."""
    for _ in range(200):
        recorder.add_frames(frames)
    recorder.finish()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("x.asc", b"", "allowed are .log"),
        ("x.blf", b"not a BLF file at all" * 20, "not a readable log"),
        ("x.log", b"(0.1) vcan7 123#00 R\n", "channel vcan7"),
        ("x.log", b"nonsense\n", "not a readable log"),
    ],
)
def test_wrong_logs_are_refused(tmp_path: Path, name: str, content: bytes, words: str):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigurationError, match=words):
        read_log(tmp_path / name)
    with pytest.raises(ConfigurationError, match="No such file"):
        read_log(tmp_path / f"missing{Path(name).suffix}" if name != "x.asc" else tmp_path / "missing.log")


def test_python_can_message_is_what_we_think_it_is():
    # The writer reuses one message object and sets its attributes directly.
    message = can.Message()
    for attribute in ("timestamp", "arbitration_id", "dlc", "data", "channel", "is_extended_id", "is_remote_frame"):
        setattr(message, attribute, getattr(message, attribute))
