"""Measures an ECU alone on its buses, fed with what it would hear in a lap, and what users have today beside it."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bridge.bus import CHANNELS
from bridge.realtime.cycle_log import CycleLog, read_cycle_log
from bridge.realtime.link import CanLink
from bridge.realtime.placement import Role
from bridge.realtime.supervisor import Ended, Part, Start, Supervisor
from bridge.realtime.wired import WiredIo
from dbc.codec import database
from dbc.errors import RaceloopError
from dbc.frames import Bus
from tools.jitter.background import Background
from tools.jitter.cyclictest import PACKAGE, CyclicTest, may_start
from tools.jitter.figures import Distribution, Stamps
from tools.jitter.measurement import Cycles, Measurement, stamps_of
from tools.jitter.peers import PEERS, peer_command
from tools.jitter.player import player_command
from tools.jitter.receiver import Receiver
from tools.jitter.setup import Setup
from tools.realtime_run import SharedFiles, bus_addresses, ecu_part, hub_part

#: From the moment when all are ready to the first cycle, s: cyclictest begins before it.
_LEAD_S = 1.8

#: How long a look at processes waits for their lines, s.
_POLL_S = 0.01

#: How much longer than it should a peer may take, s.
_PATIENCE_S = 60.0

_PLAYER = "player"


@dataclass(frozen=True)
class _Buses:
    """Buses that are up.

    Attributes
    ----------
    addresses : of each, as links take them.
    python_can : arguments of `can.Bus` for each.
    check : raises `RaceloopError` when what carries them has ended.
    """

    addresses: Mapping[Bus, str]
    python_can: Mapping[Bus, Mapping[str, Any]]
    check: Callable[[], None]


def measure_alone(setup: Setup, stimulus: Path, folder: Path, condition: str) -> Measurement:
    """Let the ECU run beside cyclictest, then each of the peers by itself.

    Parameters
    ----------
    stimulus : file with what the ECU hears, a second longer than the measurement.
    folder : for files of this measurement.
    condition : what else runs, for people.

    Raises
    ------
    RaceloopError
        When a part does not start or ends before its time.
    """
    shared = SharedFiles(folder)
    with setup.options.placement.on_other_cores(), _up(setup, shared) as buses:
        measurement = _measure_ecu(setup, buses, stimulus, shared, condition)
        peers, notes = {}, list(measurement.notes)
        for name in PEERS:
            try:
                peers[name] = _measure_peer(setup, buses, name)
            except RaceloopError as error:
                notes.append(f"{error}; left out")
    return replace(measurement, peers=peers, notes=tuple(notes))


@contextmanager
def _up(setup: Setup, shared: SharedFiles) -> Iterator[_Buses]:
    """The buses: the interfaces that are there, or a hub of this measurement."""
    addresses = bus_addresses(setup.options, shared)
    if setup.options.interfaces is not None:
        channels = zip(setup.options.buses, setup.options.interfaces, strict=True)
        yield _Buses(addresses, {bus: {"interface": "socketcan", "channel": name} for bus, name in channels}, _no_check)
        return
    lines: list[str] = []
    with Supervisor([hub_part(setup.options, shared)], lambda _name, line: lines.append(line)) as hub:
        hub.start()
        while not (port := re.search(r"socketcand 127\.0\.0\.1:(\d+)", "\n".join(lines))):
            _nobody_ends(hub.poll(_POLL_S))
        client = {"interface": "socketcand", "host": "127.0.0.1", "port": int(port[1])}
        interfaces = {bus: client | {"channel": CHANNELS[bus]} for bus in setup.options.buses}
        yield _Buses(addresses, interfaces, lambda: _nobody_ends(hub.poll()))


def _no_check() -> None:
    """An interface that goes down ends nothing here; its frames are missing."""


def _measure_ecu(setup: Setup, buses: _Buses, stimulus: Path, shared: SharedFiles, condition: str) -> Measurement:
    logs = {name: shared.cycle_log(name) for name in (setup.ecu.name, _PLAYER)}
    parts = [
        _player_part(setup, buses, stimulus, shared),
        ecu_part(setup.ecu.name, setup.options, shared, setup.recorded_cycles, setup.period_ns // 1000),
    ]
    links: list[CanLink] = []
    with ExitStack() as exits:
        exits.enter_context(WiredIo(shared.wires, create=True))

        def listen(epoch_ns: int) -> None:
            links.extend(exits.enter_context(CanLink(buses.addresses[bus], bus, epoch_ns)) for bus in setup.ecu.buses)

        supervisor = exits.enter_context(Supervisor(parts, lead_s=_LEAD_S))
        supervisor.start(listen)
        receiver = Receiver(links)
        end_ns = supervisor.epoch_ns + setup.phase_us * 1000 + setup.cycles * setup.period_ns

        def look() -> None:
            receiver.poll()
            buses.check()
            _nobody_ends(supervisor.poll(_POLL_S))

        while not may_start(now_ns := time.monotonic_ns()):
            look()
        test = setup.cyclictest(supervisor.epoch_ns, shared.folder / "cyclictest.json")
        beside = test.start(now_ns)
        if beside is not None:
            exits.enter_context(beside)
        while time.monotonic_ns() < end_ns:
            look()
        supervisor.stop(meanwhile=receiver.poll)
        receiver.poll()
        machine, notes = machine_limit(test, beside)
    log, played = (_first(read_cycle_log(logs[name]), setup.cycles) for name in (setup.ecu.name, _PLAYER))
    frames = receiver.frames()
    return Measurement(
        condition=condition,
        ecu=setup.ecu,
        cycles=Cycles(log),
        frames=frames[frames["time_us"] < (end_ns - supervisor.epoch_ns) // 1000],
        machine=machine,
        notes=(*notes, *receiver_notes(receiver), *_player_notes(played, setup)),
    )


def _player_part(setup: Setup, buses: _Buses, stimulus: Path, shared: SharedFiles) -> Part:
    addresses = {bus: buses.addresses[bus] for bus in setup.ecu.buses}
    command = player_command(setup.ecu, stimulus, shared.wires, addresses, setup.period_ns // 1000)
    command += [f"--cycle-log={shared.cycle_log(_PLAYER)}", *setup.options.placement.options(Role.PLANT)]
    return Part(_PLAYER, tuple(command), Start.PREPARES)


def _measure_peer(setup: Setup, buses: _Buses, name: str) -> Stamps:
    """Stamps of the command's frames when one of the peers sends them."""
    command = database.message(setup.ecu.command)
    arguments = peer_command(
        name, buses.python_can[command.bus], command.name, setup.period_ns / 1e9, setup.cycles * setup.period_ns / 1e9
    )
    arguments += setup.options.placement.options(Role.ECU)
    until = time.monotonic() + setup.seconds + _PATIENCE_S
    epoch_ns = time.monotonic_ns()
    with CanLink(buses.addresses[command.bus], command.bus, epoch_ns) as link, Background(name, arguments) as peer:
        receiver = Receiver([link])
        while peer.running:
            receiver.poll()
            buses.check()
            if time.monotonic() > until:
                raise RaceloopError(f"{name} has not ended in time")
            time.sleep(_POLL_S)
        peer.wait(0.0)
        receiver.poll()
    return stamps_of(command.name, receiver.frames(), epoch_ns)


