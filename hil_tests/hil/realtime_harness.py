"""`raceloop run --realtime` as a user starts it: a process, what it prints, and the processes below it."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any

from bridge.realtime.placement import Placement
from dbc.errors import RaceloopError

BOUND_S = 90.0
"""Generous: waits end as soon as what they wait for has happened."""

RACELOOP = Path(sys.executable).with_name("raceloop")


def placement_words() -> list[str]:
    """Options that keep other work on the machine away from the run, as far as this user may."""
    try:
        Placement(priority=80).check()
    except RaceloopError:
        return []
    return ["--priority", "80", "--cpu", str(max(os.sched_getaffinity(0)))]


def until(condition: Callable[[], object], what: str) -> None:
    """Wait until the condition holds."""
    end = time.monotonic() + BOUND_S
    while not condition():
        assert time.monotonic() < end, f"waited {BOUND_S} s for {what}"
        time.sleep(0.01)


def children_of(process: int) -> dict[str, int]:
    """Processes below a process by the names of their parts: obc, raptor, ..., plant, autonomy, hub, recorder."""
    found: dict[str, int] = {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal():
            continue
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            words = (folder / "cmdline").read_bytes().decode().split("\0")
        except (OSError, IndexError):
            continue
        if parent == process:
            found[_part(words)] = int(folder.name)
    return found


def _part(words: list[str]) -> str:
    if "bridge.log_writer" in words:
        return "recorder"
    if "tools.station" in words:
        return words[words.index("tools.station") + 1]
    return Path(words[0]).name.removeprefix("raceloop-")


def alive(process: int) -> bool:
    """True while the process exists and has not ended; one whose end nobody has taken note of does not count."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


class RealTimeCommand:
    """The command as a process; a context manager that leaves nothing behind.

    Attributes
    ----------
    folder : of the recording.
    errors, output : lines so far on standard error and output.
    """

    def __init__(self, folder: Path, scenario: str | Path = "short_drive", *more: str) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [RACELOOP, "run", str(scenario), "--realtime", "--out", str(folder), *placement_words(), *more],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder.parent,
            env={**os.environ, "PYTHONFAULTHANDLER": "1"},  # `wait` asks one that hangs where it is
        )
        self.errors: list[str] = []
        self.output: list[str] = []
        self._readers = [
            Thread(target=self._read, args=pair)
            for pair in ((self.process.stdout, self.output), (self.process.stderr, self.errors))
        ]
        for reader in self._readers:
            reader.start()
        self.children: dict[str, int] = {}

    def __enter__(self) -> RealTimeCommand:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGKILL)
        self.process.wait(BOUND_S)
        until(lambda: not self.left(), "all processes of the run to end")
        for reader in self._readers:
            reader.join(BOUND_S)
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.process.stdout.close()
        self.process.stderr.close()

    def left(self) -> list[str]:
        """Parts whose processes have not ended."""
        return [name for name, process in self.children.items() if alive(process)]

    def wait_for_start(self, *parts: str) -> None:
        """Wait until these parts run."""

        def all_there() -> bool:
            assert self.process.poll() is None, self.errors
            self.children |= children_of(self.process.pid)
            return set(parts) <= set(self.children)

        until(all_there, f"{parts} to run")

    def wait_for_line(self, words: str) -> str:
        """The first line on standard error that holds the words."""

        def there() -> bool:
            assert self.process.poll() is None or any(words in line for line in self.errors), self.errors
            return any(words in line for line in self.errors)

        until(there, f"a line with {words!r}")
        return next(line for line in self.errors if words in line)

    def printed_command(self, part: str) -> list[str]:
        """The command that starts a part which was left out."""

        def lines() -> list[str]:
            at = [place for place, line in enumerate(self.output) if line.startswith(f"Without {part}.")]
            return self.output[at[0] + 1 :][:1] if at else []

        until(lines, f"the command that starts {part}")
        return shlex.split(lines()[0])

    def wait(self) -> int:
        """Wait until it ends; returns its exit status. One that hangs is made to tell where, with its children."""
        try:
            status = self.process.wait(BOUND_S)
        except subprocess.TimeoutExpired:
            left = children_of(self.process.pid)
            for process in (*left.values(), self.process.pid):
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGABRT)
            self.process.wait(BOUND_S)
            until(lambda: not any(map(alive, left.values())), "the children to end")
            said = "\n".join(self.errors)
            raise AssertionError(
                f"has not ended within {BOUND_S} s; left are {sorted(left)}; it said\n{said}"
            ) from None
        for reader in self._readers:
            reader.join(BOUND_S)
        return status

    def summary(self) -> dict[str, Any]:
        """What the run has written about itself."""
        summary: dict[str, Any] = json.loads((self.folder / "summary.json").read_text())
        return summary

    @staticmethod
    def _read(stream: Any, lines: list[str]) -> None:
        lines.extend(line.rstrip("\n") for line in stream)
