"""`raceloop check-params`: the firmware's own validation of an operation configuration, without a car."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console

from bridge._native import ffi, lib
from dbc.frames import FRAME_SIZE, Bus, iterate
from firmware.parameters import Offence, Verdict, check_operation, load_operation
from tools.exit_status import ExitStatus

_OUTBOX = 256


class LoneObc:
    """A fresh onboard computer with nothing on its buses but what it is given."""

    def __init__(self) -> None:
        self._obc = ffi.new("obc *")
        lib.obc_init(self._obc)
        self._frames = ffi.new("can_frame[]", _OUTBOX)
        self._outbox = ffi.new("can_outbox *", {"frames": self._frames, "capacity": _OUTBOX})
        self._now_us = 0

    def tick(self, frames: bytes) -> Iterable[tuple[int, bytes]]:
        """Run 10 ms with these CAN-A frames; gives id and data of what it sent on CAN-A."""
        self._outbox.count = 0
        view = ffi.from_buffer("can_frame[]", frames)
        lib.obc_tick(self._obc, self._now_us, view, len(frames) // FRAME_SIZE, self._outbox)
        self._now_us += lib.EXECUTIVE_FRAME_US
        sent = bytes(ffi.buffer(self._frames, self._outbox.count * FRAME_SIZE))
        return [(frame.id, frame.data) for frame in iterate(sent) if frame.bus == Bus.CAN_A]


def validate(path: Path) -> Verdict:
    """The firmware's verdict on a file.

    Raises
    ------
    ConfigurationError
        When the file is no mapping of names to values at all; what is allowed in it is for the firmware to say.
    """
    return check_operation(load_operation(path), LoneObc().tick)


def check_params(path: Path, console: Console) -> int:
    """Print the verdict with every offence; returns the exit status."""
    verdict = validate(path)
    if verdict.accepted:
        console.print(f"{path}: accepted", markup=False)
        return ExitStatus.DONE
    show_rejected(path, verdict.offences, console)
    return ExitStatus.USER_ERROR


def show_rejected(path: Path, offences: Sequence[Offence], console: Console) -> None:
    """Print every offence: key, value, reason, what is allowed."""
    console.print(f"{path}: rejected, {len(offences)} offence{'s' if len(offences) > 1 else ''}", markup=False)
    for offence in offences:
        console.print(f"  {offence}", markup=False)
