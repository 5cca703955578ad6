"""Sources of the parameter and fault tables: their checks, and that everything committed is generated from them."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from bridge._native import lib
from dbc.errors import ConfigurationError
from firmware import generate
from firmware.parameters import load_operation
from firmware.tables import FAULTS_FILE, PARAMETERS_FILE, fnv1a, load_faults, load_parameters

ROOT = Path(__file__).resolve().parents[2]
OPERATIONS = sorted((ROOT / "scenarios" / "operations").glob("*.yaml"))


def test_fnv1a_reference_values() -> None:
    # Test vectors of draft-eastlake-fnv, appendix C.
    assert [fnv1a(text) for text in (b"", b"a", b"foobar")] == [0x811C9DC5, 0xE40C292C, 0xBF9CF968]


def test_binding_was_built_from_these_sources() -> None:
    schema = load_parameters()
    assert lib.parameter_schema_hash == schema.hash
    assert [lib.parameter_table[i].key for i in range(lib.PARAMETER_COUNT)] == [p.key for p in schema.parameters]
    assert len(load_faults()) == lib.FAULT_COUNT - 1


def test_hash_changes_with_every_fact(tmp_path: Path) -> None:
    hashes = {load_parameters().hash}
    for field, value in (("max", 91.0), ("min", 0.5), ("default", 2.0), ("unit", "Hz"), ("name", "max_velocity")):
        path = rewrite(tmp_path, PARAMETERS_FILE, lambda s, f=field, v=value: s["parameters"][0].update({f: v}))
        source = yaml.safe_load(path.read_text())
        if field == "name":
            for rule in source["cross_checks"]:
                rule.update({side: value for side in ("left", "right") if rule[side] == "max_speed"})
            path.write_text(yaml.safe_dump(source))
        hashes.add(load_parameters(path).hash)
    assert len(hashes) == 6


@pytest.mark.parametrize("path", list(generate.documents()), ids=lambda path: path.name)
def test_committed_files_are_up_to_date(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == generate.documents()[path], (
        "run: python -m firmware.generate --documents"
    )


def test_generator_is_reproducible_and_runs_by_module_and_path(tmp_path: Path) -> None:
    commands = ([sys.executable, "-m", "firmware.generate"], [sys.executable, str(Path(generate.__file__))])
    trees = []
    for index, command in enumerate(commands):
        out = tmp_path / str(index)
        subprocess.run([*command, "--out", str(out)], check=True, cwd=ROOT)
        trees.append({p.name: p.read_text() for p in (out / "generated").iterdir()})
    assert trees[0] == trees[1] == generate.tables()


def test_generator_without_a_task_is_refused() -> None:
    with pytest.raises(SystemExit) as refused:
        generate.main([])
    assert refused.value.code == 2


@pytest.mark.parametrize("path", OPERATIONS, ids=lambda path: path.name)
def test_shipped_operations_fit_the_json_schema(path: Path) -> None:
    schema = json.loads((PARAMETERS_FILE.parent / "operation.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    operation = dict(load_operation(path))
    jsonschema.validate(operation, schema)
    for change in ({"no_such_key": 1}, {"max_speed": "fast"}, {"max_speed": -1.0}, {"imu_timeout": 50.5}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(operation | change, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({k: v for k, v in operation.items() if k != "max_speed"}, schema)


def test_a_car_that_must_see_others_is_otherwise_that_of_the_solo_lap() -> None:
    alone, among = (
        load_operation(ROOT / "scenarios" / "operations" / f"{name}.yaml") for name in ("solo", "perception")
    )
    assert dict(alone)["perception_required"] is False
    changed = [(key, True if key == "perception_required" else value) for key, value in alone]
    assert among == changed


def rewrite(folder: Path, source: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    content = yaml.safe_load(source.read_text())
    change(content)
    path = folder / source.name
    path.write_text(yaml.safe_dump(content))
    return path


def parameter(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda source: source["parameters"][0].update(changes)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (parameter(name="Max Speed"), "lower case"),
        (parameter(type="double"), "none of float, int, bool"),
        (parameter(unit="mph"), "none of m, m/s"),
        (parameter(sign="plus"), "none of positive"),
        (parameter(safety="none"), "none of high"),
        (parameter(text=""), "text"),
        (parameter(max=float("nan")), "2^24"),
        (parameter(max=2**24), "2^24"),
        (parameter(max=1.0), "min is not below max"),
        (parameter(default=91.0), "default"),
        (parameter(min=0.0), "positive"),
        (parameter(sign="non_negative"), "non-negative"),
        (parameter(sign="negative"), "negative"),
        (parameter(default=True), "default"),
        (parameter(bogus=1), "bogus"),
        (lambda s: s["parameters"][0].pop("unit"), "unit"),
        (lambda s: s["parameters"].append(s["parameters"][0]), "collides"),
        (lambda s: s.update(parameters=[], cross_checks=[]), "1 to 255"),
        (lambda s: s["cross_checks"][0].update(left="max_sped"), "unknown parameter"),
        (lambda s: s["cross_checks"][0].update(kind="equal"), "none of less"),
        (lambda s: s["cross_checks"][0].update(bound=1.0), "bound"),
    ],
)
def test_wrong_parameter_source(tmp_path: Path, change: Callable[[dict[str, Any]], Any], problem: str) -> None:
    path = rewrite(tmp_path, PARAMETERS_FILE, change)
    with pytest.raises(ConfigurationError) as refused:
        load_parameters(path)
    assert problem in refused.value.problem
    assert refused.value.file == str(path)


def fault(entry: str, **changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda source: next(f for f in source["faults"] if f["name"] == entry).update(changes)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (fault("imu_timeout", reaction="stop"), "none of none, warn"),
        (fault("imu_timeout", latch="never"), "none of while_present"),
        (fault("imu_timeout", supervised="parked"), "none of always"),
        (fault("imu_timeout", disables="mpc"), "none of none, lqr"),
        (fault("imu_timeout", detection=""), "detection"),
        (fault("imu_timeout", debounce_ms=15), "10 ms"),
        (fault("imu_timeout", debounce_ms=500), "deadline"),
        (fault("imu_timeout", latch="while_present"), "safe stop"),
        (fault("misc_report_missing", latch="until_reset"), "full brake"),
        (fault("lqr_invalid", disables="none"), "switch"),
        (fault("gnss_a_timeout", speed_percent=None), "speed_percent None is no whole number from 1 to 100"),
        (fault("lqr_invalid", acceleration_percent=None), "acceleration_percent None is no whole number"),
        (fault("gnss_a_timeout", speed_percent=0), "speed_percent 0 is no"),
        (fault("gnss_a_timeout", speed_percent=101), "speed_percent 101 is no"),
        (fault("gnss_a_timeout", acceleration_percent=50.5), "acceleration_percent 50.5 is no"),
        (fault("gnss_a_timeout", acceleration_percent=True), "acceleration_percent True is no"),
        (fault("imu_timeout", speed_percent=50), "speed_percent is only for degrade and switch_controller"),
        (fault("gnss_a_wrong_size", acceleration_percent=50), "acceleration_percent is only for"),
        (fault("imu_timeout", name="gnss_a_timeout"), "twice"),
        (fault("imu_timeout", name="IMU"), "lower case"),
        (fault("imu_timeout", bogus=1), "bogus"),
        (lambda s: s.update(faults=[]), "1 to 255"),
    ],
)
def test_wrong_fault_source(tmp_path: Path, change: Callable[[dict[str, Any]], Any], problem: str) -> None:
    path = rewrite(tmp_path, FAULTS_FILE, change)
    with pytest.raises(ConfigurationError) as refused:
        load_faults(path)
    assert problem in refused.value.problem


@pytest.mark.parametrize("content", ["[1, 2]", "a: [", "\xff\xfe"])
def test_source_that_is_no_mapping(tmp_path: Path, content: str) -> None:
    path = tmp_path / "parameters.yaml"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(ConfigurationError):
        load_parameters(path)
    with pytest.raises(ConfigurationError):
        load_parameters(tmp_path / "missing.yaml")


def test_generator_reports_a_wrong_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rewrite(tmp_path, FAULTS_FILE, fault("imu_timeout", reaction="stop"))
    monkeypatch.setattr(generate, "load_faults", lambda: load_faults(path))
    assert generate.main(["--out", str(tmp_path / "out")]) == 2
    assert "imu_timeout" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
