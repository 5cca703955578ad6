"""What the user names to be checked or watched: a recording, or buses in use."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dbc.errors import RaceloopError
from dbc.frames import Bus
from tools.dbw.chunk import OnBroken
from tools.dbw.live_source import LiveSource, looks_live, parse
from tools.dbw.log_source import read_chunks
from tools.stop_signal import asked_to_stop


def is_live(sources: Sequence[str]) -> bool:
    """Whether these are buses in use.

    Raises
    ------
    RaceloopError
        When they are neither one recording nor buses only, or a bus is there twice.
    """
    live = [looks_live(source) and not Path(source).exists() for source in sources]
    if len(sources) > 1 and not all(live):
        raise RaceloopError(f"{sources[live.index(False)]}: either one recording, or one or more buses in use")
    return all(live)


def read_source(
    sources: Sequence[str], bus: Bus | None, seconds: float | None, on_broken: OnBroken
) -> Iterator[NDArray[np.void]]:
    """Frames of a recording, or of buses in use until Ctrl-C or for some time.

    Parameters
    ----------
    sources : a file, or addresses ``[BUS=]INTERFACE:CHANNEL``.
    bus : on which all frames are, whatever their channel is called; None: by the channel.
    seconds : how long to listen; None: until Ctrl-C.
    on_broken : takes how many frames there were before, and what cannot be read there.

    Yields
    ------
    array of `FRAME_DTYPE`
        Pieces that do not grow with the length; of buses in use also empty ones, several a second.

    Raises
    ------
    RaceloopError
        When nothing can be read at all.
    """
    if not is_live(sources):
        if seconds is not None:
            raise RaceloopError(f"--seconds is for buses in use; {sources[0]} is none")
        yield from read_chunks(Path(sources[0]), bus, on_broken)
        return
    addresses = [parse(source, bus) for source in sources]
    for number, address in enumerate(addresses):
        if address.bus in [other.bus for other in addresses[:number]]:
            raise RaceloopError(
                f"{address.text}: {address.bus.label} is there twice; say which it is: BUS={address.text}"
            )
    with LiveSource(addresses, on_broken) as source, asked_to_stop() as stopped:
        yield from source.chunks(seconds, stopped)
