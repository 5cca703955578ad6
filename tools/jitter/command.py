"""`raceloop jitter`: measures an ECU's cycle, idle and under load, beside the machine's own limit."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from bridge.realtime.placement import Placement
from bridge.realtime.vcan import ensure_interfaces
from bridge.scenario import Scenario
from dbc.errors import RaceloopError
from tools.exit_status import ExitStatus
from tools.jitter.alone import measure_alone
from tools.jitter.load import PACKAGE, start_load
from tools.jitter.machine import BUSY_SHARE, WATCH_S, Machine, busy_share, look_at_machine
from tools.jitter.measurement import Measurement
from tools.jitter.peers import PEERS
from tools.jitter.recording import record_stimulus
from tools.jitter.report import as_json, picture, show
from tools.jitter.setup import Setup
from tools.jitter.trace import trace_of
from tools.jitter.whole_loop import measure_whole_loop
from tools.output_files import write_json, write_text
from tools.realtime_run import shared_folder
from tools.run import make_folder
from tools.stop_signal import asked_to_stop_is_ctrl_c

#: Cycles of one measurement at most: an hour at 100 Hz.
CYCLES_MAX = 360_000

_IDLE = "idle"

#: How long a load runs before the measurement begins, and how much longer at most, s.
_SETTLE_S, _LATEST_S = 1.0, 120.0


@dataclass(frozen=True)
class Outputs:
    """Files to write; None for none."""

    json: Path | None = None
    trace: Path | None = None
    picture: Path | None = None

    @classmethod
    def of(cls, folder: Path | None, json: Path | None, trace: Path | None) -> Outputs:
        """All of them in a folder when there is one, and single ones elsewhere."""
        if folder is None:
            return cls(json, trace)
        return cls(json or folder / "jitter.json", trace or folder / "jitter.pftrace", folder / "jitter.svg")

    def check(self) -> None:
        """See now, rather than after the measurement, whether the files can be made.

        Raises
        ------
        RaceloopError
            When one cannot.
        """
        for path in (self.json, self.trace, self.picture):
            if path is not None:
                if path.is_dir():
                    raise RaceloopError(f"{path}: is a folder; must be a file")
                make_folder(path.parent)


def jitter(setup: Setup, load: str | None, scenario: Scenario | None, outputs: Outputs, console: Console) -> int:
    """Measure, print, and write the files that are wanted.

    Parameters
    ----------
    setup : what to measure; without a core, the last one is taken. A priority that is not permitted is left out.
    load : one of `tools.jitter.load.LOADS`, or None for the idle machine only.
    scenario : to drive in the whole loop; None: the ECU alone.

    Raises
    ------
    RaceloopError
        When something given is wrong, or a part fails.
    """
    if scenario is None and setup.cycles > CYCLES_MAX:
        longest = CYCLES_MAX * setup.period_ns / 1e9
        raise RaceloopError(f"--seconds {setup.seconds:g}: at most {longest:g} at {setup.rate_hz:g} Hz")
    machine = look_at_machine()
    placement, remarks = _placement(setup.options.placement, machine)
    setup = replace(setup, options=replace(setup.options, placement=placement))
    if setup.options.interfaces is not None:
        ensure_interfaces(setup.options.interfaces)
    outputs.check()
    with asked_to_stop_is_ctrl_c():
        measurements = _measure(setup, load, scenario, remarks, console)
    for line in (*_headings(setup, scenario, machine), *remarks):
        console.print(line, markup=False, soft_wrap=True)
    console.print()
    show(measurements, console)
    _write(outputs, _settings(setup, load, scenario, remarks), machine, measurements, console)
    return ExitStatus.DONE


def _placement(wanted: Placement, machine: Machine) -> tuple[Placement, list[str]]:
    """Core and priority to measure with, and what there is to say about them.

    Raises
    ------
    RaceloopError
        When the core does not exist.
    """
    # The last core has the fewest interrupts on most machines.
    core = machine.cores[-1] if wanted.cpu is None else wanted.cpu
    Placement(None, core).check()
    try:
        Placement(wanted.priority, core).check()
    except RaceloopError as error:
        return Placement(None, core), [f"{error}; measured without"]
    return Placement(wanted.priority, core), []


def _measure(
    setup: Setup, load: str | None, scenario: Scenario | None, remarks: list[str], console: Console
) -> list[Measurement]:
    """Measure idle, and under the load when there is one."""
    measurements = []
    with shared_folder() as folder:  # a log in a file on a disk would wait for the disk
        measure, seconds = _prepare(setup, scenario, Path(folder), console)
        for kind in [None] if load is None else [None, load]:
            condition = _IDLE if kind is None else f"{kind} load"
            with console.status(f"{condition}: {seconds:.0f} s"), ExitStack() as beside:
                notes = [] if kind is not None else _watch(setup)
                stress = None
                if kind is not None:
                    # On a disk, because disks are part of the load.
                    scratch = Path(beside.enter_context(tempfile.TemporaryDirectory(prefix="raceloop-")))
                    stress = start_load(kind, seconds + _LATEST_S, scratch)
                    if stress is None:
                        remarks.append(f"stress-ng is not installed, so there is no load: apt install {PACKAGE}")
                        break
                    beside.enter_context(stress)
                    time.sleep(_SETTLE_S)
                measured = measure(condition)
                if stress is not None and not stress.running:
                    notes.append("stress-ng ended before the measurement did")
            measurements.append(replace(measured, notes=(*notes, *measured.notes)))
    return measurements


def _prepare(
    setup: Setup, scenario: Scenario | None, folder: Path, console: Console
) -> tuple[Callable[[str], Measurement], float]:
    """What measures under a condition, and how many seconds that takes."""
    if scenario is not None:
        return partial(measure_whole_loop, setup, scenario), scenario.time_limit_us * 1e-6
    stimulus = folder / "stimulus"
    with console.status("Recording the stimulus in lock step"):
        record_stimulus(setup.ecu, setup.recorded_cycles).save(stimulus)

    def measure(condition: str) -> Measurement:
        with tempfile.TemporaryDirectory(dir=folder) as here:
            return measure_alone(setup, stimulus, Path(here), condition)

    return measure, (1 + len(PEERS)) * setup.seconds


def _watch(setup: Setup) -> list[str]:
    """Whether the core has time for a measurement."""
    core = setup.options.placement.cpu
    assert core is not None
    share = busy_share({core}, WATCH_S)
    return [f"core {core} was {share:.0%} busy with other work before the measurement"] if share > BUSY_SHARE else []


def _headings(setup: Setup, scenario: Scenario | None, machine: Machine) -> list[str]:
    """What was measured, and on what."""
    priority, core = setup.options.placement.priority, setup.options.placement.cpu
    scheduler = "without real-time priority" if priority is None else f"SCHED_FIFO {priority}"
    bus = "the hub" if setup.options.interfaces is None else ", ".join(setup.options.interfaces)
    facts = [f"{len(machine.cores)} cores"]
    facts += ["PREEMPT_RT"] if machine.preempt_rt else []
    facts += ["virtual machine"] if machine.virtual else []
    facts += [f"isolated cores {machine.isolated}"] if machine.isolated else []
    facts += [f"nohz_full {machine.nohz_full}"] if machine.nohz_full else []
    facts += [f"governor {machine.governor}"] if machine.governor else []
    length = f"{setup.seconds:g} s" if scenario is None else f"in the whole loop, {scenario.name}"
    return [
        f"raceloop-{setup.ecu.name}, {setup.rate_hz:g} Hz, {length}, {scheduler} on core {core}, on {bus}",
        f"Linux {machine.kernel}",
        f"{machine.processor}, {', '.join(facts)}",
    ]


def _settings(setup: Setup, load: str | None, scenario: Scenario | None, remarks: list[str]) -> dict[str, Any]:
    return {
        "ecu": setup.ecu.name,
        "rate_hz": setup.rate_hz,
        "period_us": setup.period_ns / 1000.0,
        "seconds": setup.seconds if scenario is None else None,
        "scenario": None if scenario is None else scenario.name,
        "load": load,
        "priority": setup.options.placement.priority,
        "cpu": setup.options.placement.cpu,
        "bus": "hub" if setup.options.interfaces is None else "socketcan",
        "interfaces": setup.options.interfaces,
        "remarks": remarks,
    }


def _write(
    outputs: Outputs, settings: dict[str, Any], machine: Machine, measurements: list[Measurement], console: Console
) -> None:
    written = []
    if outputs.json is not None:
        write_json(outputs.json, as_json(settings, machine, measurements))
        written.append(outputs.json)
    if outputs.picture is not None:
        title = f"raceloop-{settings['ecu']}, {settings['rate_hz']:g} Hz"
        write_text(outputs.picture, picture(title, measurements))
        written.append(outputs.picture)
    if outputs.trace is not None:
        trace_of(measurements).write(outputs.trace)
        written.append(outputs.trace)
    if written:
        console.print(f"\nWritten: {', '.join(map(str, written))}", markup=False, soft_wrap=True)
