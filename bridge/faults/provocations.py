"""How to bring about every fault that the car supervises, and when its condition begins.

The format is told at the head of ``scenarios/campaigns/provocations.yaml``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from importlib import resources
from pathlib import Path
from typing import Any

from bridge._native import lib
from bridge.faults.fault import Fault, FrameFault
from bridge.faults.plan import FaultPlan, Onset
from bridge.faults.reading import fault_schema, read_faults
from bridge.faults.signals import SCANNERS, SENSORS, SensorFrozen, node_report
from bridge.yaml_file import check_schema, read_yaml
from dbc.buses import Station
from dbc.codec import Codec, MessageCodec
from dbc.errors import ConfigurationError
from firmware.parameters import load_operation
from firmware.tables import CYCLE_MS, own_parameters

LAYERS = ("ssm", "raptor", "space_drive")

#: Operating states of the car that a provocation may be impossible in.
OPERATING_STATES = ("standstill", "launch", "pit_lane", "straight", "turn", "braking")

_TICK_US = CYCLE_MS * 1000
_FOR_EVER = 1_000_000
_CONFIGURATIONS = {"raptor": lib.raptor_config_default, "space_drive": lib.space_drive_config_default}
_LAYER_REACTIONS = {"raptor": ("emergency_shutdown", "warn"), "space_drive": ("emergency_brake", "warn")}


class Duration(Enum):
    """How long a provocation lasts."""

    BELOW = "below"
    """The longest that must not be answered."""
    AT = "at"
    """The shortest that must be."""
    PERMANENT = "permanent"


@dataclass(frozen=True)
class Detection:
    """When a condition begins, as seen from the injection; see the file's head.

    Attributes
    ----------
    since_last : the last sound sample counts, not the first that was befallen.
    limits : names of limits, added up.
    period_ms : between two samples; None for that of the message.
    frames : samples in a row, a number or the name of a limit.
    later_ms, spread_ms, tail_ms : see the file.
    hold_ms : how long one sample keeps the condition up; None for until the next one.
    """

    since_last: bool = False
    limits: tuple[str, ...] = ()
    period_ms: int | None = None
    frames: int | str = 1
    later_ms: int = 0
    spread_ms: int = 0
    tail_ms: int = 0
    hold_ms: int | None = None


@dataclass(frozen=True)
class Provocation:
    """How one fault is brought about.

    Attributes
    ----------
    layer, name : ssm and a fault of the table, or raptor or space_drive and a name of the file's.
    plans : what is injected, for good; empty when it cannot be, and then `reason` says why.
    companions : names of the faults that come with it.
    exceptions : operating states in which it cannot be brought about, with the reason.
    again_every_us : an event is repeated so often to keep its condition up; 0: no event.
    durations : times of a plan by duration, where they do not follow; None where there is no such duration.
    resets : taking it away from a standing car is a reset by the operator.
    excused : ids of safety properties that it breaks by itself.
    perception : it takes a car that must see others; all that do not are for a car that drives alone.
    reaction, diagnostic : of layers other than ssm; bits of diagnostic_report by name.
    """

    layer: str
    name: str
    plans: tuple[FaultPlan, ...] = ()
    reason: str = ""
    detection: Detection = field(default_factory=Detection)
    companions: tuple[str, ...] = ()
    exceptions: Mapping[str, str] = field(default_factory=dict)
    again_every_us: int = 0
    durations: Mapping[Duration, Mapping[str, Any] | None] = field(default_factory=dict)
    resets: bool = False
    excused: tuple[str, ...] = ()
    perception: bool = False
    reaction: str = ""
    diagnostic: tuple[str, ...] = ()


class Provoker:
    """Turns provocations into plans, and says when their conditions begin.

    Parameters
    ----------
    operation : file with the operation parameters of the car.
    database : messages of its profile.

    Raises
    ------
    ConfigurationError
        When the operation file is wrong.
    """

    def __init__(self, operation: Path, database: Codec) -> None:
        self._database = database
        self._units = {row.name: row.unit for row in own_parameters().parameters}
        self._operation = dict(load_operation(operation))

    def suits(self, provocation: Provocation) -> bool:
        """Whether it can be injected, and its fault is supervised in this car: with perception required, or without."""
        return bool(provocation.plans) and provocation.perception == (self._operation["perception_required"] is True)

    def condition_us(self, provocation: Provocation, first_us: int) -> tuple[int, int]:
        """When the condition begins at the earliest and at the latest.

        Parameters
        ----------
        first_us : when the injection has first befallen something (`Injection.first_us`).
        """
        detection = provocation.detection
        begin_us = first_us + self._lead_us(provocation) + self._lag_us(provocation) + detection.later_ms * 1000
        return begin_us, begin_us + detection.spread_ms * 1000

    def end_us(self, provocation: Provocation, last_us: int) -> tuple[int, int]:
        """When the condition is gone at the earliest and at the latest.

        Parameters
        ----------
        last_us : when the injection has last befallen something (`Injection.last_us`); the next sample is sound.
        """
        detection = provocation.detection
        hold_us = self._cycle_us(provocation) if detection.hold_ms is None else detection.hold_ms * 1000
        gone_us = last_us + hold_us + self._lag_us(provocation)
        return gone_us, gone_us + detection.tail_ms * 1000

    def plans(
        self, provocation: Provocation, duration: Duration, debounce_cycles: int = 1
    ) -> tuple[FaultPlan, ...] | None:
        """What to inject for a duration; None when there is no such duration.

        Parameters
        ----------
        debounce_cycles : ticks that the condition must last for a reaction.
        """
        plans = provocation.plans
        if provocation.again_every_us:
            return self._repeated(provocation, duration)
        if duration is Duration.PERMANENT:
            return plans
        if duration in provocation.durations:
            times = provocation.durations[duration]
            return None if times is None else tuple(_lasting(plan, times) for plan in plans)
        lasts_us = self._lead_us(provocation) + (debounce_cycles - 1) * _TICK_US
        cycle_us = self._cycle_us(provocation)
        if duration is Duration.AT:
            samples = (lasts_us + provocation.detection.spread_ms * 1000) // cycle_us + 1
        else:
            samples = lasts_us // cycle_us
        return tuple(self._lasting_samples(plan, samples, cycle_us) for plan in plans) if samples else None

    def _repeated(self, provocation: Provocation, duration: Duration) -> tuple[FaultPlan, ...] | None:
        times = provocation.durations.get(Duration.AT) or {}
        if duration is Duration.BELOW:
            below = provocation.durations.get(Duration.BELOW)
            if below is None:
                return None
            times = below
        repeated = []
        for plan in provocation.plans:
            one = _lasting(plan, times)
            if one.for_us is None and one.for_frames is None and isinstance(one.fault, FrameFault):
                one = replace(one, for_frames=1)
            if duration is Duration.PERMANENT:
                one = replace(one, times=_FOR_EVER)
            repeated.append(replace(one, every_us=provocation.again_every_us if one.times > 1 else 0))
        return tuple(repeated)

    def _lasting_samples(self, plan: FaultPlan, samples: int, cycle_us: int) -> FaultPlan:
        """A plan that befalls so many samples."""
        fault = plan.fault
        sensor = getattr(fault, "sensor", None)
        if isinstance(fault, FrameFault) and getattr(fault, "station", None) is None and sensor is None:
            return replace(plan, for_frames=samples)
        if sensor is None:
            return replace(plan, for_us=samples * cycle_us)
        # A sample has several frames. It begins behind a sample; one that is frozen keeps what the first one said.
        kept = 1 if isinstance(fault, SensorFrozen) else 0
        message = self._message(fault)
        assert message is not None
        return replace(
            plan, onset=Onset(message=message.name), for_us=(samples + kept) * cycle_us + cycle_us - _TICK_US
        )

    def _lead_us(self, provocation: Provocation) -> int:
        """From the first sample that was befallen to the condition, as far as the samples must go on being befallen."""
        detection = provocation.detection
        cycle_us = self._cycle_us(provocation)
        frames = detection.frames if isinstance(detection.frames, int) else int(self._limit(detection.frames, 1))
        lead_us = (frames - 1) * cycle_us + sum(self._limit(name, _TICK_US) for name in detection.limits)
        if detection.since_last:
            period_us = cycle_us if detection.period_ms is None else detection.period_ms * 1000
            lead_us += _TICK_US - period_us
        return lead_us

    def _lag_us(self, provocation: Provocation) -> int:
        """From the bus to who looks: a station that ticks later than the one that listens is heard in the next tick."""
        fault = provocation.plans[0].fault
        message = self._message(fault)
        sender = getattr(fault, "station", None) if message is None else message.sender
        if isinstance(fault, FrameFault) and (
            (provocation.layer == "ssm" and sender == Station.RAPTOR)
            or (provocation.layer == "raptor" and sender == Station.SPACE_DRIVE)
        ):
            return _TICK_US
        return 0

    def _cycle_us(self, provocation: Provocation) -> int:
        message = self._message(provocation.plans[0].fault)
        if message is None:
            return _TICK_US
        return message.cycle_us or (provocation.detection.period_ms or CYCLE_MS) * 1000

    def _message(self, fault: Fault) -> MessageCodec | None:
        """The message whose frames are befallen; the first one of a sensor's sample."""
        if not isinstance(fault, FrameFault):
            return None
        name = getattr(fault, "message", None)
        sensor = getattr(fault, "sensor", None)
        if sensor in SENSORS:
            name = next(message.name for message in self._database if message.name.startswith(f"{sensor}_"))
        elif getattr(fault, "scanner", None) in SCANNERS:
            name = "sensor_notice"
        elif (node := getattr(fault, "node", None)) is not None:
            name, _ = node_report(self._database, node)
        return None if name is None else self._database.message(name)

    def _limit(self, name: str, count_us: int) -> int:
        """A limit in microseconds; one that counts is multiplied."""
        layer, _, rest = name.partition(".")
        if layer in _CONFIGURATIONS and rest:
            value: Any = _CONFIGURATIONS[layer]
            for part in rest.split("."):
                value = getattr(value, part)
            return int(value) * (1000 if name.endswith("_ms") else 1 if name.endswith("_us") else count_us)
        number = self._operation[name]
        assert isinstance(number, int | float)
        return int(number) * (1000 if self._units[name] == "ms" else count_us)


