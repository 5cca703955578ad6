"""Run the SocketCAN tests, or any command, where vcan0 to vcan4 exist: on this kernel if it can, else in the guest."""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.realtime.vcan import kernel_has_can
from dbc.errors import RaceloopError
from tools.exit_status import ExitStatus
from tools.vcan_machine import kernel, machine
from tools.vcan_machine.junit import read_junit

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "vcan"
NETWORK = Path(__file__).with_name("network.sh")

DRIVE = "hil_tests/vcan/test_drive.py"
ALL_TESTS = ("hil_tests/contract/test_bus_backends.py", "hil_tests/vcan")
TEST_PROGRAMS = {"ip": "iproute2", "candump": "can-utils", "unshare": "util-linux"}
"""What the tests need of the host, and the Debian package of each."""
PYTHON_IN_GUEST = {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONUNBUFFERED": "1", "RACELOOP_GUEST": "1"}
"""Environment there. RACELOOP_GUEST lets a test set the wall clock, which is nobody else's."""
HANG_S = 300
"""A test that takes longer has its stack printed."""


@dataclass(frozen=True)
class Guest:
    """A kernel of the guest and what runs on it.

    Attributes
    ----------
    metapackage : Debian package that depends on the kernel's.
    tests : files or folders.
    left_out : files in these folders that another kernel runs.
    """

    metapackage: str
    tests: tuple[str, ...]
    left_out: tuple[str, ...] = ()


# The drive takes minutes under emulation, so one kernel has to do.
GUESTS = {
    "stock": Guest("linux-image-amd64", ALL_TESTS, left_out=(DRIVE,)),
    "rt": Guest(
        "linux-image-rt-amd64", (DRIVE, "hil_tests/vcan/test_ecus_on_vcan.py", "hil_tests/vcan/test_socketcan_link.py")
    ),
}
HERE = "own"


def _asked_for() -> dict[str, str]:
    """What the user has set for the tests, which the guest would not see otherwise."""
    return {name: value for name, value in os.environ.items() if name.startswith("RACELOOP_")}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    options = make_parser().parse_args(arguments)
    os.chdir(ROOT)
    try:
        require(TEST_PROGRAMS)
        kernels = options.kernel or choose_kernels()
        if set(kernels) != {HERE}:
            if platform.machine() != "x86_64":
                raise RaceloopError("the test machine runs this machine's programs, and emulates x86-64 only")
            require(machine.PROGRAMS)
        # Each runs, whatever the others came to.
        passed = [run(name, options.command, options.timeout) for name in kernels]
    except RaceloopError as error:
        print(f"vcan_machine: {error}", file=sys.stderr)
        return ExitStatus.USER_ERROR
    except KeyboardInterrupt:
        return ExitStatus.INTERRUPTED
    return ExitStatus.DONE if all(passed) else ExitStatus.MISSED


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = argparse.ArgumentParser(prog="python -m tools.vcan_machine", description=__doc__)
    parser.add_argument(
        "--kernel",
        action="append",
        choices=(HERE, *GUESTS),
        help="own: this machine's; stock, rt: Debian's, under QEMU (default: own if it has vcan, else stock and rt)",
    )
    parser.add_argument("--timeout", type=int, default=1800, metavar="S", help="seconds per kernel (default: 1800)")
    parser.add_argument("command", nargs="*", help="run this instead of the tests (put -- before it)")
    return parser


def require(programs: Mapping[str, str]) -> None:
    """See that programs are installed.

    Raises
    ------
    RaceloopError
        Some are not; the text names their packages.
    """
    if packages := machine.missing_programs(programs):
        raise RaceloopError(f"programs are missing; run: sudo apt-get install {' '.join(packages)}")


def choose_kernels() -> list[str]:
    """Own kernel if it can have vcan interfaces, else every kernel of the guest."""
    tried = subprocess.run(own_network("true"), check=False, capture_output=True)
    if kernel_has_can() and tried.returncode == 0:
        print("this kernel has vcan: the tests run on it, in a network namespace of their own", flush=True)
        return [HERE]
    print("this kernel has no vcan that may be used: the tests run on Debian's, under QEMU", flush=True)
    return [*GUESTS]


def own_network(*command: str) -> list[str]:
    """Command that runs another in a fresh network namespace with vcan0 to vcan4; user namespaces spare it rights."""
    user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    return ["unshare", *user, "--net", "sh", str(NETWORK), *command]


def run(name: str, command: Sequence[str], timeout_s: float) -> bool:
    """Run the tests, or the command given, on one kernel; tells whether they passed."""
    results = BUILD / name
    begin = time.monotonic()
    try:
        if name == HERE:
            results.mkdir(parents=True, exist_ok=True)
            (results / "junit.xml").unlink(missing_ok=True)
            wanted = command or pytest_command(ALL_TESTS, results, ())
            status = subprocess.run(own_network(*wanted), check=False, timeout=timeout_s).returncode
        else:
            package = kernel.newest(GUESTS[name].metapackage)
            print(f"{name}: {package}", flush=True)
            guest = GUESTS[name]
            wanted = ["sh", str(NETWORK), *(command or pytest_command(guest.tests, Path("/results"), guest.left_out))]
            status = machine.run_in_guest(
                kernel.fetch(package, BUILD), wanted, results, timeout_s, show, PYTHON_IN_GUEST | _asked_for()
            )
    except (machine.MachineError, subprocess.TimeoutExpired) as error:
        print(f"{name}: FAILED: {error}", flush=True)
        return False
    took = f"{time.monotonic() - begin:.0f} s"
    if command:
        print(f"{name}: exit status {status} after {took}", flush=True)
        return status == 0
    outcome = read_junit(results / "junit.xml")
    passed = status == 0 and outcome is not None and outcome.passed
    print(
        f"{name}: {'passed' if passed else 'FAILED'}: {outcome or 'no results'}, exit status {status}, {took}",
        flush=True,
    )
    return passed


def pytest_command(paths: Sequence[str], results: Path, left_out: Sequence[str]) -> list[str]:
    """Command of the SocketCAN tests."""
    options = ["-m", "vcan", f"--junit-xml={results / 'junit.xml'}", "-o", f"faulthandler_timeout={HANG_S}"]
    options += [f"--ignore={path}" for path in left_out]
    return [sys.executable, "-m", "pytest", *options, *paths]


def show(output: bytes) -> None:
    """Pass on output of the guest."""
    sys.stdout.buffer.write(output)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    sys.exit(main())
