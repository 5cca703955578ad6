"""The supervisor against small real processes: epoch, logs, ends, and that none is left."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bridge.realtime.supervisor import Ended, Part, Start, Supervisor
from dbc.errors import RaceloopError

BOUND_S = 30.0
"""Generous: waits end as soon as what they wait for has happened."""

#: A station that says what epoch it has, and ends on SIGTERM with status 0 after a last word.
STATION = """
import os, signal, sys
def end(*_):
    os.write(1, b"stopped\\n")
    sys.exit(0)
signal.signal(signal.SIGTERM, end)
epoch = sys.argv[-1]
if epoch == "-":
    print("early words", file=sys.stderr, flush=True)
    print("ready", flush=True)
    epoch = sys.stdin.readline().strip()
else:
    print("ready", flush=True)
print("epoch", epoch, file=sys.stderr, flush=True)
while True:
    signal.pause()
"""

STUBBORN = 'import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print("ready", flush=True); signal.pause()'
SERVICE = 'import signal; print("ready", flush=True); signal.pause()'


def python(name: str, code: str, start: Start = Start.AT_ONCE, is_ready: Callable[[], bool] | None = None) -> Part:
    return Part(name, (sys.executable, "-I", "-S", "-c", code), start, is_ready)


class Log:
    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []

    def __call__(self, name: str, line: str) -> None:
        self.lines.append((name, line))

    def of(self, name: str) -> list[str]:
        return [line for owner, line in self.lines if owner == name]


@pytest.fixture
def log() -> Log:
    return Log()


@pytest.fixture
def make(log: Log) -> Iterator[Callable[..., Supervisor]]:
    """Makes supervisors; in the end none of their processes may be left."""
    made: list[Supervisor] = []

    def call(*parts: Part, **options: float) -> Supervisor:
        made.append(Supervisor(parts, log, **({"lead_s": 0.0} | options)))
        return made[-1]

    yield call
    for supervisor in made:
        supervisor.stop(grace_s=0.0)
        assert supervisor.running == []
    assert_no_child_is_left()


def assert_no_child_is_left() -> None:
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)


def wait_for(supervisor: Supervisor, happened: Callable[[], object]) -> list[Ended]:
    ended: list[Ended] = []
    deadline = time.monotonic() + BOUND_S
    while not happened():
        assert time.monotonic() < deadline, "it did not happen"
        ended += supervisor.poll(0.05)
    return ended


def test_all_stations_get_one_epoch_that_lies_ahead(make: Callable[..., Supervisor], log: Log):
    supervisor = make(
        python("slow", STATION, Start.PREPARES), python("quick", STATION), python("hub", SERVICE, Start.SERVICE),
        lead_s=0.5,
    )  # fmt: skip
    before = time.monotonic_ns()
    supervisor.start()
    assert before + 500_000_000 <= supervisor.epoch_ns
    assert sorted(supervisor.running) == ["hub", "quick", "slow"]
    wait_for(supervisor, lambda: log.of("slow")[1:] and log.of("quick"))
    assert log.of("slow") == ["early words", f"epoch {supervisor.epoch_ns}"]
    assert log.of("quick") == [f"epoch {supervisor.epoch_ns}"]
    assert log.of("hub") == []


def test_stations_end_before_the_service_they_run_on(make: Callable[..., Supervisor], log: Log):
    supervisor = make(python("hub", SERVICE, Start.SERVICE), python("a", STATION), python("b", STATION))
    supervisor.start()
    calls = []
    supervisor.stop(grace_s=BOUND_S, meanwhile=lambda: calls.append(supervisor.running))
    assert [ended.name for ended in supervisor.ended][-1] == "hub"
    assert {(ended.name, ended.status) for ended in supervisor.ended} == {("a", 0), ("b", 0), ("hub", -signal.SIGTERM)}
    assert log.of("a")[-1] == "stopped"
    assert calls


def test_each_process_has_a_process_group_of_its_own(make: Callable[..., Supervisor]):
    """Else Ctrl-C in a terminal would reach the stations before the supervisor has a say."""
    supervisor = make(python("a", STATION), python("hub", SERVICE, Start.SERVICE))
    supervisor.start()
    for name in ("a", "hub"):
        assert os.getpgid(supervisor.process_id(name)) == supervisor.process_id(name)
        assert os.getsid(supervisor.process_id(name)) == os.getsid(0)


@pytest.mark.parametrize(
    ("code", "status", "words"),
    [
        ('print("ready\\nlast words"); raise SystemExit(3)', 3, "a ended with status 3"),
        ('print("ready"); print("no newline", end="")', 0, "a ended with status 0"),
    ],
)
def test_an_end_is_told_once(make: Callable[..., Supervisor], code: str, status: int, words: str):
    gate = "import sys; sys.stdin.readline(); "
    supervisor = make(
        python("a", "print('ready', flush=True); " + gate + code, Start.PREPARES), python("b", STATION, Start.PREPARES)
    )
    supervisor.start()
    ended = wait_for(supervisor, lambda: supervisor.running == ["b"])
    assert [(end.name, end.status) for end in ended] == [("a", status)]
    assert ended[0].last_line == ("last words" if status else "no newline")
    assert str(ended[0]) == words
    assert supervisor.poll() == []
    assert supervisor.ended == ended


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV, signal.SIGRTMIN + 3])
def test_a_part_that_is_killed(make: Callable[..., Supervisor], number: int):
    supervisor = make(python("a", SERVICE), python("b", STATION))
    supervisor.start()
    before = time.monotonic_ns()
    supervisor.kill("a", number)
    (ended,) = wait_for(supervisor, lambda: supervisor.running == ["b"])
    assert ended.status == -number
    name = {signal.SIGKILL: "SIGKILL", signal.SIGSEGV: "SIGSEGV"}.get(number, f"signal {int(number)}")
    assert str(ended) == f"a was ended by {name}"
    assert before < ended.time_ns < time.monotonic_ns()
    supervisor.kill("a", signal.SIGTERM)  # it is gone: nothing happens


def test_a_part_that_ignores_the_request_is_killed_after_the_grace(make: Callable[..., Supervisor]):
    supervisor = make(python("stubborn", STUBBORN), python("a", STATION))
    supervisor.start()
    supervisor.stop(grace_s=0.2)
    assert {(ended.name, ended.status) for ended in supervisor.ended} == {("stubborn", -signal.SIGKILL), ("a", 0)}


def test_a_part_stopped_by_a_signal_still_ends_cleanly(make: Callable[..., Supervisor]):
    supervisor = make(python("a", STATION))
    supervisor.start()
    supervisor.kill("a", signal.SIGSTOP)
    state = Path(f"/proc/{supervisor.process_id('a')}/stat")
    wait_for(supervisor, lambda: state.read_text().rpartition(")")[2].split()[0] == "T")
    supervisor.stop(grace_s=BOUND_S)
    assert [ended.status for ended in supervisor.ended] == [0]


def test_an_exception_ends_all(make: Callable[..., Supervisor]):
    supervisor = make(python("a", STATION), python("b", STATION))

    def go_wrong() -> None:
        with supervisor:
            supervisor.start()
            assert len(supervisor.running) == 2
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        go_wrong()
    assert supervisor.running == []
    assert_no_child_is_left()


def test_ctrl_c_in_the_grace_kills_at_once(make: Callable[..., Supervisor]):
    supervisor = make(python("stubborn", STUBBORN), python("hub", STUBBORN, Start.SERVICE))
    supervisor.start()

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        supervisor.stop(grace_s=BOUND_S, meanwhile=interrupt)
    assert [ended.status for ended in supervisor.ended] == [-signal.SIGKILL, -signal.SIGKILL]


@pytest.mark.parametrize("start", Start)
def test_a_part_that_fails_to_get_ready_is_the_error(make: Callable[..., Supervisor], log: Log, start: Start):
    supervisor = make(
        python("good", STATION, Start.PREPARES),
        python("bad", 'print("working", flush=True); raise SystemExit("bad: no such interface")', start),
    )
    with pytest.raises(RaceloopError, match=r"^bad: no such interface$"):
        supervisor.start()
    assert supervisor.running == []
    assert log.of("bad") == [], "its line is in the error; twice would be too much"


def test_a_part_that_ends_without_a_word_before_it_is_ready(make: Callable[..., Supervisor]):
    with pytest.raises(RaceloopError, match=r"^bad ended with status 0 before it was ready$"):
        make(python("bad", "")).start()


def test_a_program_that_is_not_there(make: Callable[..., Supervisor], tmp_path: Path):
    supervisor = make(python("good", STATION, Start.PREPARES), Part("bad", (str(tmp_path / "none"),)))
    with pytest.raises(RaceloopError, match=r"bad: cannot start .*none: No such file"):
        supervisor.start()
    assert supervisor.running == []


def test_a_part_that_never_gets_ready(make: Callable[..., Supervisor]):
    supervisor = make(python("good", STATION), python("lazy", STATION, is_ready=lambda: False), ready_s=0.2)
    with pytest.raises(RaceloopError, match=r"^lazy was not ready after 0\.2 s$"):
        supervisor.start()
    assert supervisor.running == []


def test_a_part_whose_readiness_is_seen_from_outside(make: Callable[..., Supervisor], log: Log, tmp_path: Path):
    sign = tmp_path / "sign"
    code = f'print("before", flush=True); open({str(sign)!r}, "w"); import signal; signal.pause()'
    supervisor = make(python("a", code, is_ready=sign.exists))
    assert not supervisor.is_ready("a")
    supervisor.start()
    assert supervisor.is_ready("a")
    wait_for(supervisor, lambda: log.of("a") == ["before"])


@pytest.mark.parametrize("start", [Start.AT_ONCE, Start.PREPARES])
def test_a_part_that_is_started_again_joins_the_same_epoch(make: Callable[..., Supervisor], log: Log, start: Start):
    supervisor = make(python("a", STATION, start))
    supervisor.start()
    first = supervisor.process_id("a")
    supervisor.kill("a", signal.SIGKILL)
    wait_for(supervisor, lambda: not supervisor.running)
    supervisor.restart("a")
    wait_for(supervisor, lambda: supervisor.is_ready("a") and log.of("a")[-1:] == [f"epoch {supervisor.epoch_ns}"])
    assert supervisor.process_id("a") != first
    with pytest.raises(ValueError, match="a still runs"):
        supervisor.restart("a")


def test_a_part_that_closes_its_output_lives_on_and_costs_nothing(make: Callable[..., Supervisor]):
    code = 'import os, signal; print("ready", flush=True); os.close(1); os.close(2); signal.pause()'
    supervisor = make(python("a", code))
    supervisor.start()
    deadline = time.monotonic() + BOUND_S
    while True:
        before = time.monotonic()
        assert supervisor.poll(0.3) == []
        if time.monotonic() - before > 0.25:
            break  # the closed pipe is not looked at any more
        assert time.monotonic() < deadline
    assert supervisor.running == ["a"]


def test_a_line_without_end_is_forwarded_in_pieces(make: Callable[..., Supervisor], log: Log):
    code = 'import signal; print("ready", flush=True); print("x" * 20000, end="", flush=True); signal.pause()'
    supervisor = make(python("a", code))
    supervisor.start()
    wait_for(supervisor, lambda: sum(len(line) for line in log.of("a")) > 15000)
    assert set("".join(log.of("a"))) == {"x"}


def test_the_name_of_the_program_is_left_out_of_its_lines(make: Callable[..., Supervisor], log: Log):
    """Its name is told with each line anyway, and an error of a start is the supervisor's own."""
    code = 'import signal; print("ready", flush=True); print("raceloop-a: words", flush=True); signal.pause()'
    supervisor = make(python("a", code))
    supervisor.start()
    wait_for(supervisor, lambda: log.of("a") == ["words"])
    with pytest.raises(RaceloopError, match=r"^file: key: wrong$"):
        make(python("b", 'raise SystemExit("raceloop-b: file: key: wrong")')).start()


def test_nothing_is_forwarded_from_a_run_that_does_not_start(make: Callable[..., Supervisor], log: Log):
    hub = 'import signal; print("where I am", flush=True); print("ready", flush=True); signal.pause()'
    bad = python("bad", 'import time; time.sleep(0.2); raise SystemExit("wrong")', Start.PREPARES)
    with pytest.raises(RaceloopError, match=r"^wrong$"):
        make(python("hub", hub, Start.SERVICE), bad).start()
    assert log.lines == []
    good = make(python("hub", hub, Start.SERVICE), python("good", STATION))
    good.start()
    assert log.of("hub") == ["where I am"]


def test_names_must_differ():
    with pytest.raises(ValueError, match="one name"):
        Supervisor([python("a", STATION), python("a", STATION)])