def load_provocations(path: Path, database: Codec) -> dict[str, dict[str, Provocation]]:
    """Read a file of provocations: by layer and name.

    Raises
    ------
    ConfigurationError
        With file, key, what is wrong and what is allowed.
    """
    content = read_yaml(path)
    check_schema(path, content, _schema())
    return {
        layer: {name: _provocation(path, layer, name, entry, database) for name, entry in content[layer].items()}
        for layer in LAYERS
    }


def _provocation(path: Path, layer: str, name: str, entry: Mapping[str, Any], database: Codec) -> Provocation:
    if "faults" not in entry:
        return Provocation(layer, name, reason=entry["reason"])
    try:
        plans = read_faults(path, entry["faults"], database)
    except ConfigurationError as error:
        raise ConfigurationError(path, f"{layer}.{name}.{error.key}", error.problem) from error
    told = entry.get("detection", {})
    for limit in (*_names(told.get("limit", ())), *_names(told.get("frames", ()))):
        _check_limit(path, f"{layer}.{name}.detection", limit)
    return Provocation(
        layer=layer,
        name=name,
        plans=plans,
        detection=Detection(
            since_last=told.get("since") == "last",
            limits=_names(told.get("limit", ())),
            period_ms=told.get("period_ms"),
            frames=told.get("frames", 1),
            later_ms=told.get("later_ms", 0),
            spread_ms=told.get("spread_ms", 0),
            tail_ms=told.get("tail_ms", 0),
            hold_ms=told.get("hold_ms"),
        ),
        companions=tuple(entry.get("with", ())),
        exceptions=entry.get("except", {}),
        again_every_us=round(entry.get("again_every_s", 0.0) * 1e6),
        durations={Duration(key): times for key, times in entry.get("durations", {}).items()},
        resets=entry.get("resets", False),
        excused=tuple(entry.get("excused", ())),
        perception=entry.get("perception", False),
        reaction=entry.get("reaction", ""),
        diagnostic=tuple(entry.get("diagnostic", ())),
    )


