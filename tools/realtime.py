"""`raceloop run --realtime`: every station a process of its own, on SocketCAN or on the hub, by the wall clock."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from bridge.bus import CHANNELS
from bridge.laps import LapTimer
from bridge.operator import Verdict
from bridge.realtime.placement import Placement
from bridge.realtime.supervisor import Ended
from bridge.realtime.watch import CycleWatch, RunWatch
from bridge.recorder import Recording
from bridge.scenario import Scenario
from bridge.surroundings import STANDSTILL_SPEED, Ending
from dbc.codec import profile
from dbc.errors import ConfigurationError
from firmware.parameters import Offence, decode_results, load_operation
from firmware.tables import own_parameters
from tools.exit_status import ExitStatus
from tools.jitter.machine import BUSY_SHARE, WATCH_S, busy_share
from tools.progress import ProgressBar
from tools.realtime_run import RealTimeOptions, RealTimeRun
from tools.realtime_summary import stations_summary
from tools.recorded import Recorded
from tools.run import SUMMARY, conclude, load_road
from tools.safety_summary import safety_summary
from tools.stop_signal import asked_to_stop_is_ctrl_c, never_interrupted
from tools.summary import driving_summary, event_summary, show_summary, write_summary

CYCLES = "cycles"
"""Folder of the cycle logs in that of the recording."""

LOOK_US = 100_000
"""How often the cycles of the stations are looked at."""


def run_realtime(scenario: Scenario, folder: Path, console: Console, options: RealTimeOptions) -> int:
    """Drive a scenario in real time and leave recording and `summary.json` in a folder.

    Returns
    -------
    int
        Exit status: a part that failed or a broken safety property counts as a missed finish. An interrupted run is
        recorded as far as it came.

    Raises
    ------
    RaceloopError
        When the run cannot start; nothing is left running or half-written.
    """
    if scenario.faults:
        raise ConfigurationError(scenario.path, "faults", "are for lock step; a run in real time injects none")
    profile(scenario.profile).check_sources()
    load_road(scenario, scenario.track)
    warning = _busy_cores(options.placement)
    with asked_to_stop_is_ctrl_c(), RealTimeRun(scenario, options, _say) as run:
        run.start(folder)
        if warning:
            _say("raceloop", warning)
        course = _Course(run, scenario)
        with never_interrupted() as asked_to_stop:
            _announce(run, console)
            course.follow(console, asked_to_stop)
            recording = run.finish(folder / CYCLES)
            assert recording is not None
            summary = _summary(run, course, recording, folder)
            write_summary(summary, folder / SUMMARY)
    show_summary(summary, console)
    if course.interrupted:
        print(f"raceloop: interrupted; what was recorded until then is in {folder}", file=sys.stderr)
        return ExitStatus.INTERRUPTED
    if course.failures:
        console.print(f"[red]Failed[/red]: {'; '.join(course.failures)}")
        return ExitStatus.MISSED
    status = conclude(scenario, course.finished, course.offences, console)
    return ExitStatus.MISSED if summary["safety"]["violations"] else status


class _Course:
    """What happens while a run goes on.

    Attributes
    ----------
    ending : how the plant ended the run; None when it did not.
    failures : what went wrong, one line each.
    interrupted : Ctrl-C.
    ended_us : up to here it is the run; what the parts do when they are stopped does not belong to it.
    """

    def __init__(self, run: RealTimeRun, scenario: Scenario) -> None:
        self.ending: Ending | None = None
        self.failures: list[str] = []
        self.interrupted = False
        self.offences: list[Offence] = []
        self._run = run
        self._scenario = scenario
        self._watch = RunWatch(scenario.time_limit_us)
        self._cycles = CycleWatch()
        self._lost: set[str] = set()
        self._next_look_us = 0
        self.ended_us = 0

    @property
    def finished(self) -> bool:
        """The scenario's finish was reached, and nothing failed."""
        return self.ending is Ending.FINISHED and not self.failures

    def follow(self, console: Console, asked_to_stop: Callable[[], bool]) -> None:
        """Look at the run until it is over, or somebody asks to stop it."""
        run = self._run
        with ProgressBar(console, self._scenario.name, self._scenario.time_limit_us) as bar:
            while self.ending is None and not self._watch.over(self.ended_us, self._car_stands()):
                self.interrupted = asked_to_stop()
                if self.interrupted:
                    return
                all_ended = run.poll()
                self.ending = run.ending
                for ended in all_ended:
                    self._note(ended)
                self.ended_us = max(run.now_us, 0)
                self._look_at_cycles(run.now_us)
                speed = 0.0 if run.speed_mps is None else run.speed_mps
                bar.update(self.ended_us, f"{run.observer.monitor.state('ct'):<14} {speed * 3.6:5.1f} km/h")

    def _note(self, ended: Ended) -> None:
        if ended.name != "plant" or self.ending is None:
            self._fail(f"{ended} at {self._run.seconds(ended.time_ns):.3f} s")

    def _look_at_cycles(self, now_us: int) -> None:
        if now_us < self._next_look_us:
            return
        self._next_look_us = now_us + LOOK_US
        for change in self._cycles.update(now_us, self._run.cycles()):
            if change.over:
                _say("raceloop", f"{change.name} cycles again at {now_us * 1e-6:.2f} s")
            else:
                _say("raceloop", f"{change.name} has not cycled since {change.since_us * 1e-6:.2f} s")
        for name in self._cycles.lost(now_us):
            if name not in self._lost:
                self._lost.add(name)
                self._fail(f"{name} does not cycle any more")

    def _fail(self, line: str) -> None:
        _say("raceloop", line)
        self.failures.append(line)
        self._watch.fail(self._run.now_us)

    def _car_stands(self) -> bool:
        run = self._run
        if "plant" not in run.supervisor.running:
            return True
        return run.speed_mps is None or abs(run.speed_mps) < STANDSTILL_SPEED


