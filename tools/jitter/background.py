"""Programs of others that run beside a measurement: bounded, and ended whatever happens."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from types import TracebackType

from bridge.realtime.process import end_with_parent
from dbc.errors import RaceloopError

#: How long a program may take to end when asked to, s.
_GRACE_S = 2.0


def find_program(name: str) -> str | None:
    """Path of a program, also where an ordinary user's search path does not lead; None when it is not installed."""
    folders = [*os.get_exec_path(), "/usr/local/sbin", "/usr/sbin", "/sbin"]
    return shutil.which(name, path=os.pathsep.join(folders))


class Background:
    """A program that runs beside; a context manager. It has a process group of its own, which ends with it.

    When this process is killed, the kernel asks the program to stop.

    Parameters
    ----------
    name : for people.
    command : program and arguments.

    Raises
    ------
    RaceloopError
        When it cannot start.
    """

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self.name = name
        self._words = tempfile.TemporaryFile()  # noqa: SIM115 (closed in __exit__)
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._words,
                process_group=0,
                preexec_fn=end_with_parent,  # noqa: PLW1509 (one system call)
            )
        except OSError as error:
            self._words.close()
            raise RaceloopError(f"{name}: cannot start {command[0]}: {error.strerror}") from error

    def __enter__(self) -> Background:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._end()
        self._words.close()

    @property
    def running(self) -> bool:
        """True until it has ended."""
        return self._process.poll() is None

    @property
    def process_id(self) -> int:
        """Of the program, and of its process group."""
        return self._process.pid

    def wait(self, timeout_s: float) -> None:
        """Wait until it has ended by itself.

        Raises
        ------
        RaceloopError
            When it takes longer, or ends with an error: with its last words.
        """
        try:
            status = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired as error:
            raise RaceloopError(f"{self.name} has not ended in time") from error
        if status != 0:
            raise RaceloopError(f"{self.name}: {self._last_words() or f'ended with status {status}'}")

    def stop(self, timeout_s: float) -> None:
        """Ask it to stop, if it has not ended yet, and wait until it has.

        Raises
        ------
        RaceloopError
            As `wait`.
        """
        with suppress(ProcessLookupError):
            self._process.terminate()
        self.wait(timeout_s)

    def _end(self) -> None:
        """End the whole group: first asked, then forced."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGTERM)
        try:
            self._process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            pass
        finally:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def _last_words(self) -> str:
        self._words.seek(0)
        lines = self._words.read().decode("utf-8", "replace").strip().splitlines()
        return lines[-1].strip() if lines else ""
