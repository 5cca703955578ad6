"""Replays a recorded log into a fresh onboard computer.

The log alone is enough: the DBC files say who sends each frame, and a time stamp says in which tick it was seen. In
tick k the onboard computer reads what others sent on CAN1 in tick k - 1 (it runs before the Raptor) and on CAN-S and
CAN-A in tick k (they run before it). Frames that a tap injected under an identifier of the onboard computer itself
cannot be told from its own and are not replayed.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import numpy as np
from can.io.blf import BLFParseError, BLFReader
from can.io.canutils import CanutilsLogReader
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.bus import CHANNELS
from bridge.tap import frame_of
from dbc.codec import Codec
from dbc.codec import database as car
from dbc.errors import ConfigurationError
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Bus, Flag, Station

_TICK_US: int = lib.EXECUTIVE_FRAME_US


@dataclass(frozen=True)
class Replay:
    """Frames of the onboard computer: as recorded and as it sent them again.

    Both are arrays of `FRAME_DTYPE` by tick, within a tick by bus, arbitration and order of sending; times are those
    of the tick, because the moment on the bus is the bus's, not the computer's.
    """

    recorded: NDArray[np.void]
    replayed: NDArray[np.void]

    @property
    def identical(self) -> bool:
        """True when both are the same, bit for bit."""
        return self.recorded.tobytes() == self.replayed.tobytes()

    def first_difference(self) -> int | None:
        """Start of the first tick with a difference, microseconds, or None."""
        common = min(len(self.recorded), len(self.replayed))
        different = np.flatnonzero(self.recorded[:common] != self.replayed[:common])
        if len(different):
            place = int(different[0])
            return int(min(self.recorded["time_us"][place], self.replayed["time_us"][place]))
        longer = self.recorded if len(self.recorded) > common else self.replayed
        return int(longer["time_us"][common]) if len(longer) > common else None


def read_log(path: Path) -> NDArray[np.void]:
    """Read a candump (``.log``) or BLF (``.blf``) recording; array of `FRAME_DTYPE`.

    Raises
    ------
    ConfigurationError
        When it is neither, cannot be read, or names a channel that is no bus of the car.
    """
    if path.suffix not in (".log", ".blf"):
        raise ConfigurationError(path, "", "unknown kind of log; allowed are .log (candump) and .blf")
    buses: dict[Any, Bus] = (
        {name: bus for bus, name in CHANNELS.items()} if path.suffix == ".log" else {int(bus): bus for bus in Bus}
    )
    frames = bytearray()
    try:
        for message in _messages(path):
            bus = buses.get(message.channel)
            if bus is None:
                allowed = ", ".join(str(name) for name in buses)
                raise ConfigurationError(path, f"channel {message.channel}", f"unknown; allowed are {allowed}")
            frames += frame_of(message, bus, round(message.timestamp * 1e6))
    except OSError as error:
        raise ConfigurationError(path, "", error.strerror or "cannot be read") from error
    except (ValueError, BLFParseError, struct.error, zlib.error) as error:
        raise ConfigurationError(path, "", f"not a readable log: {' '.join(str(error).split())}") from error
    return np.frombuffer(bytes(frames), dtype=FRAME_DTYPE)


def replay_obc(log: NDArray[np.void], database: Codec = car) -> Replay:
    """Replay a log that begins at power-on into a fresh onboard computer.

    Parameters
    ----------
    log : array of `FRAME_DTYPE`.
    database : messages of the profile that CAN1 had.
    """
    frames = log.copy()
    frames["sender"] = _senders(frames, database)
    tick = frames["time_us"] // _TICK_US
    own = frames["sender"] == Station.OBC
    heard = ~own & (frames["bus"] != Bus.CAN3) & (frames["bus"] != Bus.CAN_R)
    # CAN1 of the tick before first, then CAN-S, then CAN-A: the order of arrival in the bench.
    delivered = tick + (frames["bus"] == Bus.CAN1)
    arrival = np.choose(frames["bus"], [0, 9, 2, 1, 9])
    inbox = frames[heard][np.lexsort((arrival[heard], delivered[heard]))]
    ticks = int(tick[-1]) + 1 if len(tick) else 0
    bounds = np.searchsorted(np.sort(delivered[heard]), np.arange(ticks + 1))
    recorded = frames[own].copy()
    recorded["time_us"] = tick[own] * _TICK_US
    return Replay(_canonical(recorded), _canonical(np.concatenate([_EMPTY, *_run(inbox, bounds, database.number)])))


_EMPTY: NDArray[np.void] = np.empty(0, dtype=FRAME_DTYPE)


def _run(inbox: NDArray[np.void], bounds: NDArray[np.int64], profile: int) -> Iterator[NDArray[np.void]]:
    obc: Any = ffi.new("obc *")
    lib.obc_init(obc)
    lib.obc_select_profile(obc, profile)
    out: Any = ffi.new("can_outbox *")
    storage: Any = ffi.new("can_frame[]", lib.BENCH_OUTBOX_MAX)
    out.frames, out.capacity = storage, lib.BENCH_OUTBOX_MAX
    for number, (start, stop) in enumerate(pairwise(bounds)):
        out.count = 0
        received = inbox[start:stop].tobytes()
        lib.obc_tick(obc, number * _TICK_US, ffi.from_buffer("can_frame[]", received), int(stop - start), out)
        sent = np.frombuffer(bytes(ffi.buffer(storage, out.count * FRAME_SIZE)), dtype=FRAME_DTYPE).copy()
        sent["time_us"] = number * _TICK_US
        sent["sender"] = Station.OBC
        yield sent


def _canonical(frames: NDArray[np.void]) -> NDArray[np.void]:
    """Order by tick, bus and identifier; frames of one identifier keep their order."""
    ordered: NDArray[np.void] = frames[np.lexsort((frames["id"], frames["bus"], frames["time_us"]))]
    return ordered


def _senders(frames: NDArray[np.void], database: Codec) -> NDArray[np.uint8]:
    """Station behind each frame by the DBC files; NONE for unknown identifiers."""
    senders = np.zeros(len(frames), dtype=np.uint8)
    for message in database:
        chosen = (frames["bus"] == message.bus) & (frames["id"] == message.frame_id)
        senders[chosen & ((frames["flags"] & Flag.EXTENDED != 0) == message.extended)] = message.sender
    return senders


def _messages(path: Path) -> Iterator[can.Message]:
    if path.suffix == ".log":
        with path.open(encoding="ascii") as text:
            yield from CanutilsLogReader(text)
    else:
        with path.open("rb") as binary:
            yield from BLFReader(binary)
