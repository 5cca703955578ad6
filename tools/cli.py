"""The `raceloop` command."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from dbc.buses import DEFAULT_PROFILE, car_buses
from dbc.errors import RaceloopError
from tools.exit_status import ExitStatus

_REAL_TIME_ONLY = ("bus", "interfaces", "port", "without", "priority", "cpu", "slower")
"""Options of `raceloop run` that mean nothing in lock step."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    options = make_parser().parse_args(arguments)
    console = Console(highlight=False, soft_wrap=not sys.stdout.isatty())
    try:
        return _dispatch(options, console)
    except RaceloopError as error:
        # One line, whatever line breaks a key or a name in the user's file holds.
        print(f"raceloop: {' '.join(str(error).split())}", file=sys.stderr)
        return ExitStatus.USER_ERROR
    except KeyboardInterrupt:
        print("raceloop: interrupted; nothing was written", file=sys.stderr)
        return ExitStatus.INTERRUPTED


def _dispatch(options: argparse.Namespace, console: Console) -> int:
    """Import what the command needs only: `--help` and errors answer at once."""
    if options.command == "run":
        return _run(options, console)
    if options.command == "check-params":
        from tools.check_params import check_params  # noqa: PLC0415

        return check_params(options.file, console)
    if options.command == "replay":
        from dbc.codec import profile  # noqa: PLC0415
        from tools.replay import replay  # noqa: PLC0415

        return replay(options.log, profile(options.profile), console)
    if options.command == "safety":
        from tools.safety import safety  # noqa: PLC0415

        return safety(options.folder, options.scenario, console)
    if options.command == "campaign":
        from tools.campaign import Options, campaign  # noqa: PLC0415

        chosen = Options(options.out, options.workers, options.only, options.restart, options.json, options.junit)
        return campaign(options.file, chosen, console)
    if options.command == "hub":
        from tools.hub import hub  # noqa: PLC0415

        hub(options.local, options.port)
    if options.command == "jitter":
        return _jitter(options, console)
    if options.command == "dbw":
        return _dbw(options, console)
    if options.command == "eval":
        from tools.perception_eval import evaluate_perception  # noqa: PLC0415
        from tools.run import chosen_scenario  # noqa: PLC0415

        scenario = chosen_scenario(options.scenario, None)
        return evaluate_perception(scenario, options.seed, console, options.out, options.seconds)
    from tools.bench import bench  # noqa: PLC0415

    return bench(console, options.repeats, options.simulated_s)


def _run(options: argparse.Namespace, console: Console) -> int:
    given = [f"--{name}" for name in _REAL_TIME_ONLY if getattr(options, name) not in (None, [])]
    if not options.realtime and given:
        raise RaceloopError(f"{given[0]} needs --realtime")
    from tools.run import chosen_scenario, run  # noqa: PLC0415

    if not options.realtime:
        return run(chosen_scenario(options.scenario, options.profile), options.out, console, options.rt_ratio)
    if options.rt_ratio is not None:
        raise RaceloopError("--rt-ratio does not go with --realtime, which is always as fast as the clock")
    from tools.realtime import run_realtime  # noqa: PLC0415
    from tools.realtime_run import make_options  # noqa: PLC0415

    scenario = chosen_scenario(options.scenario, options.profile)
    chosen = make_options(
        options.bus,
        options.interfaces,
        options.port,
        options.without,
        options.priority,
        options.cpu,
        1 if options.slower is None else options.slower,
        scenario.buses,
    )
    return run_realtime(scenario, options.out, console, chosen)


