"""The plant's outputs in a mapped file: whole rows only, while it grows and after a kill."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bridge.realtime.truth_file import TruthFile, TruthWriter
from dbc.errors import ConfigurationError, RaceloopError

NAMES, UNITS = ("x", "y", "gear"), ("m", "m", "")


def test_rows_come_out_as_they_went_in(tmp_path: Path):
    path = tmp_path / "truth"
    rows = np.arange(40, dtype=np.float64).reshape(10, 4)
    with TruthWriter(path, NAMES, UNITS, capacity=10) as writer, TruthFile(path) as reader:
        assert (reader.names, reader.units) == (NAMES, UNITS)
        assert reader.take().shape == (0, 4)
        for row in rows[:3]:
            writer.add(int(row[0]), row[1:])
        assert np.array_equal(reader.take(), rows[:3])
        assert reader.take().shape == (0, 4)
        for row in rows[3:]:
            writer.add(int(row[0]), row[1:])
        assert np.array_equal(reader.take(), rows[3:])
        assert writer.lost == 0
        writer.add(99, rows[0, 1:])
        assert writer.lost == 1
        assert reader.take().shape == (0, 4)
    with TruthFile(path) as reader:
        assert np.array_equal(reader.take(), rows)


def test_a_new_writer_leaves_the_old_file_to_its_reader(tmp_path: Path):
    path = tmp_path / "truth"
    with TruthWriter(path, NAMES, UNITS, capacity=10) as writer:
        writer.add(1, np.ones(3))
        with TruthFile(path) as reader, TruthWriter(path, NAMES, UNITS, capacity=10):
            writer.add(2, np.ones(3))
            assert reader.take()[:, 0].tolist() == [1.0, 2.0]
    with TruthFile(path) as reader:
        assert reader.take().shape == (0, 4)


def test_it_outlives_a_writer_that_is_killed(tmp_path: Path):
    path = tmp_path / "truth"
    program = f"""
import numpy as np
from pathlib import Path
from bridge.realtime.truth_file import TruthWriter
writer = TruthWriter(Path({str(path)!r}), {NAMES!r}, {UNITS!r}, capacity=1 << 20)
for number in range(1 << 60):
    writer.add(number, np.full(3, float(number)))
    if number == 1000:
        print("running", flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"running\n"
        process.send_signal(signal.SIGKILL)
    with TruthFile(path) as reader:
        rows = reader.take()
    assert len(rows) >= 1000
    assert np.array_equal(rows, np.repeat(np.arange(len(rows), dtype=np.float64)[:, None], 4, axis=1))


def test_what_is_no_such_file_is_one_line(tmp_path: Path):
    path = tmp_path / "truth"
    with pytest.raises(ConfigurationError, match="No such file"):
        TruthFile(path)
    for content in (b"", b"RTRUTH01", b"once upon a time " * 100):
        path.write_bytes(content)
        with pytest.raises(ConfigurationError, match="no file of the truth"):
            TruthFile(path)
    with pytest.raises(RaceloopError, match="cannot be the file of the truth: No such file"):
        TruthWriter(tmp_path / "none" / "truth", NAMES, UNITS, 10)
    with pytest.raises(RaceloopError, match="cannot be the file of the truth"):
        TruthWriter(tmp_path / "huge", NAMES, UNITS, 1 << 56)
    assert not (tmp_path / "huge").exists()
