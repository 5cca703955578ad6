"""`raceloop replay`: give a recorded log to a fresh onboard computer and compare what it sends."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from bridge.replay import read_log, replay_obc
from dbc.codec import Codec
from dbc.errors import ConfigurationError
from tools.exit_status import ExitStatus


def replay(path: Path, database: Codec, console: Console) -> int:
    """Replay a recording from power-on and print whether the commands are the same, bit for bit.

    Parameters
    ----------
    path : of the recording.
    database : messages of the profile that CAN1 had.
    console : to print on.

    Raises
    ------
    ConfigurationError
        When the file is no log of the car's buses, or holds no frame of the onboard computer.
    """
    result = replay_obc(read_log(path), database)
    if len(result.recorded) == 0:
        raise ConfigurationError(path, "", "holds no frame of the onboard computer; there is nothing to compare")
    difference = result.first_difference()
    if difference is None:
        console.print(f"{path}: {len(result.recorded)} frames of the onboard computer, replayed identically")
        return ExitStatus.DONE
    console.print(
        f"{path}: {len(result.recorded)} frames recorded, {len(result.replayed)} replayed;"
        f" the first difference is in the tick at {difference * 1e-6:.2f} s"
    )
    return ExitStatus.MISSED
