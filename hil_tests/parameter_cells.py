"""Cells of the parameter matrix: every parameter of the schema by every way to get it wrong, and every rule's edge.

A cell is an operation file, the solo lap's with one thing changed, and what must come of it. Both follow from the
schema alone; nothing here asks the firmware.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from obc_harness import OPERATION

from firmware.parameters import load_operation
from firmware.tables import CrossCheck, Parameter, own_parameters

SCHEMA = own_parameters()
BY_NAME = {parameter.name: parameter for parameter in SCHEMA.parameters}

KINDS = (
    "below_minimum", "at_minimum", "inside", "at_maximum", "above_maximum", "wrong_sign", "wrong_type", "nan",
    "positive_infinity", "negative_infinity", "missing", "duplicate", "unknown_key", "truncated_file",
    "changed_after_validation",
)  # fmt: skip
EDGES = ("just_satisfied", "just_violated")

Values = dict[str, Any]
Offences = list[tuple[str, str]]

GOOD: Values = dict(load_operation(OPERATION))


@dataclass(frozen=True)
class Cell:
    """One operation file.

    Attributes
    ----------
    subject, kind : what is changed, a parameter or a rule, and how.
    text : content of the file.
    offences : (key, reason) of all that the firmware must list, sorted; none when it must accept the file.
    values : what must be in force when it does.
    late : name and value that are written after the verdict, if anything is.
    """

    subject: str
    kind: str
    text: str
    offences: Offences
    values: Values
    late: tuple[str, Any] | None = None

    @property
    def name(self) -> str:
        return f"{self.subject}-{self.kind}"


# --- YAML


def written(value: Any) -> str:
    """A value as YAML 1.1 reads it back."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and not math.isfinite(value):
        return {math.inf: ".inf", -math.inf: "-.inf"}.get(value, ".nan")
    return repr(value)


def operation_text(values: Mapping[str, Any]) -> str:
    return "".join(f"{name}: {written(value)}\n" for name, value in values.items())


# --- rules


def violated(values: Mapping[str, Any]) -> list[CrossCheck]:
    """Rules that the values break, in single precision as they travel."""
    broken = []
    for rule in SCHEMA.cross_checks:
        left, right = np.float32(values[rule.left]), np.float32(values[rule.right])
        holds = left < right if rule.kind == "less" else left * right >= np.float32(rule.bound)
        if not holds:
            broken.append(rule)
    return broken


def make_room(values: Values, *fixed: str) -> Values:
    """Move whatever breaks a rule together with these values out of their way, to the end of its own range."""
    values, settled = dict(values), set(fixed)
    while movable := [
        (rule, side) for rule in violated(values) for side in (rule.left, rule.right) if side not in settled
    ]:
        rule, side = movable[0]
        upwards = rule.kind == "product" or side == rule.right
        values[side] = of_type(BY_NAME[side], BY_NAME[side].max if upwards else BY_NAME[side].min)
        settled.add(side)
    return values


def contradictions(values: Mapping[str, Any]) -> Offences:
    return sorted((rule.left, "contradicts another parameter") for rule in violated(values))


# --- values


def of_type(parameter: Parameter, value: float) -> Any:
    return {"bool": bool, "int": int, "float": float}[parameter.type](value)


def beyond(parameter: Parameter, limit: float, direction: float) -> Any:
    """Nearest value on the far side of a limit that the wire tells from it."""
    if parameter.type == "float":
        return float(np.nextafter(np.float32(limit), np.float32(direction * math.inf)))
    return int(limit + direction)


def inside(parameter: Parameter) -> Any:
    """A value within the range that is not the solo lap's."""
    if parameter.type == "bool":
        return not GOOD[parameter.name]
    middle = of_type(parameter, 0.5 * (parameter.min + parameter.max))
    return middle if middle != GOOD[parameter.name] else of_type(parameter, 0.25 * parameter.min + 0.75 * parameter.max)


def verdict_on(parameter: Parameter, value: Any) -> str | None:
    """Reason why a single value is refused, by the words of the schema; None for one that is allowed."""
    kinds = {"float": (float, int), "int": (int,), "bool": (bool,)}[parameter.type]
    if not isinstance(value, kinds) or isinstance(value, bool) != (parameter.type == "bool"):
        return "wrong type"
    number = np.float32(value)
    if not np.isfinite(number):
        return "not a finite number"
    if number < 0 and parameter.sign in ("positive", "non_negative"):
        return "wrong sign"
    if number < np.float32(parameter.min):
        return "below the minimum"
    return "above the maximum" if number > np.float32(parameter.max) else None


