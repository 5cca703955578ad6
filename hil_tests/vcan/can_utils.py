"""The programs of can-utils as processes of a test."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from dbc.buses import Bus

INTERFACES = {bus: f"vcan{int(bus)}" for bus in Bus}
PATIENCE_S = 60.0
RECEIVE_BUFFER = 8_000_000
"""Bytes, as far as the system allows it: candump may be kept from running for a while."""


@contextmanager
def process(*command: str, output: IO[str] | None = None) -> Iterator[subprocess.Popen[str]]:
    """A program whose output is read as text or goes to a file; ended with the block whatever happens."""
    with subprocess.Popen(command, stdout=output or subprocess.PIPE, text=True) as running:
        try:
            yield running
        finally:
            running.kill()


@contextmanager
def candump(output: IO[str] | None = None) -> Iterator[subprocess.Popen[str]]:
    """Have candump write its log format to its standard output; the block begins when it hears all interfaces."""
    interfaces = tuple(INTERFACES.values())
    before = listeners(interfaces)
    with process("candump", "-L", "-r", str(RECEIVE_BUFFER), *interfaces, output=output) as running:

        def listens() -> bool:
            assert running.poll() is None, "candump has ended"
            return all(now > then for now, then in zip(listeners(interfaces), before, strict=True))

        until(listens, "candump to listen")
        yield running


def until(condition: Callable[[], bool], what: str) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited {PATIENCE_S} s for {what}"
        time.sleep(0.02)


def listeners(interfaces: Sequence[str]) -> list[int]:
    """How many raw sockets hear everything on an interface, as the kernel lists them."""
    rows = [line.split() for line in Path("/proc/net/can/rcvlist_all").read_text().splitlines()]
    return [sum(bool(row) and row[0] == interface for row in rows) for interface in interfaces]


def read_lines(running: subprocess.Popen[str], count: int) -> list[str]:
    """The next lines of a program that has them or will have them at once."""
    assert running.stdout is not None
    return [running.stdout.readline() for _ in range(count)]
