"""What users have today to send a frame again and again: python-can's periodic sender, and a plain Python loop.

Run as a program, it is one of them: it sends for a while, then ends.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import can

from dbc.codec import database
from dbc.frames import FRAME_SIZE

READY = "ready"


def send_periodic(bus: can.BusABC, message: can.Message, period_s: float, seconds: float) -> None:
    """python-can's own periodic sender; on SocketCAN that is the kernel's broadcast manager."""
    task = bus.send_periodic(message, period_s)
    time.sleep(seconds)
    task.stop()


def plain_loop(bus: can.BusABC, message: can.Message, period_s: float, seconds: float) -> None:
    """The loop that one writes without further thought, but with a time of its own for every frame."""
    started = due = time.monotonic()
    while due < started + seconds:
        bus.send(message)
        due += period_s
        time.sleep(max(0.0, due - time.monotonic()))


#: By the name under which they appear in tables.
PEERS: Mapping[str, Callable[[can.BusABC, can.Message, float, float], None]] = {
    "python-can send_periodic": send_periodic,
    "plain Python loop": plain_loop,
}


def peer_command(name: str, interface: Mapping[str, Any], message: str, period_s: float, seconds: float) -> list[str]:
    """Command line of one of them.

    Parameters
    ----------
    name : one of `PEERS`.
    interface : arguments of `can.Bus`.
    message : name of the message that it sends, all zero.
    """
    options = [f"--interface={json.dumps(dict(interface))}", f"--message={message}"]
    # -P: a folder "tools" where the user happens to be is none of ours.
    command = [sys.executable, "-P", "-m", "tools.jitter.peers", name, *options]
    return [*command, f"--period-s={period_s!r}", f"--seconds={seconds!r}"]


def main() -> None:
    """Send as the command line says."""
    parser = argparse.ArgumentParser()
    parser.add_argument("name", choices=PEERS)
    parser.add_argument("--interface", type=json.loads, required=True)
    parser.add_argument("--message", required=True)
    parser.add_argument("--period-s", type=float, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--priority", type=int)
    parser.add_argument("--cpu", type=int)
    options = parser.parse_args()
    if options.cpu is not None:
        os.sched_setaffinity(0, {options.cpu})
    if options.priority is not None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(options.priority))
    codec = database.message(options.message)
    assert len(codec.frame(*[0.0] * len(codec.signals))) == FRAME_SIZE
    message = can.Message(arbitration_id=codec.frame_id, is_extended_id=codec.extended, data=bytes(codec.length))
    with can.Bus(**options.interface) as bus:
        PEERS[options.name](bus, message, options.period_s, options.seconds)


if __name__ == "__main__":
    main()
