"""Real-time runs that do not go well: a part dies or hangs, the user stops the run, the supervisor is killed.

In each case all processes end, and what was recorded can be read.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import can
import numpy as np
import pyarrow.parquet as pq
import pytest
from burner import burning
from realtime_harness import BOUND_S, RealTimeCommand, until

from bridge.bus import CHANNELS
from bridge.replay import read_log
from bridge.scenario import load_scenario
from dbc.codec import MessageCodec, database
from dbc.errors import RaceloopError
from tools.realtime_run import PHASES_US, RealTimeRun, make_options
from tools.run import find_scenario

pytestmark = pytest.mark.realtime

ALL = ("hub", *PHASES_US, "recorder")


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., RealTimeCommand]]:
    started: list[RealTimeCommand] = []

    def call(*more: str, parts: tuple[str, ...] = ALL) -> RealTimeCommand:
        command = RealTimeCommand(tmp_path / "out", "short_drive", *more)
        started.append(command)
        command.wait_for_start(*parts)
        return command

    yield call
    for command in started:
        with command:
            pass


def power_on(command: RealTimeCommand) -> None:
    """Wait until the run has gone on for a second: the Raptor talks to the Space Drive, sensors are heard."""
    command.wait_for_line("raptor: runs")
    time.sleep(2.0)  # the epoch is a second ahead; nothing outside tells how far the run has come


def signals(command: RealTimeCommand, message: str) -> pq.ParquetFile:
    return pq.read_table(command.folder / "signals" / f"{message}.parquet")


def assert_recorded(command: RealTimeCommand) -> None:
    log = read_log(command.folder / "frames.log")
    assert log.size > 1000
    assert np.all(np.diff(log["time_us"].astype(np.int64)) >= 0)
    assert set(np.unique(log["bus"]).tolist()) == {0, 1, 2, 3}
    assert pq.read_table(command.folder / "truth.parquet").num_rows > 50
    assert not (command.folder / ".partial").exists()


def test_an_onboard_computer_that_is_killed(start: Callable[..., RealTimeCommand]):
    """The run goes on until the rest of the car has braked, then ends; one line says what happened."""
    command = start()
    power_on(command)
    command.wait_for_start("obc")
    killed_obc = command.children["obc"]
    subprocess.run(["kill", "-9", str(killed_obc)], check=True)
    line = command.wait_for_line("obc was ended by SIGKILL")
    assert command.wait() == 1
    assert [line for line in command.errors if "SIGKILL" in line] == [line]
    assert line.startswith("raceloop: obc was ended by SIGKILL at ")
    killed_s = float(line.split()[-2])
    assert_recorded(command)
    summary = command.summary()
    assert summary["real_time"]["failures"] == [line.removeprefix("raceloop: ")]
    assert not summary["finished"]
    assert summary["simulated_s"] >= killed_s + 2.5
    # Not a frame of it after its end; the Raptor notices, and the Space Drive has full pressure.
    log = read_log(command.folder / "frames.log")
    sent = log["time_us"][(log["bus"] == 0) & (log["id"] == database.message("brake_pressure_cmd").frame_id)]
    assert sent[-1] * 1e-6 < killed_s + 0.1
    assert summary["sys_state_transitions"][-1]["state"] == "EMERGENCY_SHUTDOWN"
    truth = pq.read_table(command.folder / "truth.parquet")
    assert truth.column("brake_pressure_front").to_numpy()[-1] > 4.4e6
    assert any(line.startswith("Failed: obc was ended by SIGKILL") for line in command.output)
    assert command.left() == []


def test_a_busy_core_is_named(start: Callable[..., RealTimeCommand]):
    core = max(os.sched_getaffinity(0))
    with burning(core):
        line = start("--cpu", str(core), parts=("hub",)).wait_for_line("busy with other work")
    assert re.fullmatch(rf"raceloop: core {core}: (9\d|100)% busy with other work, cycles may come late", line)


def test_a_station_that_hangs(start: Callable[..., RealTimeCommand]):
    command = start()
    power_on(command)
    subprocess.run(["kill", "-STOP", str(command.children["raptor"])], check=True)
    line = command.wait_for_line("raptor has not cycled since")
    assert line.startswith("raceloop: raptor has not cycled since ")
    command.wait_for_line("raptor does not cycle any more")
    assert command.wait() == 1
    assert command.summary()["real_time"]["failures"] == ["raptor does not cycle any more"]
    assert_recorded(command)
    # It was woken for its end, and said full brake.
    assert any(line.startswith("raptor: stops on Terminated") for line in command.errors)
    assert command.left() == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_is_recorded(start: Callable[..., RealTimeCommand], number: signal.Signals):
    command = start()
    power_on(command)
    command.process.send_signal(number)
    command.wait_for_line("stops on Terminated")
    command.process.send_signal(number)  # impatience changes nothing
    assert command.wait() == 130
    assert command.errors[-1] == f"raceloop: interrupted; what was recorded until then is in {command.folder}"
    assert_recorded(command)
    summary = command.summary()
    assert summary["real_time"]["interrupted"]
    assert summary["real_time"]["failures"] == []
    assert not summary["finished"]
    assert [fault["fault"] for fault in summary["faults"] if fault["fault"] == "computer_stopping"] == []
    assert command.left() == []


def test_an_interrupt_before_power_on(start: Callable[..., RealTimeCommand]):
    command = start(parts=("hub",))
    command.process.send_signal(signal.SIGINT)
    assert command.wait() == 130
    assert command.errors[-1] == "raceloop: interrupted; nothing was written"
    assert not command.folder.exists()
    assert command.left() == []


def test_a_killed_supervisor_takes_all_with_it(start: Callable[..., RealTimeCommand], tmp_path: Path):
    """Also a part that a signal has stopped; and the recording is completed."""
    command = start()
    power_on(command)
    subprocess.run(["kill", "-STOP", str(command.children["space-drive"])], check=True)
    command.process.kill()
    command.process.wait()
    until(lambda: not command.left(), "all processes of the run to end")
    until(lambda: not (command.folder / ".partial").exists(), "the recording to be completed")
    assert_recorded(command)
    # Its files in memory are the next run's to remove, whether that starts or not.
    shared = f"raceloop-run-{command.process.pid}-*"
    assert len(list(Path("/dev/shm").glob(shared))) == 1
    with socket.create_server(("127.0.0.1", 0)) as taken:
        nowhere = RealTimeCommand(tmp_path / "nowhere", "short_drive", "--port", str(taken.getsockname()[1]))
        with nowhere:
            assert nowhere.wait() == 2
    assert list(Path("/dev/shm").glob(shared)) == []


def hear(command: RealTimeCommand, message: MessageCodec) -> None:
    """Wait for a message on its bus, as any program of python-can would."""
    port = int(command.wait_for_line("socketcand 127.0.0.1:").rpartition(":")[2])
    channel = CHANNELS[message.bus]
    with can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel=channel) as bus:

        def heard() -> bool:
            received = bus.recv(timeout=0.1)
            return received is not None and received.arbitration_id == message.frame_id

        until(heard, f"{message.name} on {channel}")


def test_parts_of_ones_own_take_the_place_of_those_that_are_left_out(start: Callable[..., RealTimeCommand]):
    """The commands that are printed are all that is needed."""
    without = {"obc": "brake_pressure_cmd", "autonomy": "node_status"}
    options = [word for name in without for word in ("--without", name)]
    command = start(*options, parts=tuple(part for part in ALL if part not in without))
    command.wait_for_line("raptor: runs")
    with ExitStack() as own:
        for name in without:
            words = command.printed_command(name)
            process = own.enter_context(subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
            own.callback(process.terminate)
        for message in map(database.message, without.values()):
            hear(command, message)
        assert not set(without) & set(command.children)
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130
    summary = command.summary()
    assert summary["configuration"] == "ACCEPTED"
    assert summary["real_time"]["failures"] == []
    assert summary["real_time"]["without"] == ["autonomy", "obc"]
    assert_recorded(command)
    for message in without.values():
        assert (command.folder / "signals" / f"{message}.parquet").exists()


def test_an_error_in_a_run_does_not_lose_the_recording(tmp_path: Path):
    """Whoever drives a run from Python and fails leaves no process, and has what was recorded."""
    folder = tmp_path / "out"

    def fail() -> None:
        with RealTimeRun(load_scenario(find_scenario("short_drive")), make_options()) as run:
            run.start(folder)
            end = time.monotonic() + BOUND_S
            while run.now_us < 1_000_000:
                assert run.poll() == []
                assert time.monotonic() < end
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert read_log(folder / "frames.log").size > 1000
    assert not (folder / ".partial").exists()
    assert_no_child_is_left()


def test_an_ecu_that_does_not_start_leaves_no_recording(tmp_path: Path):
    folder = tmp_path / "out"
    with RealTimeRun(load_scenario(find_scenario("short_drive")), make_options(without=["plant"])) as run:
        run.shared.wires.write_bytes(b"")
        with pytest.raises(RaceloopError, match=r"wires: "):
            run.start(folder)
    assert list(folder.iterdir()) == []
    assert_no_child_is_left()


def assert_no_child_is_left() -> None:
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)
