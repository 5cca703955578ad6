"""Arrays of CAN frames as they cross every boundary: the 24-byte ``can_frame`` of firmware/common/can_frame.h.

A buffer of frames is any bytes-like object whose length is a multiple of 24. Single frames in Python are
:class:`Frame`; whole recordings are numpy arrays of :data:`FRAME_DTYPE`.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntFlag
from struct import Struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dbc.buses import Bus, Station

__all__ = [
    "FRAME_DTYPE",
    "FRAME_SIZE",
    "FRAME_STRUCT",
    "Buffer",
    "Bus",
    "Flag",
    "Frame",
    "Station",
    "frame_array",
    "iterate",
]

#: Bytes-like objects that hold frames or data.
Buffer = bytes | bytearray | memoryview

#: One frame: time_us, id, bus, dlc, flags, sender, data.
FRAME_STRUCT = Struct("<QIBBBB8s")

#: Bytes per frame.
FRAME_SIZE = FRAME_STRUCT.size

#: The same layout as a numpy record.
FRAME_DTYPE = np.dtype(
    [
        ("time_us", "<u8"),
        ("id", "<u4"),
        ("bus", "u1"),
        ("dlc", "u1"),
        ("flags", "u1"),
        ("sender", "u1"),
        ("data", "u1", (8,)),
    ]
)


class Flag(IntFlag):
    """Bits of a frame's flags; ``enum can_frame_flag`` in firmware/common/can_frame.h."""

    EXTENDED = 1
    REMOTE = 2
    ERROR = 4


class Frame(NamedTuple):
    """One frame with named fields.

    Attributes
    ----------
    time_us : end of the frame on the bus in simulated microseconds; 0 before it was sent.
    id : identifier without flag bits.
    bus, sender : numbers of :class:`Bus` and :class:`Station`.
    dlc : data bytes; receivers treat more than 8 as 8.
    flags : bits of :class:`Flag`.
    data : always 8 bytes.
    """

    time_us: int
    id: int
    bus: int
    dlc: int
    flags: int
    sender: int
    data: bytes

    def pack(self) -> bytes:
        """Return the frame as 24 bytes."""
        return FRAME_STRUCT.pack(*self)


def iterate(frames: Buffer) -> Iterator[Frame]:
    """Iterate over a buffer of frames.

    Raises
    ------
    struct.error
        When the length is not a multiple of 24.
    """
    return map(Frame._make, FRAME_STRUCT.iter_unpack(frames))


def frame_array(frames: Buffer) -> NDArray[np.void]:
    """View a buffer of frames as a numpy array of :data:`FRAME_DTYPE`, without copying.

    Raises
    ------
    ValueError
        When the length is not a multiple of 24.
    """
    return np.frombuffer(frames, dtype=FRAME_DTYPE)
