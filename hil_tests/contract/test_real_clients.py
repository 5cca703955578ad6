"""Programs of others read the same traffic, a short drive: cantools, can-utils and opendbc see our values."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

import cantools.database
import numpy as np
import pytest
from cantools.database.can import Database

from bridge.bus import CHANNELS
from bridge.scenario import load_scenario
from dbc.buses import DATABASES, DIRECTORY
from dbc.codec import database
from dbc.frames import FRAME_DTYPE, Bus, Flag
from tools.check_bench import record
from tools.dbw.log_source import read_chunks
from tools.run import DEFAULT_SCENARIO

Frames = np.ndarray
Columns = Mapping[str, Mapping[str, np.ndarray]]
"""Values by message and signal, in the order of the frames."""

BEGIN_US = 1_000_000
"""What is before is left out: log2asc takes a log that begins in its first second for one that has not begun."""
SECONDS = 2.0
EXTENDED_IN_DBC = 0x8000_0000


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of a drive in candump's format."""
    folder = tmp_path_factory.mktemp("drive")
    lines = record(load_scenario(DEFAULT_SCENARIO), SECONDS, folder / "out").read_text().splitlines(keepends=True)
    path = folder / "drive.log"
    path.write_text("".join(line for line in lines if float(line[1 : line.index(")")]) * 1e6 >= BEGIN_US))
    return path


def read(path: Path) -> Frames:
    frames = list(read_chunks(path, None, lambda frame, text: pytest.fail(f"frame {frame}: {text}")))
    return np.concatenate(frames)


@pytest.fixture(scope="module")
def frames(log: Path) -> Frames:
    return read(log)


@pytest.fixture(scope="module")
def values(frames: Frames) -> Columns:
    """As our codec has them."""
    columns = database.decode_columns(frames)
    return {message: {name: column for name, (_, column) in of.items()} for message, of in columns.items()}


def content(frames: Frames) -> Frames:
    """Without the time."""
    without = frames.copy()
    without["time_us"] = 0
    return without


def assert_same(values: Columns, others: Mapping[str, Mapping[str, list[float]]]) -> None:
    assert set(others) == set(values)
    assert len(values) > 70
    for message, signals in values.items():
        assert set(others[message]) == set(signals), message
        for name, column in signals.items():
            np.testing.assert_allclose(
                others[message][name], column, rtol=1e-12, atol=1e-12, err_msg=f"{message}.{name}"
            )


def test_cantools(frames: Frames, values: Columns):
    """Every signal of every frame."""
    databases: dict[int, Database] = {}
    for stem, bus in DATABASES.items():
        loaded = cantools.database.load_file(DIRECTORY / f"{stem}.dbc", encoding="cp1252")
        assert isinstance(loaded, Database)
        databases[int(bus)] = loaded
    others: dict[str, dict[str, list[float]]] = {}
    for frame in frames:
        message = databases[int(frame["bus"])].get_message_by_frame_id(int(frame["id"]))
        decoded = message.decode(bytes(frame["data"])[: int(frame["dlc"])], decode_choices=False)
        for name, value in decoded.items():
            others.setdefault(message.name, {}).setdefault(name, []).append(value)
    assert_same(values, others)


needs_can_utils = pytest.mark.skipif(shutil.which("log2asc") is None, reason="can-utils is not installed")


@needs_can_utils
def test_can_utils_log2asc(log: Path, frames: Frames, tmp_path: Path):
    """What it makes of our log is for our reader the same traffic."""
    path = tmp_path / "drive.asc"
    subprocess.run(["log2asc", "-I", log, "-O", path, *CHANNELS.values()], check=True, capture_output=True)
    others = read(path)
    assert np.array_equal(content(others), content(frames))
    assert np.array_equal(others["time_us"], frames["time_us"] - frames["time_us"][0])


@needs_can_utils
def test_can_utils_asc2log(log: Path, frames: Frames, tmp_path: Path):
    """And back; it puts the drive on the day of today."""
    asc, path = tmp_path / "drive.asc", tmp_path / "again.log"
    subprocess.run(["log2asc", "-I", log, "-O", asc, *CHANNELS.values()], check=True, capture_output=True)
    subprocess.run(["asc2log", "-I", asc, "-O", path], check=True, capture_output=True)
    others = read(path)
    assert np.array_equal(content(others), content(frames))
    assert np.array_equal(np.diff(others["time_us"]), np.diff(frames["time_us"]))


@needs_can_utils
def test_can_utils_log2long(log: Path, frames: Frames):
    with log.open() as source:
        out = subprocess.run(["log2long"], stdin=source, check=True, capture_output=True, text=True).stdout
    rows = re.findall(r"^\((\d+)\.(\d{6})\) +(\S+) +([0-9A-F]+) +\[(\d)\]  ([0-9A-F ]*?) *(?:'.*)?$", out, re.MULTILINE)
    assert len(rows) == len(frames)
    buses = {name: int(bus) for bus, name in CHANNELS.items()}
    others = np.zeros(len(rows), FRAME_DTYPE)
    for row, (seconds, micros, channel, identifier, length, data) in zip(others, rows, strict=True):
        row["time_us"], row["bus"] = int(seconds) * 1_000_000 + int(micros), buses[channel]
        row["id"], row["flags"] = int(identifier, 16), Flag.EXTENDED * (len(identifier) == 8)
        row["dlc"] = int(length)
        row["data"][: int(length)] = list(bytes.fromhex(data))
    assert np.array_equal(others, frames)


@pytest.mark.parametrize("bus", Bus)
def test_opendbc(frames: Frames, values: Columns, bus: Bus):
    """openpilot's parser, by the path of our DBC file, a frame after the other."""
    can = pytest.importorskip("opendbc.can", reason="opendbc is not installed")
    stem = next(stem for stem, of in DATABASES.items() if of is bus)
    mine = [codec for codec in database if codec.bus is bus and codec.name in values]
    names = {codec.frame_id | EXTENDED_IN_DBC * codec.extended: codec.name for codec in mine}
    parser = can.CANParser(str(DIRECTORY / f"{stem}.dbc"), [(name, 0) for name in names.values()], int(bus))
    others: dict[str, dict[str, list[float]]] = {}
    for frame in frames[frames["bus"] == bus]:
        number = int(frame["id"]) | EXTENDED_IN_DBC * bool(frame["flags"] & Flag.EXTENDED)
        data = bytes(frame["data"])[: int(frame["dlc"])]
        assert parser.update([(1000 * int(frame["time_us"]), [(number, data, int(bus))])]) == {number}
        for name, value in parser.vl[names[number]].items():
            others.setdefault(names[number], {}).setdefault(name, []).append(value)
    assert set(others) == set(names.values())
    for message, signals in others.items():
        assert set(signals) == set(values[message]), message
        for name, column in signals.items():
            np.testing.assert_allclose(
                column, values[message][name], rtol=1e-12, atol=1e-12, err_msg=f"{message}.{name}"
            )
