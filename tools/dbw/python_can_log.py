"""Reads what nobody but python-can has a reader for, message by message; and keeps its complaints off the terminal."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO

import can

from bridge.tap import frame_of
from dbc.errors import RaceloopError
from tools.dbw.channels import BusOf
from tools.dbw.chunk import OnBroken

_MAGIC = (b"MDF     ", b"UnFinMF ")


def read_mf4(binary: IO[bytes], bus_of: BusOf, on_broken: OnBroken) -> Iterator[bytes]:
    """Frames out of an MF4 log, ASAM's measurement data format, which has to be in memory as a whole.

    Parameters
    ----------
    binary : the file, at its beginning.
    bus_of : gives the bus of a channel, which counts from 0.
    on_broken : called for what python-can passes over, and where it gives up.

    Raises
    ------
    NotImplementedError
        When the package for it, asammdf, is not there.
    """
    count = 0
    content = binary.read()
    if not content.startswith(_MAGIC):
        on_broken(0, "no header of an MF4 log")
        return
    try:
        with complaints(lambda text: on_broken(count, text)), complaints(lambda _text: None, "asammdf"):
            for message in can.MF4Reader(io.BytesIO(content)):
                count += 1
                yield frame_of(message, bus_of(message.channel), max(round(message.timestamp * 1e6), 0))
    except (RaceloopError, NotImplementedError):
        raise
    # asammdf raises what the packages raise that it unpacks with, and they need not be there to be named here.
    except Exception as error:
        on_broken(count, f"breaks off: {' '.join(str(error).split()) or type(error).__name__}")


@contextmanager
def complaints(take: Callable[[str], None], name: str = "can") -> Iterator[None]:
    """Take what a package logs of what it does not like, instead of having it on standard error.

    Parameters
    ----------
    take : gets each of its warnings and errors in a line.
    name : of the package's logger.
    """

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            take(" ".join(record.getMessage().split())[:80])

    handler, logger = Handler(logging.WARNING), logging.getLogger(name)
    before, logger.handlers = logger.handlers, [handler]
    passed_on, logger.propagate = logger.propagate, False
    try:
        yield
    finally:
        logger.handlers, logger.propagate = before, passed_on
