"""What `raceloop dbw encode` and `decode` print of a frame."""

from __future__ import annotations

from dbc.codec import MessageCodec
from dbc.frames import Flag, Frame
from tools.dbw.frame_text import TextFrame
from tools.dbw.layout import LETTERS, describe, picture, places

_DATA_SIZE = 8


def page(codec: MessageCodec, data: bytes) -> list[str]:
    """Physical and raw values of all signals, and where their bits are.

    Parameters
    ----------
    codec : message.
    data : its bytes, as many as it has.
    """
    signals = codec.definition.signals
    owners = dict(zip(LETTERS, signals, strict=False))
    raw = codec.definition.decode(data, decode_choices=False, scaling=False)
    assert isinstance(raw, dict)
    rows = [("", "signal", "value", "unit", "raw", "bits", "")]
    for letter, signal, value, unit in zip(LETTERS, signals, codec.decode(data), codec.units, strict=False):
        number = int(str(raw[signal.name]))
        meaning = codec.choices.get(signal.name, {}).get(number, "")
        rows.append((letter, signal.name, f"{value:.10g}", unit, str(number), describe(signal), meaning))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [_heading(codec, data), ""]
    for row in rows:
        cells = [
            cell.rjust(width) if column in (2, 4) else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return [*lines, "", *picture(owners, data)]


def _heading(codec: MessageCodec, data: bytes) -> str:
    frame = TextFrame(codec.frame_id, codec.extended, data)
    cycle = f" every {codec.cycle_us // 1000} ms" if codec.cycle_us else ""
    return f"{codec.name}: {frame} on {codec.bus.label}, {codec.length} bytes, from {codec.sender.name}{cycle}"


def remarks_on(codec: MessageCodec, data: bytes) -> list[str]:
    """What is odd about data that can be decoded: values outside the declared range, bits of no signal that are set.

    The bits of a signal may hold more than the range that the DBC file declares.
    """
    lines = []
    for signal, value in zip(codec.definition.signals, codec.decode(data), strict=True):
        low, high = signal.minimum, signal.maximum
        if (low is not None and value < low) or (high is not None and value > high):
            lines.append(f"{signal.name}: {value:.10g} is outside the declared range, {low:g} to {high:g}")
    used = {place for signal in codec.definition.signals for place in places(signal)}
    if any(data[place // 8] >> place % 8 & 1 for place in range(8 * len(data)) if place not in used):
        lines.append("bits of no signal are set")
    return lines


def finished(codec: MessageCodec, data: bytes) -> bytes:
    """The data with the CRC that its sender would write; the same where the message has none."""
    facts = codec.facts
    if facts.crc is None:
        return data
    flags = Flag.EXTENDED if codec.extended else 0
    frame = Frame(0, codec.frame_id, codec.bus, codec.length, flags, codec.sender, data.ljust(_DATA_SIZE, b"\0"))
    counter = 0 if facts.counter is None else int(codec.decode(data)[codec.signals.index(facts.counter.name)])
    return codec.finish(frame.pack(), counter)[-_DATA_SIZE:][: codec.length]
