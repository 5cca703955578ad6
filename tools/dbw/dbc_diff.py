"""`raceloop dbw diff`: how one DBC file differs from another, in words."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cantools.database.can import Database, Message, Signal
from rich.console import Console

from dbc.network import load_database
from tools.dbw.layout import describe
from tools.exit_status import ExitStatus


def diff(one: Path, other: Path, console: Console) -> int:
    """Print a line per difference; returns the exit status, a miss when there is one.

    Raises
    ------
    ConfigurationError
        When a file cannot be read or parsed.
    """
    databases = [load_database(path, strict=False) for path in (one, other)]
    lines = list(differences(*databases))
    for line in lines:
        console.print(line, markup=False)
    if not lines:
        console.print("no difference in what is on the wire", markup=False)
    return ExitStatus.MISSED if lines else ExitStatus.DONE


def differences(one: Database, other: Database) -> Iterator[str]:
    """All differences, messages in the order of their identifiers; what is only in `other` comes last.

    Messages are the same when their names are; one whose name is gone but whose identifier is there was renamed.
    """
    left, right = ({message.name: message for message in database.messages} for database in (one, other))
    by_identifier = {_address(message): message for message in other.messages if message.name not in left}
    matched = set()
    for name, message in sorted(left.items(), key=lambda item: _address(item[1])):
        twin = right.get(name)
        if twin is None and (twin := by_identifier.get(_address(message))) is not None:
            yield f"{name} ({message.frame_id:X}): is called {twin.name}"
        if twin is None:
            yield f"{name} ({message.frame_id:X}): is gone"
            continue
        matched.add(twin.name)
        for text in _message_differences(message, twin):
            yield f"{name} ({message.frame_id:X}){text}"
    for name, message in sorted(right.items(), key=lambda item: _address(item[1])):
        if name not in matched:
            yield f"{name} ({message.frame_id:X}): is new"


def _message_differences(one: Message, other: Message) -> Iterator[str]:
    facts = (
        ("identifier", f"{one.frame_id:X}", f"{other.frame_id:X}"),
        ("identifier's bits", 29 if one.is_extended_frame else 11, 29 if other.is_extended_frame else 11),
        ("length in bytes", one.length, other.length),
        ("sender", ", ".join(one.senders), ", ".join(other.senders)),
        ("cycle time in ms", one.cycle_time, other.cycle_time),
    )
    yield from _changed(": ", facts)
    left, right = ({signal.name: signal for signal in message.signals} for message in (one, other))
    for name, signal in left.items():
        if name not in right:
            yield f", {name}: is gone"
        else:
            yield from _changed(f", {name}: ", _signal_facts(signal, right[name]))
    for name, signal in right.items():
        if name not in left:
            yield f", {name}: is new, {describe(signal)}"


def _signal_facts(one: Signal, other: Signal) -> tuple[tuple[str, Any, Any], ...]:
    names = ({int(value): str(name) for value, name in (signal.choices or {}).items()} for signal in (one, other))
    left, right = names
    table = tuple(
        (f"name of {value}", left.get(value), right.get(value)) for value in sorted(left.keys() | right.keys())
    )
    return (
        ("bits", describe(one), describe(other)),
        ("scale", one.scale, other.scale),
        ("offset", one.offset, other.offset),
        ("unit", one.unit, other.unit),
        ("minimum", one.minimum, other.minimum),
        ("maximum", one.maximum, other.maximum),
        ("multiplexer values", one.multiplexer_ids, other.multiplexer_ids),
        *table,
    )


def _changed(head: str, facts: tuple[tuple[str, Any, Any], ...]) -> Iterator[str]:
    for what, before, after in facts:
        if before != after:
            yield f"{head}{what} {_word(before)} is now {_word(after)}"


def _word(value: Any) -> str:
    return "none" if value in (None, "", []) else f"{value:g}" if isinstance(value, float) else str(value)


def _address(message: Message) -> tuple[bool, int]:
    return bool(message.is_extended_frame), int(message.frame_id)
