"""`raceloop check-params`: the firmware's verdict with every offence, its key, its value and what is allowed."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from cli_harness import Command, assert_one_line, command
from parameter_cells import EDGES, KINDS, SCHEMA, Cell, parameter_cell, rule_cell

import scenarios
from firmware.tables import own_parameters

GOOD = scenarios.DIRECTORY / "operations" / "solo.yaml"
ALLOWED = {parameter.name: parameter.allowed() for parameter in own_parameters().parameters}


@pytest.fixture
def raceloop(capsys: pytest.CaptureFixture[str]) -> Command:
    return command(capsys)


@pytest.mark.parametrize("path", sorted(GOOD.parent.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_file_is_accepted(raceloop: Command, path: Path) -> None:
    answer = raceloop("check-params", path)
    assert (answer.status, answer.out, answer.error) == (0, f"{path}: accepted\n", "")


def test_every_offence_of_a_file_is_listed(raceloop: Command, tmp_path: Path) -> None:
    wrong = {
        "max_speed": ("1000.0", "above the maximum"),
        "standstill_speed": ("1.0e-9", "below the minimum"),
        "max_deceleration": ("-10.0", "wrong sign"),
        "imu_timeout": ("50.5", "wrong type"),
        "degraded_driving_allowed": ("maybe", "wrong type"),
        "vehicle_number": ("[5]", "wrong type"),
        "plan_timeout": ("", "wrong type"),
        "steering_limit": (".nan", "not a finite number"),
        "throttle_limit": (".inf", "not a finite number"),
        "max_acceleration": ("-.inf", "not a finite number"),
    }
    lines = []
    for line in GOOD.read_text().splitlines():
        name = line.split(":")[0]
        if name != "steering_ratio":
            lines.append(f"{name}: {wrong[name][0]}" if name in wrong else line)
    lines += ["steering_slew: 0.5", "max_sped: 63.1"]
    path = tmp_path / "bad.yaml"
    path.write_text("\n".join(lines) + "\n")
    answer = raceloop("check-params", path)
    assert (answer.status, answer.error) == (2, "")
    title, *offences = answer.out.splitlines()
    assert title == f"{path}: rejected, {len(offences)} offences"
    shown = {"-10.0": "-10.0", "1.0e-9": "1e-09", "maybe": "'maybe'", "": "None", ".nan": "nan", ".inf": "inf"}
    expected = {
        f"  {name}: {shown.get(value, value.removeprefix('.').replace('-.', '-'))}: {reason}; allowed: {ALLOWED[name]}"
        for name, (value, reason) in wrong.items()
    } | {
        f"  steering_ratio: not given: missing; allowed: {ALLOWED['steering_ratio']}",
        f"  steering_slew: 0.6, 0.5: given more than once; allowed: {ALLOWED['steering_slew']}",
        "  max_sped: 63.1: unknown key; allowed: the parameters listed in docs/parameters.md",
    }
    assert set(offences) == expected
    assert len(offences) == len(expected)


#: One cell of the parameter matrix per kind, each of another parameter, and both edges of a rule.
SAMPLE = [
    *(
        parameter_cell(SCHEMA.parameters[7 * number % len(SCHEMA.parameters)], kind)
        for number, kind in enumerate(KINDS)
    ),
    *(rule_cell(SCHEMA.cross_checks[0], edge) for edge in EDGES),
]


@pytest.mark.parametrize("cell", SAMPLE, ids=lambda cell: cell.name)
def test_matrix_as_a_user_meets_it(raceloop: Command, tmp_path: Path, cell: Cell) -> None:
    """One line per offence, with key, reason and what is allowed."""
    path = tmp_path / "operation.yaml"
    path.write_text(cell.text)
    answer = raceloop("check-params", path)
    assert answer.error == ""
    if not cell.offences:
        assert (answer.status, answer.out) == (0, f"{path}: accepted\n")
        return
    title, *lines = answer.out.splitlines()
    assert answer.status == 2
    assert title.startswith(f"{path}: rejected, {len(cell.offences)} offence")
    told = [re.fullmatch(r"  (\w+): .+: ([^:]+); allowed: .+", line) for line in lines]
    assert sorted((match[1], match[2]) for match in told if match) == cell.offences
    assert all(told)


def test_single_offence(raceloop: Command, tmp_path: Path) -> None:
    path = tmp_path / "[bad].yaml"
    path.write_text(GOOD.read_text() + "'[red]': 1\n")
    answer = raceloop("check-params", path)
    assert answer.status == 2
    assert answer.out == (
        f"{path}: rejected, 1 offence\n  [red]: 1: unknown key; allowed: the parameters listed in docs/parameters.md\n"
    )


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read: No such file"),
        (b"", "line 1: an operation file is a mapping"),
        (b"- 1\n", "line 1: an operation file is a mapping"),
        (b"a: 1\nb: [\n", "line 3"),
        (b"a: \xff\n", "cannot be read"),
    ],
    ids=["missing", "empty", "list", "broken yaml", "not utf-8"],
)
def test_file_that_is_no_mapping(raceloop: Command, tmp_path: Path, content: bytes | None, words: str) -> None:
    path = tmp_path / "operation.yaml"
    if content is not None:
        path.write_bytes(content)
    assert_one_line(raceloop("check-params", path), path, words)


def test_installed_command(tmp_path: Path) -> None:
    """From another folder, where nothing of the sources lies."""
    run = subprocess.run(
        [Path(sys.executable).with_name("raceloop"), "check-params", GOOD],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (run.returncode, run.stdout, run.stderr) == (0, f"{GOOD}: accepted\n", "")
    assert list(tmp_path.iterdir()) == []
