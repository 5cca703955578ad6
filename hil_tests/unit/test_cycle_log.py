"""The cycle log of a station as Python reads it: what C wrote, in order, also when the ring has gone round."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge._native import ffi, lib
from bridge.realtime.cycle_log import HEADER_DTYPE, RECORD_DTYPE, read_cycle_log
from dbc.errors import RaceloopError


@pytest.mark.parametrize(("struct", "dtype"), [("cycle_record", RECORD_DTYPE), ("cycle_log_header", HEADER_DTYPE)])
def test_layout_is_that_of_the_c_struct(struct: str, dtype: np.dtype[np.void]):
    assert dtype.itemsize == ffi.sizeof(struct)
    fields = dict(ffi.typeof(struct).fields)
    assert list(dtype.names or ()) == list(fields)
    for name, field in fields.items():
        assert dtype.fields is not None
        assert (dtype.fields[name][1], dtype.fields[name][0].itemsize) == (field.offset, ffi.sizeof(field.type)), name


class Writer:
    """A station's end of the log."""

    def __init__(self, path: Path, capacity: int, **fields: Any) -> None:
        self.log = ffi.new("cycle_log *")
        self.header = ffi.new("cycle_log_header *", fields)
        assert lib.cycle_log_create(self.log, str(path).encode(), self.header, capacity) == 0
        self.slot = 0

    def write(self, count: int) -> None:
        record = ffi.new("cycle_record *")
        for _ in range(count):
            record.slot = self.slot
            record.wake_ns = 10_000_000 * self.slot + 77
            record.newest_ns = [self.slot, 0, 2, 3]
            record.task_us = [*range(15), 65535]
            lib.cycle_log_write(self.log, record)
            self.slot += 1


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "obc.cycles"


@pytest.fixture
def writer(path: Path) -> Iterator[Writer]:
    writer = Writer(
        path,
        8,
        epoch_ns=5_000_000_000,
        phase_ns=4_000_000,
        period_ns=10_000_000,
        process=4711,
        priority=80,
        cpu=1,
        name=b"obc",
        task_count=2,
        task_names=[b"receive", b"control", b"not one of them"],
    )
    yield writer
    lib.cycle_log_close(writer.log)


@pytest.mark.usefixtures("writer")
def test_header(path: Path):
    log = read_cycle_log(path)
    assert (log.name, log.process, log.priority, log.cpu) == ("obc", 4711, 80, 1)
    assert (log.epoch_ns, log.phase_ns, log.period_ns) == (5_000_000_000, 4_000_000, 10_000_000)
    assert log.task_names == ("receive", "control")
    assert len(log.records) == 0


def test_station_without_priority_and_core(path: Path):
    lib.cycle_log_close(Writer(path, 1, cpu=-1).log)
    log = read_cycle_log(path)
    assert log.priority is None
    assert log.cpu is None


@pytest.mark.parametrize("count", [1, 7, 8, 9, 20])
def test_records_in_order_without_those_that_the_ring_has_lost(writer: Writer, path: Path, count: int):
    writer.write(count)
    log = read_cycle_log(path)
    assert log.overwritten == max(0, count - 8)
    slots = np.arange(log.overwritten, count)
    assert np.array_equal(log.records["slot"], slots)
    assert np.array_equal(log.records["wake_ns"], slots * 10_000_000 + 77)
    assert np.array_equal(log.records["newest_ns"][:, 0], slots)
    assert log.records["task_us"][0].tolist() == [*range(15), 65535]


def test_what_was_read_stays_when_the_writer_goes_on(writer: Writer, path: Path):
    writer.write(5)
    log = read_cycle_log(path)
    writer.write(20)
    assert log.records["slot"].tolist() == [0, 1, 2, 3, 4]


def damaged(path: Path, field: str, value: int) -> None:
    content = np.fromfile(path, dtype=np.uint8)
    content[: HEADER_DTYPE.itemsize].view(HEADER_DTYPE)[field] = value
    content.tofile(path)


@pytest.mark.usefixtures("writer")
@pytest.mark.parametrize("field", ["magic", "version", "record_size"])
def test_other_files_are_refused(path: Path, field: str):
    damaged(path, field, 9)
    with pytest.raises(RaceloopError, match=r"obc.cycles: no cycle log of version 1"):
        read_cycle_log(path)


@pytest.mark.usefixtures("writer")
def test_files_that_are_cut_off_are_refused(path: Path):
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    with pytest.raises(RaceloopError, match="was cut off"):
        read_cycle_log(path)
    path.write_bytes(whole[:400])
    with pytest.raises(RaceloopError, match="too short"):
        read_cycle_log(path)
    path.unlink()
    with pytest.raises(RaceloopError, match="No such file"):
        read_cycle_log(path)
