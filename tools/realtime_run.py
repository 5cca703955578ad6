"""A real-time run: the processes of the car on its buses, an observer beside them, and the recording."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge.bus import CHANNELS
from bridge.plant import REQUIRED_OUTPUTS
from bridge.realtime.cycle_log import cycles_written
from bridge.realtime.link import CanLink
from bridge.realtime.observer import Observer
from bridge.realtime.placement import Placement, Role
from bridge.realtime.programs import program
from bridge.realtime.supervisor import Ended, Part, Start, Supervisor
from bridge.realtime.truth_file import TruthFile
from bridge.realtime.vcan import ensure_interfaces
from bridge.realtime.wired import WiredIo
from bridge.recorder import Recorder, Recording
from bridge.safety.limits import SafetyLimits
from bridge.safety.monitor import SafetyMonitor
from bridge.scenario import Scenario
from bridge.surroundings import TICK_US, Ending
from dbc import codec
from dbc.buses import DEFAULT_PROFILE, car_buses
from dbc.errors import RaceloopError
from dbc.frames import Bus
from tools.run import load_road, make_folder

#: When each station's cycle begins within the period, us: the order of lock step.
PHASES_US: Mapping[str, int] = MappingProxyType(
    {"plant": 0, "autonomy": 1500, "obc": 4000, "raptor": 6000, "space-drive": 7000}
)

#: Parts that can be left out.
STATIONS = tuple(PHASES_US)

#: How many times slower than real time a run may be: the period of an executable goes up to a second.
SLOWER = range(1, 101)

HUB = "hub"

#: SocketCAN interfaces of CAN1, CAN3, CANA, CANS and, in a car with the radar, CANR, unless others are given.
INTERFACES = ("vcan0", "vcan1", "vcan2", "vcan3", "vcan4")

_BUSES: Mapping[str, tuple[Bus, ...]] = MappingProxyType(
    {
        "plant": (Bus.CAN1, Bus.CAN_A, Bus.CAN_S, Bus.CAN_R),
        "autonomy": (Bus.CAN_A, Bus.CAN_S, Bus.CAN_R),
        "obc": (Bus.CAN1, Bus.CAN_A, Bus.CAN_S),
        "raptor": (Bus.CAN1, Bus.CAN3),
        "space-drive": (Bus.CAN3,),
    }
)
_ROLES: Mapping[str, Role] = MappingProxyType({"plant": Role.PLANT, "autonomy": Role.AUTONOMY})
_WIRED = ("plant", "raptor", "space-drive")

_MEMORY = Path("/dev/shm")

#: How often frames and truth go into the recording.
_RECORD_US = 100_000

#: Within this time the last frames of the stations have come through the hub.
_LAST_FRAMES_S = 0.05

#: Cycles that a log holds beyond the scenario's time limit.
_SPARE_CYCLES = 6000


@dataclass(frozen=True)
class RealTimeOptions:
    """How a run is set up.

    Attributes
    ----------
    interfaces : SocketCAN interfaces, one for each of the buses; None: the hub.
    hub_port : TCP port on 127.0.0.1 for socketcand clients of the hub; 0 for any that is free.
    without : stations that are left out.
    placement : cores and priorities.
    slower : how many times slower than real time the car lives; its own time stays as it is.
    buses : of the car.
    """

    interfaces: tuple[str, ...] | None = None
    hub_port: int = 0
    without: frozenset[str] = frozenset()
    placement: Placement = field(default_factory=Placement)
    slower: int = 1
    buses: tuple[Bus, ...] = car_buses()

    @property
    def period_us(self) -> int:
        """Real time of one cycle."""
        return TICK_US * self.slower


def make_options(
    bus: str | None = None,
    interfaces: Sequence[str] | None = None,
    hub_port: int | None = None,
    without: Sequence[str] = (),
    priority: int | None = None,
    cpu: int | None = None,
    slower: int = 1,
    buses: tuple[Bus, ...] = car_buses(),
) -> RealTimeOptions:
    """Options from what a user gives.

    Parameters
    ----------
    bus : "hub" or "socketcan"; None for the hub.
    interfaces : names of interfaces for SocketCAN; None for those from vcan0 on.
    hub_port, without, priority, cpu, slower, buses : see `RealTimeOptions`.

    Raises
    ------
    RaceloopError
        When they contradict each other, or name what does not exist.
    """
    for name in without:
        if name not in STATIONS:
            raise RaceloopError(f"--without {name}: no such part; allowed are {', '.join(STATIONS)}")
    if bus == "socketcan":
        if hub_port is not None:
            raise RaceloopError("--port is the hub's; it does not go with --bus socketcan")
        interfaces = INTERFACES[: len(buses)] if interfaces is None else tuple(interfaces)
        if len(set(interfaces)) != len(buses) or len(interfaces) != len(buses) or not all(interfaces):
            raise RaceloopError(
                f"--interfaces {','.join(interfaces)}: must be {len(buses)} different names, of"
                f" {', '.join(CHANNELS[bus] for bus in buses)}"
            )
    elif interfaces is not None:
        raise RaceloopError("--interfaces needs --bus socketcan")
    if slower not in SLOWER:
        raise RaceloopError(f"--slower {slower}: must be {SLOWER.start} to {SLOWER.stop - 1}")
    placement = Placement(priority, cpu)
    chosen = None if interfaces is None else tuple(interfaces)
    return RealTimeOptions(chosen, hub_port or 0, frozenset(without), placement, slower, buses)


@dataclass(frozen=True)
class SharedFiles:
    """Files through which the processes of a run meet."""

    folder: Path

    @property
    def hub(self) -> Path:
        """The hub's local socket."""
        return self.folder / "hub"

    @property
    def wires(self) -> Path:
        """Wires between plant and actuator ECUs."""
        return self.folder / "wires"

    @property
    def clouds(self) -> Path:
        """LiDAR points from the plant to autonomy."""
        return self.folder / "clouds"

    @property
    def truth(self) -> Path:
        """The plant's outputs."""
        return self.folder / "truth"

    def cycle_log(self, station: str) -> Path:
        """The cycle log of a station."""
        return self.folder / f"{station}.cycles"


