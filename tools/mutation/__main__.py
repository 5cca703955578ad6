"""`make mutate`: build the firmware with all its mutants, run them, print the score and who survived."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path

import yaml

from tools.mutation import verdicts
from tools.mutation.schemata import Mutant, Schemata
from tools.mutation.verdicts import Row, Verdict

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

_NO_INFLUENCE = (
    *("Makefile", "docs/strength.md", "tools/mutation/"),
    *("hil_tests/contract/", "hil_tests/hil/", "hil_tests/vcan/"),
)
"""Nothing here is run, or has a say in what a unit test does."""

TARGET = 0.98


def build(files: Sequence[str] = FILES) -> tuple[list[Mutant], str]:
    """Copy the project with the mutants in it, and install it into an environment of its own if anything changed.

    Returns
    -------
    mutants, and digest of all that has a say in a verdict except the test modules.
    """
    schemata = Schemata()
    texts = {name: schemata.instrument(name, (ROOT / name).read_bytes()).encode() for name in files}
    home = texts.get(_HOME, (ROOT / _HOME).read_bytes())
    texts[_HOME] = home + (
        b"\n#include <stdint.h>\n"
        b'__attribute__((visibility("default"))) volatile uint32_t mutation_alive;\n'
        b'__attribute__((visibility("default"))) volatile uint8_t mutation_reached[%d];\n'
    ) % (len(schemata.mutants) + 1)
    listed = subprocess.run(
        ["git", "ls-files", "-zco", "--exclude-standard"], cwd=ROOT, check=True, capture_output=True
    ).stdout
    names = [name for name in listed.decode().split("\0") if name and (ROOT / name).is_file()]
    digest = sha256()
    for name in names:
        text = texts.get(name) or (ROOT / name).read_bytes()
        _put(SOURCE / name, text, (ROOT / name).stat().st_mode)
        if not name.startswith((*_NO_INFLUENCE, "hil_tests/unit/test_")):
            digest.update(name.encode() + b"\0" + sha256(text).digest())
    for path in SOURCE.glob("hil_tests/unit/*.py"):
        if path.relative_to(SOURCE).as_posix() not in names:
            path.unlink()
    project = digest.hexdigest()[:16]
    built = WORK / "built"
    if not built.exists() or built.read_text() != project:
        built.unlink(missing_ok=True)
        _install()
        built.write_text(project)
    return schemata.mutants, project


def _put(path: Path, text: bytes, mode: int) -> None:
    """Write a file unless it is there as it should be: what is not touched is not compiled again."""
    if not path.exists() or path.read_bytes() != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text)
    path.chmod(mode)


def _install() -> None:
    python = ENVIRONMENT / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", ENVIRONMENT], check=True)
        lend = "import sysconfig; print(sysconfig.get_path('purelib'))"
        packages = subprocess.run([sys.executable, "-c", lend], check=True, capture_output=True, text=True).stdout
        target = subprocess.run([python, "-c", lend], check=True, capture_output=True, text=True).stdout.strip()
        Path(target, "dependencies.pth").write_text(packages)
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    # A mutant may count down where it should count up: what overflows then wraps, and is not undefined.
    flags = "--config-settings=cmake.define.CMAKE_C_FLAGS=-w -std=gnu11 -fwrapv"
    subprocess.run(
        [
            *(str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-build-isolation"),
            *("--no-deps", "--editable", ".", flags),
        ],
        cwd=SOURCE,
        check=True,
        env=os.environ | {"PATH": tools},
    )


def run(mutants: Sequence[Mutant], project: str, files: Sequence[str], tests: Sequence[str], workers: int) -> None:
    """Judge the mutants of some files; verdicts are kept in `build/mutation/verdicts.jsonl`."""
    known = [{"number": one.number, "key": one.key, "path": one.path} for one in mutants]
    listed = {"project": project, "files": list(files), "mutants": known}
    (WORK / "mutants.json").write_text(json.dumps(listed))
    arguments = [
        *(
            "-m",
            "pytest",
            "-o",
            "addopts=--strict-markers",
            "-p",
            "tools.mutation.pytest_mutants",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:xdist",
        ),
        *("-p", "no:terminal", "-p", "no:faulthandler"),
        *("-m", "not realtime and not machine and not vcan"),
        *("--assert=plain", "--capture=sys", f"--mutants={WORK}", f"--mutants-workers={workers}", *tests),
    ]
    done = subprocess.run([ENVIRONMENT / "bin" / "python", *arguments], cwd=SOURCE, check=False)
    if done.returncode:
        raise SystemExit(f"mutation testing failed, status {done.returncode}")


def report(mutants: Sequence[Mutant], rows: Mapping[str, Row]) -> bool:
    """Print the score, and each survivor that nobody has explained; tells whether the target is met."""
    reasons: dict[str, str] = yaml.safe_load(EQUIVALENT.read_text()) or {}
    found = {one.key: Verdict[rows[one.key].verdict] for one in mutants}
    survivors = [one for one in mutants if found[one.key] in (Verdict.SURVIVED, Verdict.NOT_REACHED)]
    explained = [one for one in survivors if reasons.get(one.key)]
    for one in survivors:
        if not reasons.get(one.key):
            name = found[one.key].name.lower().replace("_", " ")
            print(f"{name}, {rows[one.key].tests} tests: {one.path}:{one.line}: {one.key.partition(':')[2]}")
    by_file: dict[str, Counter[Verdict]] = {}
    for one in mutants:
        by_file.setdefault(one.path, Counter())[found[one.key]] += 1
    total: Counter[Verdict] = sum(by_file.values(), Counter())
    print(f"{'file':<36}{'mutants':>8}{'killed':>8}{'time-out':>9}{'crashed':>8}{'survived':>9}{'not reached':>12}")
    for path, counts in (*by_file.items(), ("all", total)):
        print(
            f"{path:<36}{counts.total():>8}{counts[Verdict.KILLED]:>8}{counts[Verdict.TIMED_OUT]:>9}"
            f"{counts[Verdict.CRASHED]:>8}{counts[Verdict.SURVIVED]:>9}{counts[Verdict.NOT_REACHED]:>12}"
        )
    killed = total[Verdict.KILLED]
    valid = killed + len(survivors)
    score, alive = killed / valid, len(survivors) - len(explained)
    print(f"valid are the {valid} that neither crash nor run out of time")
    print(f"a test fails for {killed} of them: {score:.1%} (target {TARGET:.0%})")
    print(f"of the others {len(explained)} change nothing (equivalent.yaml), {alive} are not explained")
    paths = tuple(f"{path}:" for path in by_file)
    unused = sorted(key for key in reasons.keys() - {one.key for one in explained} if key.startswith(paths))
    for key in unused:
        print(f"equivalent.yaml: {key}: no such survivor")
    return score >= TARGET and not alive and not unused


def main() -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tools.mutation", description=__doc__)
    parser.add_argument("tests", nargs="*", default=["hil_tests/unit"], help="(default: hil_tests/unit)")
    parser.add_argument("--file", action="append", choices=FILES, help="take its mutants only (default: all)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)")
    parser.add_argument("--fresh", action="store_true", help="forget the verdicts that are kept")
    options = parser.parse_args()
    if options.fresh:
        shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True, exist_ok=True)
    mutants, project = build()
    files = options.file or FILES
    run(mutants, project, files, options.tests, options.workers)
    chosen = [one for one in mutants if one.path in files]
    return 0 if report(chosen, verdicts.load(WORK / "verdicts.jsonl")) else 1


if __name__ == "__main__":
    sys.exit(main())