def _dbw(options: argparse.Namespace, console: Console) -> int:
    if options.dbw_command == "profiles":
        from tools.dbw.profiles import compare, show  # noqa: PLC0415

        if not options.names:
            return show(console)
        if len(options.names) != 2:
            raise RaceloopError(f"profiles {' '.join(options.names)}: must be two profiles to compare, or none to list")
        one, other = options.names
        return compare(one, other, console)
    if options.dbw_command == "lint":
        from tools.dbw.lint import lint  # noqa: PLC0415

        return lint(options.file, console)
    if options.dbw_command == "diff":
        from tools.dbw.dbc_diff import diff  # noqa: PLC0415

        return diff(options.one, options.other, console)
    from dbc.codec import profile  # noqa: PLC0415

    database = profile(options.profile)
    if options.dbw_command == "encode":
        from tools.dbw.encode import encode  # noqa: PLC0415

        return encode(database, options.message, options.values, console)
    if options.dbw_command == "check":
        from tools.dbw.check import Outputs, check  # noqa: PLC0415
        from tools.dbw.counters import CounterMode  # noqa: PLC0415

        outputs = Outputs(options.json, options.junit, options.timing)
        return check(
            database, options.source, options.bus, options.seconds, CounterMode(options.counter), outputs, console
        )
    if options.dbw_command == "monitor":
        from tools.dbw.monitor import monitor  # noqa: PLC0415

        return monitor(database, options.source, options.bus, options.seconds, options.message, options.once, console)
    if options.dbw_command == "schedule":
        from tools.dbw.schedule import schedule  # noqa: PLC0415

        return schedule(database, options.bus, options.bit_rate, options.all_at, console)
    from tools.dbw.decode import decode  # noqa: PLC0415

    return decode(database, options.frame, options.bus, console)


