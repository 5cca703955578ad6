"""The error tree of raceloop.

::

    RaceloopError                 anything a user can put right; the command line prints it and exits with 2
    +-- ConfigurationError        a YAML or DBC file: wrong key, type, value, or missing
    +-- CodecError                a value that a message cannot carry, or data that is not that message
    +-- PlantError                an FMU that cannot be loaded, lacks a variable or fails in a step
    |   +-- StartValueError       an FMU that has not or refuses a start value
    +-- BusError                  a CAN interface that cannot be opened or used
"""

from __future__ import annotations

from pathlib import Path


class RaceloopError(Exception):
    """Base of every error that the user of raceloop can put right."""


class ConfigurationError(RaceloopError):
    """A configuration file is wrong.

    Parameters
    ----------
    file : path of the offending file.
    key : dotted key or line inside it; empty for the file as a whole.
    problem : what is wrong and what is allowed, in one line.
    """

    def __init__(self, file: str | Path, key: str, problem: str) -> None:
        self.file = str(file)
        self.key = key
        self.problem = problem
        super().__init__(f"{self.file}: {key}: {problem}" if key else f"{self.file}: {problem}")


class CodecError(RaceloopError):
    """A message cannot carry the values given, or the data are not that message."""


class PlantError(RaceloopError):
    """An FMU cannot be loaded, lacks a variable or fails in a step."""


class StartValueError(PlantError):
    """An FMU lacks a variable that is given a start value, or refuses the value."""


class BusError(RaceloopError):
    """A CAN interface cannot be opened or used."""
