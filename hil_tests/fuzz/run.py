"""Build the fuzz targets with clang, AddressSanitizer and UndefinedBehaviorSanitizer, and run each for a while.

What one finds is kept in build/fuzz/found, and the command that runs it again is printed.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "fuzz"
TARGETS = ("obc", "raptor", "space_drive", "parameters", "codec", "logs", "can_bus", "socketcand")
FLAGS = (
    "-O1 -g -fno-omit-frame-pointer -fsanitize=fuzzer-no-link,address,undefined,float-cast-overflow "
    "-fno-sanitize-recover=all"
)
LONGEST = 4096
"""Bytes of an input."""

DONE = re.compile(r"#(\d+)\s+DONE\s+cov: (\d+)")


def build() -> None:
    """Compile the targets; make recordings and seeds anew."""
    define = {
        "CMAKE_C_COMPILER": "clang", "CMAKE_BUILD_TYPE": "Debug", "CMAKE_C_FLAGS": FLAGS, "RACELOOP_WERROR": "ON",
        "RACELOOP_FUZZ": "ON", "Python_EXECUTABLE": sys.executable,
    }  # fmt: skip
    configure = [
        "cmake",
        "-S",
        ROOT,
        "-B",
        BUILD,
        "-G",
        "Ninja",
        *(f"-D{key}={value}" for key, value in define.items()),
    ]
    for command in (configure, ["cmake", "--build", BUILD, "--target", "fuzz"]):
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(done.stdout + done.stderr)
    shutil.rmtree(BUILD / "corpus", ignore_errors=True)
    subprocess.run([sys.executable, ROOT / "hil_tests" / "fuzz" / "corpus.py", BUILD], check=True)


def start(target: str, limit: str, seed: int) -> tuple[subprocess.Popen[str], float]:
    """Start one target; its inputs are the seeds, and what earlier long runs have learned."""
    learned, found = BUILD / "learned" / target, BUILD / "found" / target
    for folder in (learned, found):
        folder.mkdir(parents=True, exist_ok=True)
    # The first folder is written to. A run of so many inputs must not depend on earlier ones.
    folders = [BUILD / "corpus" / target] if limit.startswith("-runs") else [learned, BUILD / "corpus" / target]
    command = [
        BUILD / "hil_tests" / "fuzz" / f"fuzz_{target}", limit, f"-seed={seed}", f"-max_len={LONGEST}", "-timeout=10",
        "-print_final_stats=0", f"-artifact_prefix={found}/", *folders,
    ]  # fmt: skip
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True), time.monotonic()


def report(target: str, text: str, status: int, seconds: float) -> bool:
    """Print a row of the table; whether nothing was found."""
    done = DONE.search(text)
    if status == 0 and done is not None:
        print(
            f"{target:<12} {'clean':<8} {int(done[1]):>9} inputs {int(done[2]):>5} edges {seconds:>6.1f} s", flush=True
        )
        return True
    print(f"{target:<12} FOUND", flush=True)
    print("\n".join(line for line in text.splitlines() if re.search(r": not |runtime error|ERROR:| in \w+ /", line)))
    kept = re.search(r"Test unit written to (\S+)", text)
    if kept is None:
        print(text[-2000:])
    else:
        print(f"again: {BUILD / 'hil_tests' / 'fuzz' / f'fuzz_{target}'} {kept[1]}")
    return False


def main() -> int:
    """Run what the command line asks for; 1 when something was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    limit = parser.add_mutually_exclusive_group()
    limit.add_argument("--seconds", type=int, default=60, help="of each target (default: 60)")
    limit.add_argument("--runs", type=int, help="inputs of each target instead, the same with the same seed")
    parser.add_argument("--seed", type=int, default=1, help="(default: 1)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="targets at once (default: processors)")
    parser.add_argument("targets", nargs="*", default=TARGETS, metavar="TARGET", help=f"(default: {' '.join(TARGETS)})")
    options = parser.parse_args()
    if unknown := set(options.targets) - set(TARGETS):
        parser.error(f"no target {', '.join(sorted(unknown))}; there are {', '.join(TARGETS)}")
    build()
    print(f"seed {options.seed}")
    bound = f"-max_total_time={options.seconds}" if options.runs is None else f"-runs={options.runs}"
    waiting, clean = list(options.targets), True
    while waiting:
        group, waiting = waiting[: options.jobs], waiting[options.jobs :]
        for target, (process, begun) in [(target, start(target, bound, options.seed)) for target in group]:
            text = process.communicate()[1]
            clean = report(target, text, process.returncode, time.monotonic() - begun) and clean
    return 0 if clean else 1


if __name__ == "__main__":
    sys.exit(main())
