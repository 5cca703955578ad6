"""The `raceloop` command as a user meets it: exit status, standard output, standard error."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

import scenarios
from tools.cli import main

SCENARIO = "solo_lap.yaml"


@dataclass(frozen=True)
class Answer:
    status: int
    out: str
    error: str


Command = Callable[..., Answer]


def command(capsys: pytest.CaptureFixture[str]) -> Command:
    """Run the command in this process."""

    def call(*arguments: object) -> Answer:
        capsys.readouterr()
        status = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Answer(status, captured.out, captured.err)

    return call


def copy_scenarios(folder: Path) -> Path:
    """A copy of the shipped scenarios to be broken; gives the scenario file."""
    shutil.copytree(scenarios.DIRECTORY, folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    return folder / SCENARIO


def edit(path: Path, old: str, new: str) -> None:
    """Replace text that must be there exactly once."""
    text = path.read_text()
    assert text.count(old) == 1, (path, old)
    path.write_text(text.replace(old, new))


def assert_one_line(answer: Answer, *words: object) -> None:
    """A user's mistake: status 2, one line on standard error that holds the words, nothing else."""
    assert answer.status == 2
    assert answer.out == ""
    assert answer.error.endswith("\n")
    assert len(answer.error.splitlines()) == 1, answer.error
    assert answer.error.startswith("raceloop: ")
    for word in words:
        assert str(word) in answer.error, (word, answer.error)
