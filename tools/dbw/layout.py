"""Where the bits of signals are, and a picture of them."""

from __future__ import annotations

from collections.abc import Mapping
from string import ascii_letters

from cantools.database.can import Signal

LETTERS = ascii_letters
"""What stands for the signals of a message in a picture, in their order."""


def places(signal: Signal) -> tuple[int, ...]:
    """Places of a signal's bits, most significant first: 8 * byte + bit, the last bit of a byte being bit 0.

    A DBC file gives the least significant bit of a little-endian signal, and the most significant one of a big-endian
    signal, which goes on at bit 7 of the next byte.
    """
    if signal.byte_order == "little_endian":
        return tuple(range(signal.start + signal.length - 1, signal.start - 1, -1))
    found = [signal.start]
    while len(found) < signal.length:
        found.append(found[-1] + 15 if found[-1] % 8 == 0 else found[-1] - 1)
    return tuple(found)


def describe(signal: Signal) -> str:
    """Place and form of a signal as a DBC file writes them: `16|8@1+`."""
    order = 1 if signal.byte_order == "little_endian" else 0
    return f"{signal.start}|{signal.length}@{order}{'-' if signal.is_signed else '+'}"


def picture(owners: Mapping[str, Signal], data: bytes) -> list[str]:
    """Draw data byte by byte: each bit with the letter of the signal that it belongs to.

    Parameters
    ----------
    owners : signals by their letter.
    data : of the message.
    """
    letter_at = {place: letter for letter, signal in owners.items() for place in places(signal)}
    lines = ["byte" + "".join(f"{bit:>4}" for bit in range(7, -1, -1))]
    for number, byte in enumerate(data):
        cells = (f"{letter_at.get(8 * number + bit, '.')}{byte >> bit & 1}" for bit in range(7, -1, -1))
        lines.append(f"{number:>4}" + "".join(f"{cell:>4}" for cell in cells) + f"   {byte:02X}")
    return lines