def _jitter(options: argparse.Namespace, console: Console) -> int:
    if options.scenario is not None:
        for name in ("rate", "seconds"):
            if getattr(options, name) is not None:
                raise RaceloopError(f"--{name} does not go with --scenario, which has its own")
    from bridge.scenario import load_scenario  # noqa: PLC0415
    from tools.jitter.command import Outputs, jitter  # noqa: PLC0415
    from tools.jitter.setup import Setup  # noqa: PLC0415
    from tools.jitter.stimulus import ECUS  # noqa: PLC0415
    from tools.realtime_run import make_options  # noqa: PLC0415
    from tools.run import find_scenario  # noqa: PLC0415

    scenario = None if options.scenario is None else load_scenario(find_scenario(options.scenario))
    buses = car_buses() if scenario is None else scenario.buses
    chosen = make_options(
        options.bus, options.interfaces, priority=options.priority or None, cpu=options.cpu, buses=buses
    )
    setup = Setup(ECUS[options.ecu], options.rate or 100.0, options.seconds or 30.0, chosen)
    outputs = Outputs.of(options.out, options.json, options.trace)
    return jitter(setup, None if options.load == "none" else options.load, scenario, outputs, console)


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="raceloop",
        description="Hardware-in-the-loop CAN bench for autonomous race cars",
        epilog="Exit status: 0 done, 1 finish or target missed, 2 a mistake in what was given.",
    )
    commands = parser.add_subparsers(dest="command", required=True)

    run = commands.add_parser("run", help="drive a scenario and record it")
    run.add_argument("scenario", nargs="?", help="YAML file, or the name of a shipped scenario (default: solo_lap)")
    run.add_argument(
        "--out", type=Path, default=Path("out"), metavar="DIR", help="folder of the recording (default: out)"
    )
    run.add_argument(
        "--rt-ratio",
        type=_positive,
        metavar="N",
        help="simulated seconds per second of the wall clock (default: as fast as possible)",
    )

    run.add_argument("--profile", help="layout of CAN1 (default: the scenario's, V14 where it has none)")
    run.add_argument("--realtime", action="store_true", help="every station a process of its own, by the wall clock")
    live = run.add_argument_group("with --realtime")
    live.add_argument("--bus", choices=["hub", "socketcan"], help="what carries the buses (default: hub)")
    live.add_argument(
        "--interfaces",
        type=lambda text: text.split(","),
        metavar="A,B,C,D",
        help="CAN interfaces of CAN1, CAN3, CANA, CANS, and of CANR with the radar (default: vcan0,vcan1 and so on)",
    )
    live.add_argument(
        "--port", type=_port, metavar="N", help="of the hub for socketcand clients (default: any that is free)"
    )
    live.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="PART",
        help="leave a part out, to take its place: obc, raptor, space-drive, autonomy, plant; may be repeated",
    )
    live.add_argument("--priority", type=int, metavar="N", help="SCHED_FIFO priority of the ECUs, 1 to 99")
    live.add_argument("--cpu", type=int, metavar="N", help="core for ECUs and hub alone")
    live.add_argument(
        "--slower", type=_count, metavar="N", help="N times slower, where the machine cannot keep up (default: 1)"
    )

    check = commands.add_parser("check-params", help="let the firmware validate an operation configuration")
    check.add_argument("file", type=Path, help="YAML file")

    replay = commands.add_parser("replay", help="replay a recorded log into a fresh onboard computer and compare")
    replay.add_argument("log", type=Path, help="frames.log (candump) or frames.blf of a run, from power-on")

    replay.add_argument("--profile", default=DEFAULT_PROFILE, help=f"layout of CAN1 (default: {DEFAULT_PROFILE})")

    safety = commands.add_parser("safety", help="hold a recorded run to the safety properties")
    safety.add_argument(
        "folder", nargs="?", type=Path, default=Path("out"), metavar="DIR", help="of the recording (default: out)"
    )
    safety.add_argument("--scenario", metavar="NAME", help="that was driven (default: what summary.json says)")

    campaign = commands.add_parser("campaign", help="inject every fault of a list at every onset of a grid")
    campaign.add_argument("file", metavar="FILE", help="YAML file, or the name of a shipped campaign")
    campaign.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the results, or of the recording with --only (default: out)"
    )
    campaign.add_argument("--workers", type=_count, metavar="N", help="processes (default: one per core)")
    campaign.add_argument("--only", metavar="ID", help="one run alone, FAULT@ONSET_MS; recorded with --out")
    campaign.add_argument("--restart", action="store_true", help="begin anew, whatever results there are")
    campaign.add_argument("--json", type=Path, metavar="FILE", help="write the summary")
    campaign.add_argument("--junit", type=Path, metavar="FILE", help="write a test case per fault as JUnit XML")

    hub = commands.add_parser("hub", help="carry the buses where the kernel has no CAN")
    hub.add_argument(
        "--port", type=_port, default=29536, metavar="N", help="for socketcand clients; 0: any free (default: 29536)"
    )
    hub.add_argument("--local", type=Path, metavar="PATH", help="socket for raceloop's stations (default: your own)")

    jitter = commands.add_parser("jitter", help="measure how regular an ECU's cycle is, beside the machine's own limit")
    jitter.add_argument("--ecu", choices=["obc", "raptor", "space-drive"], default="obc", help="(default: obc)")
    jitter.add_argument("--rate", type=_rate, metavar="HZ", help="cycles per second, 10 to 1000 (default: 100)")
    jitter.add_argument("--seconds", type=_positive, metavar="S", help="of each measurement (default: 30)")
    jitter.add_argument(
        "--load",
        choices=["none", "cpu", "memory", "kernel", "io", "all"],
        default="none",
        help="measure idle, then under this load of stress-ng (default: none)",
    )
    jitter.add_argument(
        "--scenario", metavar="NAME", help="measure inside the whole loop, for this scenario: file or shipped name"
    )
    jitter.add_argument(
        "--priority", type=_priority, default=80, metavar="N", help="SCHED_FIFO, 1 to 99; 0: none (default: 80)"
    )
    jitter.add_argument("--cpu", type=int, metavar="N", help="core to measure on (default: the last)")
    jitter.add_argument("--bus", choices=["hub", "socketcan"], help="what carries the buses (default: hub)")
    jitter.add_argument(
        "--interfaces",
        type=lambda text: text.split(","),
        metavar="A,B,C,D",
        help="CAN interfaces of CAN1, CAN3, CANA, CANS (default: vcan0,vcan1,vcan2,vcan3)",
    )
    jitter.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    jitter.add_argument("--trace", type=Path, metavar="FILE", help="write a trace for the Perfetto viewer")
    jitter.add_argument(
        "--out", type=Path, metavar="DIR", help="write jitter.json, jitter.pftrace and a picture, jitter.svg"
    )

    dbw = commands.add_parser("dbw", help="drive-by-wire messages as they are on the wire")
    tasks = dbw.add_subparsers(dest="dbw_command", required=True)
    encode = tasks.add_parser("encode", help="physical values into a frame, with raw values and a picture of the bits")
    encode.add_argument("message", help="name, as in docs/protocol.md")
    encode.add_argument("values", nargs="*", metavar="SIGNAL=VALUE", help="a number or a name; raw 0 when not given")
    decode = tasks.add_parser("decode", help="a frame into physical values")
    decode.add_argument("frame", metavar="ID#DATA", help="as can-utils write it: 57A#2D07050000000000")
    decode.add_argument(
        "--bus", metavar="BUS", help="CAN1, CAN3, CAN-A, CAN-S, CAN-R (default: wherever the identifier is)"
    )

    check = tasks.add_parser("check", help="everything in a recording or on a bus that is not what the DBC files say")
    _add_source(check)
    check.add_argument(
        "--counter",
        choices=["automatic", "plus-one", "changed"],
        default="automatic",
        help="what message counters have to do (default: automatic: plus one, the end found out from the recording)",
    )
    check.add_argument("--timing", action="store_true", help="show the times between the frames of each message")
    check.add_argument("--json", type=Path, metavar="FILE", help="write findings and times between frames")
    check.add_argument("--junit", type=Path, metavar="FILE", help="write a test case per message as JUnit XML")
    monitor = tasks.add_parser("monitor", help="a table of what is on a bus now: values, ages, counters, offenders")
    _add_source(monitor)
    monitor.add_argument(
        "--message",
        action="append",
        default=[],
        metavar="PATTERN",
        help="only messages of this name or identifier, * and ? as in file names; may be repeated",
    )
    monitor.add_argument("--once", action="store_true", help="no moving table: print the last one, and that at once")
    lint = tasks.add_parser("lint", help="what is wrong or missing in a DBC file")
    lint.add_argument("file", type=Path, help="DBC file")
    diff = tasks.add_parser("diff", help="how one DBC file differs from another")
    diff.add_argument("one", type=Path, help="DBC file")
    diff.add_argument("other", type=Path, help="DBC file")
    schedule = tasks.add_parser("schedule", help="whether what is sent in cycles fits on a bus, in the worst case")
    schedule.add_argument(
        "--bus", metavar="BUS", default="CAN1", help="CAN1, CAN3, CAN-A, CAN-S, CAN-R (default: CAN1)"
    )
    schedule.add_argument("--bit-rate", type=_count, metavar="N", help="bit/s (default: that of the DBC file)")
    schedule.add_argument(
        "--all-at", type=_positive, metavar="MS", help="every message with this cycle (default: those of the DBC file)"
    )
    profiles = tasks.add_parser("profiles", help="which layouts of CAN1 there are, or how one differs from another")
    profiles.add_argument("names", nargs="*", metavar="PROFILE", help="two, to compare; none, to list")
    for task in (encode, decode, check, monitor, schedule):
        task.add_argument("--profile", default=DEFAULT_PROFILE, help=f"layout of CAN1 (default: {DEFAULT_PROFILE})")

    evaluate = commands.add_parser("eval", help="how good a part of the stack is, against the truth")
    parts = evaluate.add_subparsers(dest="eval_part", required=True)
    perception = parts.add_parser("perception", help="detection, tracking and prediction on a drive with another car")
    perception.add_argument("scenario", nargs="?", metavar="SCENARIO", help="file or name (default: solo_lap)")
    perception.add_argument("--seed", type=_seed, default=1, metavar="N", help="of the sensors (default: 1)")
    perception.add_argument("--seconds", type=_positive, metavar="S", help="of the drive (default: all of it)")
    perception.add_argument("--out", type=Path, metavar="FILE", help="all figures as JSON (default: none)")

    bench = commands.add_parser("bench", help="measure the loop against the plain loop a user would write")
    bench.add_argument("--repeats", type=_count, default=5, help="pairs of runs (default: 5)")
    bench.add_argument(
        "--simulated-s", type=_positive, default=40.0, metavar="S", help="simulated seconds per run (default: 40)"
    )
    return parser


def _add_source(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        nargs="+",
        metavar="SOURCE",
        help="a recording (candump .log, BLF, ASC, TRC or MF4, each also .gz), or buses in use, each"
        " [BUS=]INTERFACE:CHANNEL: socketcan:vcan0, socketcand:127.0.0.1:29536/CAN1, CAN1=slcan:/dev/ttyACM0,"
        " or any other of python-can's",
    )
    parser.add_argument(
        "--bus", metavar="BUS", help="of all frames: CAN1, CAN3, CAN-A, CAN-S, CAN-R (default: by channel)"
    )
    parser.add_argument("--seconds", type=_positive, metavar="S", help="listen so long (default: until Ctrl-C)")


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a number above 0")
    return value


def _rate(text: str) -> float:
    rate = _positive(text)
    if not 10.0 <= rate <= 1000.0:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be 10 to 1000")
    return rate


def _priority(text: str) -> int:
    if not text.isdecimal() or int(text) > 99:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a whole number from 0 to 99")
    return int(text)


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a whole number from 0 to 65535")
    return int(text)


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a whole number of at least 0")
    return int(text)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a whole number of at least 1")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
