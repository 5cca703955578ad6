"""`raceloop dbw monitor`: a table of what is on the buses now, or was in a recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.padding import Padding
from rich.text import Text

from dbc.codec import Codec
from dbc.errors import CodecError
from tools.dbw.bus_option import bus_of
from tools.dbw.findings import Finding, Place, Rule
from tools.dbw.message_table import Address, MessageTable, Row
from tools.dbw.playback import steps
from tools.dbw.source import is_live, read_source
from tools.exit_status import ExitStatus
from tools.stop_signal import asked_to_stop

#: Between two pictures: enough for eyes, and a small part of a core.
REFRESH_US = 250_000

_MICROS = 1_000_000
_OFFENDING = "red"


def monitor(
    database: Codec,
    sources: Sequence[str],
    bus: str | None,
    seconds: float | None,
    patterns: Sequence[str],
    once: bool,
    console: Console,
) -> int:
    """Show the table until the source ends or Ctrl-C comes; returns the exit status.

    Parameters
    ----------
    database : the messages that are allowed.
    sources, seconds : see `tools.dbw.source.read_source`.
    bus : label of the bus on which all frames are; None: by the channel.
    patterns : of names or identifiers of messages; none for all.
    once : print the table at the end only, and do not keep to the pace of a recording. So it is without a terminal.

    Raises
    ------
    RaceloopError
        When the source cannot be read at all, or the bus does not exist.
    """
    chosen = None if bus is None else bus_of(bus)
    table = MessageTable(database)

    def broken(frame: int, text: str) -> None:
        table.conformance.note(Place(Rule.BROKEN), 1, frame, 0, text)

    frames = read_source(sources, chosen, seconds, broken)
    moving = console.is_terminal and not once
    with asked_to_stop() as stopped:
        if is_live(sources):
            pieces = _as_they_come(frames)
        elif moving:
            pieces = _at_its_pace(steps(frames, REFRESH_US), stopped)
        else:
            pieces = ((piece, int(piece["time_us"].max())) for piece in frames)
        now_us = _show(table, pieces, patterns, console) if moving else _take(table, pieces, stopped)
    table.conformance.finish()
    lines = picture(table, now_us, patterns)
    if console.is_terminal:
        console.print(_page(lines))
    for indent, text in () if console.is_terminal else lines:
        console.print(Text(" " * indent).append_text(text))
    return ExitStatus.DONE


def _take(table: MessageTable, pieces: Iterator[tuple[NDArray[np.void], int]], stopped: Callable[[], bool]) -> int:
    """Take in everything; gives the time of the end."""
    now_us = 0
    for frames, now_us in pieces:
        table.update(frames, now_us)
        if stopped():
            break
    return now_us


def _show(
    table: MessageTable, pieces: Iterator[tuple[NDArray[np.void], int]], patterns: Sequence[str], console: Console
) -> int:
    """Take in everything and show it meanwhile; gives the time of the end."""
    now_us = shown_us = 0
    with Live(console=console, auto_refresh=False, transient=True, vertical_overflow="crop") as live:
        for frames, now_us in pieces:
            table.update(frames, now_us)
            if now_us - shown_us >= REFRESH_US:
                shown_us = now_us
                # What the terminal has no room for costs most of the time.
                live.update(_page(picture(table, now_us, patterns)[: console.height]), refresh=True)
    return now_us


def _as_they_come(chunks: Iterator[NDArray[np.void]]) -> Iterator[tuple[NDArray[np.void], int]]:
    for frames in chunks:
        yield frames, time.monotonic_ns() // 1000


def _at_its_pace(
    pieces: Iterator[tuple[NDArray[np.void], int]], stopped: Callable[[], bool]
) -> Iterator[tuple[NDArray[np.void], int]]:
    begin_us = time.monotonic_ns() // 1000
    for frames, time_us in pieces:
        while not stopped() and (left_us := begin_us + time_us - time.monotonic_ns() // 1000) > 0:
            time.sleep(left_us / _MICROS)
        if stopped():
            return
        yield frames, time_us


class Line(NamedTuple):
    """A line of the page, which is indented, also where it is broken on a narrow terminal."""

    indent: int
    text: Text


def picture(table: MessageTable, now_us: int, patterns: Sequence[str] = ()) -> list[Line]:
    """The table at some moment, for people.

    Parameters
    ----------
    table : what is known.
    now_us : by the clock of its updates.
    patterns : of names or identifiers; none for all messages.
    """
    findings = table.findings()
    lines = [Line(0, Text(_HEAD, "bold"))]
    offending = 0
    for address, row in table.sorted():
        found, stale = findings.pop((address.bus, _name(address, row)), []), row.stale(now_us)
        offending += bool(found or stale)
        name = "" if row.codec is None else row.codec.name
        if not patterns or any(fnmatchcase(name, wanted) or _digits(address) == wanted for wanted in patterns):
            lines += _row(table.conformance.database, address, row, found, now_us)
    for found in findings.values():
        lines += [Line(0, Text(f"{one.place.subject}: {_told(one)}: {one.text}", _OFFENDING)) for one in found]
    counts = f"{table.conformance.frames} frames of {len(table.rows)} messages, {offending} offending"
    return [Line(0, Text(counts)), *lines]


_SHAPE = "{:<5} {:>3}  {:<26} {:<11} {:>7} {:>8} {:>8} {:>8} {:>7}"
_HEAD = _SHAPE.format("bus", "id", "message", "from", "frames", "period", "mean", "age ms", "counter")
_INDENT = 11


def _name(address: Address, row: Row) -> str:
    """As `Conformance` calls it."""
    return f"{address.frame_id:0{8 if address.extended else 1}X}" if row.codec is None else row.codec.name


def _digits(address: Address) -> str:
    return f"{address.frame_id:0{8 if address.extended else 3}X}"


def _row(codecs: Codec, address: Address, row: Row, found: Sequence[Finding], now_us: int) -> list[Line]:
    """A line for the message, one for its values, one for what is wrong."""
    codec, stale = row.codec, row.stale(now_us)
    counter, values = _content(codecs, row, {one.place.signal for one in found})
    head = _SHAPE.format(
        address.bus.label,
        _digits(address),
        "" if codec is None else codec.name,
        "" if codec is None else codec.sender.name,
        row.count,
        _milliseconds(row.period_us),
        _milliseconds(row.mean_us),
        _milliseconds(row.age_us(now_us)),
        counter,
    )
    lines = [Line(0, Text(head.rstrip(), _OFFENDING if found or stale else "")), Line(_INDENT, values)]
    wrong = [_told(one) for one in found] + (["stale"] if stale else [])
    return [*lines, Line(_INDENT, Text(", ".join(wrong), _OFFENDING))] if wrong else lines


def _page(lines: Sequence[Line]) -> Group:
    """The lines on a terminal."""
    return Group(*(Padding(text, (0, 0, 0, indent)) for indent, text in lines))


def _told(finding: Finding) -> str:
    signal = f"{finding.place.signal} " if finding.place.signal else ""
    return f"{signal}{finding.place.rule.value} {finding.count}"


def _milliseconds(time_us: float | None) -> str:
    return "" if time_us is None else f"{time_us / 1000:.1f}"


def _content(codecs: Codec, row: Row, offending: Collection[str]) -> tuple[str, Text]:
    """Counter and values of the newest frame in words; bytes where nobody knows what they mean.

    Parameters
    ----------
    codecs : where the message is from.
    row : of the message.
    offending : signals.
    """
    digits = row.data.hex(" ").upper()
    if row.codec is None:
        return "", Text(digits)
    try:
        decoded = row.codec.decode(row.data)
    except CodecError:
        return "", Text(digits)
    facts, choices = codecs.facts(row.codec.name), row.codec.choices
    counter, values = "", Text()
    for name, unit, value in zip(row.codec.signals, row.codec.units, decoded, strict=True):
        if facts.counter is not None and name == facts.counter.name:
            counter = f"{value:g}"
        elif facts.crc is None or name != facts.crc.name:
            word = choices.get(name, {}).get(round(value), f"{value:.7g}")
            values.append(f"{', ' if values else ''}{name} ").append(
                f"{word}{unit and ' ' + unit}", _OFFENDING if name in offending else "bold"
            )
    return counter, values
