"""A car in real time for fault tests: its processes in the test's hand, and a receiver of its own on every bus.

The receiver is none of the run's parts. It has links of its own, sends nothing, and takes the kernel's stamps, so what
it says about a reaction does not depend on when the test looked. All times are the car's, which may live slower than
the clock on the wall.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np
import pyarrow.parquet as pq
import yaml
from numpy.typing import NDArray
from reaction_times import EMERGENCY_STOP, reactions_to

from bridge._native import ffi, lib
from bridge.operator import LAUNCH_PERIOD_US
from bridge.realtime.cycle_log import read_cycle_log
from bridge.realtime.link import CanLink, Filter
from bridge.realtime.supervisor import Ended
from bridge.realtime.wired import Cell, WiredIo
from bridge.recorder import Recording
from bridge.scenario import load_scenario
from dbc.codec import database
from dbc.errors import ConfigurationError
from dbc.frames import FRAME_DTYPE, Bus
from dbc.states import SysState
from tools.realtime_run import PHASES_US, RealTimeOptions, RealTimeRun
from tools.run import find_scenario

BOUND_S = 60.0
"""Of the car's time. Generous: waits end as soon as what they wait for has happened."""

MOVING = 4.0
"""m/s. Faster than this, the car drives."""

STANDING = 0.05
"""m/s. Slower than this for SETTLED_US, it stands."""

SETTLED_US = 500_000
"""A car that stops rocks on its tyres, so that its speed passes through zero several times in half a second."""

STEERED_BRAKE_KPA = 3500.0  # the least that a full brake is
FULL_BRAKE_PA, STEERED_BRAKE_PA = 4.5e6, 3.5e6

_BUSY = """
import os, sys, time
core, seconds, priority = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
os.sched_setaffinity(0, {core})
if priority:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
begun_ns = time.monotonic_ns()
while time.monotonic_ns() < begun_ns + seconds * 1e9:
    pass
print(begun_ns)
"""

_PAUSE = """
import os, signal, sys, time
process, seconds, priority = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
os.kill(process, signal.SIGSTOP)
time.sleep(seconds)
os.kill(process, signal.SIGCONT)
"""

_FLOOD = """
import sys, time
from bridge.realtime.cycle_log import read_cycle_log
from bridge.realtime.link import CanLink
from dbc.frames import Bus, Frame
bus, end = Bus(int(sys.argv[2])), time.monotonic() + float(sys.argv[3])
frames = Frame(0, 0, bus, 8, 0, 0, bytes(8)).pack() * 64
with CanLink(sys.argv[1], bus) as link:
    while time.monotonic() < end:
        link.send(frames)
    print(link.statistics.sent)
"""

Signals = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Witness:
    """Frames that show whether a station brakes.

    Attributes
    ----------
    messages : that show it, each in every frame.
    brakes : whether each frame of a message shows the reaction, from the message's signals.
    """

    messages: tuple[str, ...]
    brakes: Callable[[Signals], NDArray[np.bool_]]


WITNESSES = {
    # The Raptor hears a full brake on CAN1.
    "obc": Witness(("brake_pressure_cmd",), lambda signals: signals["brake_pressure_cmd"] >= STEERED_BRAKE_KPA),
    # The Space Drive hears on CAN3 as much: count 0 would be 6000 kPa, the middle of the scale none. Half a count is
    # rounding.
    "raptor": Witness(
        ("req_brake_pos",),
        lambda signals: signals["contrl_pos_brk"] <= 0.5 + 0x4000 * (1.0 - STEERED_BRAKE_KPA / 6000.0),
    ),
    # The Space Drive tells on CAN3 that it brakes by itself, in one of both messages in every cycle.
    "space-drive": Witness(("stat_steer_1", "stat_brk_1"), lambda signals: signals["emr_brk"] == 1),
    # A state of the SSM from EMERGENCY on, on CAN-A.
    EMERGENCY_STOP: Witness(("ssm_status",), lambda signals: signals["ssm_state"] >= lib.SSM_EMERGENCY),
}

_HEARD = (
    *(message for witness in WITNESSES.values() for message in witness.messages),
    *("accelerator_cmd", "ct_report", "misc_report", "diagnostic_report", "calb_brake_pos_1", "launch_request"),
)


