"""Frames as can-utils write them: identifier in three or eight hexadecimal digits, `#`, data."""

from __future__ import annotations

import re
from dataclasses import dataclass

from dbc.errors import CodecError

_DATA_MAX = 8
STANDARD_MAX, EXTENDED_MAX = 0x7FF, 0x1FFF_FFFF
_SHAPE = "must be like 57A#2D07050000000000: three digits (or eight, of 29 bits), #, up to 8 bytes"


@dataclass(frozen=True)
class TextFrame:
    """A data frame without time and bus.

    Attributes
    ----------
    frame_id : without flag bits.
    extended : of 29 bits.
    data : 0 to 8 bytes.
    """

    frame_id: int
    extended: bool
    data: bytes

    def __str__(self) -> str:
        """As can-utils take it."""
        return f"{self.frame_id:0{8 if self.extended else 3}X}#{self.data.hex().upper()}"


def parse_frame(text: str) -> TextFrame:
    """Read a frame; bytes may be separated by dots, as `cansend` allows it.

    Raises
    ------
    CodecError
        When the text is no classic data frame; says what is allowed.
    """
    parts = re.fullmatch(r"([0-9A-Fa-f]+)#(.*)", text)
    if parts is None or len(parts[1]) not in (3, 8):
        raise CodecError(f"{text}: {_SHAPE}")
    extended = len(parts[1]) == 8
    frame_id, largest = int(parts[1], 16), EXTENDED_MAX if extended else STANDARD_MAX
    if frame_id > largest:
        raise CodecError(f"{text}: identifier {parts[1]}; at most {largest:X} with {len(parts[1])} digits")
    if parts[2].startswith(("R", "r")):
        raise CodecError(f"{text}: a remote frame has no data to decode")
    if parts[2].startswith("#"):
        raise CodecError(f"{text}: a CAN FD frame; the buses here are classic CAN")
    if re.fullmatch(r"(?:[0-9A-Fa-f]{2}\.?)*", parts[2]) is None:
        raise CodecError(f"{text}: {_SHAPE}")
    data = bytes.fromhex(parts[2].replace(".", ""))
    if len(data) > _DATA_MAX:
        raise CodecError(f"{text}: {len(data)} data bytes; at most {_DATA_MAX}")
    return TextFrame(frame_id, extended, data)
