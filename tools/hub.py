"""`raceloop hub`: the car's buses on a machine whose kernel has no CAN."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path
from typing import NoReturn

from bridge.realtime.programs import program
from dbc.errors import BusError


def default_path() -> Path:
    """The local socket of this user's hub, in a folder that nobody else can enter; made when missing.

    Raises
    ------
    BusError
        When the folder cannot be made, or belongs to somebody else.
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(runtime) / "raceloop" if runtime else Path(tempfile.gettempdir()) / f"raceloop-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise BusError(f"{folder}: {error.strerror}; give --local PATH") from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise BusError(f"{folder}: is not a folder that only you can enter; give --local PATH")
    return folder / "hub"


def hub(local: Path | None, port: int) -> NoReturn:
    """Become the hub: this process turns into the executable.

    Parameters
    ----------
    local : local socket for the stations of this project; None for the default.
    port : TCP port on 127.0.0.1 for socketcand clients; 0 for any free one.

    Raises
    ------
    BusError
        When there is no place for the local socket.
    RaceloopError
        When the executable is missing.
    """
    executable = program("raceloop-hub")
    path = default_path() if local is None else local
    os.execv(executable, [str(executable), "--local", str(path), "--port", str(port)])
