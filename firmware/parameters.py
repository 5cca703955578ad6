"""Operation files: from YAML to the frames that the onboard computer validates, and its verdict back into words.

The firmware decides; this module only carries. Every key that the user wrote is sent, known or not, with the type that
the YAML value has, so that the firmware can list every offence (SSM-1, SSM-2).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import yaml

from dbc.codec import database
from dbc.errors import ConfigurationError
from firmware.tables import ParameterSchema, own_parameters, parameter_key

Tick: TypeAlias = Callable[[bytes], Iterable[tuple[int, bytes]]]

TYPE_FLOAT, TYPE_INT, TYPE_BOOL, TYPE_TEXT, TYPE_NULL = range(5)
ACCEPTED = 0
VERDICT_PENDING, VERDICT_ACCEPTED, VERDICT_REJECTED = range(3)

_CROSS_CHECK = 9
_COUNT_MISMATCH, _SCHEMA_MISMATCH = 11, 12

#: What an operator says of a parameter that was accepted with another value than it sent; above what the wire carries.
ALTERED = 0x100
_REASONS = {
    1: "unknown key",
    2: "wrong type",
    3: "not a finite number",
    4: "below the minimum",
    5: "above the maximum",
    6: "wrong sign",
    7: "given more than once",
    8: "missing",
    _CROSS_CHECK: "contradicts another parameter",
    10: "sent after the verdict",
    _COUNT_MISMATCH: "the number of parameters sent and received differs",
    _SCHEMA_MISMATCH: "sender and firmware were built from different parameter schemas",
    ALTERED: "accepted with another value than was sent",
}
_WRITES_PER_TICK = 5
_TICKS_MAX = 10_000


@dataclass(frozen=True)
class Offence:
    """One thing that the firmware does not accept: the key, the value given, what is allowed and why it is refused."""

    key: str
    value: str
    allowed: str
    reason: str

    def __str__(self) -> str:
        """One line for the user."""
        return f"{self.key}: {self.value}: {self.reason}; allowed: {self.allowed}"


@dataclass(frozen=True)
class Verdict:
    """The firmware's answer to an operation file."""

    accepted: bool
    offences: tuple[Offence, ...]


