"""`raceloop dbw lint`: what is wrong or missing in a DBC file, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

from cantools.database.can import Database, Message, Signal
from rich.console import Console

from dbc.network import load_database, raw_limits
from tools.dbw.layout import places
from tools.exit_status import ExitStatus

#: What cantools and Vector's tools call the node that stands for none.
_NOBODY = "Vector__XXX"


def lint(path: Path, console: Console) -> int:
    """Print a line per finding; returns the exit status, a miss when there is one.

    Raises
    ------
    ConfigurationError
        When the file cannot be read or parsed.
    """
    database = load_database(path, strict=False)
    lines = list(findings(database))
    for line in lines:
        console.print(f"{path}: {line}", markup=False)
    if not lines:
        console.print(f"{path}: {len(database.messages)} messages, nothing to say", markup=False)
    return ExitStatus.MISSED if lines else ExitStatus.DONE


def findings(database: Database) -> Iterator[str]:
    """All findings, message by message."""
    messages = sorted(database.messages, key=lambda message: (message.is_extended_frame, message.frame_id))
    identifiers = Counter((message.is_extended_frame, message.frame_id) for message in messages)
    names = Counter(message.name for message in messages)
    for message in messages:
        head = f"{message.name} ({message.frame_id:X})"
        if identifiers[message.is_extended_frame, message.frame_id] > 1:
            yield f"{head}: another message has the same identifier"
        if names[message.name] > 1:
            yield f"{head}: another message has the same name"
        for text in _message_findings(message):
            yield f"{head}: {text}"
        for signal in message.signals:
            for text in _signal_findings(message, signal):
                yield f"{head}, {signal.name}: {text}"


def _message_findings(message: Message) -> Iterator[str]:
    cycle_ms, timeout_ms = _attribute(message, "GenMsgCycleTime"), _attribute(message, "GenMsgTimeout")
    if not set(message.senders) - {_NOBODY}:
        yield "no sender"
    if not cycle_ms:
        yield "no cycle time (GenMsgCycleTime)"
    elif timeout_ms and timeout_ms <= cycle_ms:
        yield f"the time-out, {timeout_ms} ms, is not longer than the cycle, {cycle_ms} ms"
    if _attribute(message, "CounterSignal") and not timeout_ms:
        yield "a counter but no time-out (GenMsgTimeout)"
    names = {signal.name for signal in message.signals}
    for attribute in ("CounterSignal", "CrcSignal"):
        named = _attribute(message, attribute)
        if named and named not in names:
            yield f"{attribute} names {named}, which is no signal of it"
    for one, other in combinations(message.signals, 2):
        shared = set(places(one)) & set(places(other))
        if shared and not _exclude_each_other(one, other):
            yield f"{one.name} and {other.name} overlap in {_bits(shared)}"


def _signal_findings(message: Message, signal: Signal) -> Iterator[str]:
    beyond = {place for place in places(signal) if not 0 <= place < 8 * message.length}
    if beyond:
        yield f"{_bits(beyond)} beyond the {message.length} bytes of the message"
    if signal.scale == 0:
        yield "the scale is 0"
    if not set(signal.receivers) - {_NOBODY}:
        yield "no receiver"
    if signal.is_float:
        return
    ends = [limit * signal.scale + signal.offset for limit in raw_limits(signal)]
    low, high = min(ends), max(ends)
    for declared, word in ((signal.minimum, "minimum"), (signal.maximum, "maximum")):
        if declared is not None and not low <= declared <= high:
            yield f"the declared {word}, {declared:g}, is beyond what the bits hold, {low:g} to {high:g}"
    for value, meaning in (signal.choices or {}).items():
        if not raw_limits(signal)[0] <= int(value) <= raw_limits(signal)[1]:
            yield f"the value table has {value} ({meaning}), which {signal.length} bits do not hold"


def _exclude_each_other(one: Signal, other: Signal) -> bool:
    """Signals of one multiplexer that are never in the same frame."""
    if one.multiplexer_signal is None or one.multiplexer_signal != other.multiplexer_signal:
        return False
    return not set(one.multiplexer_ids or ()) & set(other.multiplexer_ids or ())


def _bits(found: set[int]) -> str:
    """Bits in words, lowest first: `bit 5`, `bits 8, 9`."""
    return f"bit{'s' * (len(found) > 1)} {', '.join(map(str, sorted(found)))}"


def _attribute(message: Message, name: str) -> Any:
    attributes = {} if message.dbc is None else message.dbc.attributes
    return attributes[name].value if name in attributes else None
