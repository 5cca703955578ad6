"""Scenarios: one run of the bench as a YAML file, checked and turned into plain data.

The format is ``bridge/schemas/scenario.schema.json``; ``scenarios/solo_lap.yaml`` is an example.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from bridge.yaml_file import check_schema, read_yaml
from dbc.buses import DEFAULT_PROFILE
from dbc.errors import ConfigurationError
from dbc.states import CtState, SysState, TrackFlag, VehicleFlag


class Situation(NamedTuple):
    """What conditions look at, once per tick.

    Attributes
    ----------
    time_us : simulated time.
    sys_state, ct_state : as last sent on CAN1.
    distance_m : driven since power-on.
    laps : full laps, line to line.
    standstill : the car stands.
    """

    time_us: int
    sys_state: int
    ct_state: int
    distance_m: float
    laps: int
    standstill: bool


@dataclass(frozen=True)
class Condition:
    """All that is given must hold at once; times and distances are lower bounds.

    `for_us` is how long the rest must have held without a break: see `Trigger`.
    """

    time_us: int | None = None
    sys_state: SysState | None = None
    ct_state: CtState | None = None
    distance_m: float | None = None
    laps: int | None = None
    standstill: bool | None = None
    for_us: int = 0

    def holds(self, now: Situation) -> bool:
        """True when all that is given holds now, whatever `for_us` asks."""
        return (
            (self.time_us is None or now.time_us >= self.time_us)
            and (self.sys_state is None or now.sys_state == self.sys_state)
            and (self.ct_state is None or now.ct_state == self.ct_state)
            and (self.distance_m is None or now.distance_m >= self.distance_m)
            and (self.laps is None or now.laps >= self.laps)
            and (self.standstill is None or now.standstill == self.standstill)
        )


class Trigger:
    """Watches one condition over time.

    Parameters
    ----------
    condition : what to wait for.
    """

    def __init__(self, condition: Condition) -> None:
        self._condition = condition
        self._since_us: int | None = None

    def update(self, now: Situation) -> bool:
        """True when the condition holds and has held for as long as it asks; to be called every tick."""
        if not self._condition.holds(now):
            self._since_us = None
            return False
        if self._since_us is None:
            self._since_us = now.time_us
        return now.time_us - self._since_us >= self._condition.for_us


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
class Scenario:
    """One run of the bench. Files are absolute; lengths in m; `profile` is the one of CAN1, see `dbc.buses`."""

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
            SwitchStep(_condition(step["when"]), step["position"]) for step in content["safety_switch"]
        ),
        race_control=tuple(_flag_step(step) for step in content["race_control"]),
        finish=_condition(content["finish"]),
        time_limit_us=_microseconds(content["time_limit_s"]),
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
    return schema


def _referenced(scenario: Path, content: Mapping[str, Any], key: str, parent: str = "") -> Path:
    """The existing file that a key names; `parent` of the key is for the message."""
    name: str = content[key]
    path = (scenario.parent / name).resolve()
    if not path.is_file():
        raise ConfigurationError(scenario, parent + key, f"no such file: {name}")
    return path


def _condition(when: Mapping[str, Any]) -> Condition:
    return Condition(
        time_us=_microseconds(when["time_s"]) if "time_s" in when else None,
        sys_state=SysState[when["sys_state"]] if "sys_state" in when else None,
        ct_state=CtState[when["ct_state"]] if "ct_state" in when else None,
        distance_m=when.get("distance_m"),
        laps=when.get("laps"),
        standstill=when.get("standstill"),
        for_us=_microseconds(when.get("for_s", 0.0)),
    )


def _flag_step(step: Mapping[str, Any]) -> FlagStep:
    flags = step["set"]
    return FlagStep(
        when=_condition(step["when"]),
        track_flag=TrackFlag[flags["track_flag"]] if "track_flag" in flags else None,
        vehicle_flag=VehicleFlag[flags["vehicle_flag"]] if "vehicle_flag" in flags else None,
        round_target_speed_mph=flags.get("round_target_speed_mph"),
    )


def _microseconds(seconds: float) -> int:
    return round(seconds * 1e6)
