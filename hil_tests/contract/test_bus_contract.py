"""What the bench states twice is the same in both places: DBC files, C enums, Python enums, schema, FMU."""

from __future__ import annotations

import json
from pathlib import Path

import cantools
import fmpy
import pytest

import bridge
from autonomy.status import NodeId, NodeStatus, SensorId
from bridge._native import lib
from bridge.bus import BIT_RATES
from bridge.plant import REQUIRED_INPUTS, REQUIRED_OUTPUTS
from dbc.buses import DATABASES, DIRECTORY
from dbc.codec import database
from dbc.frames import Bus, Flag, Station
from dbc.states import CtState, SsmState, SysState, TrackFlag, VehicleFlag
from plant_fmu import fmu_path

SCHEMA = json.loads((Path(bridge.__file__).parent / "schemas" / "scenario.schema.json").read_text())


@pytest.mark.parametrize(("stem", "bus"), DATABASES.items())
def test_bit_rates_are_those_of_the_dbc_files(stem: str, bus: Bus):
    loaded = cantools.database.load_file(DIRECTORY / f"{stem}.dbc")
    assert loaded.dbc.attributes["Baudrate"].value == BIT_RATES[bus]


@pytest.mark.parametrize(
    ("states", "message", "signal"),
    [
        (SysState, "misc_report", "sys_state"),
        (CtState, "ct_report", "ct_state"),
        (SsmState, "ssm_status", "ssm_state"),
        (TrackFlag, "base_to_car_summary", "track_flag"),
        (VehicleFlag, "base_to_car_summary", "veh_flag"),
        (NodeStatus, "node_status", "node_status_code"),
        (NodeStatus, "perception_status", "perception_status_code"),
        (SensorId, "sensor_notice", "sensor_id"),
    ],
)
def test_states_are_the_value_tables_of_the_dbc_files(states: type, message: str, signal: str):
    choices = database.facts(message).message.get_signal_by_name(signal).choices
    assert {state.value: state.name for state in states} == {code: str(name) for code, name in choices.items()}


def test_every_node_reports_in_one_of_two_messages_of_the_same_layout():
    names = [
        database.message("node_status").choices["node_id"],
        database.message("perception_status").choices["perception_id"],
    ]
    assert names[0].keys().isdisjoint(names[1])
    assert {node.value: node.name for node in NodeId} == names[0] | names[1]
    one, other = (database.facts(name) for name in ("node_status", "perception_status"))
    assert [len(each) for each in names] == [one.frames_per_cycle, other.frames_per_cycle]
    assert one.cycle_ms == other.cycle_ms
    for mine, its in zip(one.message.signals, other.message.signals, strict=True):
        assert mine.name.replace("node_", "perception_", 1) == its.name
        assert (mine.start, mine.length, mine.scale, mine.unit) == (its.start, its.length, its.scale, its.unit)


def test_schema_names_only_states_and_flags_that_exist():
    condition = SCHEMA["$defs"]["condition"]["properties"]
    flags = SCHEMA["properties"]["race_control"]["items"]["properties"]["set"]["properties"]
    assert set(condition["sys_state"]["enum"]) <= set(SysState.__members__)
    assert set(condition["ct_state"]["enum"]) <= set(CtState.__members__)
    assert set(flags["track_flag"]["enum"]) == set(TrackFlag.__members__) - {"UNKNOWN"}
    assert set(flags["vehicle_flag"]["enum"]) == set(VehicleFlag.__members__) - {"NONE_ALT"}


def test_buses_stations_and_flags_are_those_of_the_firmware():
    assert list(Bus) == [lib.CAN_BUS_1, lib.CAN_BUS_3, lib.CAN_BUS_A, lib.CAN_BUS_S, lib.CAN_BUS_R]
    for station in Station:
        assert getattr(lib, f"CAN_STATION_{station.name}") == station
    for flag in Flag:
        assert getattr(lib, f"CAN_FLAG_{flag.name}") == flag


@pytest.mark.parametrize("version", [2, 3])
def test_the_plant_has_every_wired_variable(version: int):
    variables = {
        variable.name: variable for variable in fmpy.read_model_description(str(fmu_path(version))).modelVariables
    }
    assert len(REQUIRED_OUTPUTS) == lib.PLANT_OUT_COUNT
    assert len(REQUIRED_INPUTS) == lib.PLANT_IN_COUNT
    for names, causality in ((REQUIRED_OUTPUTS, "output"), (REQUIRED_INPUTS, "input")):
        for name in names:
            assert variables[name].causality == causality, name
