"""The FMU binding: what it sets and gets is what fmpy's own calls see, and bad FMUs give one line."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

from bridge.plant import OPTIONAL_INPUTS, REQUIRED_INPUTS, REQUIRED_OUTPUTS, Plant
from bridge.scenario import load_vehicle
from dbc.errors import PlantError
from plant_fmu import fmu_path
from scenarios import DIRECTORY

VEHICLE = load_vehicle(DIRECTORY / "vehicles" / "av21.yaml")
STEP_S = 0.01


def drive(plant: Plant, ticks: int) -> np.ndarray:
    """A launch with some steering; outputs after every tick."""
    rows = []
    place = {name: index for index, name in enumerate(REQUIRED_INPUTS)}
    plant.inputs[place["ignition"]] = 1.0
    plant.inputs[place["road_friction"]] = 1.0
    for tick in range(ticks):
        plant.inputs[place["starter"]] = float(20 <= tick < 120)
        plant.inputs[place["gear_demand"]] = 1.0 if tick > 200 else 0.0
        plant.inputs[place["throttle_demand"]] = 0.4 if tick > 220 else 0.0
        plant.inputs[place["steer_motor_demand"]] = 0.3 * np.sin(tick * 0.02)
        plant.step(tick * STEP_S, STEP_S)
        rows.append(plant.outputs.copy())
    return np.array(rows)


@pytest.mark.parametrize("version", [2, 3])
def test_same_as_the_calls_of_fmpy(version: int):
    with Plant(fmu_path(version), VEHICLE | {"x0": 5.0, "yaw0": 0.5}) as plant:
        ours = drive(plant, 500)
        names = plant.output_names
    path = fmu_path(version)
    description = fmpy.read_model_description(str(path))
    folder = fmpy.extract(str(path))
    variables = {variable.name: variable for variable in description.modelVariables}
    fmu = (FMU2Slave if version == 2 else FMU3Slave)(
        guid=description.guid if version == 2 else description.instantiationToken,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
    )
    try:
        fmu.instantiate()
        real = (fmu.setReal, fmu.getReal) if version == 2 else (fmu.setFloat64, fmu.getFloat64)
        whole = (fmu.setInteger, fmu.getInteger) if version == 2 else (fmu.setInt32, fmu.getInt32)
        calls = {"Real": real, "Float64": real, "Integer": whole, "Int32": whole}
        calls["Boolean"] = (fmu.setBoolean, fmu.getBoolean)

        def put(name: str, value: float) -> None:
            setter = calls[variables[name].type][0]
            setter([variables[name].valueReference], [value if setter is real[0] else int(value)])

        for name, value in (VEHICLE | {"x0": 5.0, "yaw0": 0.5}).items():
            put(name, value)
        if version == 2:
            fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        for tick in range(500):
            put("ignition", 1)
            put("road_friction", 1.0)
            put("starter", 20 <= tick < 120)
            put("gear_demand", 1 if tick > 200 else 0)
            put("throttle_demand", 0.4 if tick > 220 else 0.0)
            put("steer_motor_demand", 0.3 * np.sin(tick * 0.02))
            fmu.doStep(tick * STEP_S, STEP_S)
            if tick % 50 == 49:
                for index, name in enumerate(names):
                    value = calls[variables[name].type][1]([variables[name].valueReference])[0]
                    assert ours[tick, index] == float(value), (tick, name)
        assert ours[-1, names.index("vx")] > 3.0  # it did drive
        assert ours[-1, names.index("engine_running")] == 1.0
    finally:
        fmu.terminate()
        fmu.freeInstance()
        shutil.rmtree(folder)


def test_both_fmi_versions_give_the_same_bits():
    results = []
    for version in (2, 3):
        with Plant(fmu_path(version), VEHICLE) as plant:
            results.append((plant.output_names, plant.output_units, drive(plant, 400).tobytes()))
    assert results[0] == results[1]


def test_outputs_begin_with_the_wired_ones_and_have_units():
    with Plant(fmu_path(3), VEHICLE) as plant:
        assert plant.output_names[: len(REQUIRED_OUTPUTS)] == REQUIRED_OUTPUTS
        assert len(set(plant.output_names)) == len(plant.output_names) > len(REQUIRED_OUTPUTS)
        units = dict(zip(plant.output_names, plant.output_units, strict=True))
    assert (units["vx"], units["wheel_speed_fl"], units["brake_pressure_front"]) == ("m/s", "rad/s", "Pa")


def test_start_values_take_effect():
    with Plant(fmu_path(3), VEHICLE | {"x0": 12.0, "y0": -3.0, "yaw0": 1.0}) as plant:
        values = dict(zip(plant.output_names, plant.outputs.tolist(), strict=True))
        assert (values["x"], values["y"], values["yaw"]) == pytest.approx((12.0, -3.0, 1.0))
        inputs = dict(zip(plant.input_names, plant.inputs.tolist(), strict=True))
        assert plant.input_names == (*REQUIRED_INPUTS, *OPTIONAL_INPUTS)
        assert inputs["road_friction"] == 1.0  # the FMU's own start value
        assert [inputs[name] for name in OPTIONAL_INPUTS] == [1.0] * 4


def test_unpacked_files_go_with_the_plant():
    plant = Plant(fmu_path(3), VEHICLE)
    folder = Path(plant._folder or "")
    assert folder.is_dir()
    plant.close()
    plant.close()
    assert not folder.exists()


def edited(tmp_path: Path, replace: tuple[str, str] | None = None, drop: str | None = None) -> Path:
    """Copy of the FMI 3 FMU with a changed description or without some of its files."""
    target = tmp_path / "edited.fmu"
    with zipfile.ZipFile(fmu_path(3)) as source, zipfile.ZipFile(target, "w") as out:
        for item in source.namelist():
            if drop is not None and drop in item:
                continue
            data = source.read(item)
            if replace is not None and item == "modelDescription.xml":
                assert replace[0].encode() in data
                data = data.replace(replace[0].encode(), replace[1].encode())
            out.writestr(item, data)
    return target


def refused(path: Path, start: dict[str, float] | None = None) -> str:
    with pytest.raises(PlantError) as caught:
        Plant(path, start or {})
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def test_missing_file(tmp_path: Path):
    assert "no such FMU file" in refused(tmp_path / "none.fmu")


def test_not_an_fmu(tmp_path: Path):
    path = tmp_path / "text.fmu"
    path.write_text("hello")
    assert "not an FMU" in refused(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "no description here")
    assert "not an FMU" in refused(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", "<fmiModelDescription")
    assert "not an FMU" in refused(path)


def test_missing_output_and_wrong_causality(tmp_path: Path):
    assert "no variable 'yaw_rate', which is needed as output" in refused(
        edited(tmp_path, replace=('"yaw_rate"', '"turning"'))
    )
    with pytest.raises(PlantError, match=r"'mass' is a Float64 parameter; needed is one number as output"):
        Plant(fmu_path(3), {}, required_outputs=["mass"])


def test_grip_of_single_wheels_is_left_out_where_an_fmu_has_not_all_of_it(tmp_path: Path):
    with Plant(edited(tmp_path, replace=('"wheel_grip_rl"', '"grip_of_another_name"')), VEHICLE) as plant:
        assert plant.input_names == REQUIRED_INPUTS
        assert plant.inputs.shape == (len(REQUIRED_INPUTS),)
        drive(plant, 5)


def test_unknown_start_value():
    assert "no variable 'wings', which is given a start value" in refused(fmu_path(3), {"wings": 2.0})


def test_refused_start_value_gives_the_fmus_own_reason():
    message = refused(fmu_path(3), VEHICLE | {"mass": -1.0})
    assert "mass" in message.removeprefix(str(fmu_path(3)))


def test_missing_library(tmp_path: Path):
    assert "cannot be loaded" in refused(edited(tmp_path, drop="binaries/"))


def test_other_interface_and_version(tmp_path: Path):
    path = tmp_path / "old.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "modelDescription.xml",
            '<fmiModelDescription fmiVersion="1.0" modelName="m" modelIdentifier="m" guid="1"'
            ' numberOfContinuousStates="0" numberOfEventIndicators="0"><ModelVariables/></fmiModelDescription>',
        )
    assert "FMI 1.0; allowed are FMI 2 and 3" in refused(path)
