"""What an importer may rely on: standard conformance, equality of both FMI versions, saved states."""

from __future__ import annotations

import ctypes
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

from plant_fmu import fmu_path, package
from plant_fmu.driver import Plant, Value, read_description

START: dict[str, Value] = {
    "v0": 25.0,
    "gear0": 3,
    "gear_demand": 3,
    "engine_running0": True,
    "ignition": True,
    "road_bank": 0.1,
}
VERSIONS = (2, 3)


@pytest.fixture(params=VERSIONS)
def car(request: pytest.FixtureRequest) -> Iterator[Plant]:
    with Plant(START, fmi_version=request.param) as plant:
        yield plant


def drive(plant: Plant, seconds: float, phase: float = 0.0) -> list[dict[str, Value]]:
    """A short drive with every command in use; the outputs every tenth of a second."""
    rows = []
    for k in range(round(seconds * 10)):
        plant.step(
            0.1,
            steer_motor_demand=0.2 * ((k + phase) % 7 - 3),
            throttle_demand=((k + phase) % 11) / 11.0,
            brake_pressure_demand=2e6 if (k + phase) % 13 == 0 else 0.0,
            gear_demand=3 + (k // 10) % 2,
        )
        rows.append(plant.outputs())
    return rows


@pytest.mark.parametrize("fmi_version", VERSIONS)
def test_validates(fmi_version: int) -> None:
    assert validate_fmu(str(fmu_path(fmi_version))) == []


def test_both_fmi_versions_give_the_same_bits() -> None:
    with Plant(START, fmi_version=2) as two, Plant(START, fmi_version=3) as three:
        assert two.names("output") == three.names("output")
        assert drive(two, 10.0) == drive(three, 10.0)


def test_two_runs_give_the_same_bits(car: Plant) -> None:
    with Plant(START, fmi_version=car.fmi_version) as other:
        assert drive(car, 5.0) == drive(other, 5.0)


def test_instances_do_not_disturb_each_other(car: Plant) -> None:
    alone = drive(car, 3.0)
    with Plant(START) as one, Plant({**START, "v0": 60.0}) as two:
        rows = []
        for k in range(3):
            rows += drive_slice(one, k)
            drive_slice(two, k)
        assert rows == drive_sliced_alone()
    assert alone  # the first drive did happen


def drive_slice(plant: Plant, k: int) -> list[dict[str, Value]]:
    return drive(plant, 1.0, phase=float(k))


def drive_sliced_alone() -> list[dict[str, Value]]:
    with Plant(START) as plant:
        return [row for k in range(3) for row in drive_slice(plant, k)]


def test_the_communication_step_does_not_matter() -> None:
    results = []
    for step_s in (0.001, 0.01, 0.05):
        with Plant(START, step_s=step_s) as plant:
            results.append(drive(plant, 3.0))
    assert results[0] == results[1] == results[2]


def test_reset_restores_every_bit(car: Plant) -> None:
    first = drive(car, 4.0)
    car.reset(START)
    assert drive(car, 4.0) == first
    car.reset()
    with Plant(fmi_version=car.fmi_version) as fresh:
        assert car.outputs() == fresh.outputs()
        assert {n: car[n] for n in car.names("parameter")} == {n: fresh[n] for n in fresh.names("parameter")}


def _get_state(car: Plant) -> object:
    return car.fmu.getFMUState() if car.fmi_version == 3 else car.fmu.getFMUstate()


def _set_state(car: Plant, state: object) -> None:
    (car.fmu.setFMUState if car.fmi_version == 3 else car.fmu.setFMUstate)(state)


def _free_state(car: Plant, state: object) -> None:
    (car.fmu.freeFMUState if car.fmi_version == 3 else car.fmu.freeFMUstate)(state)


def _serialize(car: Plant, state: object) -> bytes:
    if car.fmi_version == 3:
        return bytes(car.fmu.serializeFMUState(state))
    return bytes(car.fmu.serializeFMUstate(state))


def _deserialize(car: Plant, data: bytes) -> object:
    return car.fmu.deserializeFMUState(data) if car.fmi_version == 3 else car.fmu.deSerializeFMUstate(data)


def test_saved_state_restores_every_bit(car: Plant) -> None:
    drive(car, 2.0)
    time, state = car.time, _get_state(car)
    first = drive(car, 3.0, phase=2.0)
    _set_state(car, state)
    car.time = time
    assert drive(car, 3.0, phase=2.0) == first
    _free_state(car, state)


def test_serialised_state_restores_every_bit_in_another_instance(car: Plant) -> None:
    drive(car, 2.0)
    time, state = car.time, _get_state(car)
    data = _serialize(car, state)
    first = drive(car, 3.0, phase=2.0)
    _free_state(car, state)
    with Plant(fmi_version=car.fmi_version) as other:
        restored = _deserialize(other, data)
        _set_state(other, restored)
        other.time = time
        assert drive(other, 3.0, phase=2.0) == first
        _free_state(other, restored)


def test_equal_states_have_equal_bytes(car: Plant) -> None:
    with Plant(START, fmi_version=car.fmi_version) as other:
        drive(car, 1.0)
        drive(other, 1.0)
        states = [_get_state(car), _get_state(other)]
        assert _serialize(car, states[0]) == _serialize(other, states[1])
        _free_state(car, states[0])
        _free_state(other, states[1])


def test_foreign_bytes_are_refused_and_change_nothing(car: Plant) -> None:
    drive(car, 1.0)
    state = _get_state(car)
    data = bytearray(_serialize(car, state))
    _free_state(car, state)
    before = car.outputs()
    data[20] ^= 1  # inside the token
    wrong = _deserialize(car, bytes(data))
    with pytest.raises(FMICallException):
        _set_state(car, wrong)
    _free_state(car, wrong)
    assert car.outputs() == before
    with pytest.raises(FMICallException):
        _deserialize(car, bytes(data[:-1]))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_values_that_are_not_finite_are_refused(car: Plant, value: float) -> None:
    before = car["throttle_demand"]
    with pytest.raises(FMICallException):
        car["throttle_demand"] = value
    assert car["throttle_demand"] == before
    car.step()


@pytest.mark.parametrize("fmi_version", VERSIONS)
def test_parameter_outside_its_range_is_refused(fmi_version: int) -> None:
    with pytest.raises(FMICallException):
        Plant({"mass": -5.0}, fmi_version=fmi_version)


def test_messages_say_what_is_wrong_and_what_is_allowed() -> None:
    with Plant(START) as car:
        cases: list[tuple[str, Value, str]] = [
            ("brake_torque_gain", 7.0, "brake_torque_gain = 7 is refused: allowed is 0 to 0.01."),
            ("throttle_demand", float("nan"), "the value must be finite"),
            ("mass", 800.0, "mass is a fixed parameter; set it before initialization ends."),
            ("vx", 3.0, "vx is an output and cannot be set."),
        ]
        for name, value, message in cases:
            with pytest.raises(FMICallException):
                car[name] = value
            assert message in car.messages[-1]
        with pytest.raises(FMICallException):
            car.fmu.getFloat64([9999])
        assert "value reference 9999 does not exist" in car.messages[-1]
        with pytest.raises(FMICallException):
            car.fmu.getFloat64([package.read_variables()[4].reference])
        assert "gear_demand (value reference 4) is integer, not real." in car.messages[-1]
        with pytest.raises(FMICallException):
            car.fmu.getFloat32([1])
        assert "does not support" in car.messages[-1]


def test_tunable_parameter_may_change_while_driving(car: Plant) -> None:
    car.step(1.0)
    car["oval_asymmetry"] = 0.0
    car.step(1.0)
    assert car["oval_asymmetry"] == 0.0


@pytest.mark.parametrize("step", [0.0, -0.01, 0.0005, 0.0015, float("nan"), 1e300])
def test_step_that_is_no_multiple_of_the_inner_step_is_refused(car: Plant, step: float) -> None:
    with pytest.raises(FMICallException):
        car.fmu.doStep(0.0, step)
    car.step()


def test_step_from_another_time_is_refused(car: Plant) -> None:
    car.step()
    with pytest.raises(FMICallException):
        car.fmu.doStep(5.0, 0.01)
    car.step()


def test_calls_in_the_wrong_state_are_refused(car: Plant) -> None:
    with pytest.raises(FMICallException):
        car.fmu.exitInitializationMode()
    with pytest.raises(FMICallException):
        car.fmu.enterInitializationMode()
    car.fmu.terminate()
    with pytest.raises(FMICallException):
        car.fmu.doStep(0.0, 0.01)
    car.reset(START)
    car.step()


def test_wrong_token_is_refused(tmp_path: Path) -> None:
    for version in VERSIONS:
        description = read_description(fmu_path(version))
        folder = tmp_path / str(version)
        with zipfile.ZipFile(fmu_path(version)) as archive:
            archive.extractall(folder)
        arguments = {
            "guid": "{00000000-0000-0000-0000-000000000000}",
            "unzipDirectory": str(folder),
            "modelIdentifier": description.coSimulation.modelIdentifier,
            "instanceName": "car",
        }
        slave: Any = (FMU3Slave if version == 3 else FMU2Slave)(**arguments)
        with pytest.raises(Exception, match="Failed to instantiate"):
            slave.instantiate()


def test_outputs_follow_start_values_in_initialization_mode() -> None:
    with Plant() as car:
        car.fmu.reset()
        car.fmu.enterInitializationMode(startTime=3.0)
        car["v0"] = 12.0
        assert car["vx"] == 12.0
        car["v0"] = 13.0
        assert car["vx"] == 13.0
        assert car["time"] == 3.0


def test_start_time_is_kept() -> None:
    with Plant({"v0": 10.0}, start_time=100.0) as car:
        car.step(1.0)
        assert car["time"] == pytest.approx(101.0)


@pytest.mark.parametrize("fmi_version", VERSIONS)
def test_archive_is_reproducible(fmi_version: int, tmp_path: Path) -> None:
    source = fmu_path(fmi_version)
    with zipfile.ZipFile(source) as archive:
        assert all(info.date_time == package.ZIP_DATE for info in archive.infolist())
        names = archive.namelist()
        binary = next(n for n in names if n.startswith("binaries/"))
        library, header, again = tmp_path / "lib.so", tmp_path / "plant_token.h", tmp_path / "again.fmu"
        library.write_bytes(archive.read(binary))
        header.write_bytes(archive.read("sources/plant_token.h"))
    package.pack(fmi_version, library, header, again)
    assert again.read_bytes() == source.read_bytes()


@pytest.mark.parametrize("fmi_version", VERSIONS)
def test_sources_inside_are_those_of_the_build(fmi_version: int) -> None:
    with zipfile.ZipFile(fmu_path(fmi_version)) as archive:
        for name in (*package.source_files(fmi_version), "variables.def", "model.h"):
            assert archive.read(f"sources/{name}") == (package.SOURCE_DIR / name).read_bytes(), name
        assert package.token() in archive.read("sources/plant_token.h").decode(), "the build is stale"


@pytest.mark.parametrize("fmi_version", VERSIONS)
def test_library_exports_nothing_but_fmi(fmi_version: int, tmp_path: Path) -> None:
    with zipfile.ZipFile(fmu_path(fmi_version)) as archive:
        binary = next(n for n in archive.namelist() if n.startswith("binaries/"))
        library = Path(archive.extract(binary, tmp_path))
    loaded = ctypes.CDLL(str(library))
    assert hasattr(loaded, f"fmi{fmi_version}DoStep")
    for name in ("plant_advance", "plant_reset", "tyre_step", "plant_variables", "fmi_step"):
        assert not hasattr(loaded, name), f"{name} is visible"
