"""Wires in shared memory: newest values, no waiting, no torn reads, no trust in a writer's survival."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from bridge._native import ffi, lib
from bridge.realtime.wired import Cell, WiredIo
from dbc.errors import ConfigurationError

CELLS = {
    lib.WIRED_RAPTOR_IN: "raptor_wired_in",
    lib.WIRED_RAPTOR_OUT: "raptor_wired_out",
    lib.WIRED_SPACE_DRIVE_IN: "space_drive_wired_in",
    lib.WIRED_SPACE_DRIVE_OUT: "space_drive_wired_out",
}


@pytest.fixture
def ends(tmp_path: Path):
    path = str(tmp_path / "wires").encode()
    writer, reader = ffi.new("wired_io *"), ffi.new("wired_io *")
    assert lib.wired_io_create(writer, path) == 0
    assert lib.wired_io_open(reader, path) == 0
    yield writer, reader
    lib.wired_io_close(writer)
    lib.wired_io_close(reader)


def filled(kind: str, value: int):
    struct = ffi.new(f"{kind} *")
    ffi.memmove(struct, bytes([value]) * ffi.sizeof(kind), ffi.sizeof(kind))
    return struct


def raw(kind: str, struct) -> bytes:
    return bytes(ffi.buffer(struct, ffi.sizeof(kind)))


@pytest.mark.parametrize("cell", CELLS)
def test_each_cell_carries_its_own_struct(ends, cell: int):
    writer, reader = ends
    kind = CELLS[cell]
    received = filled(kind, 0xEE)
    assert lib.wired_io_read(reader, cell, received) == 0
    assert raw(kind, received) == raw(kind, filled(kind, 0xEE))  # never written: nothing is touched
    lib.wired_io_write(writer, cell, filled(kind, 0x11), 77)
    lib.wired_io_write(writer, cell, filled(kind, 0x22), 78)
    assert lib.wired_io_read(reader, cell, received) == 78
    assert raw(kind, received) == raw(kind, filled(kind, 0x22))
    for other in CELLS.keys() - {cell}:
        assert lib.wired_io_read(reader, other, ffi.new("raptor_wired_in *")) == 0


def test_a_cell_that_does_not_exist_is_ignored(ends):
    writer, reader = ends
    lib.wired_io_write(writer, lib.WIRED_CELLS, filled("raptor_wired_in", 1), 1)
    assert lib.wired_io_read(reader, lib.WIRED_CELLS, ffi.new("raptor_wired_in *")) == 0


def test_a_writer_that_died_in_the_middle_is_not_waited_for_and_can_be_replaced(ends, tmp_path: Path):
    writer, reader = ends
    lib.wired_io_write(writer, lib.WIRED_RAPTOR_OUT, filled("raptor_wired_out", 1), 10)
    # The sequence of a cell comes first in it; it is odd while a writer is inside.
    size = (tmp_path / "wires").stat().st_size // lib.WIRED_CELLS // 8 * 8
    offset = 8 + lib.WIRED_RAPTOR_OUT * size
    with (tmp_path / "wires").open("r+b") as file:
        file.seek(offset)
        sequence = int.from_bytes(file.read(8), "little")
        assert sequence == 2
        file.seek(offset)
        file.write((3).to_bytes(8, "little"))
    received = filled("raptor_wired_out", 0xEE)
    assert lib.wired_io_read(reader, lib.WIRED_RAPTOR_OUT, received) == 0
    assert raw("raptor_wired_out", received) == raw("raptor_wired_out", filled("raptor_wired_out", 0xEE))
    successor = ffi.new("wired_io *")
    assert lib.wired_io_open(successor, str(tmp_path / "wires").encode()) == 0
    lib.wired_io_write(successor, lib.WIRED_RAPTOR_OUT, filled("raptor_wired_out", 5), 20)
    assert lib.wired_io_read(reader, lib.WIRED_RAPTOR_OUT, received) == 20
    assert raw("raptor_wired_out", received) == raw("raptor_wired_out", filled("raptor_wired_out", 5))
    lib.wired_io_close(successor)


def test_no_read_is_torn(ends):
    """A process writes one pattern after the other as fast as it can; every read is one of them, whole."""
    writer, reader = ends
    kind = "raptor_wired_in"
    patterns = [filled(kind, value) for value in range(1, 250)]
    child = os.fork()
    if child == 0:
        while True:
            for stamp, pattern in enumerate(patterns, 1):
                lib.wired_io_write(writer, lib.WIRED_RAPTOR_IN, pattern, stamp)
    try:
        seen = set()
        received = ffi.new(f"{kind} *")
        reads = 0
        while len(seen) < 50 or reads < 20_000:
            stamp = lib.wired_io_read(reader, lib.WIRED_RAPTOR_IN, received)
            reads += 1
            assert reads < 10_000_000
            if stamp:
                assert raw(kind, received) == bytes([stamp]) * ffi.sizeof(kind)
                seen.add(stamp)
    finally:
        os.kill(child, 9)
        os.waitpid(child, 0)


def test_files_that_are_no_wires_are_refused(tmp_path: Path):
    wires = ffi.new("wired_io *")
    assert lib.wired_io_open(wires, str(tmp_path / "absent").encode()) == errno.ENOENT
    (tmp_path / "short").write_bytes(b"WIRE")
    assert lib.wired_io_open(wires, str(tmp_path / "short").encode()) == errno.EPROTO
    assert lib.wired_io_create(wires, str(tmp_path / "wires").encode()) == 0
    size = (tmp_path / "wires").stat().st_size
    (tmp_path / "zeros").write_bytes(bytes(size))
    other = ffi.new("wired_io *")
    assert lib.wired_io_open(other, str(tmp_path / "zeros").encode()) == errno.EPROTO
    assert other.memory == ffi.NULL
    assert lib.wired_io_create(other, str(tmp_path / "no" / "folder").encode()) == errno.ENOENT
    lib.wired_io_close(wires)


def test_python_face_joins_two_attachments(tmp_path: Path):
    path = tmp_path / "wires"
    with WiredIo(path, create=True) as plant, WiredIo(path) as ecu:
        demand, received = ffi.new("raptor_wired_out *"), ffi.new("raptor_wired_out *")
        received.throttle_demand = 0.25
        assert ecu.read(Cell.RAPTOR_OUT, received) == 0
        assert received.throttle_demand == 0.25
        demand.throttle_demand, demand.gear_demand = 0.5, 3
        before_ns = lib.monotonic_ns()
        plant.write(Cell.RAPTOR_OUT, demand)
        assert before_ns <= ecu.read(Cell.RAPTOR_OUT, received) <= lib.monotonic_ns()
        assert (received.throttle_demand, received.gear_demand) == (0.5, 3)


def test_python_face_complains_in_one_line(tmp_path: Path):
    with pytest.raises(ConfigurationError, match="wires: No such file"):
        WiredIo(tmp_path / "wires")
    with pytest.raises(ConfigurationError, match="No such file"):
        WiredIo(tmp_path / "none" / "wires", create=True)
    (tmp_path / "text").write_text("once upon a time")
    with pytest.raises(ConfigurationError, match="text: no wires of this version"):
        WiredIo(tmp_path / "text")
