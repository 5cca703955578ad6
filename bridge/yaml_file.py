"""YAML files of users: read, refuse what YAML hides, check against a JSON schema."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jsonschema
import yaml

from dbc.errors import ConfigurationError


class _Loader(yaml.SafeLoader):
    """Safe loader that refuses a key given twice, of which plain YAML would silently keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            if key_node.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key_node.value!r} is given twice", key_node.start_mark
                )
            seen.add(key_node.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


def read_yaml(path: Path) -> Any:
    """Parse a YAML file.

    Raises
    ------
    ConfigurationError
        When it cannot be read, is no YAML, gives a key twice or holds a number that is not finite.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(path, "", error.strerror or "cannot be read") from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(path, "", "is not UTF-8 text") from error
    try:
        content = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigurationError(path, line, " ".join(str(error.problem).split())) from error
    except yaml.YAMLError as error:
        raise ConfigurationError(path, "", f"not valid YAML: {' '.join(str(error).split())}") from error
    for key, value in _numbers(content, ""):
        if not math.isfinite(value):
            raise ConfigurationError(path, key, f"is {value}; must be a finite number")
    return content


def check_schema(path: Path, content: object, schema: Mapping[str, Any]) -> None:
    """Check parsed content against a JSON schema (draft 2020-12).

    Raises
    ------
    ConfigurationError
        Names the first offence by its place in the file: key, what is wrong, what is allowed.
    """
    errors = sorted(
        jsonschema.Draft202012Validator(schema).iter_errors(content),
        key=lambda error: (error.validator != "additionalProperties", [str(part) for part in error.absolute_path]),
    )
    if errors:
        key = _key(errors[0].absolute_path)
        raise ConfigurationError(path, *_explain(key, errors[0]))


def _explain(key: str, error: jsonschema.ValidationError) -> tuple[str, str]:
    """Key and problem in our words."""
    value: Any = error.instance
    limit: Any = error.validator_value
    schema: Any = error.schema
    match error.validator:
        case "additionalProperties":
            allowed = sorted(schema["properties"])
            unknown = next(name for name in value if name not in allowed)
            return _join(key, str(unknown)), f"unknown key; allowed are {', '.join(allowed)}"
        case "required":
            missing = next(name for name in limit if name not in value)
            return _join(key, str(missing)), "is missing"
        case "type":
            kinds = [limit] if isinstance(limit, str) else limit
            return key, f"is {_show(value)}; must be of type {' or '.join(kinds)}"
        case "enum":
            return key, f"is {_show(value)}; allowed are {', '.join(str(item) for item in limit)}"
        case "minimum":
            return key, f"is {_show(value)}; must be at least {limit}"
        case "maximum":
            return key, f"is {_show(value)}; must be at most {limit}"
        case "exclusiveMinimum":
            return key, f"is {_show(value)}; must be more than {limit}"
        case "exclusiveMaximum":
            return key, f"is {_show(value)}; must be less than {limit}"
        case "dependentRequired":
            name, needed = next((name, needed) for name, needed in limit.items() if name in value)
            return _join(key, name), f"needs {' and '.join(needed)} beside it"
        case "minProperties":
            return key, f"is empty; must hold at least one of {', '.join(sorted(schema['properties']))}"
        case "minItems":
            return key, "is empty; must hold at least one entry"
        case "minLength":
            return key, "is empty; must be a text"
        case "oneOf":
            options = " or ".join(" and ".join(option["required"]) for option in limit)
            return key, f"must hold either {options}"
        case _:
            return key, error.message


def _numbers(value: object, key: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, float):
        yield key, value
    elif isinstance(value, dict):
        for name, item in value.items():
            yield from _numbers(item, _join(key, str(name)))
    elif isinstance(value, list):
        for place, item in enumerate(value):
            yield from _numbers(item, f"{key}[{place}]")


def _key(parts: Any) -> str:
    key = ""
    for part in parts:
        key = f"{key}[{part}]" if isinstance(part, int) else _join(key, str(part))
    return key


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


def _show(value: object) -> str:
    return "empty" if value is None else repr(value) if isinstance(value, str | int | float) else type(value).__name__