def _lasting(plan: FaultPlan, times: Mapping[str, Any]) -> FaultPlan:
    return replace(
        plan,
        for_us=round(times["for_s"] * 1e6) if "for_s" in times else plan.for_us,
        for_frames=times.get("for_frames", plan.for_frames),
        times=times.get("times", plan.times),
    )


def _names(value: object) -> tuple[str, ...]:
    """Names of limits: one, or a list of them; a number is none."""
    if isinstance(value, str):
        return (value,)
    return tuple(str(name) for name in value) if isinstance(value, list | tuple) else ()


def _check_limit(path: Path, key: str, name: str) -> None:
    layer, _, rest = name.partition(".")
    if layer in _CONFIGURATIONS and rest:
        value: Any = _CONFIGURATIONS[layer]
        for part in rest.split("."):
            if not hasattr(value, part):
                raise ConfigurationError(path, key, f"the configuration of {layer} has no {rest!r}")
            value = getattr(value, part)
    elif name not in {row.name for row in own_parameters().parameters}:
        raise ConfigurationError(path, key, f"no operation parameter is called {name!r}")


def _schema() -> dict[str, Any]:
    scenario = json.loads(resources.files("bridge").joinpath("schemas", "scenario.schema.json").read_text("utf-8"))
    count: dict[str, Any] = {"type": "integer", "minimum": 0}
    seconds = {"type": "number", "exclusiveMinimum": 0}
    names = {"type": "array", "items": {"type": "string"}}
    limit = {"type": ["string", "array"], "items": {"type": "string"}}
    times = {
        "type": ["object", "null"],
        "additionalProperties": False,
        "properties": {
            "for_s": seconds,
            "for_frames": {"type": "integer", "minimum": 1},
            "times": {"type": "integer", "minimum": 1},
        },
    }
    properties = {
        "faults": {"type": "array", "minItems": 1, "items": fault_schema()},
        "reason": {"type": "string", "minLength": 1},
        "detection": {
            "type": "object",
            "additionalProperties": False,
            "properties": {
                "since": {"enum": ["first", "last"]},
                "limit": limit,
                "frames": {"type": ["integer", "string"]},
                **dict.fromkeys(("period_ms", "spread_ms", "tail_ms", "hold_ms"), count),
                "later_ms": {"type": "integer"},
            },
        },
        "with": names,
        "except": {
            "type": "object",
            "additionalProperties": False,
            "properties": {state: {"type": "string", "minLength": 1} for state in OPERATING_STATES},
        },
        "again_every_s": seconds,
        "durations": {
            "type": "object",
            "additionalProperties": False,
            "properties": {"at": times, "below": times},
        },
        "resets": {"type": "boolean"},
        "excused": names,
        "perception": {"type": "boolean"},
    }
    either = [{"required": ["faults"]}, {"required": ["reason"]}]

    def layer(name: str) -> dict[str, Any]:
        own = {"reaction": {"enum": list(_LAYER_REACTIONS[name])}, "diagnostic": names} if name != "ssm" else {}
        entry = {"type": "object", "additionalProperties": False, "oneOf": either, "properties": properties | own}
        return {"type": "object", "additionalProperties": entry}

    return {
        "type": "object",
        "additionalProperties": False,
        "required": list(LAYERS),
        "properties": {name: layer(name) for name in LAYERS},
        "$defs": scenario["$defs"],
    }
