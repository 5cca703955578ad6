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


def test_a_reader_takes_all_of_an_old_file_and_goes_on_with_the_new_one(tmp_path: Path):
    path = tmp_path / "truth"
    with TruthWriter(path, NAMES, UNITS, capacity=10) as first:
        first.add(1, np.ones(3))
        with TruthFile(path) as reader:
            path.unlink()
            assert reader.take()[:, 0].tolist() == [1.0]
            assert reader.take().shape == (0, 4)  # nothing has its name now
            path.write_bytes(b"")
            assert reader.take().shape == (0, 4)  # nor is it whole
            with TruthWriter(path, NAMES, UNITS, capacity=10) as second:
                first.add(2, np.ones(3))
                second.add(3, np.ones(3))
                assert reader.take()[:, 0].tolist() == [2.0]
                assert reader.take()[:, 0].tolist() == [3.0]
                first.add(4, np.ones(3))
                second.add(5, np.ones(3))
                assert reader.take()[:, 0].tolist() == [5.0]


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
