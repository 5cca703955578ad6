"""The `raceloop` command."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from dbc.errors import RaceloopError
from tools.exit_status import ExitStatus


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
        from tools.run import run  # noqa: PLC0415

        return run(options.scenario, options.out, console, options.rt_ratio)
    if options.command == "check-params":
        from tools.check_params import check_params  # noqa: PLC0415

        return check_params(options.file, console)
    if options.command == "replay":
        from tools.replay import replay  # noqa: PLC0415

        return replay(options.log, console)
    if options.command == "hub":
        from tools.hub import hub  # noqa: PLC0415

        hub(options.local, options.port)
    from tools.bench import bench  # noqa: PLC0415

    return bench(console, options.repeats, options.simulated_s)


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

    check = commands.add_parser("check-params", help="let the firmware validate an operation configuration")
    check.add_argument("file", type=Path, help="YAML file")

    replay = commands.add_parser("replay", help="replay a recorded log into a fresh onboard computer and compare")
    replay.add_argument("log", type=Path, help="frames.log (candump) or frames.blf of a run, from power-on")

    hub = commands.add_parser("hub", help="carry the four buses where the kernel has no CAN")
    hub.add_argument(
        "--port", type=_port, default=29536, metavar="N", help="for socketcand clients; 0: any free (default: 29536)"
    )
    hub.add_argument("--local", type=Path, metavar="PATH", help="socket for raceloop's stations (default: your own)")

    bench = commands.add_parser("bench", help="measure the loop against the plain loop a user would write")
    bench.add_argument("--repeats", type=_count, default=5, help="pairs of runs (default: 5)")
    bench.add_argument(
        "--simulated-s", type=_positive, default=40.0, metavar="S", help="simulated seconds per run (default: 40)"
    )
    return parser


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a number above 0")
    return value


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a whole number from 0 to 65535")
    return int(text)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"is {text!r}; must be a whole number of at least 1")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
