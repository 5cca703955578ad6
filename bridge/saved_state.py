"""The state of a bench, saved in place: what was changed since is put back, and every object stays the object it was.

Whoever holds a part of the bench, a test with a handle or a closure, still holds it after a restore. The state is found
by walking over all that the bench refers to; what the walk does not know how to save is an error, so that nothing is
forgotten silently. Values are shared: numbers, texts, tuples, frozen dataclasses, arrays that cannot be written.
"""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from functools import partial
from operator import itemgetter
from pathlib import PurePath
from struct import Struct
from types import (
    BuiltinFunctionType,
    CellType,
    FunctionType,
    MappingProxyType,
    MethodType,
    ModuleType,
    NoneType,
)
from typing import Any

import numpy as np

from bridge._native import ffi
from bridge.safety.track import TrackEdges
from dbc.codec import Codec, MessageCodec
from dbc.errors import RaceloopError


class _Plain:
    """Has a dictionary and nothing else."""


#: Objects of these do not change. What a codec works in does, but only within a call; a view's memory is another's.
_VALUES = (
    *(NoneType, bool, int, float, complex, str, bytes, range, type, Enum, PurePath, Struct, ModuleType, itemgetter),
    *(np.generic, np.dtype, np.ufunc, type(np.linalg.inv), type(ffi.buffer(ffi.new("char *")))),
    *(Codec, MessageCodec, TrackEdges),
)
#: Those that there are many of, and that need no second look.
_PLAIN = frozenset({NoneType, bool, int, float, str, bytes})

#: Puts one object back; None for one that does not change.
_Restorer = Callable[[], object] | None
#: What an object refers to, with the names for messages.
_Parts = Iterable[tuple[str, Any]]


class SavedState:
    """What puts the objects behind a root back into the state that they have now.

    Parameters
    ----------
    root : where to start from.
    name : of the root, for messages.

    Raises
    ------
    RaceloopError
        When there is an object whose state cannot be saved: says where it is.
    """

    def __init__(self, root: object, name: str) -> None:
        self._restorers: list[Callable[[], object]] = []
        known: dict[int, object] = {}  # with the objects: while they live, no other one has their identity
        waiting: list[tuple[str, Any]] = [(name, root)]
        while waiting:
            where, value = waiting.pop()
            if type(value) in _PLAIN or id(value) in known:
                continue
            known[id(value)] = value
            restorer, parts = _save(value, where)
            if restorer is not None:
                self._restorers.append(restorer)
            waiting.extend((where + place, part) for place, part in parts if type(part) not in _PLAIN)

    def restore(self) -> None:
        """Put everything back; any number of times."""
        for restorer in self._restorers:
            restorer()


def _save(value: Any, where: str) -> tuple[_Restorer, _Parts]:
    kind = type(value)
    if hasattr(kind, "save_state"):
        state = value.save_state()
        return partial(value.restore_state, state), ()
    if kind in _SAVERS:
        return _SAVERS[kind](value)
    if isinstance(value, tuple):
        return None, _items(value)
    if isinstance(value, _VALUES) or _is_frozen(kind):
        return None, ()
    if isinstance(value, ffi.CData):
        return _save_memory(value), ()
    if hasattr(value, "__dict__") and kind.__basicsize__ <= _Plain.__basicsize__:
        return _save_attributes(value)
    raise RaceloopError(f"{where}: the state of {kind.__module__}.{kind.__qualname__} cannot be saved")


def _is_frozen(kind: type) -> bool:
    parameters = getattr(kind, "__dataclass_params__", None)
    return parameters is not None and bool(parameters.frozen)


def _items(values: Iterable[Any]) -> _Parts:
    return [(f"[{place}]", value) for place, value in enumerate(values) if type(value) not in _PLAIN]


def _entries(mapping: Mapping[Any, Any]) -> _Parts:
    return [*_items(mapping), *((f"[{key!r}]", value) for key, value in mapping.items() if type(value) not in _PLAIN)]


def _save_attributes(value: Any) -> tuple[_Restorer, _Parts]:
    attributes, saved = value.__dict__, value.__dict__.copy()
    return partial(_refill, attributes, saved), [("." + name, part) for name, part in saved.items()]


def _save_dict(value: dict[Any, Any]) -> tuple[_Restorer, _Parts]:
    return partial(_refill, value, value.copy()), _entries(value)


def _save_set(value: set[Any]) -> tuple[_Restorer, _Parts]:
    return partial(_refill, value, value.copy()), _items(value)


def _refill(mapping: dict[Any, Any] | set[Any], saved: Any) -> None:
    mapping.clear()
    mapping.update(saved)


def _save_list(value: list[Any]) -> tuple[_Restorer, _Parts]:
    return partial(value.__setitem__, slice(None), value.copy()), _items(value)


def _save_deque(value: deque[Any]) -> tuple[_Restorer, _Parts]:
    def restore(saved: list[Any]) -> None:
        value.clear()
        value.extend(saved)

    return partial(restore, list(value)), _items(value)


def _save_array(value: np.ndarray[Any, Any]) -> tuple[_Restorer, _Parts]:
    restorer = partial(value.__setitem__, ..., value.copy()) if value.flags.writeable else None
    return restorer, _items(value.flat) if value.dtype.hasobject else ()


def _save_function(value: FunctionType) -> tuple[_Restorer, _Parts]:
    return None, [
        (f".{name}", cell) for name, cell in zip(value.__code__.co_freevars, value.__closure__ or (), strict=True)
    ]


def _save_cell(value: CellType) -> tuple[_Restorer, _Parts]:
    return partial(setattr, value, "cell_contents", value.cell_contents), [("", value.cell_contents)]


def _save_memory(value: Any) -> _Restorer:
    """C memory: a struct or an array, or what a pointer from `ffi.new` owns."""
    if value == ffi.NULL or ffi.typeof(value).kind == "function":
        return None
    memory = ffi.buffer(ffi.addressof(value) if ffi.typeof(value).kind == "struct" else value)
    return partial(memory.__setitem__, slice(None), bytes(memory))


def _save_generator(value: np.random.Generator) -> tuple[_Restorer, _Parts]:
    source = value.bit_generator
    return partial(setattr, source, "state", source.state), ()


_SAVERS: Mapping[type, Callable[[Any], tuple[_Restorer, _Parts]]] = {
    dict: _save_dict,
    Counter: _save_dict,  # from empty, an update is what was counted
    list: _save_list,
    set: _save_set,
    deque: _save_deque,
    tuple: lambda value: (None, _items(value)),
    frozenset: lambda value: (None, _items(value)),
    MappingProxyType: lambda value: (None, _entries(value)),
    bytearray: lambda value: (partial(value.__setitem__, slice(None), bytes(value)), ()),
    np.ndarray: _save_array,
    np.random.Generator: _save_generator,
    random.Random: lambda value: (partial(value.setstate, value.getstate()), ()),
    FunctionType: _save_function,
    CellType: _save_cell,
    MethodType: lambda value: (None, [("", value.__self__)]),
    BuiltinFunctionType: lambda value: (None, [("", value.__self__)]),
    partial: lambda value: (None, [(".func", value.func), *_items(value.args), *_entries(value.keywords)]),
}
