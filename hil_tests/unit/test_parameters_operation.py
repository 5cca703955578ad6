"""Operation files: reading, and the firmware's verdict back in words (`raceloop check-params`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from datetime import date
from pathlib import Path
from typing import Any

import pytest
from obc_harness import OPERATION, ObcHarness

from dbc.errors import ConfigurationError
from dbc.frames import Bus, iterate
from firmware.parameters import Verdict, check_operation, load_operation, parameter_frames


def lone_obc() -> Callable[[bytes], Iterable[tuple[int, bytes]]]:
    harness = ObcHarness()

    def tick(frames: bytes) -> Iterable[tuple[int, bytes]]:
        return [(frame.id, frame.data) for frame in iterate(harness.tick(frames)) if frame.bus == Bus.CAN_A]

    return tick


def verdict_on(**changes: Any) -> Verdict:
    operation = dict(load_operation(OPERATION)) | changes
    return check_operation(list(operation.items()), lone_obc())


def test_shipped_operation_is_accepted() -> None:
    assert verdict_on() == Verdict(True, ())


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"max_speed": -1e300}, "not a finite number"),
        ({"max_speed": 10**12}, "above the maximum"),
        ({"max_speed": None}, "wrong type"),
        ({"max_speed": True}, "wrong type"),
        ({"max_speed": [50.0]}, "wrong type"),
        ({"max_speed": {"a": 50.0}}, "wrong type"),
        ({"max_speed": date(2022, 1, 2)}, "wrong type"),
        ({"imu_timeout": 50.0}, "wrong type"),
        ({"imu_timeout": 10**12}, "wrong type"),
    ],
)
def test_values_of_any_type_reach_the_firmware(changes: dict[str, Any], reason: str) -> None:
    """Beside the parameter matrix: what YAML can hold and no parameter can be."""
    ((key, value),) = changes.items()
    (offence,) = verdict_on(**changes).offences
    assert (offence.key, offence.reason, offence.value) == (key, reason, repr(value))
    assert str(offence).startswith(f"{key}: ")


def test_all_offences_together() -> None:
    wrong = dict.fromkeys(dict(load_operation(OPERATION)), "text")
    unknown = {f"unknown_{index}": 1 for index in range(100)}
    verdict = check_operation([*(wrong | unknown).items()], lone_obc())
    assert {offence.key for offence in verdict.offences} == set(wrong) | set(unknown)
    assert len(verdict.offences) == len(wrong) + len(unknown)


def test_key_given_twice_goes_to_the_firmware(tmp_path: Path) -> None:
    path = write(tmp_path, OPERATION.read_text() + "max_speed: 50.0\n")
    entries = load_operation(path)
    assert entries == [*load_operation(OPERATION), ("max_speed", 50.0)]
    verdict = check_operation(entries, lone_obc())
    assert [(offence.key, offence.reason) for offence in verdict.offences] == [("max_speed", "given more than once")]
    assert verdict.offences[0].value == f"{dict(load_operation(OPERATION))['max_speed']}, 50.0"


def test_firmware_of_another_schema(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware.tables.ParameterSchema.hash", property(lambda _: 1))
    verdict = verdict_on()
    assert [offence.reason for offence in verdict.offences] == [
        "sender and firmware were built from different parameter schemas"
    ]


def test_lost_frame_is_a_count_mismatch() -> None:
    tick = lone_obc()
    first = True

    def lossy(frames: bytes) -> Iterable[tuple[int, bytes]]:
        nonlocal first
        frames, first = (frames[24:] if first else frames), False
        return tick(frames)

    verdict = check_operation(load_operation(OPERATION), lossy)
    reasons = [offence.reason for offence in verdict.offences]
    assert reasons == ["the number of parameters sent and received differs", "missing"]


def test_silent_firmware_is_reported() -> None:
    with pytest.raises(ConfigurationError, match="no verdict"):
        check_operation(load_operation(OPERATION), lambda _: [])


def write(folder: Path, content: str | bytes) -> Path:
    path = folder / "operation.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    ("content", "key", "problem"),
    [
        ("max_speed: [1\nimu: 2\n", "line 2", "expected ',' or ']'"),
        ("max_speed: 1\n\tbad: 2\n", "line 2", "cannot start any token"),
        ("- 1\n- 2\n", "line 1", "mapping"),
        ("", "line 1", "mapping"),
        ("just text\n", "line 1", "mapping"),
        ("max_speed: 2020-99-01\n", "", "no YAML"),
        ("1: 2\n", "line 1", "a key must be text"),
        ("? [a]\n: 1\n", "line 1", "a key must be text"),
        (b"max_speed: \xff\xfe\n", "", "cannot be read"),
        ("max_speed: \x00\n", "", "special characters"),
        ("a: !!python/object/apply:os.system [ls]\n", "line 1", "could not determine a constructor"),
        ("a: " + "[" * 2000 + "\n", "", "no YAML"),
    ],
)
def test_file_that_is_no_operation(tmp_path: Path, content: str | bytes, key: str, problem: str) -> None:
    path = write(tmp_path, content)
    with pytest.raises(ConfigurationError) as refused:
        parameter_frames(path)
    assert (refused.value.file, refused.value.key) == (str(path), key)
    assert problem in refused.value.problem
    assert "\n" not in str(refused.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        load_operation(tmp_path / "nothing.yaml")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_operation(tmp_path)