WRONG_TYPE = {"float": "fast", "int": 50.5, "bool": 1}
NOT_FINITE = {"nan": math.nan, "positive_infinity": math.inf, "negative_infinity": -math.inf}


def value_of(parameter: Parameter, kind: str) -> Any:
    """Value that a kind of cell gives a parameter."""
    if kind in NOT_FINITE:
        return NOT_FINITE[kind]
    return {
        "below_minimum": beyond(parameter, parameter.min, -1.0),
        "at_minimum": of_type(parameter, parameter.min) if parameter.type != "bool" else False,
        "inside": inside(parameter),
        "at_maximum": of_type(parameter, parameter.max) if parameter.type != "bool" else True,
        "above_maximum": beyond(parameter, parameter.max, 1.0),
        "wrong_sign": -parameter.max,
        "wrong_type": WRONG_TYPE[parameter.type],
    }[kind]


# --- cells


def parameter_cell(parameter: Parameter, kind: str) -> Cell:
    name = parameter.name
    if kind in ("missing", "unknown_key", "duplicate", "truncated_file", "changed_after_validation"):
        return FILE_CELLS[kind](parameter)
    value = value_of(parameter, kind)
    reason = verdict_on(parameter, value)
    values = GOOD | {name: value} if reason else make_room(GOOD | {name: value}, name)
    offences = [(name, reason)] if reason else contradictions(values)
    return Cell(name, kind, operation_text(values), offences, values)


def missing(parameter: Parameter) -> Cell:
    rest = {name: value for name, value in GOOD.items() if name != parameter.name}
    return Cell(parameter.name, "missing", operation_text(rest), [(parameter.name, "missing")], {})


def unknown_key(parameter: Parameter) -> Cell:
    """One letter too many, so that the parameter is missing as well."""
    typo = f"{parameter.name}s"
    text = re.sub(rf"^{parameter.name}:", f"{typo}:", operation_text(GOOD), flags=re.MULTILINE)
    offences = sorted([(typo, "unknown key"), (parameter.name, "missing")])
    return Cell(parameter.name, "unknown_key", text, offences, {})


def duplicate(parameter: Parameter) -> Cell:
    text = operation_text(GOOD) + operation_text({parameter.name: GOOD[parameter.name]})
    return Cell(parameter.name, "duplicate", text, [(parameter.name, "given more than once")], {})


def truncated_file(parameter: Parameter) -> Cell:
    """The file ends before this parameter's value: it has none, and those after it are not there."""
    names = list(GOOD)
    place = names.index(parameter.name)
    text = operation_text({name: GOOD[name] for name in names[:place]}) + f"{parameter.name}:"
    offences = [(parameter.name, "wrong type"), *((name, "missing") for name in names[place + 1 :])]
    return Cell(parameter.name, "truncated_file", text, sorted(offences), {})


def changed_after_validation(parameter: Parameter) -> Cell:
    late = (parameter.name, inside(parameter))
    return Cell(parameter.name, "changed_after_validation", operation_text(GOOD), [], GOOD, late)


FILE_CELLS = {
    "missing": missing,
    "unknown_key": unknown_key,
    "duplicate": duplicate,
    "truncated_file": truncated_file,
    "changed_after_validation": changed_after_validation,
}


def rule_name(rule: CrossCheck) -> str:
    return f"{rule.left}-{rule.kind}-{rule.right}"


def rule_cell(rule: CrossCheck, edge: str) -> Cell:
    """Both sides of a rule as near to its edge as the wire can tell; other rules get room."""
    left, right = BY_NAME[rule.left], BY_NAME[rule.right]
    values = dict(GOOD)
    if rule.kind == "less":
        equal = max(left.min, right.min, min(left.max, right.max, float(GOOD[rule.left])))
        values[rule.left], values[rule.right] = of_type(left, equal), of_type(right, equal)
        if edge == "just_satisfied":
            values[rule.right] = beyond(right, equal, 1.0)
    else:
        smallest = float(np.float32(rule.bound / values[rule.left]))
        while np.float32(values[rule.left]) * np.float32(smallest) < np.float32(rule.bound):
            smallest = beyond(right, smallest, 1.0)
        values[rule.right] = smallest if edge == "just_satisfied" else beyond(right, smallest, -1.0)
    values = make_room(values, rule.left, rule.right)
    return Cell(rule_name(rule), edge, operation_text(values), contradictions(values), values)


def parameter_cells() -> Iterator[Cell]:
    for parameter in SCHEMA.parameters:
        for kind in KINDS:
            yield parameter_cell(parameter, kind)


def rule_cells() -> Iterator[Cell]:
    for rule in SCHEMA.cross_checks:
        for edge in EDGES:
            yield rule_cell(rule, edge)
