"""Faults in scenario files: the keys of each kind are the fields of its class, and the schema is made from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, get_type_hints

from bridge.condition import condition_of, microseconds
from bridge.faults import car, ecus, frames, lidar, memory, signals
from bridge.faults.fault import Fault
from bridge.faults.plan import FaultPlan, Onset
from dbc.buses import Bus, Station
from dbc.codec import Codec
from dbc.errors import CodecError, ConfigurationError
from dbc.states import SsmState

#: All kinds of faults by the name that a scenario file gives them.
KINDS: Mapping[str, type[Fault]] = {
    kind.kind: kind
    for module in (frames, signals, lidar, ecus, car, memory)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Fault) and kind.kind
}

_STATIONS = [station.name for station in Station if station is not Station.NONE]

#: Keys that an entry has besides those of its kind.
_TIMES: Mapping[str, Mapping[str, Any]] = {
    "when": {"$ref": "#/$defs/onset"},
    "for_s": {"type": "number", "exclusiveMinimum": 0},
    "for_frames": {"type": "integer", "minimum": 1},
    "times": {"type": "integer", "minimum": 1},
    "every_s": {"type": "number", "exclusiveMinimum": 0},
    "seed": {"type": "integer", "minimum": 0},
}

#: JSON schema by the type of a field.
_TYPES: Mapping[Any, Mapping[str, Any]] = {
    str: {"type": "string", "minLength": 1},
    int: {"type": "integer"},
    float: {"type": "number"},
    bool: {"type": "boolean"},
    float | int | bool: {"type": ["number", "boolean"]},
    float | str: {"type": ["number", "string"]},
    Station: {"enum": _STATIONS},
    Bus: {"enum": [bus.name for bus in Bus]},
}


def fault_schema() -> dict[str, Any]:
    """JSON schema of one entry of `faults`; refers to `onset` among the definitions of the scenario's."""
    return {
        "type": "object",
        "required": ["fault"],
        "properties": {"fault": {"enum": sorted(KINDS)}},
        "allOf": [
            {"if": {"required": ["fault"], "properties": {"fault": {"const": name}}}, "then": _schema_of(kind)}
            for name, kind in KINDS.items()
        ],
    }


def read_faults(path: Path, entries: Sequence[Mapping[str, Any]], database: Codec) -> tuple[FaultPlan, ...]:
    """Turn entries that the schema accepts into plans.

    Raises
    ------
    ConfigurationError
        See `check_faults`.
    """
    plans = tuple(_plan(entry) for entry in entries)
    check_faults(path, plans, database)
    return plans


def check_faults(path: Path, plans: Sequence[FaultPlan], database: Codec) -> None:
    """See whether the faults of a scenario file make sense with the messages of a profile.

    Raises
    ------
    ConfigurationError
        When not: names the entry and what is allowed.
    """
    for place, plan in enumerate(plans):
        try:
            plan.check(database)
        except CodecError as error:
            raise ConfigurationError(path, f"faults[{place}]", str(error)) from error


def _plan(entry: Mapping[str, Any]) -> FaultPlan:
    kind = KINDS[entry["fault"]]
    hints = get_type_hints(kind)
    given = {item.name: _value(hints[item.name], entry[item.name]) for item in fields(kind) if item.name in entry}
    when = entry.get("when", {})
    return FaultPlan(
        fault=kind(**given),
        onset=Onset(
            condition=condition_of(when),
            ssm_state=SsmState[when["ssm_state"]] if "ssm_state" in when else None,
            station_m=when.get("station_m"),
            message=when.get("message"),
            frames=when.get("frames", 1),
        ),
        for_us=microseconds(entry["for_s"]) if "for_s" in entry else None,
        for_frames=entry.get("for_frames"),
        times=entry.get("times", 1),
        every_us=microseconds(entry.get("every_s", 0.0)),
        seed=entry.get("seed"),
    )


def _schema_of(kind: type[Fault]) -> dict[str, Any]:
    hints = get_type_hints(kind)
    own = {item.name: _property(hints[item.name], item) for item in fields(kind)}
    return {
        "additionalProperties": False,
        "required": [item.name for item in fields(kind) if item.default is MISSING],
        "properties": {"fault": {}, **own, **_TIMES},
    }


def _property(hint: Any, item: Field[Any]) -> dict[str, Any]:
    if hint == tuple[int, ...]:
        return {"type": "array", "items": {"type": "integer", **item.metadata}}
    plain = next((known for known in _TYPES if hint in (known, known | None)), None)
    return {**_TYPES[plain], **item.metadata}


def _value(hint: Any, value: Any) -> Any:
    if hint == tuple[int, ...]:
        return tuple(value)
    for names in (Station, Bus):
        if hint in (names, names | None):
            return names[value]
    return float(value) if hint in (float, float | None) else value
