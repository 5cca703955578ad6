"""Faults in scenario files: every kind is read, and every way to get one wrong names the key and what is allowed."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import yaml

import scenarios
from bridge.condition import Condition
from bridge.faults import (
    ActuatorStuck,
    Babble,
    BrakeFade,
    Corrupt,
    Drop,
    Fault,
    FaultPlan,
    Hang,
    Masquerade,
    Onset,
    ParameterAltered,
    Partition,
    Stuck,
)
from bridge.faults.reading import KINDS
from bridge.scenario import load_scenario
from dbc.buses import Bus, Station
from dbc.errors import ConfigurationError
from dbc.states import CtState, SsmState

DRIVE = scenarios.DIRECTORY / "short_drive.yaml"

STEERING = {"message": "steering_cmd"}
ANGLE = STEERING | {"signal": "steering_motor_ang_cmd"}

MEMORY = {"fault": "memory_altered", "station": "OBC", "field": "control_output.throttle", "value": 1}
WIRE = {"fault": "wire_altered", "station": "RAPTOR", "input": "battery_voltage"}

EXAMPLES: dict[str, dict[str, Any]] = {
    "drop": STEERING,
    "delay": STEERING | {"ticks": 2},
    "duplicate": STEERING,
    "corrupt": STEERING | {"random_bits": 1},
    "replay": STEERING | {"age": 5},
    "reorder": STEERING,
    "deaf": {"station": "RAPTOR"},
    "wrong_length": STEERING | {"length": 1},
    "wrong_identifier": STEERING | {"identifier": 1},
    "masquerade": ANGLE | {"station": "RAPTOR", "value": 3.5, "owner_heard": True},
    "partition": {"bus": "CAN1", "station": "RAPTOR"},
    "silent": {"station": "OBC"},
    "late": {"station": "OBC", "ticks": 2},
    "bus_error": STEERING,
    "babble": {"station": "OBC", "bus": "CAN1"},
    "stuck": ANGLE | {"value": 3},
    "freeze": ANGLE,
    "offset": ANGLE | {"value": 3.5},
    "scale": ANGLE | {"factor": 0.5},
    "noise": ANGLE | {"sigma": 0.5},
    "heartbeat_stalled": {"node": "planning"},
    "status_code": {"node": "estimation", "code": 200},
    "scan_outage": {"scanner": "lidar"},
    "scan_frozen": {"scanner": "radar"},
    "scan_size": {"scanner": "lidar", "size": 100},
    "sensor_outage": {"sensor": "imu"},
    "sensor_frozen": {"sensor": "gnss_b"},
    "gnss_bias": {"sensor": "gnss_a", "east": 2.0},
    "parameter_altered": {"name": "max_speed", "value": 90.0},
    "reset": {"station": "RAPTOR"},
    "power_loss": {"station": "SPACE_DRIVE"},
    "hang": {"station": "AUTONOMY"},
    "slow": {"station": "OBC", "every": 3},
    "clock_drift": {"station": "OBC", "ppm": -100},
    "actuator_stuck": {"actuator": "brake"},
    "brake_fade": {"factor": 0.4},
    "engine_stall": {},
    "reliability": {"node": "planning", "percent": 10.0},
    "memory_altered": {"station": "OBC", "field": "control_output.throttle", "value": "nan", "after": "control"},
    "execution_time": {"task": "control", "extra_us": 5000},
    "wire_altered": {"station": "RAPTOR", "input": "brake_pressure_front", "offset": 1e5},
    "grip_loss": {"factor": 0.3, "wheel": "rl"},
    "lidar_silent": {},
    "lidar_frozen": {},
    "lidar_not_finite": {},
    "lidar_sparse": {"share": 0.1},
    "lidar_slow": {"every": 3},
}


def load(folder: Path, *faults: object) -> tuple[FaultPlan, ...]:
    content = yaml.safe_load(DRIVE.read_text())
    for key in ("track", "vehicle", "operation"):
        content[key] = str(scenarios.DIRECTORY / content[key])
    path = folder / "scenario.yaml"
    path.write_text(yaml.safe_dump(content | {"faults": list(faults)}))
    return load_scenario(path).faults


def test_no_faults_by_default() -> None:
    assert load_scenario(DRIVE).faults == ()


def test_there_is_an_example_of_every_kind() -> None:
    assert set(EXAMPLES) == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_read(tmp_path: Path, kind: str) -> None:
    (plan,) = load(tmp_path, {"fault": kind} | EXAMPLES[kind])
    assert type(plan.fault) is KINDS[kind]
    assert str(plan.fault).split()[0] == kind
    assert (plan.onset, plan.for_us, plan.times, plan.seed) == (Onset(), None, 1, None)


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_of_every_kind_is_checked(tmp_path: Path, kind: str) -> None:
    for key in (item.name for item in fields(KINDS[kind])):
        with pytest.raises(ConfigurationError) as caught:
            load(tmp_path, {"fault": kind} | EXAMPLES[kind] | {key: {}})
        assert caught.value.key == f"faults[0].{key}"
    with pytest.raises(ConfigurationError, match=r"faults\[0\]\.colour: unknown key; allowed are"):
        load(tmp_path, {"fault": kind, "colour": "red"} | EXAMPLES[kind])


def test_everything_is_read(tmp_path: Path) -> None:
    when = {"time_s": 1.5, "ct_state": "CAUTION", "ssm_state": "NOMINAL", "station_m": 200, "message": "steering_cmd"}
    plans = load(
        tmp_path,
        {"fault": "drop", "message": "steering_cmd", "probability": 0.25, "when": when | {"frames": 7}, "seed": 3},
        {"fault": "stuck", **ANGLE, "value": 5, "for_frames": 4, "times": 3, "every_s": 0.5},
        {"fault": "corrupt", "station": "OBC", "bits": [0, 63], "for_s": 0.25},
        {"fault": "babble", "station": "RAPTOR", "bus": "CAN3", "identifier": 1, "frames_per_tick": 9},
        {"fault": "hang", "station": "OBC"},
        {"fault": "masquerade", **ANGLE, "station": "RAPTOR", "value": 2, "owner_heard": True},
        {"fault": "partition", "bus": "CAN3"},
        {"fault": "actuator_stuck", "actuator": "steering", "value": 1},
        {"fault": "brake_fade", "factor": 0.5},
        {"fault": "parameter_altered", "name": "max_speed", "value": 90},
    )
    faults: list[Fault] = [
        Drop(message="steering_cmd", probability=0.25),
        Stuck(message="steering_cmd", signal="steering_motor_ang_cmd", value=5.0),
        Corrupt(station=Station.OBC, bits=(0, 63)),
        Babble(station=Station.RAPTOR, bus=Bus.CAN3, identifier=1, frames_per_tick=9),
        Hang(station=Station.OBC),
        Masquerade(**ANGLE, station=Station.RAPTOR, value=2.0, owner_heard=True),
        Partition(bus=Bus.CAN3),
        ActuatorStuck(actuator="steering", value=1.0),
        BrakeFade(factor=0.5),
        ParameterAltered(name="max_speed", value=90),
    ]
    assert [plan.fault for plan in plans] == faults
    condition = Condition(time_us=1_500_000, ct_state=CtState.CAUTION)
    assert plans[0].onset == Onset(condition, SsmState.NOMINAL, 200, "steering_cmd", 7)
    assert plans[0].seed == 3
    assert (plans[1].for_frames, plans[1].times, plans[1].every_us) == (4, 3, 500_000)
    assert plans[2].for_us == 250_000


@pytest.mark.parametrize(
    ("entry", "key", "words"),
    [
        ({}, "faults[0].fault", "is missing"),
        ({"fault": "gremlin"}, "faults[0].fault", "is 'gremlin'; allowed are actuator_stuck, babble"),
        ({"fault": "hang"}, "faults[0].station", "is missing"),
        ({"fault": "hang", "station": "DRIVER"}, "faults[0].station", "allowed are SENSORS, AUTONOMY, OBC"),
        ({"fault": "slow", "station": "OBC", "every": 1}, "faults[0].every", "must be at least 2"),
        ({"fault": "brake_fade", "factor": 1}, "faults[0].factor", "is 1; must be less than 1"),
        ({"fault": "drop"}, "faults[0]", "drop needs either a message or a station"),
        ({"fault": "drop", "message": "steering"}, "faults[0]", "no message is called 'steering'; the nearest is"),
        ({"fault": "stuck", **ANGLE, "value": 999}, "faults[0]", "allowed is -512 to 511.5"),
        ({"fault": "reset", "station": "AUTONOMY"}, "faults[0]", "allowed are OBC, RAPTOR, SPACE_DRIVE"),
        ({"fault": "clock_drift", "station": "SENSORS", "ppm": 1}, "faults[0]", "allowed are OBC, RAPTOR, SPACE_DRIVE"),
        ({"fault": "masquerade", **STEERING, "station": "OBC"}, "faults[0]", "OBC is the owner of steering_cmd"),
        ({"fault": "masquerade", **ANGLE, "station": "RAPTOR"}, "faults[0]", "both signal and value, or neither"),
        ({"fault": "masquerade", **ANGLE, "station": "RAPTOR", "value": 999}, "faults[0]", "allowed is -512 to 511.5"),
        ({"fault": "grip_loss", "factor": 0.5, "wheel": "spare"}, "faults[0].wheel", "allowed are fl, fr, rl, rr"),
        ({"fault": "engine_stall", "for_frames": 3}, "faults[0]", "befalls no single frames"),
        ({"fault": "engine_stall", "times": 3}, "faults[0]", "needs every_s"),
        ({"fault": "engine_stall", "when": {}}, "faults[0].when", "is empty; must hold at least one of"),
        ({"fault": "engine_stall", "when": {"frames": 3}}, "faults[0].when.frames", "needs message beside it"),
        ({"fault": "engine_stall", "when": {"ssm_state": "FINE"}}, "faults[0].when.ssm_state", "allowed are BOOT"),
        ({"fault": "engine_stall", "when": {"message": "no", "frames": 1}}, "faults[0]", "no message is called 'no'"),
        ("engine_stall", "faults[0]", "must be of type object"),
        (MEMORY | {"field": "control_output.throttel"}, "faults[0]", "the nearest is 'throttle'"),
        (MEMORY | {"field": "control_output"}, "faults[0]", "is no number but struct control_output; allowed below"),
        (MEMORY | {"field": "control_output.road_wheel_angle[5]"}, "faults[0]", "allowed is 0 to 4"),
        (MEMORY | {"field": "control_output.throttle.x"}, "faults[0]", "float has no parts"),
        (MEMORY | {"field": "ssm..state"}, "faults[0]", "cannot be read from"),
        (MEMORY | {"field": "ssm.state", "value": 256}, "faults[0]", "uint8_t cannot hold it"),
        (MEMORY | {"field": "ssm.state", "value": "nan"}, "faults[0]", "uint8_t cannot hold it"),
        (MEMORY | {"value": "much"}, "faults[0]", "neither a number, nan, inf nor an enumerator"),
        (MEMORY | {"value": "obc_init"}, "faults[0]", "neither a number, nan, inf nor an enumerator"),
        (MEMORY | {"station": "RAPTOR", "field": "speed", "after": "control"}, "faults[0]", "after 'control'"),
        (WIRE, "faults[0]", "needs either a value or an offset"),
        (WIRE | {"value": 1, "offset": 1}, "faults[0]", "needs either a value or an offset"),
        (WIRE | {"input": "gear", "offset": 1}, "faults[0]", "an offset goes with float only"),
        (WIRE | {"station": "OBC", "value": 1}, "faults[0]", "allowed are RAPTOR, SPACE_DRIVE"),
    ],
)
def test_wrong_entries_are_one_line(tmp_path: Path, entry: object, key: str, words: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path, entry)
    assert caught.value.key == key
    assert words in caught.value.problem
    assert "\n" not in str(caught.value)
