"""The programs of can-utils as processes of a test."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from dbc.buses import Bus

INTERFACES = {bus: f"vcan{int(bus)}" for bus in Bus}
PATIENCE_S = 30.0


@contextmanager
def process(*command: str) -> Iterator[subprocess.Popen[str]]:
    """A program whose output is read as text; ended with the block whatever happens."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield running
        finally:
            running.kill()


@contextmanager
def candump(*options: str, interfaces: Sequence[str] = tuple(INTERFACES.values())) -> Iterator[subprocess.Popen[str]]:
    """Have candump write its log format to its standard output; the block begins when it hears all interfaces."""
    before = listeners(interfaces)
    with process("candump", "-L", *options, *interfaces) as running:
        deadline = time.monotonic() + PATIENCE_S
        while any(now <= then for now, then in zip(listeners(interfaces), before, strict=True)):
            assert running.poll() is None, "candump has ended"
            assert time.monotonic() < deadline, "candump does not listen"
            time.sleep(0.01)
        yield running


def listeners(interfaces: Sequence[str]) -> list[int]:
    """How many raw sockets hear everything on an interface, as the kernel lists them."""
    rows = [line.split() for line in Path("/proc/net/can/rcvlist_all").read_text().splitlines()]
    return [sum(bool(row) and row[0] == interface for row in rows) for interface in interfaces]


def read_lines(running: subprocess.Popen[str], count: int) -> list[str]:
    """The next lines of a program that has them or will have them at once."""
    assert running.stdout is not None
    return [running.stdout.readline() for _ in range(count)]