def shared_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder in memory whose name holds the process; those of processes that were killed are removed."""
    folder = _MEMORY if _MEMORY.is_dir() else Path(tempfile.gettempdir())
    for left in folder.glob("raceloop-run-*"):
        process = left.name.split("-")[2]
        if process.isdecimal() and not Path(f"/proc/{process}").exists() and left.stat().st_uid == os.getuid():
            shutil.rmtree(left, ignore_errors=True)
    return tempfile.TemporaryDirectory(prefix=f"raceloop-run-{os.getpid()}-", dir=folder)


def make_parts(scenario: Scenario, options: RealTimeOptions, shared: SharedFiles) -> dict[str, Part]:
    """All parts of a run by name, those that are left out too.

    Raises
    ------
    RaceloopError
        When an executable is not installed.
    """
    parts = {} if options.interfaces is not None else {HUB: hub_part(options, shared)}
    cycles = scenario.time_limit_us // TICK_US + _SPARE_CYCLES
    for name, phase_us in PHASES_US.items():
        role = _ROLES.get(name, Role.ECU)
        if role is Role.ECU:
            parts[name] = ecu_part(name, options, shared, cycles, options.period_us, scenario.profile)
        else:
            # -P: a folder "tools" where the user happens to stand is none of ours.
            command = [
                sys.executable,
                "-P",
                "-m",
                "tools.station",
                name,
                str(scenario.path),
                f"--profile={scenario.profile}",
            ]
            command += _station_arguments(name, options, shared, cycles)
            command += [f"--truth={shared.truth}"] if name == "plant" else []
            command += [f"--clouds={shared.clouds}"]
            command += [f"--phase={phase_us * options.slower}", f"--period={options.period_us}"]
            command += options.placement.options(role)
            # An FMU is unpacked where the run's folder takes it along, however the process ends.
            parts[name] = Part(name, tuple(command), Start.PREPARES, environment={"TMPDIR": str(shared.folder)})
    return parts


def hub_part(options: RealTimeOptions, shared: SharedFiles) -> Part:
    """The hub of a run.

    Raises
    ------
    RaceloopError
        When the executable is not installed.
    """
    command = [str(program("raceloop-hub")), f"--local={shared.hub}", f"--port={options.hub_port}", "--with-parent"]
    command += options.placement.options(Role.HUB)
    return Part(HUB, tuple(command), Start.SERVICE, partial(_listens, shared.hub))


def ecu_part(
    name: str,
    options: RealTimeOptions,
    shared: SharedFiles,
    cycles: int,
    period_us: int = TICK_US,
    profile: str = DEFAULT_PROFILE,
) -> Part:
    """An ECU of a run.

    Parameters
    ----------
    name : of `STATIONS`.
    cycles : that its log holds.
    period_us : of its cycle; its phase keeps its place within the period.
    profile : that CAN1 has.

    Raises
    ------
    RaceloopError
        When the executable is not installed.
    """
    command = [str(program(f"raceloop-{name}")), *_station_arguments(name, options, shared, cycles)]
    command += [f"--phase={PHASES_US[name] * period_us // TICK_US}", f"--period={period_us}"]
    command += [f"--profile={profile}"] if Bus.CAN1 in _BUSES[name] else []
    command += options.placement.options(Role.ECU)
    return Part(name, tuple(command), is_ready=partial(_has_begun, shared.cycle_log(name)))


def _station_arguments(name: str, options: RealTimeOptions, shared: SharedFiles, cycles: int) -> list[str]:
    """What the command line of every station has."""
    addresses = bus_addresses(options, shared)
    arguments = [f"--bus={CHANNELS[bus]}={addresses[bus]}" for bus in _BUSES[name] if bus in addresses]
    arguments += [f"--wired={shared.wires}"] if name in _WIRED else []
    return [*arguments, f"--cycle-log={shared.cycle_log(name)}", f"--cycles={cycles}", "--with-parent"]


def bus_addresses(options: RealTimeOptions, shared: SharedFiles) -> dict[Bus, str]:
    """Address of each bus, as links take it."""
    if options.interfaces is None:
        return dict.fromkeys(options.buses, f"hub:{shared.hub}")
    return {bus: f"socketcan:{name}" for bus, name in zip(options.buses, options.interfaces, strict=True)}


def _has_begun(log: Path) -> bool:
    return cycles_written(log) is not None


def _listens(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as knock:
        try:
            knock.connect(str(path))
        except OSError:
            return False
    return True


class RealTimeRun:
    """A run from power-on; a context manager that ends all processes on the way out.

    `start`, then `poll` at least every 20 ms, then `finish`.

    Parameters
    ----------
    scenario : what to run.
    options : on what buses, which are those of the scenario's car, and where.
    on_line : takes name and line of what a part logs.

    Attributes
    ----------
    scenario, options : as given.
    parts : all parts by name, those left out too.
    links : of the observer, one per bus, once the run has started.
    supervisor, safety, observer : of the run; the observer is there once the run has started.
    shared : the processes' files; gone when the run is left.
    speed_mps : newest true speed; None without a plant.
    plant_report : what the plant says about the run when it ends; empty before, or when it did not come to that.

    Raises
    ------
    RaceloopError
        When the run cannot be set up here: no CAN, no executable, no such core, no permission.
    """

    observer: Observer

    def __init__(
        self,
        scenario: Scenario,
        options: RealTimeOptions,
        on_line: Callable[[str, str], None] = lambda _name, _line: None,
    ) -> None:
        options.placement.check()
        if options.interfaces is not None:
            ensure_interfaces(options.interfaces)
        self._on_line = on_line
        self._exits = ExitStack()
        self.shared = SharedFiles(Path(self._exits.enter_context(shared_folder())))
        try:
            self.scenario = scenario
            self.options = options
            # Now: when it starts, power-on is near, and reading files takes its time.
            self.safety = SafetyMonitor(
                SafetyLimits.of_scenario(scenario),
                codec.profile(scenario.profile),
                () if "plant" in options.without else REQUIRED_OUTPUTS,
                load_road(scenario, scenario.track).boundaries(),
            )
            self.parts = make_parts(scenario, options, self.shared)
            self._wires = self._exits.enter_context(WiredIo(self.shared.wires, create=True))
            present = [part for name, part in self.parts.items() if name not in options.without]
            self.supervisor = self._exits.enter_context(Supervisor(present, self._forward))
        except BaseException:
            self._exits.close()
            raise
        self._started = False
        self._recorder: Recorder | None = None
        self.links: list[CanLink] = []
        self._truth: TruthFile | None = None
        self._next_record_us = 0
        self.speed_mps: float | None = None
        self.plant_report: dict[str, Any] = {}

    def __enter__(self) -> RealTimeRun:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._exits:
            self.supervisor.stop()
            if self._recorder is None:
                return
            if self._started:
                self._recorder.finish()  # an error ends the run; what it has come to is not lost
            else:
                self._recorder.abort()

    @property
    def ending(self) -> Ending | None:
        """How the plant says that the run has ended; None while it goes on, or when something else has ended it."""
        reason = self.plant_report.get("reason")
        return Ending(reason) if reason in {ending.value for ending in Ending} else None

    @property
    def now_us(self) -> int:
        """The car's time, since the epoch; negative before it."""
        return (time.monotonic_ns() - self.supervisor.epoch_ns) // (1000 * self.options.slower)

    def seconds(self, time_ns: int) -> float:
        """The car's time, s, at a time on CLOCK_MONOTONIC."""
        return (time_ns - self.supervisor.epoch_ns) * 1e-9 / self.options.slower

    def addresses(self) -> dict[Bus, str]:
        """Address of each bus."""
        return bus_addresses(self.options, self.shared)

    def cycles(self) -> dict[str, int]:
        """Cycles that each running station has made so far."""
        counts = ((name, cycles_written(self.shared.cycle_log(name))) for name in self.supervisor.running)
        return {name: count for name, count in counts if count is not None}

    def start(self, folder: Path | None = None) -> None:
        """Start all processes; power-on is the epoch, about a second ahead when this returns.

        Parameters
        ----------
        folder : of the recording; None for no recording.

        Raises
        ------
        RaceloopError
            When a part does not start; nothing is left running.
        """
        self._exits.enter_context(self.options.placement.on_other_cores())
        self.supervisor.start(partial(self._attach, folder))
        self._started = True

    def poll(self, timeout_s: float = 0.005) -> list[Ended]:
        """Look at processes and buses; returns the processes that have ended since the last call."""
        ended = self.supervisor.poll(timeout_s)
        now_us = self.now_us
        self.observer.poll(now_us)
        if now_us >= self._next_record_us:
            self._next_record_us = now_us + _RECORD_US
            self._take_truth()
        return ended

    def restart(self, name: str) -> None:
        """Start a part again that has ended; its cycle log so far is kept beside the new one."""
        log = self.shared.cycle_log(name)
        if log.exists():
            earlier = len(list(self.shared.folder.glob(f"{name}.*.cycles"))) + 1
            log.rename(self.shared.cycle_log(f"{name}.{earlier}"))
        self.supervisor.restart(name)

    def finish(self, folder: Path | None = None) -> Recording | None:
        """End all processes and complete the recording; frames up to the last are in it.

        Parameters
        ----------
        folder : gets the cycle logs.
        """
        self.supervisor.stop_stations(meanwhile=lambda: self.observer.poll(self.now_us))
        self.supervisor.poll(_LAST_FRAMES_S)
        self._take_truth()
        self.observer.finish()
        self.safety.finish()
        for link in self.links:
            link.close()
        self.supervisor.stop()
        if folder is not None:
            folder.mkdir(exist_ok=True)
            for log in sorted(self.shared.folder.glob("*.cycles")):
                shutil.copyfile(log, folder / log.name)
        if self._recorder is None:
            return None
        recorder, self._recorder = self._recorder, None
        return recorder.finish()

    def command_line(self, name: str) -> str:
        """The command that starts a part by hand, for this run."""
        words = [word for word in self.parts[name].command if word != "--with-parent"]
        return shlex.join([*words, f"--epoch={self.supervisor.epoch_ns}"])

    def _forward(self, name: str, line: str) -> None:
        """Pass on a line of a log; the plant's last one is its report."""
        if name == "plant" and line.startswith("{"):
            self.plant_report = json.loads(line)
        else:
            self._on_line(name, line)

    def _attach(self, folder: Path | None, epoch_ns: int) -> None:
        """Listen to all buses and open the recording, before any station sends."""
        for bus, address in self.addresses().items():
            self.links.append(self._exits.enter_context(CanLink(address, bus, epoch_ns)))
        if self.shared.truth.exists():
            self._truth = self._exits.enter_context(TruthFile(self.shared.truth))
        if folder is not None:
            make_folder(folder)
            names, units = ((), ()) if self._truth is None else (self._truth.names, self._truth.units)
            self._recorder = Recorder(folder, names, units, self.scenario.profile, keep=True)
        database = codec.profile(self.scenario.profile)
        self.observer = Observer(self.links, self._take_frames, self.options.slower, database)

    def _take_frames(self, frames: NDArray[np.void]) -> None:
        self.safety.update(frames)
        if self._recorder is not None:
            self._recorder.add_frames(frames)

    def _take_truth(self) -> None:
        if self._truth is None:
            return
        rows = self._truth.take()
        if not len(rows):
            return
        self.speed_mps = float(rows[-1, 1 + self._truth.names.index("vx")])
        for row in rows:
            self.safety.add_truth(int(row[0]), row[1 : 1 + len(REQUIRED_OUTPUTS)])
            if self._recorder is not None:
                self._recorder.add_truth(int(row[0]), row[1:])
        if self._recorder is not None:
            self._recorder.flush()
