"""All that a bench refers to, as a list that two states can be compared by; shares nothing with `bridge.saved_state`.

The interpreter itself says what refers to what, so closures, generators and attributes in C are seen as well.
"""

from __future__ import annotations

import gc
import random
from itertools import chain
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

from bridge._native import ffi
from bridge.bench import Bench
from bridge.plant import Plant
from dbc.codec import Codec, MessageCodec

_NOT_STATE = (type, ModuleType, CodeType, Codec, MessageCodec)
_BUFFER = type(ffi.buffer(ffi.new("char *")))


def walk(bench: Bench) -> list[tuple[str, object]]:
    """Type and content of every object, in the order in which they are found."""
    found: list[tuple[str, object]] = []
    known: dict[int, object] = {}
    waiting: list[Any] = [bench]
    while waiting:
        value = waiting.pop()
        if isinstance(value, _NOT_STATE) or id(value) in known:
            continue
        known[id(value)] = value
        found.append((type(value).__name__, _content(value)))
        waiting.extend(_referents(value))
    return found


def _content(value: Any) -> object:
    if isinstance(value, str | bytes | bytearray | int | float | complex | np.generic):
        return repr(value)
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, np.random.Generator):
        return repr(value.bit_generator.state)
    if isinstance(value, random.Random):
        return value.getstate()
    if isinstance(value, Plant):
        return value.inputs.tobytes(), value.outputs.tobytes(), _fmu_state(value)
    if isinstance(value, _BUFFER):
        return bytes(value)
    if isinstance(value, ffi.CData):
        if ffi.typeof(value) is ffi.typeof("network *"):  # what is behind are frames that were drained
            return bytes(ffi.buffer(value, ffi.offsetof("network", "log")))
        is_struct = ffi.typeof(value).kind == "struct"
        return bytes(ffi.buffer(ffi.addressof(value) if is_struct else value))
    if _is_of_floats(value):
        return np.array(value).tobytes()
    return len(value) if isinstance(value, tuple | list | dict | set) else None


def _is_of_floats(value: Any) -> bool:
    return isinstance(value, tuple | list) and {type(item) for item in value} == {float}


def _referents(value: Any) -> list[Any]:
    if isinstance(value, Plant) or _is_of_floats(value):
        return []
    if isinstance(value, FunctionType):
        return list(value.__closure__ or ())
    if isinstance(value, BuiltinFunctionType):
        return [] if isinstance(value.__self__, ModuleType) else [value.__self__]
    if isinstance(value, set | frozenset):
        return sorted(value, key=repr)
    if isinstance(value, dict):
        return list(chain.from_iterable(value.items()))
    return gc.get_referents(value)


def _fmu_state(plant: Plant) -> bytes:
    fmu = plant._fmu
    if plant._fmi3:
        state = fmu.getFMUState()
        content = fmu.serializeFMUState(state)
        fmu.freeFMUState(state)
    else:
        state = fmu.getFMUstate()
        content = fmu.serializeFMUstate(state)
        fmu.freeFMUstate(state)
    return bytes(content)
