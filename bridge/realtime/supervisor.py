"""Starts the processes of a run on one epoch, watches them, and ends every one of them.

A station gets ready, then waits for the epoch of the run; `Start` says how it learns the epoch. Every process has a
process group of its own, so that Ctrl-C reaches the supervisor only, which then stops them in order. When the
supervisor is killed, the stations end by themselves: their commands hold `--with-parent`.
"""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import Enum
from types import TracebackType

from dbc.errors import RaceloopError

#: The line with which a part says that it is ready.
READY = "ready"

#: Longest line of a log that is forwarded in one piece.
_LINE_MAX = 4096

#: How often a wait looks whether a process has ended, s. What a process logs ends the wait at once.
_LOOK_S = 0.02


class Start(Enum):
    """When a part starts, and how it learns the epoch."""

    SERVICE = 1
    """Before all stations, and without an epoch: the hub."""
    PREPARES = 2
    """Takes long to get ready: with `--epoch -` it writes a line `ready`, then reads the epoch from standard input."""
    AT_ONCE = 3
    """When all others are ready, with `--epoch NS`."""


@dataclass(frozen=True)
class Part:
    """One process of a run.

    Attributes
    ----------
    name : for people.
    command : program and arguments without `--epoch`, which the supervisor adds.
    start : when it starts.
    is_ready : true once the process is ready; None: the part says so itself with a line `ready`.
    environment : variables that it gets besides the supervisor's.
    """

    name: str
    command: tuple[str, ...]
    start: Start = Start.AT_ONCE
    is_ready: Callable[[], bool] | None = None
    environment: Mapping[str, str] = field(default_factory=dict)

    def command_line(self, epoch_ns: int) -> list[str]:
        """The whole command."""
        match self.start:
            case Start.SERVICE:
                return list(self.command)
            case Start.PREPARES:
                return [*self.command, "--epoch", "-"]
            case Start.AT_ONCE:
                return [*self.command, "--epoch", str(epoch_ns)]


@dataclass(frozen=True)
class Ended:
    """A process that has ended.

    Attributes
    ----------
    name : of the part.
    status : exit status, or minus the number of the signal.
    time_ns : when it was seen, CLOCK_MONOTONIC.
    last_line : the last that it logged; empty when it logged nothing.
    """

    name: str
    status: int
    time_ns: int
    last_line: str

    def __str__(self) -> str:
        if self.status < 0:
            return f"{self.name} was ended by {signal_name(-self.status)}"
        return f"{self.name} ended with status {self.status}"


