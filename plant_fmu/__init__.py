"""The vehicle plant, packed as FMUs for FMI 2.0 and 3.0."""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

__all__ = ["FMU_DIR_VARIABLE", "fmu_path"]

FMU_DIR_VARIABLE = "RACELOOP_FMU_DIR"
"""Environment variable with the folder that holds the FMUs, before any other place."""


def _folders() -> Iterator[Path]:
    override = os.environ.get(FMU_DIR_VARIABLE)
    if override:
        yield Path(override)
        return  # an override that does not hold must not fall back to another FMU
    # Installed: one folder or, in an editable install, the source and the build's folder.
    seen: set[Path] = set()
    package = resources.files(__name__)
    for candidate in [Path(str(package)), *(Path(entry) for entry in __path__)]:
        if candidate not in seen:
            seen.add(candidate)
            yield candidate
    try:
        spec_origin = package.joinpath("fmu")
        yield Path(str(spec_origin))
    except (OSError, ValueError):
        return


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
