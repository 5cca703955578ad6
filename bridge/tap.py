"""Taps: python-can interfaces on the bench's buses, to watch the traffic or to take part in it."""

from __future__ import annotations

from collections.abc import Mapping

import can
import numpy as np
from numpy.typing import NDArray

from bridge.bus import CHANNELS
from dbc.errors import BusError, ConfigurationError
from dbc.frames import FRAME_STRUCT, Bus, Flag, Station, iterate

#: Frames taken from one tap in one tick, so that a flood from outside cannot stop the loop.
RECEIVE_MAX = 64


class Taps:
    """Mirrors transmitted frames to python-can buses and takes in what arrives there.

    Frames from a tap enter their bus as of an unknown station at the start of the next tick. They are not mirrored
    back to where they came from.

    Parameters
    ----------
    buses : open python-can bus by channel name: CAN1, CAN3, CANA, CANS, CANR.

    Raises
    ------
    ConfigurationError
        When a name is none of these.
    """

    def __init__(self, buses: Mapping[str, can.BusABC]) -> None:
        by_name = {name: bus for bus, name in CHANNELS.items()}
        for name in buses:
            if name not in by_name:
                raise ConfigurationError("taps", name, f"unknown bus; allowed are {', '.join(by_name)}")
        self._taps = {by_name[name]: tap for name, tap in buses.items()}

    def save_state(self) -> None:
        """What is outside cannot be taken back.

        Raises
        ------
        BusError
            Always.
        """
        raise BusError("a bench with taps cannot be saved: what is outside does not go back")

    def receive(self) -> bytes:
        """Frames that have arrived from outside, ready to submit; never blocks."""
        frames = []
        for bus, tap in self._taps.items():
            for _ in range(RECEIVE_MAX):
                try:
                    message = tap.recv(timeout=0.0)
                except can.CanError as error:
                    raise BusError(f"tap {CHANNELS[bus]}: {error}") from error
                if message is None:
                    break
                if not message.is_fd:  # the car has classic CAN
                    frames.append(frame_of(message, bus))
        return b"".join(frames)

    def mirror(self, frames: NDArray[np.void]) -> None:
        """Send transmitted frames out."""
        for bus, tap in self._taps.items():
            chosen = frames[(frames["bus"] == bus) & (frames["sender"] != Station.NONE)]
            for frame in iterate(chosen.tobytes()):
                message = can.Message(
                    timestamp=frame.time_us * 1e-6,
                    arbitration_id=frame.id,
                    is_extended_id=bool(frame.flags & Flag.EXTENDED),
                    is_remote_frame=bool(frame.flags & Flag.REMOTE),
                    dlc=frame.dlc,
                    data=None if frame.flags & Flag.REMOTE else frame.data[: frame.dlc],
                )
                try:
                    tap.send(message)
                except can.CanError as error:
                    raise BusError(f"tap {CHANNELS[bus]}: {error}") from error


def frame_of(message: can.Message, bus: Bus, time_us: int = 0) -> bytes:
    """24-byte frame of a python-can message, from an unknown station."""
    flags = (
        Flag.EXTENDED * message.is_extended_id
        | Flag.REMOTE * message.is_remote_frame
        | Flag.ERROR * message.is_error_frame
    )
    data = bytes(message.data)[:8].ljust(8, b"\0")
    return FRAME_STRUCT.pack(time_us, message.arbitration_id, bus, message.dlc, flags, Station.NONE, data)
