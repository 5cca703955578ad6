"""The scenarios, tracks, vehicles and operation configurations that come with raceloop, as YAML."""

from pathlib import Path

DIRECTORY = Path(__file__).parent
"""Folder of the YAML files: scenarios at its top, `tracks/`, `vehicles/` and `operations/` below."""