def machine_limit(test: CyclicTest, beside: Background | None) -> tuple[Distribution | None, list[str]]:
    """What cyclictest has found, and what there is to say about it; beside: None when it is not installed."""
    if beside is None:
        return None, [f"cyclictest is not installed, so the machine's own lateness is not known: apt install {PACKAGE}"]
    try:
        machine = test.finish(beside)
    except RaceloopError as error:
        return None, [f"{error}; left out"]
    worst = machine.figures().maximum
    if worst is not None and worst * 1000.0 >= test.period_ns:
        return machine, [f"the machine stalled: cyclictest itself woke up {worst / 1000.0:.1f} ms late"]
    return machine, []


def receiver_notes(receiver: Receiver) -> list[str]:
    """What the receiver missed."""
    return [f"{receiver.lost} frames did not reach the receiver"] if receiver.lost else []


def _player_notes(log: CycleLog, setup: Setup) -> list[str]:
    """How often the player was too late for the ECU's cycle."""
    due_ns = setup.phase_us * 1000 + log.epoch_ns + log.records["slot"].astype(np.int64) * setup.period_ns
    late = int(np.count_nonzero(log.records["sent_ns"].astype(np.int64) > due_ns)) + int(log.records["skipped"].sum())
    return [f"in {late} cycles the stimulus came after the cycle had begun"] if late else []


def _first(log: CycleLog, cycles: int) -> CycleLog:
    """The log up to the end of the measurement."""
    return replace(log, records=log.records[log.records["slot"] < cycles])


def _nobody_ends(ended: Sequence[Ended]) -> None:
    for one in ended:
        # Who ends by itself says why; who is ended by a signal cannot.
        raise RaceloopError(one.last_line if one.status > 0 and one.last_line else str(one))
