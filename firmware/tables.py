"""The hand-written sources of the firmware's tables: parameters and faults.

Reads ``firmware/schema/parameters.yaml`` and ``firmware/schema/faults.yaml`` into frozen records and refuses a source
that contradicts itself, so that everything generated from it may rely on it.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from dbc.errors import ConfigurationError

DIRECTORY = Path(__file__).resolve().parent / "schema"
PARAMETERS_FILE = DIRECTORY / "parameters.yaml"
FAULTS_FILE = DIRECTORY / "faults.yaml"

CYCLE_MS = 10
TYPES = ("float", "int", "bool")
SIGNS = {"positive": 1, "non_negative": 1, "negative": -1, "any": 0}
SAFETY = ("high", "medium", "low")
RULES = ("less", "product")
REACTIONS = ("none", "warn", "degrade", "switch_controller", "safe_stop", "emergency_stop", "full_brake")
DEGRADING = ("degrade", "switch_controller")
LATCHES = ("while_present", "until_reset", "until_restart")
SCOPES = ("always", "running", "driving")
CONTROLLERS = ("none", "lqr", "stanley", "pure_pursuit")
_NAME = re.compile(r"[a-z][a-z0-9_]*")
_EXACT_FLOAT = 1 << 24
_FAULT_LIMIT = 255


@dataclass(frozen=True)
class Parameter:
    """One operation parameter as the schema declares it."""

    name: str
    type: str
    unit: str
    min: float
    max: float
    sign: str
    default: float | bool
    safety: str
    text: str

    @property
    def key(self) -> int:
        """Low 24 bits of the FNV-1a hash of the name: how parameter_write addresses it."""
        return parameter_key(self.name)

    def allowed(self) -> str:
        """Say in a few words what the user may write."""
        if self.type == "bool":
            return "true or false"
        kind = "a whole number" if self.type == "int" else "a number"
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{kind} from {figure(self.min)} to {figure(self.max)}{unit}"


@dataclass(frozen=True)
class CrossCheck:
    """A rule between two parameters: ``less`` (left < right) or ``product`` (left * right >= bound)."""

    kind: str
    left: str
    right: str
    text: str
    bound: float = 0.0

    def allowed(self) -> str:
        """State the rule in words."""
        if self.kind == "less":
            return f"{self.left} below {self.right}: {self.text}"
        return f"{self.left} times {self.right} at least {figure(self.bound)}: {self.text}"


@dataclass(frozen=True)
class ParameterSchema:
    """All parameters in table order, and the rules between them."""

    parameters: tuple[Parameter, ...]
    cross_checks: tuple[CrossCheck, ...]

    @property
    def hash(self) -> int:
        """32-bit FNV-1a hash of everything that the firmware checks; travels in parameter_commit."""
        facts = [[p.name, p.type, p.unit, p.min, p.max, p.sign, p.default] for p in self.parameters]
        rules = [[c.kind, c.left, c.right, c.bound] for c in self.cross_checks]
        return fnv1a(json.dumps([facts, rules], separators=(",", ":")).encode())


@dataclass(frozen=True)
class Fault:
    """One fault as the table declares it; ``id`` is its position from 1."""

    id: int
    name: str
    detection: str
    debounce_ms: int
    reaction: str
    clear_ms: int
    latch: str
    deadline_ms: int
    supervised: str
    blocks_launch: bool
    disables: str = "none"
    detail: str = ""
    speed_percent: int | None = None
    acceleration_percent: int | None = None

    @property
    def debounce_cycles(self) -> int:
        """Consecutive cycles with the condition before the fault is active."""
        return self.debounce_ms // CYCLE_MS if self.debounce_ms else 1

    @property
    def share(self) -> tuple[int, int]:
        """What is left of the degraded speed and acceleration while the fault is active, percent."""
        if self.speed_percent is not None and self.acceleration_percent is not None:
            return self.speed_percent, self.acceleration_percent
        stops = REACTIONS.index(self.reaction) > REACTIONS.index("switch_controller")
        return (0, 0) if stops else (100, 100)

    @property
    def clear_cycles(self) -> int:
        """Consecutive cycles without the condition before the fault may clear."""
        return self.clear_ms // CYCLE_MS if self.clear_ms else 1


def figure(value: float) -> str:
    """Write a number for people: no exponent, no trailing zeros."""
    return f"{value:.10g}"


def fnv1a(data: bytes) -> int:
    """32-bit FNV-1a hash (offset basis 0x811C9DC5, prime 0x01000193)."""
    value = 0x811C9DC5
    for byte in data:
        value = ((value ^ byte) * 0x01000193) & 0xFFFFFFFF
    return value


def parameter_key(name: str) -> int:
    """Key of a parameter name on the wire: the low 24 bits of its FNV-1a hash."""
    return fnv1a(name.encode()) & 0xFFFFFF


def load_parameters(path: Path = PARAMETERS_FILE) -> ParameterSchema:
    """Read and check the parameter schema.

    Raises
    ------
    ConfigurationError
        For a source that contradicts itself; names the file and the entry.
    """
    source = _mapping(path)
    units = source.get("units", [])
    parameters = tuple(_record(path, Parameter, entry) for entry in source.get("parameters", []))
    cross_checks = tuple(_record(path, CrossCheck, entry) for entry in source.get("cross_checks", []))
    keys: dict[int, str] = {0: "(reserved)"}
    for parameter in parameters:
        _check_parameter(path, parameter, units)
        if parameter.key in keys:
            raise ConfigurationError(path, parameter.name, f"its key collides with that of {keys[parameter.key]}")
        keys[parameter.key] = parameter.name
    names = {parameter.name for parameter in parameters}
    for check in cross_checks:
        _require(path, check.left, check.kind in RULES, f"rule {check.kind!r} is none of {', '.join(RULES)}")
        _require(path, check.left, {check.left, check.right} <= names, "a rule names an unknown parameter")
        _require(path, check.left, (check.kind == "product") == (check.bound > 0), "only a product rule has a bound")
    _require(path, "parameters", 0 < len(parameters) <= _FAULT_LIMIT, "1 to 255 parameters are allowed")
    return ParameterSchema(parameters, cross_checks)


def load_faults(path: Path = FAULTS_FILE) -> tuple[Fault, ...]:
    """Read and check the fault table.

    Raises
    ------
    ConfigurationError
        For a source that contradicts itself; names the file and the entry.
    """
    entries = _mapping(path).get("faults", [])
    faults = tuple(_record(path, Fault, {"id": index, **entry}) for index, entry in enumerate(entries, 1))
    _require(path, "faults", 0 < len(faults) <= _FAULT_LIMIT, "1 to 255 faults are allowed")
    for fault in faults:
        _check_fault(path, fault)
    names = [fault.name for fault in faults]
    for name in names:
        _require(path, name, names.count(name) == 1, "the name is used twice")
    return faults


@cache
def own_parameters() -> ParameterSchema:
    """The schema that comes with raceloop, read once; see `load_parameters`."""
    return load_parameters()


@cache
def own_faults() -> tuple[Fault, ...]:
    """The faults that come with raceloop, read once; see `load_faults`."""
    return tuple(load_faults())


def _check_parameter(path: Path, parameter: Parameter, units: Iterable[str]) -> None:
    def require(condition: bool, problem: str) -> None:
        _require(path, parameter.name, condition, problem)

    require(_NAME.fullmatch(parameter.name) is not None, "a name is lower case with underscores")
    require(parameter.type in TYPES, f"type {parameter.type!r} is none of {', '.join(TYPES)}")
    require(parameter.unit in units, f"unit {parameter.unit!r} is none of {', '.join(units)}")
    require(parameter.sign in SIGNS, f"sign {parameter.sign!r} is none of {', '.join(SIGNS)}")
    require(parameter.safety in SAFETY, f"safety {parameter.safety!r} is none of {', '.join(SAFETY)}")
    require(bool(parameter.text), "a text is missing")
    bounds = (parameter.min, parameter.max)
    require(all(math.isfinite(b) and abs(b) < _EXACT_FLOAT for b in bounds), "a bound is not below 2^24")
    require(parameter.min < parameter.max, "min is not below max")
    require(parameter.min <= parameter.default <= parameter.max, "the default is outside min and max")
    require(parameter.sign != "positive" or parameter.min > 0, "a positive parameter has min above 0")
    require(parameter.sign != "non_negative" or parameter.min == 0, "a non-negative parameter has min 0")
    require(parameter.sign != "negative" or parameter.max <= 0, "a negative parameter has max up to 0")
    require((parameter.type == "bool") == isinstance(parameter.default, bool), "the default is not of the type")


def _check_fault(path: Path, fault: Fault) -> None:
    def require(condition: bool, problem: str) -> None:
        _require(path, fault.name, condition, problem)

    require(_NAME.fullmatch(fault.name) is not None, "a name is lower case with underscores")
    require(fault.reaction in REACTIONS, f"reaction {fault.reaction!r} is none of {', '.join(REACTIONS)}")
    require(fault.latch in LATCHES, f"latch {fault.latch!r} is none of {', '.join(LATCHES)}")
    require(fault.supervised in SCOPES, f"supervised {fault.supervised!r} is none of {', '.join(SCOPES)}")
    require(fault.disables in CONTROLLERS, f"disables {fault.disables!r} is none of {', '.join(CONTROLLERS)}")
    require(bool(fault.detection), "a detection is missing")
    require(fault.debounce_ms % CYCLE_MS == 0 and fault.clear_ms % CYCLE_MS == 0, "times are multiples of 10 ms")
    require(fault.debounce_cycles * CYCLE_MS <= fault.deadline_ms, "the deadline is shorter than the debounce")
    stops = fault.reaction in ("safe_stop", "emergency_stop")
    require(not stops or fault.latch != "while_present", "a safe stop or an emergency stop latches until a reset")
    require((fault.reaction == "full_brake") == (fault.latch == "until_restart"), "only a full brake needs a restart")
    require((fault.reaction == "switch_controller") == (fault.disables != "none"), "a switch disables a controller")
    for key in ("speed_percent", "acceleration_percent"):
        value = getattr(fault, key)
        if fault.reaction in DEGRADING:
            require(_is_percent(value), f"{key} {value!r} is no whole number from 1 to 100")
        else:
            require(value is None, f"{key} is only for {' and '.join(DEGRADING)}")


def _is_percent(value: object) -> bool:
    return type(value) is int and 0 < value <= 100


def _require(path: Path, key: str, condition: bool, problem: str) -> None:
    if not condition:
        raise ConfigurationError(path, key, problem)


def _mapping(path: Path) -> Mapping[str, Any]:
    try:
        source = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigurationError(path, "", " ".join(str(error).split())) from error
    if not isinstance(source, dict):
        raise ConfigurationError(path, "", "the file is not a mapping")
    return source


def _record(path: Path, kind: type[Any], entry: Mapping[str, Any]) -> Any:
    try:
        return kind(**entry)
    except TypeError as error:
        name = str(entry.get("name", entry.get("left", "")))
        raise ConfigurationError(path, name, str(error).replace(f"{kind.__name__}.__init__() ", "")) from error
