"""The vehicle file, the FMU's start values and the description are one and the same."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

import plant_fmu
from plant_fmu import package
from plant_fmu.driver import Plant

ROOT = Path(__file__).resolve().parents[2]
VEHICLE = ROOT / "scenarios" / "vehicles" / "av21.yaml"


def vehicle() -> dict[str, float]:
    loaded = yaml.safe_load(VEHICLE.read_text(encoding="utf-8"))
    assert isinstance(loaded, dict)
    return loaded


@pytest.mark.parametrize("fmi_version", [2, 3])
def test_vehicle_file_equals_fmu_start_values(fmi_version: int) -> None:
    values = vehicle()
    with Plant(fmi_version=fmi_version) as car:
        names = set(car.names("parameter")) - package.START_PARAMETERS
        assert set(values) == names
        assert {name: car[name] for name in names} == values


def test_vehicle_file_gives_unit_and_source_of_every_value() -> None:
    lines = [line for line in VEHICLE.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    assert lines == package.parameters_yaml().splitlines()


def test_start_values_are_inside_their_ranges() -> None:
    for variable in package.vehicle_parameters(package.read_variables()):
        assert float(variable.min) <= float(variable.start) <= float(variable.max), variable.name
        assert variable.source, f"{variable.name} has no source"


def test_value_references_are_positions() -> None:
    variables = package.read_variables()
    assert [v.reference for v in variables] == list(range(len(variables)))
    with Plant() as car:
        assert [v.valueReference for v in car.description.modelVariables] == list(range(len(variables)))
        assert [v.name for v in car.description.modelVariables] == [v.name for v in variables]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ('VAR(REAL, a, INPUT, CONTINUOUS, "parsec", 0.0, 0.0, 1.0, "d", "")', "unknown unit"),
        ('VAR(REAL, a, INPUT, CONTINUOUS, "m", 0.0, 0.0, "d", "")', "not a valid VAR entry"),
        ("VAR(REAL, a", "not a valid VAR entry"),
    ],
)
def test_wrong_definition_names_file_and_line(tmp_path: Path, line: str, reason: str) -> None:
    path = tmp_path / "variables.def"
    path.write_text("/* head */\n" + line + "\n", encoding="utf-8")
    with pytest.raises(package.DefinitionError, match=f":2: .*{reason}"):
        package.read_variables(path)


def test_doubled_definition_is_refused(tmp_path: Path) -> None:
    line = 'VAR(REAL, a, INPUT, CONTINUOUS, "m", 0.0, 0.0, 1.0, "d", "")\n'
    path = tmp_path / "variables.def"
    path.write_text(line + line, encoding="utf-8")
    with pytest.raises(package.DefinitionError, match="defined twice"):
        package.read_variables(path)


def test_fmu_path_refuses_other_versions_and_names_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="allowed are 2 and 3"):
        plant_fmu.fmu_path(1)
    monkeypatch.setenv(plant_fmu.FMU_DIR_VARIABLE, str(tmp_path))
    with pytest.raises(FileNotFoundError, match=str(tmp_path)):
        plant_fmu.fmu_path()
