"""The Python stations of a real-time run as processes: `python -m tools.station plant` and `... autonomy`.

Their command line has the words of the ECUs' executables. With `--epoch -` a station gets ready, writes a line `ready`
and reads the epoch from standard input; the supervisor of a run uses it, because getting ready takes a second. When the
run ends by itself, the plant ends with a status of `PlantExit`; in any case its last words are one line of JSON on
standard output.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

from bridge._native import lib
from bridge.bus import CHANNELS
from bridge.realtime.autonomy_station import AutonomyStation
from bridge.realtime.cloud import CloudReceiver, CloudSender
from bridge.realtime.cycle_log import CycleLogWriter
from bridge.realtime.link import CanLink, Filter
from bridge.realtime.placement import Placement
from bridge.realtime.plant_station import PlantExit, PlantStation
from bridge.realtime.process import end_with_parent, keep_memory, schedule
from bridge.realtime.station import Station, StopRequest, run_station
from bridge.realtime.supervisor import READY
from bridge.realtime.timer import DeadlineTimer
from bridge.realtime.truth_file import TruthWriter
from bridge.realtime.wired import WiredIo
from bridge.scenario import Condition, Scenario, load_scenario
from bridge.surroundings import TICK_US, Surroundings
from dbc.buses import DEFAULT_PROFILE
from dbc.codec import profile
from dbc.errors import RaceloopError
from dbc.frames import Bus
from tools.run import build_bench, load_road, make_autonomy

#: Buses of each station. In a car with the radar, both are on CAN-R too.
BUSES = {"plant": (Bus.CAN1, Bus.CAN_A, Bus.CAN_S), "autonomy": (Bus.CAN_A, Bus.CAN_S)}

#: All that the plant's process listens to.
_PLANT_HEARS = ("misc_report", "ct_report", "parameter_result", "parameter_summary")

#: How far the warm-up drives: the first plans are made.
_WARM_UP_US = 10_000_000

#: Rows of truth and records of cycles beyond the scenario's time limit.
_SPARE = 100


class _Parser(argparse.ArgumentParser):
    """Tells a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(PlantExit.USER_ERROR, f"{self.prog}: {message}\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a station; returns the exit status."""
    # Until the station runs, a request to stop ends it where it is, files removed.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _leave)
    options = make_parser().parse_args(arguments)
    name: str = options.station

    def say(line: str) -> None:
        print(f"raceloop-{name}: {' '.join(line.split())}", file=sys.stderr, flush=True)

    try:
        with ExitStack() as exits:
            if options.with_parent:
                end_with_parent()
            Placement(options.priority, options.cpu).check()  # now rather than when it is ready
            scenario = replace(load_scenario(options.scenario), profile=profile(options.profile).profile)
            addresses = _addresses(options.bus, [*BUSES[name], Bus.CAN_R] if scenario.radar else BUSES[name])
            if name == "plant":
                return _run_plant(options, scenario, addresses, exits, say)
            return _run_autonomy(options, scenario, addresses, exits, say)
    except RaceloopError as error:
        say(str(error))
        return PlantExit.USER_ERROR


def _run_plant(
    options: argparse.Namespace,
    scenario: Scenario,
    addresses: dict[Bus, str],
    exits: ExitStack,
    say: Callable[[str], None],
) -> int:
    surroundings = Surroundings.from_scenario(scenario, load_road(scenario, scenario.track))
    exits.callback(surroundings.close)
    wires = exits.enter_context(WiredIo(options.wired))
    truth: TruthWriter | None = None
    if options.truth is not None:
        plant, rows = surroundings.plant, scenario.time_limit_us // TICK_US + _SPARE
        truth = exits.enter_context(TruthWriter(options.truth, plant.output_names, plant.output_units, rows))
    clouds = None if options.clouds is None else exits.enter_context(CloudSender(options.clouds))
    station = PlantStation(surroundings, scenario, wires, truth, say, clouds)
    messages = [profile(scenario.profile).message(heard) for heard in _PLANT_HEARS]
    filters = {bus: [Filter(one.frame_id) for one in messages if one.bus == bus] for bus in addresses}
    _run(options, scenario, station, addresses, filters, exits, say)
    print(json.dumps(station.report()), flush=True)
    return station.exit_status


def _run_autonomy(
    options: argparse.Namespace,
    scenario: Scenario,
    addresses: dict[Bus, str],
    exits: ExitStack,
    say: Callable[[str], None],
) -> int:
    clouds = None if options.clouds is None else exits.enter_context(CloudReceiver(options.clouds))
    station = AutonomyStation(make_autonomy(scenario, load_road(scenario, scenario.track)), clouds)
    _run(options, scenario, station, addresses, {}, exits, say)
    return 0


def _run(
    options: argparse.Namespace,
    scenario: Scenario,
    station: Station,
    addresses: dict[Bus, str],
    filters: dict[Bus, list[Filter]],
    exits: ExitStack,
    say: Callable[[str], None],
) -> None:
    """Get ready, learn the epoch, and run the station until it ends."""
    _warm_up(scenario)
    schedule(options.priority, options.cpu)
    keep_memory(options.priority is not None, say)
    epoch_ns = _epoch(options.epoch)
    stop = exits.enter_context(StopRequest())
    timer = DeadlineTimer(epoch_ns, options.phase * 1000, options.period * 1000)
    links = [
        exits.enter_context(CanLink(address, bus, epoch_ns, filters.get(bus))) for bus, address in addresses.items()
    ]
    cycles = options.cycles or scenario.time_limit_us // TICK_US + _SPARE
    log = exits.enter_context(
        CycleLogWriter(options.cycle_log, options.station, timer, cycles, options.priority, options.cpu)
    )
    run_station(station, links, timer, log, stop, say)


def _warm_up(scenario: Scenario) -> None:
    """Drive the scenario's beginning in lock step: all code and libraries are loaded and have run once."""
    with build_bench(scenario) as bench:
        bench.run(until=Condition(time_us=_WARM_UP_US))


def _epoch(word: str | None) -> int:
    """The epoch that the command line gives, or asks for."""
    if word == "-":
        print(READY, flush=True)
        word = sys.stdin.readline().strip()
        if not word.isdecimal():
            raise RaceloopError(f"--epoch -: standard input has {word!r}; must be nanoseconds of CLOCK_MONOTONIC")
    return int(lib.monotonic_ns()) if word is None else int(word)


def _addresses(words: Sequence[str], needed: Sequence[Bus]) -> dict[Bus, str]:
    """The address of each bus out of words NAME=ADDRESS."""
    names = {CHANNELS[bus]: bus for bus in needed}
    addresses: dict[Bus, str] = {}
    for word in words:
        name, _, address = word.partition("=")
        if name not in names or not address:
            raise RaceloopError(f"--bus {word}: must be BUS=ADDRESS; buses are {', '.join(names)}")
        if names[name] in addresses:
            raise RaceloopError(f"--bus {word}: {name} is given twice")
        addresses[names[name]] = address
    for name, bus in names.items():
        if bus not in addresses:
            raise RaceloopError(f"--bus {name}=ADDRESS is missing")
    return addresses


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = _Parser(prog="raceloop-station", description="A Python station of a real-time run")
    stations = parser.add_subparsers(dest="station", required=True, parser_class=_Parser)
    plant = stations.add_parser("plant", prog="raceloop-plant", help="car, sensors, operator and race control")
    plant.add_argument("--wired", type=Path, required=True, metavar="FILE", help="wires to the actuator ECUs")
    plant.add_argument("--truth", type=Path, metavar="FILE", help="file to make for the plant's outputs")
    autonomy = stations.add_parser("autonomy", prog="raceloop-autonomy", help="estimation and planning")
    for station in (plant, autonomy):
        station.add_argument("scenario", type=Path, help="YAML file")
        station.add_argument("--profile", default=DEFAULT_PROFILE, help=f"of CAN1 (default: {DEFAULT_PROFILE})")
        station.add_argument("--bus", action="append", default=[], metavar="BUS=ADDRESS", help="repeat for each bus")
        station.add_argument("--clouds", type=Path, metavar="FILE", help="file of LiDAR points (default: none)")
        station.add_argument("--epoch", type=_epoch_word, metavar="NS", help="CLOCK_MONOTONIC; -: ask (default: now)")
        station.add_argument("--phase", type=_count, default=0, metavar="US", help="within the period (default: 0)")
        station.add_argument(
            "--period",
            type=_positive,
            default=TICK_US,
            metavar="US",
            help=f"of the cycle; each is {TICK_US} us of the station's time (default: {TICK_US})",
        )
        station.add_argument("--priority", type=_positive, metavar="N", help="SCHED_FIFO, 1 to 99 (default: none)")
        station.add_argument("--cpu", type=_count, metavar="N", help="core to run on (default: any)")
        station.add_argument("--cycle-log", type=Path, metavar="FILE", help="file to make for the cycle log")
        station.add_argument("--cycles", type=_positive, metavar="N", help="cycles that the log holds")
        station.add_argument("--with-parent", action="store_true", help="stop when the parent dies")
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) > 1_000_000_000:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a whole number, 0 to 1000000000")
    return int(text)


def _positive(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) <= 1_000_000:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a whole number, 1 to 1000000")
    return int(text)


def _epoch_word(text: str) -> str:
    if text != "-" and not text.isdecimal():
        raise argparse.ArgumentTypeError(f"is {text!r}; must be nanoseconds, or - to ask for them")
    return text


def _leave(_number: int, _frame: object) -> None:
    raise SystemExit(PlantExit.STOPPED)


if __name__ == "__main__":
    STATUS = main()
    sys.stdout.flush()
    os._exit(STATUS)  # everything is closed; to take the interpreter apart would cost the run a second of waiting
