"""LiDAR points from the plant's process to autonomy's: a file in the run's folder that both have mapped.

Nobody waits: a scan that nobody has looked at when the next one comes is lost, and so is one that has become old. The
file is made by whoever comes first, and outlives both: who starts anew goes on with it.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.sensors.lidar import PERIOD_US
from dbc.errors import ConfigurationError

Cloud = NDArray[np.float32]

#: A scan that is overwritten while it is copied is given up for a newer one, so often.
_ATTEMPTS = 3


def _make(path: Path) -> None:
    """Make the file unless there is one; it has its name when it is complete."""
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}-") as file:
        # A full disk shows now, not in the middle of the run.
        os.posix_fallocate(file.fileno(), 0, lib.cloud_ring_size())
        with mmap.mmap(file.fileno(), 0) as memory, ffi.from_buffer("char[]", memory, require_writable=True) as ring:
            lib.cloud_ring_mark(ring)
        with suppress(FileExistsError):
            os.link(file.name, path)


def _map(path: Path) -> mmap.mmap:
    """The file, made if need be, in memory.

    Raises
    ------
    ConfigurationError
        When it cannot be made or mapped, or is something else.
    """
    try:
        if not path.exists():
            _make(path)
        with path.open("r+b", buffering=0) as file:
            if os.fstat(file.fileno()).st_size == lib.cloud_ring_size():
                memory = mmap.mmap(file.fileno(), 0, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
                with ffi.from_buffer("char[]", memory, require_writable=True) as ring:
                    if lib.cloud_ring_is_one(ring):
                        return memory
                memory.close()
    except OSError as error:
        raise ConfigurationError(path, "", f"cannot be the file of clouds: {error.strerror or error}") from error
    raise ConfigurationError(path, "", "no file of clouds of this version of raceloop")


class _End:
    """An attachment to the file; a context manager."""

    def __init__(self, path: Path) -> None:
        self._map = _map(path)
        self._ring: Any = ffi.from_buffer("char[]", self._map, require_writable=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file, which stays; safe to call twice."""
        if not self._map.closed:
            ffi.release(self._ring)
            self._map.close()


class CloudSender(_End):
    """Sends scans; one process does.

    Parameters
    ----------
    path : of the file; made unless it is there.

    Attributes
    ----------
    lost : scans that nobody had looked at when the next one came, and those that were too large.

    Raises
    ------
    ConfigurationError
        When the file cannot be made, or is something else.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.lost = 0

    def __enter__(self) -> CloudSender:
        return self

    def send(self, now_us: int, cloud: Cloud) -> None:
        """Send the scan of a slot: shape (n, k), a point per row; at most 92160 points of four values."""
        if self._map.closed or cloud.size > lib.CLOUD_RING_VALUES_MAX:
            self.lost += 1
            return
        values = ffi.from_buffer("float[]", np.ascontiguousarray(cloud, np.float32))
        self.lost += not lib.cloud_ring_write(self._ring, now_us, values, *cloud.shape)


class CloudReceiver(_End):
    """Receives scans; one process does.

    Parameters
    ----------
    path : of the file; made unless it is there.

    Raises
    ------
    ConfigurationError
        When the file cannot be made, or is something else.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._found: Any = ffi.new("cloud_scan *")

    def __enter__(self) -> CloudReceiver:
        return self

    def newest(self, now_us: int) -> Cloud | None:
        """Newest scan since the last call that is younger than a period and not of the future; None without one.

        Those before it are gone. It has the shape with which it was sent.
        """
        found = self._found
        if self._map.closed:
            return None
        for _ in range(_ATTEMPTS):
            if not lib.cloud_ring_find(self._ring, now_us, found) or now_us - found.time_us >= PERIOD_US:
                return None
            cloud: Cloud = np.empty((found.points, found.columns), np.float32)
            if lib.cloud_ring_copy(self._ring, found, ffi.from_buffer("float[]", cloud, require_writable=True)):
                return cloud
        return None