def _busy_cores(placement: Placement) -> str:
    """A warning when other work has the cores that the ECUs will need; empty when it has not."""
    placement.check()
    cores = os.sched_getaffinity(0) if placement.cpu is None else {placement.cpu}
    share = busy_share(cores, WATCH_S)
    if share <= BUSY_SHARE:
        return ""
    names = f"core{'s' * (len(cores) > 1)} {', '.join(map(str, sorted(cores)))}"
    return f"{names}: {share:.0%} busy with other work, cycles may come late"


def _announce(run: RealTimeRun, console: Console) -> None:
    """Say where the run is, for those who want to join it."""
    if run.options.interfaces is not None:
        places = ", ".join(f"{CHANNELS[bus]} {address}" for bus, address in run.addresses().items())
        console.print(f"Buses: {places}", markup=False)
    for name in sorted(run.options.without):
        console.print(f"Without {name}. It would have been started with", markup=False)
        console.print(f"  {run.command_line(name)}", markup=False)


def _say(name: str, line: str) -> None:
    """Forward a line of a part's log."""
    print(f"{name}: {line}", file=sys.stderr, flush=True)


def _summary(run: RealTimeRun, course: _Course, recording: Recording, folder: Path) -> dict[str, Any]:
    scenario = run.scenario
    recorded = Recorded(recording.signals, recording.truth)
    # A plant that has ended the run did so in the slot of its last row; the supervisor sees it a little later.
    ended_us = course.ended_us if course.ending is None else int(recorded.truth["time_us"][-1])
    verdict, course.offences = _verdict(recorded, scenario)
    files = (recording.candump, recording.blf, recording.signals, recording.truth, folder / CYCLES, folder / SUMMARY)
    overflows = {link.bus: link.statistics.overflows for link in run.links}
    return {
        "scenario": scenario.name,
        "profile": scenario.profile,
        "seed": scenario.seed,
        "finished": course.finished,
        "simulated_s": ended_us * 1e-6,
        "configuration": verdict.name,
        "offences": [asdict(offence) for offence in course.offences],
        "laps_s": _laps(recorded, scenario),
        **driving_summary(recorded),
        **event_summary(run.observer.monitor, ended_us),
        "safety": safety_summary(run.safety, ended_us),
        "buses": {
            CHANNELS[bus]: statistics | {"lost": overflows[bus]}
            for bus, statistics in run.observer.load.statistics(course.ended_us * 1e-6).items()
            if bus in scenario.buses
        },
        "frames_lost": sum(overflows.values()),
        "frame_log_sha256": recording.frame_log_sha256,
        "folder": str(folder),
        "files": [file.name + ("/" if file.is_dir() else "") for file in files],
        "real_time": {
            "bus": "hub" if run.options.interfaces is None else "socketcan",
            "addresses": {CHANNELS[bus]: address for bus, address in run.addresses().items()},
            "slower": run.options.slower,
            "without": sorted(run.options.without),
            "epoch_ns": run.supervisor.epoch_ns,
            "interrupted": course.interrupted,
            "failures": course.failures,
            "out_of_order": run.observer.late,
            "plant": run.plant_report,
            "outages": {CHANNELS[link.bus]: link.statistics.outages for link in run.links},
            "stations": stations_summary(folder / CYCLES),
        },
    }


def _verdict(recorded: Recorded, scenario: Scenario) -> tuple[Verdict, list[Offence]]:
    """The onboard computer's verdict on the operation file, and what it has refused, from its frames."""
    verdicts = recorded.message("parameter_summary")["summary_verdict"]
    results = recorded.message("parameter_result")
    columns = (results[name].astype(int).tolist() for name in ("result_key", "result_status", "result_value"))
    offences = decode_results(zip(*columns, strict=True), load_operation(scenario.operation), own_parameters())
    return Verdict(int(verdicts[-1])) if verdicts.size else Verdict.PENDING, list(offences)


def _laps(recorded: Recorded, scenario: Scenario) -> list[float]:
    road = load_road(scenario, scenario.track)
    laps = LapTimer(road.length)
    truth = recorded.truth
    if "x" in truth:
        for time_us, x, y in zip(truth["time_us"], truth["x"], truth["y"], strict=True):
            laps.update(int(time_us), road.project(float(x), float(y))[0])
    return laps.laps_s