def signal_name(number: int) -> str:
    """Name of a signal; most real-time signals have none."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


@contextmanager
def _signals_held() -> Iterator[None]:
    """Let SIGINT and SIGTERM wait: a process in the middle of being started would be left running, known to nobody."""
    if threading.current_thread() is not threading.main_thread():  # others get no KeyboardInterrupt
        yield
        return
    held: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _frame: held.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if held:
            signal.raise_signal(held[0])


class _Running:
    """A process of a part, and the pipe with all that it writes."""

    def __init__(self, part: Part, epoch_ns: int) -> None:
        command = part.command_line(epoch_ns)
        asks = part.start is Start.PREPARES
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE if asks else subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env={**os.environ, **part.environment},
                process_group=0,
            )
        except OSError as error:
            raise RaceloopError(f"{part.name}: cannot start {command[0]}: {error.strerror}") from error
        assert self.process.stdout is not None
        os.set_blocking(self.process.stdout.fileno(), False)
        self.part = part
        self.ready = False
        self.early: list[str] = []
        self.last_line = ""
        self.drained = False
        self._rest = b""

    def fileno(self) -> int:
        assert self.process.stdout is not None
        return self.process.stdout.fileno()

    def lines(self) -> list[str]:
        """Lines that have come in; never blocks."""
        while not self.drained:
            try:
                chunk = os.read(self.fileno(), 1 << 16)
            except BlockingIOError:
                break
            self.drained = not chunk
            self._rest += chunk
        *whole, self._rest = self._rest.split(b"\n")
        if self.drained or self.process.returncode is not None or len(self._rest) > _LINE_MAX:
            whole.append(self._rest)
            self._rest = b""
        head = f"raceloop-{self.part.name}: "
        texts = [text for line in whole if (text := line.decode("utf-8", "replace").rstrip().removeprefix(head))]
        if texts:
            self.last_line = texts[-1]
        return texts

    def tell(self, epoch_ns: int) -> None:
        """Give the epoch to a part that waits for it."""
        if self.process.stdin is not None:
            with suppress(BrokenPipeError):  # it has ended, as the next look at it shows
                self.process.stdin.write(b"%d\n" % epoch_ns)
                self.process.stdin.flush()

    def close(self) -> None:
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()


class Supervisor:
    """The processes of one run. A context manager: on the way out, all of them end.

    Parameters
    ----------
    parts : in the order in which they start; of different names.
    on_line : takes name and line of what a part logs, without the `raceloop-NAME: ` at its head. What it logs before
        the run has started, or before it is ready, comes then.
    lead_s : from the moment when all that prepare are ready to the epoch.
    ready_s : how long parts may take to get ready.

    Attributes
    ----------
    epoch_ns : of the run, CLOCK_MONOTONIC; 0 before `start` has chosen it.
    ended : the processes that have ended, in order.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        on_line: Callable[[str, str], None] = lambda _name, _line: None,
        lead_s: float = 1.0,
        ready_s: float = 300.0,
    ) -> None:
        self._parts = {part.name: part for part in parts}
        if len(self._parts) != len(parts):
            raise ValueError("two parts have one name")
        self._on_line = on_line
        self._lead_ns = round(lead_s * 1e9)
        self._ready_s = ready_s
        self._running: dict[str, _Running] = {}
        self._selector = selectors.DefaultSelector()
        self._started = False
        self.epoch_ns = 0
        self.ended: list[Ended] = []

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()
        self._selector.close()

    @property
    def running(self) -> list[str]:
        """Names of the parts whose processes run, or are stopped by a signal."""
        return list(self._running)

    def is_ready(self, name: str) -> bool:
        """True when the part runs and has got ready."""
        return name in self._running and self._running[name].ready

    def process_id(self, name: str) -> int:
        """Process of a part that runs."""
        return self._running[name].process.pid

    def start(self, when_set: Callable[[int], None] = lambda _epoch_ns: None) -> None:
        """Start all parts, wait until they are ready, and set the epoch `lead_s` ahead.

        Parameters
        ----------
        when_set : called with the epoch when the hub runs and before any station knows it, to attach in time.

        Raises
        ------
        RaceloopError
            When a part cannot start, ends before it is ready, or is not ready in time: with its own last line.
            Then nothing is left running.
        """
        try:
            self._launch(Start.SERVICE)
            self._launch(Start.PREPARES)
            self.epoch_ns = time.monotonic_ns() + self._lead_ns
            when_set(self.epoch_ns)
            for running in self._running.values():
                running.tell(self.epoch_ns)
            self._launch(Start.AT_ONCE)
        except BaseException:
            self.stop()
            raise
        self._started = True
        for running in self._running.values():
            self._catch_up(running)

    def poll(self, timeout_s: float = 0.0) -> list[Ended]:
        """Forward what the parts log, give the epoch to those that have got ready, find those that have ended.

        Parameters
        ----------
        timeout_s : how long to wait for a line; a process that ends does not cut it short.

        Returns
        -------
        list of Ended
            The processes that have ended since the last look at them.
        """
        for key, _ in self._selector.select(timeout_s):
            self._forward(key.data)
        ended = []
        for running in list(self._running.values()):
            if running.process.poll() is not None:
                ended.append(self._bury(running))
            elif not running.ready and running.part.is_ready is not None and running.part.is_ready():
                self._got_ready(running)
        return ended

    def kill(self, name: str, number: int) -> None:
        """Send a signal to a part's process; nothing happens when it has ended."""
        if name in self._running:
            self._running[name].process.send_signal(number)

    def restart(self, name: str) -> None:
        """Start a part again that has ended, on the epoch of the run. Does not wait until it is ready; `poll` goes on.

        Raises
        ------
        RaceloopError
            When it cannot start.
        """
        if name in self._running:
            raise ValueError(f"{name} still runs")
        self._spawn(self._parts[name])

    def stop(self, grace_s: float = 5.0, meanwhile: Callable[[], None] = lambda: None) -> None:
        """End all processes: the stations, then what they run on. Safe at any time; `ended` tells how they ended.

        Each is asked to stop, and woken in case a signal has stopped it. One that has not ended after the grace is
        killed. A Ctrl-C cuts the grace short.

        Parameters
        ----------
        grace_s : how long a part may take to end.
        meanwhile : called again and again while waiting.
        """
        try:
            self.stop_stations(grace_s, meanwhile)
        finally:
            self._end(list(self._running), grace_s, meanwhile)

    def stop_stations(self, grace_s: float = 5.0, meanwhile: Callable[[], None] = lambda: None) -> None:
        """End all but the services, see `stop`."""
        services = [name for name, running in self._running.items() if running.part.start is Start.SERVICE]
        self._end([name for name in self._running if name not in services], grace_s, meanwhile)

    def _end(self, names: Sequence[str], grace_s: float, meanwhile: Callable[[], None]) -> None:
        try:
            for name in names:
                self.kill(name, signal.SIGTERM)
                self.kill(name, signal.SIGCONT)
            deadline = time.monotonic() + grace_s
            while self._left(names) and time.monotonic() < deadline:
                self.poll(_LOOK_S)
                meanwhile()
        finally:
            for running in self._left(names):
                running.process.kill()
                running.process.wait()
                self._bury(running)

    def _left(self, names: Sequence[str]) -> list[_Running]:
        return [self._running[name] for name in names if name in self._running]

    def _launch(self, start: Start) -> None:
        """Start the parts of a kind and wait until they are ready."""
        names = [part.name for part in self._parts.values() if part.start is start]
        for name in names:
            self._spawn(self._parts[name])
        deadline = time.monotonic() + self._ready_s
        while waiting := [name for name in names if not self.is_ready(name)]:
            for ended in self.poll(_LOOK_S):
                raise RaceloopError(ended.last_line or f"{ended} before it was ready")
            if time.monotonic() > deadline:
                raise RaceloopError(f"{waiting[0]} was not ready after {self._ready_s:g} s")

    def _spawn(self, part: Part) -> None:
        with _signals_held():
            running = self._running[part.name] = _Running(part, self.epoch_ns)
        self._selector.register(running, selectors.EVENT_READ, running)

    def _forward(self, running: _Running) -> None:
        for line in running.lines():
            if running.ready and self._started:
                self._on_line(running.part.name, line)
            elif not running.ready and running.part.is_ready is None and line == READY:
                self._got_ready(running)
            else:
                running.early.append(line)
        if running.drained:
            self._unwatch(running)

    def _got_ready(self, running: _Running) -> None:
        running.ready = True
        if self._started:
            self._catch_up(running)
        if self.epoch_ns:
            running.tell(self.epoch_ns)

    def _catch_up(self, running: _Running) -> None:
        for line in running.early:
            self._on_line(running.part.name, line)
        running.early.clear()

    def _bury(self, running: _Running) -> Ended:
        """Take the last words of a process that has ended, and forget it."""
        name = running.part.name
        self._forward(running)
        self._unwatch(running)
        running.close()
        del self._running[name]
        ended = Ended(name, running.process.returncode, time.monotonic_ns(), running.last_line)
        self.ended.append(ended)
        return ended

    def _unwatch(self, running: _Running) -> None:
        if running.fileno() in self._selector.get_map():
            self._selector.unregister(running)
