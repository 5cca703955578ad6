"""`raceloop dbw profiles`: the layouts of CAN1 that there are, and how they differ."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from dbc.buses import DEFAULT_PROFILE, DIRECTORY, PROFILES, Bus
from dbc.codec import profile
from dbc.network import load_database
from tools.dbw.dbc_diff import diff
from tools.exit_status import ExitStatus


def show(console: Console) -> int:
    """Print a line per profile.

    Raises
    ------
    ConfigurationError
        When a DBC file cannot be read.
    """
    for name in PROFILES:
        path = _can1(name)
        database = load_database(path)
        (comment,) = [bus.comment for bus in database.buses if bus.comment]
        chosen = " (default)" if name == DEFAULT_PROFILE else ""
        console.print(f"{name}{chosen}: {path.name}, {len(database.messages)} messages; {comment}", markup=False)
    return ExitStatus.DONE


def compare(one: str, other: str, console: Console) -> int:
    """Print how CAN1 of one profile differs from that of another one; returns the exit status, a miss when it does.

    Raises
    ------
    CodecError
        When there is no such profile; says which there are.
    ConfigurationError
        When a DBC file cannot be read.
    """
    return diff(_can1(profile(one).profile), _can1(profile(other).profile), console)


def _can1(name: str) -> Path:
    """DBC file of CAN1 in a profile."""
    return DIRECTORY / f"{next(stem for stem, bus in PROFILES[name].items() if bus == Bus.CAN1)}.dbc"
