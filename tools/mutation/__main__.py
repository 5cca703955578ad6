"""`make mutate`: build the firmware with all its mutants, run them, print the score and who survived."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import yaml

from tools.mutation.pytest_mutants import Verdict
from tools.mutation.schemata import Mutant, Schemata

ROOT = Path(__file__).resolve().parents[2]
WORK = ROOT / "build" / "mutation"
SOURCE = WORK / "source"
ENVIRONMENT = WORK / "venv"
EQUIVALENT = Path(__file__).with_name("equivalent.yaml")

#: What decides about safety: SSM, parameter check, the checks of Raptor and Space Drive, and what they stand on.
FILES = (
    "firmware/common/codec.c",
    "firmware/common/debounce.c",
    "firmware/common/voter.c",
    "firmware/obc/fault_monitor.c",
    "firmware/obc/parameters.c",
    "firmware/obc/ssm.c",
    "firmware/raptor/command_monitor.c",
    "firmware/raptor/diagnostic.c",
    "firmware/raptor/gateway.c",
    "firmware/raptor/sys_state.c",
    "firmware/space_drive/axis.c",
    "firmware/space_drive/request.c",
    "firmware/space_drive/space_drive.c",
)
_HOME = "firmware/common/codec.c"
"""Linked into each extension module: holds the numbers."""

TARGET = 0.98


def build(files: Sequence[str]) -> list[Mutant]:
    """Copy the project, put the mutants in, install it into an environment of its own."""
    shutil.rmtree(SOURCE, ignore_errors=True)
    SOURCE.mkdir(parents=True)
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True).stdout
    for name in listed.decode().split("\0"):
        if name and (ROOT / name).is_file():
            (SOURCE / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, SOURCE / name)
    schemata = Schemata()
    texts = {name: schemata.instrument(name, (ROOT / name).read_bytes()) for name in files}
    home = texts.get(_HOME, (ROOT / _HOME).read_text())
    texts[_HOME] = home + (
        "\n#include <stdint.h>\n"
        '__attribute__((visibility("default"))) volatile uint32_t mutation_alive;\n'
        f'__attribute__((visibility("default"))) volatile uint8_t mutation_reached[{len(schemata.mutants) + 1}];\n'
    )
    for name, text in texts.items():
        (SOURCE / name).write_text(text)
    python = ENVIRONMENT / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", ENVIRONMENT], check=True)
        lend = "import sysconfig; print(sysconfig.get_path('purelib'))"
        packages = subprocess.run([sys.executable, "-c", lend], check=True, capture_output=True, text=True).stdout
        target = subprocess.run([python, "-c", lend], check=True, capture_output=True, text=True).stdout.strip()
        Path(target, "dependencies.pth").write_text(packages)
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(
        [
            *(str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-build-isolation"),
            *("--no-deps", "--editable", ".", "--config-settings=cmake.define.CMAKE_C_FLAGS=-w -std=gnu11"),
        ],
        cwd=SOURCE,
        check=True,
        env=os.environ | {"PATH": tools},
    )
    return schemata.mutants


def run(mutants: Sequence[Mutant], tests: Sequence[str], workers: int) -> dict[int, tuple[Verdict, int, str]]:
    """Verdict, number of tests that reach it, and who killed it, by mutant."""
    parts = []
    for part in range(workers):
        out = WORK / f"verdicts.{part}"
        arguments = [
            *("-m", "pytest", "-q", "-p", "tools.mutation.pytest_mutants", "-p", "no:cacheprovider", "-p", "no:xdist"),
            *("-m", "not realtime and not machine and not vcan", "--tb=no", "--no-header"),
            *(f"--mutants={len(mutants)}", f"--mutants-out={out}", f"--mutants-part={part}/{workers}", *tests),
        ]
        process = subprocess.Popen(
            [ENVIRONMENT / "bin" / "python", *arguments], cwd=SOURCE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        parts.append((process, out))
    verdicts: dict[int, tuple[Verdict, int, str]] = {}
    for process, out in parts:
        said, _ = process.communicate()
        if process.returncode:
            raise SystemExit(f"{said.decode()[-2000:]}\nmutation testing failed, status {process.returncode}")
        for line in out.read_text().splitlines():
            row = json.loads(line)
            verdicts[row["mutant"]] = (Verdict[row["verdict"]], row["tests"], row["by"])
    return verdicts


def report(mutants: Sequence[Mutant], verdicts: dict[int, tuple[Verdict, int, str]]) -> bool:
    """Print the score, and each survivor that nobody has explained; tells whether the target is met."""
    reasons: dict[str, str] = yaml.safe_load(EQUIVALENT.read_text()) or {}
    survivors = [one for one in mutants if verdicts[one.number][0] in (Verdict.SURVIVED, Verdict.NOT_REACHED)]
    explained = [one for one in survivors if _reason(reasons, one)]
    counts = Counter(verdict for verdict, _, _ in verdicts.values())
    for one in survivors:
        if not _reason(reasons, one):
            verdict, reached_by, _ = verdicts[one.number]
            print(f"{verdict.name.lower()}, {reached_by} tests: {one.path}:{one.line}: {one.key.split(':', 1)[1]}")
    by_file: dict[str, Counter[Verdict]] = {}
    for one in mutants:
        by_file.setdefault(one.path, Counter())[verdicts[one.number][0]] += 1
    print(f"{'file':<36}{'mutants':>8}{'killed':>8}{'timeout':>8}{'crashed':>8}{'survived':>9}{'not reached':>12}")
    for path, found in by_file.items():
        print(
            f"{path:<36}{found.total():>8}{found[Verdict.KILLED]:>8}{found[Verdict.TIMED_OUT]:>8}"
            f"{found[Verdict.CRASHED]:>8}{found[Verdict.SURVIVED]:>9}{found[Verdict.NOT_REACHED]:>12}"
        )
    valid = len(mutants) - counts[Verdict.CRASHED]
    killed = counts[Verdict.KILLED] + counts[Verdict.TIMED_OUT]
    score, alive = killed / valid, valid - killed - len(explained)
    print(f"{len(mutants)} mutants, of which {counts[Verdict.CRASHED]} crash and are not counted")
    print(f"of {valid} {killed} are killed: {score:.1%} (target {TARGET:.0%})")
    print(f"of the others {len(explained)} change nothing (equivalent.yaml), {alive} are not explained")
    unused = sorted(reasons.keys() - {one.key for one in explained})
    for key in unused:
        print(f"equivalent.yaml: {key}: no such survivor")
    return score >= TARGET and not alive and not unused


def _reason(reasons: dict[str, str], mutant: Mutant) -> str:
    return reasons.get(mutant.key, "")


def main() -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tools.mutation", description=__doc__)
    parser.add_argument("tests", nargs="*", default=["hil_tests/unit"], help="(default: hil_tests/unit)")
    parser.add_argument("--file", action="append", help="source to mutate (default: what decides about safety)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)")
    options = parser.parse_args()
    mutants = build(options.file or FILES)
    return 0 if report(mutants, run(mutants, options.tests, options.workers)) else 1


if __name__ == "__main__":
    sys.exit(main())
