"""Faults of an ECU's memory and of its time: a field that holds something else, a task that takes longer."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from bridge._native import ffi, lib
from bridge.faults.ecus import EcuFault
from bridge.faults.fault import BenchFault, Memory, parameter
from dbc.buses import Station
from dbc.codec import Codec
from dbc.errors import CodecError

if TYPE_CHECKING:
    from bridge.bench import Bench

#: Tasks of the onboard computer by name, in the order of its schedule.
TASKS = {
    name.removeprefix("OBC_TASK_").lower(): getattr(lib, name)
    for name in sorted(
        (name for name in dir(lib) if name.startswith("OBC_TASK_") and name != "OBC_TASK_COUNT"),
        key=lambda name: int(getattr(lib, name)),
    )
}

_STRUCTS = {Station.OBC: "obc", Station.RAPTOR: "raptor", Station.SPACE_DRIVE: "space_drive"}
_NUMBERS = {"nan": float("nan"), "inf": float("inf")}
_REALS = ("float", "double")
_STEP = re.compile(r"\.?([A-Za-z_]\w*)|\[(\w+)\]")


class Field:
    """A field of a C struct by its path, such as ``control_output.road_wheel_angle[CONTROL_LQR]``.

    Parameters
    ----------
    struct : name of the C type.
    path : members by name, elements by number or by an enumerator of the firmware.

    Raises
    ------
    CodecError
        When there is no such field, or it is not one number: says what there is.
    """

    def __init__(self, struct: str, path: str) -> None:
        self._steps: list[str | int] = []
        kind = ffi.typeof(struct)
        place = 0
        while place < len(path):
            step = _STEP.match(path, place)
            if step is None:
                raise CodecError(f"field {path!r}: cannot be read from {path[place:]!r} on")
            place = step.end()
            kind = self._member(kind, step[1], step[2], path)
        if kind.kind not in ("primitive", "enum"):
            raise CodecError(f"field {path!r} is no number but {kind.cname}; allowed below it are {_members(kind)}")
        self.type = kind

    def read(self, owner: Any) -> Any:
        """The number in a struct."""
        for step in self._steps:
            owner = getattr(owner, step) if isinstance(step, str) else owner[step]
        return owner

    def write(self, owner: Any, value: Any) -> None:
        """Set the number in a struct."""
        for step in self._steps[:-1]:
            owner = getattr(owner, step) if isinstance(step, str) else owner[step]
        last = self._steps[-1]
        if isinstance(last, str):
            setattr(owner, last, value)
        else:
            owner[last] = value

    def number(self, value: float | str) -> Any:
        """A value as the field's type takes it: a number, nan, inf, or an enumerator of the firmware.

        Raises
        ------
        CodecError
            When the field cannot hold it.
        """
        number = value if not isinstance(value, str) else _NUMBERS.get(value, getattr(lib, value, None))
        if not isinstance(number, int | float):
            raise CodecError(f"value {value!r} is neither a number, nan, inf nor an enumerator of the firmware")
        if self.type.cname not in _REALS and float(number).is_integer():
            number = int(number)
        try:
            ffi.new(f"{self.type.cname} *", number)
        except (TypeError, OverflowError, ValueError) as error:
            raise CodecError(f"value {value!r}: {self.type.cname} cannot hold it") from error
        return number

    def _member(self, kind: Any, name: str | None, index: str | None, path: str) -> Any:
        if name is not None and kind.kind in ("struct", "union"):
            members = dict(kind.fields)
            if name not in members:
                nearest = get_close_matches(name, members, n=1, cutoff=0.0)[0]
                raise CodecError(f"field {path!r}: no {name!r} in {kind.cname}; the nearest is {nearest!r}")
            self._steps.append(name)
            return members[name].type
        if index is not None and kind.kind == "array":
            element = int(index) if index.isdecimal() else getattr(lib, index, None)
            if not isinstance(element, int) or not 0 <= element < kind.length:
                raise CodecError(f"field {path!r}: [{index}] is out of range; allowed is 0 to {kind.length - 1}")
            self._steps.append(element)
            return kind.item
        raise CodecError(f"field {path!r}: {kind.cname} has {_members(kind)}")


def _members(kind: Any) -> str:
    if kind.kind in ("struct", "union"):
        return ", ".join(name for name, _ in kind.fields)
    return f"elements 0 to {kind.length - 1}" if kind.kind == "array" else "no parts"


def struct_of(bench: Bench, station: Station) -> Any:
    """The C struct of an ECU of a bench."""
    return getattr(bench, _STRUCTS[station])


class _TaskHooks:
    """Acts between two tasks of one onboard computer, by way of the clock that its executive asks around each task.

    The clock always says 0, so that a task costs what is injected and nothing else.
    """

    def __init__(self) -> None:
        self._actions: list[tuple[int, Callable[[], None]]] = []
        self._callback = ffi.callback("uint64_t(void *)", self._asked)

    def _asked(self, _context: Any) -> int:
        for _, act in self._actions:
            act()
        return 0

    def add(self, bench: Bench, act: Callable[[], None]) -> None:
        """Do something whenever the clock is asked in this tick."""
        self._actions = [one for one in self._actions if one[0] == bench.now_us] + [(bench.now_us, act)]
        bench.obc.executive.clock = self._callback

    def release(self, bench: Bench) -> None:
        """Take the clock away, unless somebody else acts in this tick."""
        self._actions = [one for one in self._actions if one[0] == bench.now_us]
        if not self._actions:
            bench.obc.executive.clock = ffi.NULL


@dataclass(frozen=True, kw_only=True)
class MemoryAltered(EcuFault):
    """A field in the memory of an ECU holds another value, as after a fault of its memory or its processor.

    It is written at the start of every tick, before anybody acts; what the firmware writes afterwards stays. When the
    fault is over, the field is left as it is.

    Attributes
    ----------
    field : path in the ECU's C struct: members by name, elements by number or enumerator.
    value : a number, `nan`, `inf` or an enumerator of the firmware.
    after : task of the onboard computer behind which it is written instead, so that the next task reads it.
    """

    kind = "memory_altered"
    field: str
    value: float | str = parameter()
    after: str | None = parameter(default=None, enum=list(TASKS))

    def check(self, database: Codec) -> None:
        super().check(database)
        self._place().number(self.value)
        if self.after is not None and (self.station is not Station.OBC or self.after not in TASKS):
            raise CodecError(f"{self.kind}: after {self.after!r}; allowed are, of station OBC, {', '.join(TASKS)}")

    def tick(self, bench: Bench, memory: Memory) -> int:
        owner, place = struct_of(bench, self.station), self._place()
        value = place.number(self.value)
        if self.after is None:
            place.write(owner, value)
            return 1
        record = owner.executive.records[TASKS[self.after]]
        runs = record.runs

        def write() -> None:
            if record.runs != runs:
                place.write(owner, value)

        if bench.task_hooks is None:
            bench.task_hooks = _TaskHooks()
        bench.task_hooks.add(bench, write)
        return 1

    def end(self, bench: Bench, memory: Memory) -> None:
        if self.after is not None:
            bench.task_hooks.release(bench)

    def _place(self) -> Field:
        return Field(_STRUCTS[self.station], self.field)


@dataclass(frozen=True, kw_only=True)
class ExecutionTime(BenchFault):
    """A task of the onboard computer takes longer by the executive's account; lock step does not wait for it.

    Attributes
    ----------
    extra_us : added to every run.
    """

    kind = "execution_time"
    task: str = parameter(enum=list(TASKS))
    extra_us: int = parameter(minimum=1, maximum=1_000_000)

    def check(self, database: Codec) -> None:
        if self.task not in TASKS:
            raise CodecError(f"{self.kind}: no task {self.task!r}; allowed are {', '.join(TASKS)}")

    def tick(self, bench: Bench, memory: Memory) -> int:
        bench.obc.executive.records[TASKS[self.task]].injected_cost_us = self.extra_us
        return 1

    def end(self, bench: Bench, memory: Memory) -> None:
        bench.obc.executive.records[TASKS[self.task]].injected_cost_us = 0


@dataclass(frozen=True, kw_only=True)
class WireAltered(EcuFault):
    """A signal that is wired to the Raptor or the Space Drive reads something else: a sensor or its cable.

    Attributes
    ----------
    input : path in `raptor_wired_in` or `space_drive_wired_in`.
    value : what it reads; or
    offset : what is added to what it should read.
    """

    kind = "wire_altered"
    input: str
    value: float | str | None = parameter(default=None)
    offset: float | None = parameter(default=None)

    def check(self, database: Codec) -> None:
        if self.station not in (Station.RAPTOR, Station.SPACE_DRIVE):
            raise CodecError(f"{self.kind}: station {self.station.name}; allowed are RAPTOR, SPACE_DRIVE")
        if (self.value is None) == (self.offset is None):
            raise CodecError(f"{self.kind} needs either a value or an offset")
        place = self._place()
        if self.value is not None:
            place.number(self.value)
        elif place.type.cname not in _REALS:
            raise CodecError(f"{self.kind}: {self.input} is {place.type.cname}; an offset goes with float only")

    def tick(self, bench: Bench, memory: Memory) -> int:
        return 1

    def sense(self, bench: Bench, memory: Memory) -> None:
        place, wired = self._place(), self._wired(bench)
        reads = place.read(wired)
        if "wrote" not in memory.kept or reads != memory.kept["wrote"]:
            memory.kept["true"] = reads  # sampled or set since; else it is what was written here in the last tick
        true = memory.kept["true"]
        place.write(wired, true + self.offset if self.value is None else place.number(self.value))
        memory.kept["wrote"] = place.read(wired)

    def end(self, bench: Bench, memory: Memory) -> None:
        place, wired = self._place(), self._wired(bench)
        if "wrote" in memory.kept and place.read(wired) == memory.kept["wrote"]:
            place.write(wired, memory.kept["true"])

    def _place(self) -> Field:
        return Field(f"{_STRUCTS[self.station]}_wired_in", self.input)

    def _wired(self, bench: Bench) -> Any:
        return getattr(bench.wiring, f"{_STRUCTS[self.station]}_in")
