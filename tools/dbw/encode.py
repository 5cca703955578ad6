"""`raceloop dbw encode`: physical values into a frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console

from dbc.codec import Codec, MessageCodec
from dbc.errors import CodecError
from tools.dbw.page import finished, page, remarks_on
from tools.exit_status import ExitStatus

#: Part of a step by which a value may miss it and still count as on it: what decimal fractions lose in binary.
_ON_A_STEP = 1e-6


def encode(database: Codec, name: str, assignments: Sequence[str], console: Console) -> int:
    """Print the frame of a message; signals that are not given have the raw value 0, a CRC is computed.

    Parameters
    ----------
    database : messages of a profile.
    name : of the message.
    assignments : SIGNAL=VALUE each.
    console : to print on.

    Raises
    ------
    CodecError
        When there is no such message or signal, or a value does not fit; says what is allowed.
    """
    codec = database.message(name)
    given = _given(codec, assignments)
    signals = codec.definition.signals
    data = codec.encode(*(given.get(signal.name, signal.offset) for signal in signals))[: codec.length]
    facts = codec.facts
    remarks = remarks_on(codec, data)
    if facts.crc is not None and facts.crc.name not in given:
        data = finished(codec, data)
    for signal, value in zip(signals, codec.decode(data), strict=True):
        if signal.name in given and abs(value - given[signal.name]) > _ON_A_STEP * abs(signal.scale):
            remarks.append(f"{signal.name}: {given[signal.name]:g} is between two steps of {signal.scale:g}: {value:g}")
    for line in [*page(codec, data), *([""] if remarks else []), *remarks]:
        console.print(line, markup=False)
    return ExitStatus.DONE


def _given(codec: MessageCodec, assignments: Sequence[str]) -> dict[str, float]:
    given: dict[str, float] = {}
    for text in assignments:
        name, separator, value = text.partition("=")
        if not separator:
            raise CodecError(f"{text}: must be SIGNAL=VALUE; signals are {', '.join(codec.signals)}")
        codec.limits(name)  # says which name is nearest when there is no such signal
        if name in given:
            raise CodecError(f"{codec.name}.{name} is given twice")
        given[name] = _value(codec, name, value)
    return given


def _value(codec: MessageCodec, name: str, text: str) -> float:
    """A number, or a name from the signal's value table."""
    choices = {meaning.upper(): float(number) for number, meaning in codec.choices.get(name, {}).items()}
    if text.upper() in choices:
        return choices[text.upper()]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        low, high = codec.limits(name)
        names = f", or {', '.join(choices)}" if choices else ""
        raise CodecError(f"{codec.name}.{name}: {text!r}; must be a number from {low:.10g} to {high:.10g}{names}")
    return value
