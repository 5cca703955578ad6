"""The project's own executables, where the build installs them."""

from __future__ import annotations

import os
import sysconfig
from pathlib import Path

from dbc.errors import RaceloopError


def program(name: str) -> Path:
    """Path of an executable: ``raceloop-hub``, ``raceloop-obc``, ``raceloop-raptor``, ``raceloop-space-drive``.

    Raises
    ------
    RaceloopError
        When it is not there.
    """
    path = Path(sysconfig.get_path("scripts")) / name
    if not os.access(path, os.X_OK):
        raise RaceloopError(f"{path}: no such executable; `make build` installs it")
    return path
