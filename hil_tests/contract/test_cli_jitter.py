"""`raceloop jitter` with what a user may give wrongly: one line, nothing measured, nothing written."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_harness import Command, assert_one_line, command

from bridge.realtime import vcan
from tools.cli import main
from tools.jitter.load import LOADS


@pytest.fixture
def raceloop(capsys: pytest.CaptureFixture[str]) -> Command:
    return command(capsys)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--ecu", "engine"], "invalid choice: 'engine'"),
        (["--rate", "9.9"], "is '9.9'; must be 10 to 1000"),
        (["--rate", "1001"], "is '1001'; must be 10 to 1000"),
        (["--rate", "fast"], "is 'fast'; must be a number above 0"),
        (["--seconds", "0"], "is '0'; must be a number above 0"),
        (["--seconds", "nan"], "is 'nan'; must be a number above 0"),
        (["--load", "heavy"], "invalid choice: 'heavy'"),
        (["--priority", "100"], "is '100'; must be a whole number from 0 to 99"),
        (["--priority", "-1"], "is '-1'; must be a whole number from 0 to 99"),
        (["--cpu", "first"], "invalid int value: 'first'"),
        (["--bus", "lin"], "invalid choice: 'lin'"),
    ],
)
def test_wrong_arguments(capsys: pytest.CaptureFixture[str], arguments: list[str], words: str):
    with pytest.raises(SystemExit) as ended:
        main(["jitter", *arguments])
    assert ended.value.code == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--cpu", "4095"], ["--cpu 4095", "no such core", "allowed are"]),
        (["--cpu", "-1"], ["--cpu -1", "no such core"]),
        (["--seconds", "3601"], ["--seconds 3601", "at most 3600 at 100 Hz"]),
        (["--seconds", "361", "--rate", "1000"], ["--seconds 361", "at most 360 at 1000 Hz"]),
        (["--interfaces", "a,b,c,d"], ["--interfaces needs --bus socketcan"]),
        (["--bus", "socketcan", "--interfaces", "a,b"], ["--interfaces a,b", "must be 4 different names"]),
        (["--scenario", "moon"], ["moon: no such scenario file", "solo_lap"]),
        (["--scenario", "solo_lap", "--rate", "50"], ["--rate does not go with --scenario"]),
        (["--scenario", "solo_lap", "--seconds", "5"], ["--seconds does not go with --scenario"]),
    ],
)
def test_what_cannot_be_measured(raceloop: Command, tmp_path: Path, arguments: list[str], words: list[str]):
    out = tmp_path / "out"
    assert_one_line(raceloop("jitter", "--out", out, *arguments), *words)
    assert not out.exists()


def test_no_can_in_the_kernel(raceloop: Command, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(vcan, "kernel_has_can", lambda: False)
    assert_one_line(raceloop("jitter", "--bus", "socketcan"), "no CAN in this kernel", "--bus hub")


@pytest.mark.parametrize("option", ["--json", "--trace"])
def test_files_that_cannot_be_written(raceloop: Command, tmp_path: Path, option: str):
    assert_one_line(raceloop("jitter", option, tmp_path), tmp_path, "is a folder; must be a file")
    blocked = tmp_path / "blocked"
    blocked.write_text("mine\n")
    assert_one_line(raceloop("jitter", option, blocked / "figures"), blocked)
    assert blocked.read_text() == "mine\n"
    assert list(tmp_path.iterdir()) == [blocked]


def test_loads_of_the_command_line_are_those_of_stress_ng(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["jitter", "--load", "?"])
    error = capsys.readouterr().err
    for load in ("none", *LOADS):
        assert f"'{load}'" in error or f" {load}" in error or f",{load}" in error, load
