"""The vehicle plant, packed as FMUs for FMI 2.0 and 3.0."""

from __future__ import annotations

import os
import sysconfig
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent

__all__ = ["FMU_DIR_VARIABLE", "fmu_path"]

FMU_DIR_VARIABLE = "RACELOOP_FMU_DIR"
"""Environment variable with the folder that holds the FMUs, before any other place."""


def _folders() -> Iterator[Path]:
    override = os.environ.get(FMU_DIR_VARIABLE)
    if override:
        yield Path(override)
        return  # an override that does not hold must not fall back to another FMU
    # An editable install has two: the sources' folder, and the installed one with the built files.
    yield HERE
    yield from (Path(entry) for entry in __path__ if Path(entry) != HERE)
    paths = sysconfig.get_paths()
    yield from (Path(paths[kind]) / __name__ for kind in ("platlib", "purelib"))


def fmu_path(fmi_version: int = 3) -> Path:
    """Return the path of the FMU for FMI 2 or 3.

    Raises ValueError for another version and FileNotFoundError, with the places searched, when the
    FMU was not built or installed.
    """
    if fmi_version not in (2, 3):
        raise ValueError(f"fmi_version is {fmi_version}; allowed are 2 and 3")
    name = f"raceloop_plant_fmi{fmi_version}.fmu"
    searched: list[str] = []
    for folder in _folders():
        path = folder / name
        if path.is_file():
            return path
        searched.append(str(folder))
    raise FileNotFoundError(f"{name} not found in {', '.join(searched)}; build the project or set {FMU_DIR_VARIABLE}")
