"""Check the firmware and the bench's C with cppcheck and its MISRA C:2012 add-on, against misra.txt.

Fails on a finding that misra.txt has no line for, and on a line that nothing is found for.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build" / "misra"
REASONS = Path(__file__).with_name("misra.txt")
IMAGE = ("firmware/common", "firmware/obc", "firmware/raptor", "firmware/space_drive")
HOST = ("firmware/ports", "bridge/native")

_FINDING = re.compile(r"^(?P<file>[^:]+):(?P<line>\d+): (?P<id>\S+?): ?(?P<text>.*)$")


@dataclass(frozen=True)
class Finding:
    """One line of the checker: file relative to the project, line number, rule number or the checker's own id."""

    file: str
    line: int
    rule: str


@dataclass(frozen=True)
class Deviation:
    """One line of misra.txt."""

    rule: str
    where: str
    reason: str

    def covers(self, finding: Finding) -> bool:
        """Whether it gives the reason of a finding."""
        if finding.rule != self.rule:
            return False
        places = {"any": (*IMAGE, *HOST), "image": IMAGE, "host": HOST}.get(self.where)
        return finding.file == self.where if places is None else finding.file.startswith(places)


def read_deviations(text: str) -> list[Deviation]:
    """Read misra.txt.

    Raises
    ------
    ValueError
        A line has no reason.
    """
    rows = [line.split(maxsplit=2) for line in text.splitlines() if line and not line.startswith("#")]
    for row in rows:
        if len(row) < 3:
            raise ValueError(f"{REASONS.name}: {' '.join(row)}: RULE WHERE REASON are needed")
    return [Deviation(*row) for row in rows]


def read_findings(text: str) -> list[Finding]:
    """Read what cppcheck printed."""
    found = [match for line in text.splitlines() if (match := _FINDING.match(line))]
    return [Finding(m["file"], int(m["line"]), m["id"].removeprefix("misra-c2012-")) for m in found]


def judge(findings: Iterable[Finding], deviations: list[Deviation]) -> list[str]:
    """What is wrong: findings without a reason, reasons without a finding."""
    used: Counter[Deviation] = Counter()
    wrong = []
    for finding in findings:
        reasons = [deviation for deviation in deviations if deviation.covers(finding)]
        used.update(reasons)
        if not reasons:
            wrong.append(f"{finding.file}:{finding.line}: {finding.rule}: no reason in {REASONS.name}")
    wrong += [f"{REASONS.name}: {d.rule} {d.where}: nothing is found for it" for d in deviations if not used[d]]
    return wrong


def check(folders: Iterable[str]) -> str:
    """Run cppcheck over folders; what it printed."""
    for package in ("firmware", "dbc"):
        subprocess.run([sys.executable, "-m", f"{package}.generate", "--out", BUILD], check=True, cwd=ROOT)
    command = [
        "cppcheck", "--addon=misra", "--std=c11", "--quiet", "--enable=warning,performance,portability", "-j", "2",
        "-I", "firmware", "-I", str(BUILD), "-I", ".", "--template={file}:{line}: {id}: {message}",
        f"--suppress=*:{BUILD}/*", *folders,
    ]  # fmt: skip
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=ROOT)
    if done.returncode != 0:
        sys.exit(done.stdout + done.stderr)
    return done.stderr


def main() -> int:
    """1 when something is wrong."""
    if shutil.which("cppcheck") is None:
        sys.exit("cppcheck is not installed; run: sudo apt-get install cppcheck")
    findings = read_findings(check((*IMAGE, *HOST)))
    deviations = read_deviations(REASONS.read_text())
    wrong = judge(findings, deviations)
    print("\n".join(wrong) if wrong else f"{len(findings)} findings, each with one of {len(deviations)} reasons")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
