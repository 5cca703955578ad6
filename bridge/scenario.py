"""Scenarios: one run of the bench as a YAML file, checked and turned into plain data.

The format is ``bridge/schemas/scenario.schema.json``; ``scenarios/solo_lap.yaml`` is an example.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib import resources
from pathlib import Path
from typing import Any

from bridge.condition import Condition, Situation, Trigger, condition_of, microseconds
from bridge.faults.plan import FaultPlan
from bridge.faults.reading import fault_schema, read_faults
from bridge.yaml_file import check_schema, read_yaml
from dbc.buses import DEFAULT_PROFILE, Bus, car_buses
from dbc.codec import profile
from dbc.errors import ConfigurationError
from dbc.states import TrackFlag, VehicleFlag

__all__ = [
    "Condition",
    "FlagStep",
    "Opponent",
    "OpponentStep",
    "PerceptionMode",
    "Scenario",
    "Situation",
    "SwitchStep",
    "Trigger",
    "load_scenario",
    "load_vehicle",
]


@dataclass(frozen=True)
class SwitchStep:
    """Turn the safety switch when the condition holds."""

    when: Condition
    position: int


@dataclass(frozen=True)
class FlagStep:
    """Show flags when the condition holds; what is None stays as it is."""

    when: Condition
    track_flag: TrackFlag | None = None
    vehicle_flag: VehicleFlag | None = None
    round_target_speed_mph: int | None = None


@dataclass(frozen=True)
class OpponentStep:
    """Tell an opponent another speed, m/s, or line, m left of the centre line; what is None stays as it is."""

    when: Condition
    speed_mps: float | None = None
    d_m: float | None = None
    acceleration_mps2: float = 5.0


@dataclass(frozen=True)
class Opponent:
    """Another car, which stands where it starts until its script has it drive."""

    name: str
    start_s_m: float
    start_d_m: float
    script: tuple[OpponentStep, ...] = ()


class PerceptionMode(StrEnum):
    """What the car has to see other cars with."""

    NONE = "none"
    """Nothing; of the LiDARs a slice, in which there are walls alone."""
    FULL = "full"
    """Three LiDARs and the front radar, and the nodes that find and follow cars with them."""


@dataclass(frozen=True)
class Scenario:
    """One run of the bench.

    Files are absolute; lengths in m; `profile` is the one of CAN1, see `dbc.buses`; with `radar` the car has the front
    radar, on CAN-R; `perception_map` is the track file by which perception takes points to be on the track.
    """

    path: Path
    name: str
    description: str
    track: Path
    vehicle: Path
    operation: Path
    seed: int
    profile: str
    fmi_version: int
    fmu: Path | None
    start_s_m: float
    start_d_m: float
    safety_switch: tuple[SwitchStep, ...]
    race_control: tuple[FlagStep, ...]
    finish: Condition
    time_limit_us: int
    faults: tuple[FaultPlan, ...] = ()
    radar: bool = False
    perception: PerceptionMode = PerceptionMode.NONE
    perception_map: Path | None = None
    opponents: tuple[Opponent, ...] = ()

    @property
    def buses(self) -> tuple[Bus, ...]:
        """Buses of the car."""
        return car_buses(self.radar)


def load_scenario(path: Path) -> Scenario:
    """Read and check a scenario file.

    Raises
    ------
    ConfigurationError
        With file, key, what is wrong and what is allowed: the first offence.
    """
    content = read_yaml(path)
    check_schema(path, content, _schema())
    plant = content["plant"]
    perception = PerceptionMode(content.get("perception", "none"))
    return Scenario(
        path=path,
        name=content["name"],
        description=content.get("description", ""),
        track=_referenced(path, content, "track"),
        vehicle=_referenced(path, content, "vehicle"),
        operation=_referenced(path, content, "operation"),
        seed=content["seed"],
        profile=content.get("profile", DEFAULT_PROFILE),
        fmi_version=plant.get("fmi_version", 0),
        fmu=_referenced(path, plant, "fmu", "plant.") if "fmu" in plant else None,
        start_s_m=float(content["start"]["s_m"]),
        start_d_m=float(content["start"]["d_m"]),
        safety_switch=tuple(
            SwitchStep(condition_of(step["when"]), step["position"]) for step in content["safety_switch"]
        ),
        race_control=tuple(_flag_step(step) for step in content["race_control"]),
        finish=condition_of(content["finish"]),
        time_limit_us=microseconds(content["time_limit_s"]),
        faults=read_faults(path, content.get("faults", []), profile(content.get("profile", DEFAULT_PROFILE))),
        radar=content.get("radar", False) or perception is PerceptionMode.FULL,
        perception=perception,
        perception_map=_referenced(path, content, "perception_map") if "perception_map" in content else None,
        opponents=tuple(_opponent(one) for one in content.get("opponents", [])),
    )


def load_vehicle(path: Path) -> dict[str, float]:
    """Read vehicle parameters: a flat mapping of names to SI numbers.

    Raises
    ------
    ConfigurationError
        When the file is not that.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or not content:
        raise ConfigurationError(path, "", "must map parameter names to numbers")
    for name, value in content.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigurationError(path, str(name), f"is {value!r}; must be a number")
    return {str(name): float(value) for name, value in content.items()}


def _schema() -> dict[str, Any]:
    text = resources.files("bridge").joinpath("schemas", "scenario.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    schema["properties"]["faults"]["items"] = fault_schema()
    return schema


def _referenced(scenario: Path, content: Mapping[str, Any], key: str, parent: str = "") -> Path:
    """The existing file that a key names; `parent` of the key is for the message."""
    name: str = content[key]
    path = (scenario.parent / name).resolve()
    if not path.is_file():
        raise ConfigurationError(scenario, parent + key, f"no such file: {name}")
    return path


def _flag_step(step: Mapping[str, Any]) -> FlagStep:
    flags = step["set"]
    return FlagStep(
        when=condition_of(step["when"]),
        track_flag=TrackFlag[flags["track_flag"]] if "track_flag" in flags else None,
        vehicle_flag=VehicleFlag[flags["vehicle_flag"]] if "vehicle_flag" in flags else None,
        round_target_speed_mph=flags.get("round_target_speed_mph"),
    )


def _opponent(content: Mapping[str, Any]) -> Opponent:
    script = (OpponentStep(condition_of(step["when"]), **step["set"]) for step in content["script"])
    start = content["start"]
    return Opponent(content["name"], float(start["s_m"]), float(start["d_m"]), tuple(script))