class Receiver:
    """Hears the messages that matter here on all buses.

    Parameters
    ----------
    addresses : of the buses.
    epoch_ns : of the run.
    slower : how many times slower than real time the car lives.
    """

    def __init__(self, addresses: Mapping[Bus, str], epoch_ns: int, slower: int = 1) -> None:
        messages = [database.message(name) for name in _HEARD]
        self.links = [
            CanLink(address, bus, epoch_ns, [Filter(one.frame_id) for one in messages if one.bus == bus])
            for bus, address in addresses.items()
            if any(one.bus == bus for one in messages)
        ]
        self._slower = slower
        self._frames: list[NDArray[np.void]] = []

    def poll(self) -> None:
        """Take what has come in."""
        for link in self.links:
            while (frames := link.receive()).size:
                self._frames.append(frames.copy())
                self._frames[-1]["time_us"] //= self._slower

    def columns(self, message: str) -> tuple[NDArray[np.int64], Signals]:
        """Times in us since the epoch, and the signals, of all frames of a message."""
        self._frames = [np.concatenate(self._frames)] if self._frames else [np.zeros(0, FRAME_DTYPE)]
        frames, codec = self._frames[0], database.message(message)
        own = frames[(frames["bus"] == codec.bus) & (frames["id"] == codec.frame_id) & (frames["flags"] == 0)]
        decoded = database.decode_columns(own).get(message)
        if decoded is None:
            return np.zeros(0, np.int64), {name: np.zeros(0) for name in codec.signals}
        times = next(iter(decoded.values()))[0].astype(np.int64)
        return times, {name: column for name, (_, column) in decoded.items()}

    def newest(self, message: str) -> dict[str, float]:
        """Signals of the newest frame of a message; empty when there is none."""
        times, signals = self.columns(message)
        return {name: float(column[-1]) for name, column in signals.items()} if times.size else {}

    def braking(self, witness: str) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Times of the frames of a witness, in order, and whether each shows the reaction."""
        shown = WITNESSES[witness]
        pieces = [self.columns(message) for message in shown.messages]
        times = np.concatenate([piece[0] for piece in pieces])
        brakes = np.concatenate([shown.brakes(piece[1]) for piece in pieces])
        order = np.argsort(times, kind="stable")
        return times[order], brakes[order]

    def brakes_since(self, witness: str) -> int | None:
        """Time of the first frame from which on all show the reaction; None when the newest does not."""
        times, brakes = self.braking(witness)
        if not times.size or not brakes[-1]:
            return None
        released = np.flatnonzero(~brakes)
        return int(times[released[-1] + 1 if released.size else 0])

    def close(self) -> None:
        for link in self.links:
            link.close()


@dataclass(frozen=True)
class Measured:
    """A reaction as it was seen.

    Attributes
    ----------
    fault : what was done, for people.
    by : who reacted.
    deadline_us, took_us : from the fault.
    """

    fault: str
    by: str
    deadline_us: int
    took_us: int


def quick_scenario(folder: Path, chequered_m: float | None = None) -> Path:
    """short_drive without the pauses that people make: the car moves after four seconds.

    Parameters
    ----------
    folder : gets the file.
    chequered_m : distance at which the car is told to stop; None for never.
    """
    origin = find_scenario("short_drive")
    content = yaml.safe_load(origin.read_text())
    content |= {key: str(origin.parent / content[key]) for key in ("track", "vehicle", "operation")}
    content["safety_switch"] = [
        {"when": {"time_s": 0.0}, "position": 3},
        {"when": {"sys_state": "ACT_TEST_PASSED", "ct_state": "ACT_TEST"}, "position": 4},
    ]
    content["race_control"] = [
        {"when": {"time_s": 0.0}, "set": {"track_flag": "RED", "vehicle_flag": "NONE", "round_target_speed_mph": 0}},
        {"when": {"sys_state": "CRANK_CHECKS_PASSED"}, "set": {"track_flag": "ORANGE"}},
        {"when": {"ct_state": "RACEREADY"}, "set": {"track_flag": "YELLOW", "round_target_speed_mph": 31}},
    ]
    if chequered_m is not None:
        content["race_control"].append({"when": {"distance_m": chequered_m}, "set": {"vehicle_flag": "CHEQUERED"}})
    path = folder / "quick_drive.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


class Car:
    """A car that runs in real time.

    Attributes
    ----------
    run : the run.
    receiver : hears its buses.
    lines : what the parts have logged: name and line.
    ended : parts whose processes have ended.
    """

    def __init__(self, run: RealTimeRun, receiver: Receiver, lines: Sequence[tuple[str, str]], wires: WiredIo) -> None:
        self.run = run
        self.receiver = receiver
        self.lines = lines
        self.ended: list[Ended] = []
        self._moved_us = 0
        self._wires = wires
        self._drive: Any = ffi.new("space_drive_wired_out *")

    def poll(self) -> None:
        """One look at everything."""
        self.ended += self.run.poll(0.002)
        self.receiver.poll()
        if abs(self.speed) >= STANDING:
            self._moved_us = self.run.now_us

    def until(self, condition: Callable[[], object], what: str, bound_s: float = BOUND_S) -> None:
        """Let the run go on until a condition holds."""
        end_us = self.run.now_us + bound_s * 1e6
        while not condition():
            assert self.run.now_us < end_us, f"waited {bound_s} s for {what}; {self.story()}"
            self.poll()

    def watch(self, seconds: float) -> None:
        """Let the run go on for a while, to see that something does not happen."""
        end_us = self.run.now_us + seconds * 1e6
        while self.run.now_us < end_us:
            self.poll()

    def story(self) -> str:
        """What is known, for a test that fails."""
        states = {name: self.receiver.newest(name) for name in ("ssm_status", "misc_report", "ct_report")}
        lines = "\n".join(f"  {name}: {line}" for name, line in self.lines)
        ended = [str(one) for one in self.ended]
        monitor = self.run.observer.monitor
        events = "\n".join(f"  {one}" for one in (*monitor.transitions[-12:], *monitor.faults[-12:]))
        return (
            f"speed {self.speed}, {states}, ended {ended}, logged:\n{lines}\nlate cycles:\n{self._late_cycles()}"
            f"\nlast transitions and faults:\n{events}"
        )

    def _late_cycles(self) -> str:
        """When stations came late, and how long they waited for a core: a machine that stalls, or a program."""
        rows = []
        for name in PHASES_US:
            try:
                records = read_cycle_log(self.run.shared.cycle_log(name)).records
            except ConfigurationError:
                continue
            for record in records[records["skipped"] > 0][-5:]:
                late_ms = (int(record["wake_ns"]) - int(record["deadline_ns"])) * 1e-6 + 10 * int(record["skipped"])
                waited_ms = int(record["run_queue_ns"]) * 1e-6
                rows.append(f"  {name}, slot {record['slot']}: {late_ms:.1f} ms, for a core {waited_ms:.1f} ms")
        return "\n".join(rows)

    @property
    def speed(self) -> float:
        """True speed, m/s."""
        return 0.0 if self.run.speed_mps is None else self.run.speed_mps

    @property
    def stands(self) -> bool:
        """The car has come to rest, and stays there."""
        return self.run.now_us - self._moved_us > SETTLED_US

    def says(self, message: str, signal_name: str, value: float) -> bool:
        """Whether the newest frame of a message has this value."""
        return self.receiver.newest(message).get(signal_name) == value

    def drive(self) -> int:
        """From power-on until the car drives and nobody brakes; returns when that was, us since the epoch."""
        self.until(lambda: self.speed > MOVING, "motion")
        assert self.receiver.newest("misc_report")["sys_state"] == SysState.DRIVING, self.story()
        assert self.receiver.newest("ssm_status")["ssm_state"] == lib.SSM_NOMINAL, self.story()
        for witness in WITNESSES:
            assert not self.receiver.braking(witness)[1][-1], f"{witness} brakes already; {self.story()}"
        assert not self.ended, self.story()
        return self.run.now_us

    def drives_on(self, since_us: int) -> None:
        """Nobody has braked since then, and the car still drives."""
        for witness in WITNESSES:
            times, brakes = self.receiver.braking(witness)
            assert not brakes[times > since_us].any(), f"{witness} has braked; {self.story()}"
            assert self.run.now_us - times[-1] < 500_000, f"{witness} is silent; {self.story()}"
        assert self.speed > MOVING, self.story()
        assert not self.ended, self.story()

    def withdraw_launch(self) -> None:
        """A frame in the operator's name that asks for no launch, between two of his own.

        Of two frames in one tick of the onboard computer the later counts, and nothing would have been withdrawn.
        """
        self.until(lambda: 20_000 <= self.run.now_us % LAUNCH_PERIOD_US < 60_000, "the operator's silence")
        request = database.message("launch_request")
        with CanLink(self.run.addresses()[request.bus], request.bus) as link:
            assert link.send(request.frame(0.0, 0.0, 200.0)) == 1

    def busy(self, core: int, seconds: float, priority: int | None = None) -> int:
        """Keep a core busy for a while, as an ordinary process or with a priority of SCHED_FIFO.

        Returns
        -------
        int
            When that began, us since the epoch.
        """
        begun_ns = int(self._beside(_BUSY, str(core), str(seconds), str(priority or 0)))
        return self._car_us(begun_ns)

    def pause(self, part: str, seconds: float, priority: int) -> None:
        """Stop a part for so long and no longer: the one who does it has a priority of SCHED_FIFO."""
        self._beside(_PAUSE, str(self.run.supervisor.process_id(part)), str(seconds), str(priority))

    def flood(self, bus: Bus, seconds: float) -> int:
        """Send frames of identifier 0 as fast as the bus takes them, from a process of its own; returns how many.

        The seconds are real ones.
        """
        return int(self._beside(_FLOOD, self.run.addresses()[bus], str(int(bus)), str(seconds)))

    def _beside(self, program: str, *arguments: str) -> str:
        """Run a small program while the run goes on; returns what it prints."""
        process = subprocess.Popen([sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, text=True)
        try:
            self.until(lambda: process.poll() is not None, "the end of a program beside the run")
        finally:
            process.kill()
            printed = process.communicate()[0]
        assert process.returncode == 0
        return printed

    def signal(self, part: str, number: signal.Signals) -> int:
        """Send a signal to a part; returns when, us since the epoch."""
        now_us = self.run.now_us
        self.run.supervisor.kill(part, number)
        return now_us

    def reacts(self, gone: str, fault_us: int, fault: str, allowance_us: int) -> list[Measured]:
        """Wait until all have reacted to the loss of a part and check that they did so in time."""
        reactions = reactions_to(gone)
        self.until(
            lambda: all((self.receiver.brakes_since(one.by) or 0) > fault_us for one in reactions),
            f"reactions to {fault}",
            bound_s=reactions[-1].deadline_us * 1e-6 + 5.0,
        )
        measured = []
        for one in reactions:
            since_us = self.receiver.brakes_since(one.by)
            assert since_us is not None
            measured.append(Measured(fault, one.by, one.deadline_us, since_us - fault_us))
            assert since_us - fault_us <= one.deadline_us + allowance_us, f"{measured[-1]}; {self.story()}"
        return measured

    def brake_demand(self) -> tuple[int, float]:
        """What the Space Drive has on its wires: when it was written, us since the epoch, and Pa."""
        written_ns = self._wires.read(Cell.SPACE_DRIVE_OUT, self._drive)
        return self._car_us(written_ns), self._drive.brake_pressure_demand

    def _car_us(self, time_ns: int) -> int:
        """The car's time, us since the epoch, at a time on CLOCK_MONOTONIC."""
        return round(self.run.seconds(time_ns) * 1e6)

    def still_brakes(self, since_us: int, *witnesses: str) -> None:
        """Every frame of the witnesses since then has shown the reaction."""
        for witness in witnesses:
            times, brakes = self.receiver.braking(witness)
            shown = brakes[times > since_us]
            assert shown.size, f"{witness} was not heard any more; {self.story()}"
            assert shown.all(), f"{witness} let go in {np.count_nonzero(~shown)} frames; {self.story()}"


