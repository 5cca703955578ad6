"""The plant's outputs of a run in a file that is mapped into memory.

The file is written without a system call per row, outlives a plant that is killed, and can be read while it grows. The
reader never maps it, so a plant that starts anew and makes a new file cannot pull memory from under a reader.

Layout: a header of 32 bytes, the names and units as JSON, then rows of doubles: time in us, then the outputs.
"""

from __future__ import annotations

import json
import mmap
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from struct import Struct
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from dbc.errors import ConfigurationError, RaceloopError

_MAGIC = b"RTRUTH01"
_HEADER = Struct("<8sIIQQ")  # magic, columns, bytes of the JSON text, rows that fit, rows written
_WRITTEN = Struct("<Q")
_WRITTEN_AT = _HEADER.size - _WRITTEN.size


def _rows_at(text_size: int) -> int:
    """Where rows begin: after the text, on a multiple of 8."""
    return (_HEADER.size + text_size + 7) // 8 * 8


def _make_map(path: Path, size: int) -> mmap.mmap:
    """A new file of zeros, mapped; none is left behind when that fails."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    try:
        os.posix_fallocate(descriptor, 0, size)  # a full disk shows now, not in the middle of the run
        return mmap.mmap(descriptor, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
    except BaseException:
        path.unlink()
        raise
    finally:
        os.close(descriptor)


class TruthWriter:
    """Writes one row per slot; a context manager.

    Parameters
    ----------
    path : file to make; one that exists is replaced, and whoever has it open keeps the old one.
    names, units : of the outputs.
    capacity : rows that fit; what comes after is counted in `lost` and dropped.

    Raises
    ------
    RaceloopError
        When the file cannot be made or there is no room for it.
    """

    def __init__(self, path: Path, names: Sequence[str], units: Sequence[str], capacity: int) -> None:
        text = json.dumps({"names": list(names), "units": list(units)}).encode()
        columns = 1 + len(names)
        start = _rows_at(len(text))
        size = start + capacity * columns * 8
        self.lost = 0
        self._count = 0
        try:
            path.unlink(missing_ok=True)
            self._map = _make_map(path, size)
        except OSError as error:
            raise RaceloopError(f"{path}: cannot be the file of the truth: {error.strerror}") from error
        self._map[_HEADER.size : _HEADER.size + len(text)] = text
        self._rows: NDArray[np.float64] = np.frombuffer(self._map, np.float64, capacity * columns, start)
        self._rows = self._rows.reshape(capacity, columns)
        _HEADER.pack_into(self._map, 0, b"", columns, len(text), capacity, 0)
        self._map[: len(_MAGIC)] = _MAGIC  # now it is one

    def __enter__(self) -> TruthWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def add(self, time_us: int, outputs: NDArray[np.float64]) -> None:
        """Append the outputs at one time."""
        if self._count == len(self._rows):
            self.lost += 1
            return
        row = self._rows[self._count]
        row[0] = time_us
        row[1:] = outputs
        self._count += 1
        _WRITTEN.pack_into(self._map, _WRITTEN_AT, self._count)

    def close(self) -> None:
        """Unmap the file; it stays. Safe to call twice."""
        if not self._map.closed:
            self._rows = np.empty((0, 0))
            self._map.close()


class TruthFile:
    """Reads such a file, from the beginning and then what has been added.

    When a plant that was started again has put a new file in its place, the reader goes on with that one.

    Parameters
    ----------
    path : of the file.

    Attributes
    ----------
    names, units : of the outputs.

    Raises
    ------
    ConfigurationError
        When it cannot be read, or is no such file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open = _OpenFile(path)
        self.names: tuple[str, ...] = self._open.names
        self.units: tuple[str, ...] = self._open.units

    def __enter__(self) -> TruthFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def take(self) -> NDArray[np.float64]:
        """Rows since the last call, shape (n, 1 + len(names)): time in us, then the outputs."""
        rows = self._open.take()
        if not len(rows) and self._open.was_replaced():
            with suppress(ConfigurationError):  # the new one is still being made
                newer = _OpenFile(self._path)
                self._open.close()
                self._open = newer
                rows = newer.take()
        return rows

    def close(self) -> None:
        """Close the file."""
        self._open.close()


class _OpenFile:
    """One file, whatever happens to its name."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise ConfigurationError(path, "", error.strerror or "cannot be read") from error
        try:
            head = self._pread(_HEADER.size, 0)
            if len(head) < _HEADER.size or not head.startswith(_MAGIC):
                raise ConfigurationError(path, "", "no file of the truth of this version of raceloop")
            _, self._columns, text_size, _, _ = _HEADER.unpack(head)
            description = json.loads(self._pread(text_size, _HEADER.size))
        except BaseException:
            self._file.close()
            raise
        self._start = _rows_at(text_size)
        self._taken = 0
        self.names: tuple[str, ...] = tuple(description["names"])
        self.units: tuple[str, ...] = tuple(description["units"])

    def take(self) -> NDArray[np.float64]:
        (written,) = _WRITTEN.unpack(self._pread(_WRITTEN.size, _WRITTEN_AT))
        size = self._columns * 8
        data = self._pread((written - self._taken) * size, self._start + self._taken * size)
        rows: NDArray[np.float64] = np.frombuffer(data, np.float64).reshape(-1, self._columns)
        self._taken += len(rows)
        return rows

    def was_replaced(self) -> bool:
        try:
            return os.stat(self._path).st_ino != os.fstat(self._file.fileno()).st_ino
        except FileNotFoundError:
            return False  # between the two

    def close(self) -> None:
        self._file.close()

    def _pread(self, size: int, offset: int) -> bytes:
        try:
            return os.pread(self._file.fileno(), size, offset)
        except OSError as error:
            raise ConfigurationError(self._path, "", error.strerror or "cannot be read") from error
