"""Plays a stimulus to an ECU in real time: the station that stands for everybody else."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from bridge._native import ffi, lib
from bridge.realtime.cycle_log import CycleLogWriter
from bridge.realtime.link import CanLink
from bridge.realtime.process import end_with_parent, keep_memory, schedule
from bridge.realtime.station import StopRequest, run_station
from bridge.realtime.supervisor import READY
from bridge.realtime.timer import DeadlineTimer
from bridge.realtime.wired import Cell, WiredIo
from dbc.errors import RaceloopError
from dbc.frames import Bus
from tools.jitter.stimulus import ECUS, Ecu, Stimulus

_TICK_US: int = lib.EXECUTIVE_FRAME_US


class Player:
    """Sends in every slot what the ECU hears in it; after slots that passed unused, theirs too.

    Parameters
    ----------
    ecu : who hears it.
    stimulus : what.
    wires : of the ECU.
    """

    def __init__(self, ecu: Ecu, stimulus: Stimulus, wires: WiredIo) -> None:
        self._stimulus = stimulus
        self._wires = wires
        self._next = 0
        self._wired: Any = None
        if ecu.wired is not None:
            self._cell = Cell[ecu.wired.upper()]
            self._wired = ffi.new(f"{ecu.wired.removesuffix('_in')}_wired_in *")

    @property
    def over(self) -> bool:
        """True when everything was played."""
        return self._next >= self._stimulus.cycles

    def step(self, now_us: int, received: bytes) -> bytes:  # noqa: ARG002 (it hears nothing)
        """Frames that are due, and the wires as they are now."""
        first, self._next = self._next, min(now_us // _TICK_US + 1, self._stimulus.cycles)
        if self._wired is not None and self._next > first:
            ffi.memmove(self._wired, self._stimulus.wired[self._next - 1].tobytes(), ffi.sizeof(self._wired[0]))
            self._wires.write(self._cell, self._wired)
        bounds = self._stimulus.bounds
        return self._stimulus.frames[bounds[first] : bounds[self._next]].tobytes()

    def end(self) -> bytes:
        """Nothing to say at the end."""
        return b""


def player_command(ecu: Ecu, stimulus: Path, wires: Path, addresses: Mapping[Bus, str], period_us: int) -> list[str]:
    """Command line of the player as a process; it asks for its epoch.

    Parameters
    ----------
    stimulus : file of `Stimulus.save`.
    wires : file of the wires.
    addresses : of the ECU's buses, as links take them.
    period_us : of a slot.
    """
    # -P: a folder "tools" where the user happens to be is none of ours.
    command = [sys.executable, "-P", "-m", "tools.jitter.player", ecu.name, str(stimulus), str(wires)]
    return [*command, json.dumps({bus.name: addresses[bus] for bus in ecu.buses}), f"--period={period_us}"]


def main() -> int:
    """Play as the command line says; the same words as a station's."""
    parser = argparse.ArgumentParser(prog="raceloop-player")
    parser.add_argument("ecu", choices=ECUS)
    parser.add_argument("stimulus", type=Path)
    parser.add_argument("wires", type=Path)
    parser.add_argument("addresses", type=json.loads)
    parser.add_argument("--period", type=int, required=True)
    parser.add_argument("--priority", type=int)
    parser.add_argument("--cycle-log", type=Path)
    parser.add_argument("--epoch", choices="-")
    options = parser.parse_args()
    end_with_parent()

    def say(line: str) -> None:
        print(f"raceloop-player: {line}", file=sys.stderr, flush=True)

    try:
        with ExitStack() as exits:
            ecu, stimulus = ECUS[options.ecu], Stimulus.load(options.stimulus)
            player = Player(ecu, stimulus, exits.enter_context(WiredIo(options.wires)))
            schedule(options.priority, None)
            keep_memory(False, say)
            print(READY, flush=True)
            epoch_ns = int(sys.stdin.readline())
            timer = DeadlineTimer(epoch_ns, 0, options.period * 1000)
            links = [
                exits.enter_context(CanLink(address, Bus[name], epoch_ns, []))
                for name, address in options.addresses.items()
            ]
            log = CycleLogWriter(options.cycle_log, "player", timer, stimulus.cycles, options.priority, None)
            stop = exits.enter_context(StopRequest())
            run_station(player, links, timer, exits.enter_context(log), stop, say)
    except RaceloopError as error:
        say(str(error))
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
