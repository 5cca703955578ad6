"""A second decoder of all messages, in numpy: from the numbers of the DBC files alone, one operation per signal.

It exists because it does a hundred thousand frames in the time in which cantools does a hundred. What it says is worth
only as much as cantools' agreement with it, which test_codec_cantools.py checks first.
"""

from __future__ import annotations

import numpy as np
from cantools.database.can import Message, Signal
from numpy.typing import NDArray

from dbc.network import raw_limits

Data = NDArray[np.uint8]
"""Data bytes of frames, shape (n, 8)."""


def shift_of(signal: Signal) -> int:
    """Place of the signal's lowest bit in the 8 bytes read as one number in the signal's own byte order."""
    if signal.byte_order == "little_endian":
        return int(signal.start)
    # DBC files number the bits of a byte from the right, and name the highest one of a big-endian signal.
    byte, bit = divmod(int(signal.start), 8)
    return 64 - (8 * byte + (7 - bit)) - int(signal.length)


def raw_values(signal: Signal, data: Data) -> NDArray[np.int64]:
    """Raw values of one signal, shape (n,)."""
    order = "<u8" if signal.byte_order == "little_endian" else ">u8"
    words = np.ascontiguousarray(data).view(order)[:, 0].astype(np.uint64)
    mask = np.uint64((1 << signal.length) - 1)
    raw = ((words >> np.uint64(shift_of(signal))) & mask).astype(np.int64)
    if signal.is_signed:
        raw -= (raw >> (signal.length - 1)) << signal.length
    return raw


def physical_values(definition: Message, data: Data) -> NDArray[np.float64]:
    """Physical values, shape (number of signals, n), in the order of the signals."""
    return np.stack([raw_values(s, data) * float(s.scale) + float(s.offset) for s in definition.signals])


def used_bits(definition: Message) -> Data:
    """Eight bytes in which every bit that belongs to a signal is set."""
    bits = {"<u8": 0, ">u8": 0}
    for signal in definition.signals:
        order = "<u8" if signal.byte_order == "little_endian" else ">u8"
        bits[order] |= ((1 << signal.length) - 1) << shift_of(signal)
    parts = [np.array([word], dtype=order).view(np.uint8) for order, word in bits.items()]
    return np.asarray(parts[0] | parts[1], dtype=np.uint8)


def boundary_values(signal: Signal) -> list[int]:
    """Raw values at the ends and around zero, and with one bit set or one bit clear."""
    low, high = raw_limits(signal)
    bits = [1 << place for place in range(signal.length)]
    walks = [low + bit for bit in bits] + [high - bit for bit in bits]
    return sorted(value for value in {low, low + 1, -1, 0, 1, high - 1, high, *walks} if low <= value <= high)
