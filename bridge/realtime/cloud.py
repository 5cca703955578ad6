"""LiDAR points from the plant's process to autonomy's: datagrams on a local socket in the run's folder.

Nobody waits: a scan that finds no room, or nobody to take it, is lost, and so is one that has become old.
"""

from __future__ import annotations

import os
import socket
import struct
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from bridge.sensors.lidar import PERIOD_US
from dbc.errors import ConfigurationError

Cloud = NDArray[np.float32]

#: Largest datagram, bytes: some 17000 points.
_LARGEST = 200_000
_HEAD = struct.Struct("<q")  # time of the scan, us


class _Socket:
    """A local datagram socket that never waits; a context manager."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the socket; safe to call twice."""
        self._socket.close()


class CloudSender(_Socket):
    """Sends scans.

    Parameters
    ----------
    path : of the receiver's socket; there may be none yet, or any more.

    Attributes
    ----------
    lost : scans that nobody took.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 * _LARGEST)
        self._path = os.fspath(path)
        self.lost = 0

    def __enter__(self) -> CloudSender:
        return self

    def send(self, now_us: int, cloud: Cloud) -> None:
        """Send the scan of a slot."""
        try:
            self._socket.sendto(_HEAD.pack(now_us) + cloud.tobytes(), self._path)
        except OSError:
            self.lost += 1


class CloudReceiver(_Socket):
    """Receives scans.

    Parameters
    ----------
    path : of the socket; one that is there is replaced.

    Raises
    ------
    ConfigurationError
        When it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        try:
            path.unlink(missing_ok=True)
            self._socket.bind(os.fspath(path))
        except OSError as error:
            self.close()
            raise ConfigurationError(path, "", f"cannot be a socket: {error.strerror or error}") from error

    def __enter__(self) -> CloudReceiver:
        return self

    def newest(self, now_us: int) -> Cloud | None:
        """Newest scan since the last call that is younger than a period; None without one. All others are gone."""
        newest: bytes | None = None
        while (data := self._receive()) is not None:
            newest = data
        if newest is None or len(newest) < _HEAD.size or (len(newest) - _HEAD.size) % 12 != 0:
            return None
        age_us = now_us - _HEAD.unpack_from(newest)[0]
        if not 0 <= age_us < PERIOD_US:
            return None
        return np.frombuffer(newest, np.float32, offset=_HEAD.size).reshape(-1, 3)

    def _receive(self) -> bytes | None:
        try:
            return self._socket.recv(_LARGEST)
        except BlockingIOError:
            return None
