"""Scenario files: what is read, and that every way to get one wrong names file, key and what is allowed."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml

import scenarios
from bridge.scenario import Condition, load_scenario, load_vehicle
from dbc.buses import DEFAULT_PROFILE, PROFILES
from dbc.errors import ConfigurationError
from dbc.states import CtState, SysState, TrackFlag, VehicleFlag

GOOD: dict[str, Any] = {
    "name": "test",
    "track": "track.yaml",
    "vehicle": "vehicle.yaml",
    "operation": "operation.yaml",
    "seed": 3,
    "plant": {"fmi_version": 2},
    "start": {"s_m": 10.0, "d_m": -2.5},
    "safety_switch": [{"when": {"time_s": 0.5}, "position": 3}],
    "race_control": [
        {"when": {"time_s": 0}, "set": {"track_flag": "RED"}},
        {
            "when": {"sys_state": "DRIVING", "laps": 1, "for_s": 0.25},
            "set": {"vehicle_flag": "CHEQUERED", "round_target_speed_mph": 31},
        },
    ],
    "finish": {"ct_state": "CNTRL_SHUTDOWN", "standstill": True},
    "time_limit_s": 12.5,
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("track", "vehicle", "operation"):
        (tmp_path / f"{name}.yaml").write_text("a: 1\n")
    return tmp_path


def write(folder: Path, content: object) -> Path:
    path = folder / "scenario.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_a_scenario_is_of_v14_unless_it_says_otherwise(folder: Path) -> None:
    assert load_scenario(write(folder, GOOD)).profile == DEFAULT_PROFILE
    for name in PROFILES:
        assert load_scenario(write(folder, GOOD | {"profile": name})).profile == name
    with pytest.raises(ConfigurationError) as caught:
        load_scenario(write(folder, GOOD | {"profile": "V12"}))
    assert (caught.value.key, caught.value.problem) == ("profile", f"is 'V12'; allowed are {', '.join(PROFILES)}")


def test_a_car_has_no_radar_unless_its_scenario_says_so(folder: Path) -> None:
    assert not load_scenario(write(folder, GOOD)).radar
    for radar, buses in ((False, "CAN1 CAN3 CAN-A CAN-S"), (True, "CAN1 CAN3 CAN-A CAN-S CAN-R")):
        scenario = load_scenario(write(folder, GOOD | {"radar": radar}))
        assert scenario.radar is radar
        assert " ".join(bus.label for bus in scenario.buses) == buses


def changed(*keys: str | int, value: Any = None, remove: bool = False) -> dict[str, Any]:
    content = copy.deepcopy(GOOD)
    place: Any = content
    for key in keys[:-1]:
        place = place[key]
    if remove:
        del place[keys[-1]]
    else:
        place[keys[-1]] = value
    return content


def test_everything_is_read(folder: Path):
    scenario = load_scenario(write(folder, GOOD))
    assert scenario.track == (folder / "track.yaml").resolve()
    assert (scenario.seed, scenario.fmi_version, scenario.fmu) == (3, 2, None)
    assert (scenario.start_s_m, scenario.start_d_m) == (10.0, -2.5)
    assert scenario.safety_switch[0].position == 3
    assert scenario.safety_switch[0].when == Condition(time_us=500_000)
    assert scenario.race_control[0].track_flag is TrackFlag.RED
    assert scenario.race_control[0].vehicle_flag is None
    assert scenario.race_control[1].vehicle_flag is VehicleFlag.CHEQUERED
    assert scenario.race_control[1].round_target_speed_mph == 31
    assert scenario.race_control[1].when == Condition(sys_state=SysState.DRIVING, laps=1, for_us=250_000)
    assert scenario.finish == Condition(ct_state=CtState.CNTRL_SHUTDOWN, standstill=True)
    assert scenario.time_limit_us == 12_500_000


def test_another_fmu(folder: Path):
    path = write(folder, changed("plant", value={"fmu": "my.fmu"}))
    with pytest.raises(ConfigurationError, match=r"plant\.fmu: no such file: my\.fmu"):
        load_scenario(path)
    (folder / "my.fmu").touch()
    assert load_scenario(path).fmu == folder / "my.fmu"


@pytest.mark.parametrize(
    ("content", "key", "words"),
    [
        (changed("colour", value="red"), "colour", "unknown key; allowed are description, faults, finish"),
        (changed("seed", remove=True), "seed", "is missing"),
        (changed("seed", value="many"), "seed", "is 'many'; must be of type integer"),
        (changed("radar", value="front"), "radar", "is 'front'; must be of type boolean"),
        (changed("radar", value=1), "radar", "is 1; must be of type boolean"),
        (changed("radar"), "radar", "is empty; must be of type boolean"),
        (changed("radar", value={"place": "front"}), "radar", "must be of type boolean"),
        (changed("seed", value=-1), "seed", "is -1; must be at least 0"),
        (changed("seed", value=True), "seed", "must be of type integer"),
        (changed("name", value=""), "name", "is empty"),
        (changed("plant", value={"fmi_version": 1}), "plant.fmi_version", "is 1; allowed are 2, 3"),
        (changed("plant", value={}), "plant", "must hold either fmi_version or fmu"),
        (changed("plant", value={"fmi_version": 2, "fmu": "x"}), "plant", "must hold either fmi_version or fmu"),
        (changed("start", "s_m", value=float("nan")), "start.s_m", "is nan; must be a finite number"),
        (changed("start", "s_m", value=float("inf")), "start.s_m", "is inf; must be a finite number"),
        (changed("start", "d_m", value=[1]), "start.d_m", "is list; must be of type number"),
        (changed("start", value=None), "start", "is empty; must be of type object"),
        (changed("safety_switch", value=[]), "safety_switch", "must hold at least one entry"),
        (changed("safety_switch", 0, "position", value=8), "safety_switch[0].position", "is 8; must be at most 7"),
        (changed("race_control", 1, "when", value={}), "race_control[1].when", "is empty; must hold at least one of"),
        (
            changed("race_control", 1, "when", "weather", value="wet"),
            "race_control[1].when.weather",
            "unknown key; allowed are ct_state, distance_m, for_s, laps, standstill, sys_state, time_s",
        ),
        (
            changed("race_control", 0, "set", "track_flag", value="BLUE"),
            "race_control[0].set.track_flag",
            "is 'BLUE'; allowed are RED, ORANGE, YELLOW, GREEN, WAVING_GREEN",
        ),
        (changed("finish", "ct_state", value="DONE"), "finish.ct_state", "allowed are PWR_ON"),
        (changed("time_limit_s", value=0), "time_limit_s", "is 0; must be more than 0"),
        (changed("track", value="nowhere.yaml"), "track", "no such file: nowhere.yaml"),
        ([1, 2], "", "must be of type object"),
        (None, "", "is empty; must be of type object"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_wrong_content_is_refused_by_key(folder: Path, content: object, key: str, words: str):
    path = write(folder, content)
    with pytest.raises(ConfigurationError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert caught.value.key == key
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name: a\nname: b\n", "line 2: key 'name' is given twice"),
        ("name: [a\n", "line 2: expected ',' or ']'"),
        ("name: a\n\tseed: 1\n", "line 2: found character '\\t' that cannot start any token"),
        ("!!python/object:os.system {}\n", "line 1: could not determine a constructor"),
    ],
)
def test_wrong_yaml_is_refused_by_line(folder: Path, text: str, words: str):
    path = folder / "scenario.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        load_scenario(path)
    assert str(caught.value).startswith(f"{path}: {words}")


def test_unreadable_files_are_refused(folder: Path):
    with pytest.raises(ConfigurationError, match="No such file"):
        load_scenario(folder / "missing.yaml")
    with pytest.raises(ConfigurationError, match="Is a directory"):
        load_scenario(folder)
    (folder / "latin.yaml").write_bytes(b"name: caf\xe9\n")
    with pytest.raises(ConfigurationError, match="not UTF-8"):
        load_scenario(folder / "latin.yaml")


@pytest.mark.parametrize(
    ("text", "words"),
    [("mass: heavy\n", "mass: is 'heavy'; must be a number"), ("- 1\n", "must map"), ("mass: true\n", "is True")],
)
def test_wrong_vehicle_files_are_refused(folder: Path, text: str, words: str):
    (folder / "vehicle.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match=words):
        load_vehicle(folder / "vehicle.yaml")


@pytest.mark.parametrize("path", sorted(scenarios.DIRECTORY.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_scenarios_load(path: Path):
    scenario = load_scenario(path)
    assert scenario.name == path.stem
    assert len(load_vehicle(scenario.vehicle)) > 50
