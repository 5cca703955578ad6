"""Wires between the plant and the actuator ECUs as processes (``firmware/ports/linux/wired_io.h``)."""

from __future__ import annotations

import errno
import os
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Any

from bridge._native import ffi, lib
from dbc.errors import ConfigurationError


class Cell(IntEnum):
    """A direction of an ECU, with the struct that it carries; ``enum wired_cell``."""

    RAPTOR_IN = lib.WIRED_RAPTOR_IN
    """raptor_wired_in, written by the plant."""
    RAPTOR_OUT = lib.WIRED_RAPTOR_OUT
    """raptor_wired_out, written by the Raptor."""
    SPACE_DRIVE_IN = lib.WIRED_SPACE_DRIVE_IN
    """space_drive_wired_in, written by the plant."""
    SPACE_DRIVE_OUT = lib.WIRED_SPACE_DRIVE_OUT
    """space_drive_wired_out, written by the Space Drive."""


class WiredIo:
    """An attachment to the wires in shared memory; a context manager.

    Parameters
    ----------
    path : of the file.
    create : True: make it new, with all cells unwritten; nobody may be attached. False: attach to an existing one.

    Raises
    ------
    ConfigurationError
        When that fails, or the file is none of ours.
    """

    def __init__(self, path: Path, create: bool = False) -> None:
        self._io: Any = ffi.new("wired_io *")
        attach = lib.wired_io_create if create else lib.wired_io_open
        error = attach(self._io, os.fsencode(path))
        if error != 0:
            reason = "no wires of this version of raceloop" if error == errno.EPROTO else os.strerror(error)
            raise ConfigurationError(path, "", reason)

    def __enter__(self) -> WiredIo:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def read(self, cell: Cell, struct: Any) -> int:
        """Copy the newest value of a cell into its C struct.

        Returns
        -------
        int
            When it was written, ns on CLOCK_MONOTONIC; 0 when it never was, or its writer died while writing: then
            the struct is left as it was.
        """
        return int(lib.wired_io_read(self._io, cell, struct))

    def write(self, cell: Cell, struct: Any) -> None:
        """Put the C struct of a cell on its wires, stamped with now."""
        lib.wired_io_write(self._io, cell, struct, lib.monotonic_ns())

    def close(self) -> None:
        """Detach; the file stays. Safe to call twice."""
        lib.wired_io_close(self._io)
