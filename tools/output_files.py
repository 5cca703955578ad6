"""Files that a command leaves besides what it prints."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dbc.errors import RaceloopError


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file; under a temporary name first, so that a reader never sees half of it.

    Raises
    ------
    RaceloopError
        When it cannot be written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise RaceloopError(f"{path}: cannot be written: {error.strerror}") from error


def write_text(path: Path, text: str) -> None:
    """Write a text file, as `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file, as `write_text`."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")
