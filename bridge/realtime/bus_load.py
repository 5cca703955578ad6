"""How full the buses would be on copper: exact bits of every frame against the time of the run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.bus import BIT_RATES
from dbc.frames import FRAME_SIZE, Bus

#: The busiest stretch of this length is the peak.
WINDOW_US = 10_000


class BusLoad:
    """Counts frames and bits per bus; a virtual bus is never full, so a load may exceed 1.

    Parameters
    ----------
    bit_rates : bit/s per bus.
    """

    def __init__(self, bit_rates: Mapping[Bus, int] = BIT_RATES) -> None:
        self._rates = bit_rates
        self._wire: Any = ffi.new("can_wire *")
        lib.can_wire_init(self._wire)
        self._frames = np.zeros(len(Bus), np.int64)
        self._bits = np.zeros(len(Bus), np.int64)
        self._window = np.zeros(len(Bus), np.int64)  # index of the window that _in_window counts
        self._in_window = np.zeros(len(Bus), np.int64)
        self._busiest = np.zeros(len(Bus), np.int64)

    def update(self, frames: NDArray[np.void]) -> None:
        """Take the next frames, per bus in order of time; array of `FRAME_DTYPE`."""
        frames = np.ascontiguousarray(frames)
        bits = np.zeros(frames.size, np.uint32)
        source = ffi.from_buffer("can_frame[]", frames.view(np.uint8), require_writable=False)
        assert frames.nbytes == frames.size * FRAME_SIZE
        lib.can_wire_bits_of_each(self._wire, source, frames.size, ffi.from_buffer("uint32_t[]", bits))
        for bus in Bus:
            own = frames["bus"] == bus
            if own.any():
                self._count(bus, frames["time_us"][own].astype(np.int64), bits[own].astype(np.int64))

    def statistics(self, elapsed_s: float) -> dict[Bus, dict[str, Any]]:
        """Per bus: bit_rate, frames, frames_per_s, load and load_peak (share of the time that the bus is busy)."""
        elapsed_s = max(elapsed_s, WINDOW_US * 1e-6)
        peak = np.maximum(self._busiest, self._in_window)
        return {
            bus: {
                "bit_rate": self._rates[bus],
                "frames": int(self._frames[bus]),
                "frames_per_s": float(self._frames[bus] / elapsed_s),
                "load": float(self._bits[bus] / self._rates[bus] / elapsed_s),
                "load_peak": float(peak[bus] / self._rates[bus] / (WINDOW_US * 1e-6)),
            }
            for bus in Bus
        }

    def _count(self, bus: Bus, time_us: NDArray[np.int64], bits: NDArray[np.int64]) -> None:
        self._frames[bus] += bits.size
        self._bits[bus] += bits.sum()
        windows, place = np.unique(time_us // WINDOW_US, return_inverse=True)
        sums = np.zeros(windows.size, np.int64)
        np.add.at(sums, place, bits)
        if windows[0] == self._window[bus]:
            sums[0] += self._in_window[bus]
        self._busiest[bus] = max(self._busiest[bus], self._in_window[bus], sums.max())
        self._window[bus], self._in_window[bus] = windows[-1], sums[-1]