def load_operation(path: str | Path) -> list[tuple[str, object]]:
    """Read an operation file: one mapping from parameter names to values.

    Returns
    -------
    list of name and value in the file's order. A name given twice is there twice, and a value may be of any type: what
    is allowed is for the firmware to say.

    Raises
    ------
    ConfigurationError
        When the file cannot be read, is no YAML or is no mapping with text as keys; names the line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigurationError(path, "", f"cannot be read: {reason}") from error
    try:
        return list(_entries(path, yaml.SafeLoader(text)))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ConfigurationError(path, f"line {mark.line + 1}" if mark else "", problem) from error
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(path, "", f"is no YAML that can be read: {error}") from error


def _entries(path: str | Path, loader: yaml.SafeLoader) -> Iterator[tuple[str, object]]:
    """Key and value pairs of the one mapping in a document; plain loading would keep only the last of a key."""
    root = loader.get_single_node()
    if not isinstance(root, yaml.MappingNode):
        raise ConfigurationError(path, "line 1", "an operation file is a mapping from parameter names to values")
    for key_node, value_node in root.value:
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(None, None, "a key must be text", key_node.start_mark)
        yield key, loader.construct_object(value_node, deep=True)


def parameter_frames(path: str | Path) -> bytes:
    """Read an operation file and encode it: parameter_write frames in its order, then parameter_commit.

    Returns
    -------
    bytes of the 24-byte frames (`dbc.frames`), one after the other.

    Raises
    ------
    ConfigurationError
        See `load_operation`; a value that the firmware will refuse is no error here.
    """
    return b"".join(encode_operation(load_operation(path), own_parameters()))


def encode_operation(operation: Iterable[tuple[str, object]], schema: ParameterSchema) -> list[bytes]:
    """Encode names and values of parameters as frames of 24 bytes, in their order, parameter_commit last."""
    write, commit = database.message("parameter_write"), database.message("parameter_commit")
    frames = [write.frame(parameter_key(key), *_wire_value(value)) for key, value in operation]
    return [*frames, commit.frame(len(frames), schema.hash)]


def _wire_value(value: object) -> tuple[int, int]:
    """Type and raw bits of a value; what 32 bits cannot hold as an integer travels as a float.

    Lists, mappings and dates travel as text: no parameter is any of them.
    """
    if value is None:
        return TYPE_NULL, 0
    if not isinstance(value, float | int):
        return TYPE_TEXT, 0
    if isinstance(value, bool):
        return TYPE_BOOL, int(value)
    if isinstance(value, int) and -(1 << 31) <= value < (1 << 31):
        return TYPE_INT, value & 0xFFFFFFFF
    try:
        packed = struct.pack("<f", value)
    except OverflowError:
        packed = struct.pack("<f", math.copysign(math.inf, value))
    return TYPE_FLOAT, int.from_bytes(packed, "little")


def check_operation(
    operation: Sequence[tuple[str, object]], tick: Tick, schema: ParameterSchema | None = None
) -> Verdict:
    """Have the firmware validate an operation.

    Parameters
    ----------
    operation : names and values of parameters.
    tick : runs one 10 ms tick of a fresh onboard computer with the CAN-A frames given (concatenated 24-byte frames) and
        returns what it sent on CAN-A as (id, 8 data bytes).
    schema : parameters that the firmware was built with; read anew when it is not given.

    Returns
    -------
    Verdict with every offence, in the firmware's order.
    """
    schema = schema or own_parameters()
    result, summary = database.message("parameter_result"), database.message("parameter_summary")
    results: list[tuple[int, int, int]] = []
    for batch in _batches(encode_operation(operation, schema)):
        verdict, expected = VERDICT_PENDING, 0
        for identifier, data in tick(batch):
            if identifier == result.frame_id:
                key, status, value = result.decode(data)
                results.append((int(key), int(status), int(value)))
            elif identifier == summary.frame_id:
                accepted, rejected, missing, verdict_code, _ = summary.decode(data)
                verdict, expected = int(verdict_code), int(accepted + rejected + missing)
        if verdict != VERDICT_PENDING and len(results) >= expected:
            return Verdict(verdict == VERDICT_ACCEPTED, tuple(decode_results(results, operation, schema)))
    raise ConfigurationError("operation", "", f"the firmware gave no verdict within {_TICKS_MAX} ticks")


def _batches(frames: list[bytes]) -> Iterator[bytes]:
    for start in range(0, len(frames), _WRITES_PER_TICK):
        yield b"".join(frames[start : start + _WRITES_PER_TICK])
    yield from [b""] * _TICKS_MAX


def decode_results(
    results: Iterable[tuple[int, int, int]], operation: Iterable[tuple[str, object]], schema: ParameterSchema
) -> Iterator[Offence]:
    """Turn (key, status, value) of parameter_result frames into offences, leaving out what was accepted."""
    values: dict[str, list[object]] = {}
    for name, value_given in operation:
        values.setdefault(name, []).append(value_given)
    names = {parameter_key(name): name for name in values}
    known = {parameter.key: parameter for parameter in schema.parameters}
    for key, status, value in results:
        if status == ACCEPTED:
            continue
        name = names.get(key) or (known[key].name if key in known else "")
        given = ", ".join(repr(item) for item in values[name]) if name in values else "not given"
        if status in (_COUNT_MISMATCH, _SCHEMA_MISMATCH):
            yield Offence("(all parameters)", f"{value:#x}", "one build of sender and firmware", _REASONS[status])
            continue
        if status == _CROSS_CHECK and value < len(schema.cross_checks):
            allowed = schema.cross_checks[value].allowed()
        elif key in known:
            allowed = known[key].allowed()
        else:
            allowed = "the parameters listed in docs/parameters.md"
        yield Offence(name or f"key {key:#08x}", given, allowed, _REASONS.get(status, f"status {status}"))