@contextmanager
def car(folder: Path, options: RealTimeOptions) -> Iterator[Car]:
    """A car at power-on. On the way out everything ends, and what it leaves behind is looked at."""
    before = children()
    lines: list[tuple[str, str]] = []
    recording_folder = folder / "recording"
    scenario = load_scenario(quick_scenario(folder))
    with RealTimeRun(scenario, options, lambda name, line: lines.append((name, line))) as run:
        run.start(recording_folder)
        receiver = Receiver(run.addresses(), run.supervisor.epoch_ns, options.slower)
        try:
            with WiredIo(run.shared.wires) as wires:
                yield Car(run, receiver, lines, wires)
            recording = run.finish()
        finally:
            receiver.close()
    assert recording is not None
    assert_readable(recording)
    assert children() == before
    assert not (left := processes_that_name(run.shared.folder)), left
    assert not run.shared.folder.exists()


def assert_readable(recording: Recording) -> None:
    """What was recorded can be read by programs that are not ours."""
    counts = []
    for path in (recording.candump, recording.blf):
        with can.LogReader(path) as reader:
            counts.append(sum(1 for _ in reader))
    assert counts[0] == counts[1] > 1000, counts
    truth = pq.read_table(recording.truth)
    assert truth.num_rows > 100
    for message in ("brake_pressure_cmd", "req_brake_pos", "stat_brk_1", "ssm_status"):
        assert pq.read_table(recording.signals / f"{message}.parquet").num_rows > 10, message


def children() -> set[int]:
    """Processes that this one has started and that have not ended, or were not waited for."""
    mine = os.getpid()
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue  # it has just ended
            if parent == mine:
                found.add(int(entry.name))
    return found


def processes_that_name(path: Path) -> list[str]:
    """Command lines, of any process, in which a path occurs."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                words = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if str(path) in words:
                found.append(words)
    return found


def table(measured: Sequence[Measured]) -> str:
    """The reactions as a table for people."""
    rows = [f"{'fault':<34}{'reaction':<16}{'deadline ms':>12}{'measured ms':>12}"]
    rows += [
        f"{one.fault:<34}{one.by:<16}{one.deadline_us / 1000:>12.1f}{one.took_us / 1000:>12.1f}" for one in measured
    ]
    return "\n".join(rows)
