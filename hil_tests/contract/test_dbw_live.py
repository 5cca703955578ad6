"""`raceloop dbw check` on buses in use: a real hub by both its ends, and a serial adapter's line."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from cli_harness import Command, assert_one_line, command
from hub_process import BOUND_S, Hub, data_frame, stations, until

from bridge.realtime.vcan import kernel_has_can
from dbc.codec import database
from dbc.frames import Bus
from tools.dbw.live_source import LiveSource, parse

RACELOOP = Path(sys.executable).with_name("raceloop")
STEERING = database.message("steering_cmd")
COUNT = 40


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    with Hub(tmp_path / "hub") as running:
        yield running


@pytest.fixture
def raceloop(capsys: pytest.CaptureFixture[str]) -> Command:
    return command(capsys)


def steering(number: int) -> bytes:
    return STEERING.frame(-105.5, number % 256)[16:]


def message(number: int) -> can.Message:
    return can.Message(arbitration_id=STEERING.frame_id, is_extended_id=False, data=steering(number))


def by_socketcand(hub: Hub) -> str:
    return f"socketcand:127.0.0.1:{hub.port}/CAN1"


def by_local_socket(hub: Hub) -> str:
    return f"CAN1=hub:{hub.local}"


def first(source: LiveSource, count: int) -> np.ndarray:
    """The first frames, as soon as they are there."""
    heard: list[np.ndarray] = []
    pieces = source.chunks(BOUND_S, lambda: False)
    while sum(map(len, heard)) < count:
        heard.append(next(pieces))
    return np.concatenate(heard)


@pytest.mark.parametrize("address", [by_socketcand, by_local_socket])
def test_every_frame_is_heard_with_the_time_of_day(hub: Hub, address: Callable[[Hub], str]):
    before_us = clock_us()
    with LiveSource([parse(address(hub), None)], pytest.fail) as source, hub.client() as mouth:
        for number in range(COUNT):
            mouth.send(message(number))
        frames = first(source, COUNT)
    assert [bytes(data) for data in frames["data"]] == [steering(number) for number in range(COUNT)]
    assert set(frames["id"].tolist()) == {STEERING.frame_id}
    assert set(frames["bus"].tolist()) == {Bus.CAN1}
    times = frames["time_us"].astype(np.int64)
    assert np.all(np.diff(times) >= 0)
    assert before_us - 1000 <= times[0] <= times[-1] <= clock_us() + 1000


def clock_us() -> int:
    return time.time_ns() // 1000


@pytest.mark.parametrize("address", [by_socketcand, by_local_socket])
def test_a_hub_that_dies_ends_the_check_with_the_report(hub: Hub, address: Callable[[Hub], str]):
    told: list[tuple[int, str]] = []
    heard = 0
    with LiveSource([parse(address(hub), None)], lambda *what: told.append(what)) as source, hub.client() as mouth:
        for number in range(COUNT):
            mouth.send(message(number))
        for piece in source.chunks(BOUND_S, lambda: False):
            heard += len(piece)
            if heard == COUNT:
                hub.stop(signal.SIGKILL)
    assert heard == COUNT
    ((count, text),) = told
    assert count == COUNT
    assert text.startswith(f"{address(hub)}: ")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_the_check_with_the_report(hub: Hub, number: signal.Signals):
    addresses = [f"{bus.label}=hub:{hub.local}" for bus in (Bus.CAN1, Bus.CAN3)]
    with subprocess.Popen(
        [RACELOOP, "dbw", "check", *addresses], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        try:
            until(lambda: catches(running.pid, signal.SIGTERM), "the check to listen")
            # The hub serves its stations in the order in which they came: what the last one hears, all have heard.
            with stations(hub, Bus.CAN1, Bus.CAN1) as (mouth, ear):
                for _ in range(4):
                    mouth.send(data_frame(Bus.CAN1, STEERING.frame_id, steering(7)))
                heard = 0
                while heard < 4:
                    heard += len(ear.frames())
            running.send_signal(number)
            out, error = running.communicate(timeout=BOUND_S)
        finally:
            running.kill()
    assert (running.returncode, error) == (1, "")
    finding, summary = out.splitlines()
    assert finding.startswith(
        "CAN1 steering_cmd.steering_motor_cmd_counter: counter stuck, 3 times, first in frame 1 at "
    )
    assert summary == f"{' '.join(addresses)}: 4 frames of 1 messages, 1 finding"


def catches(process: int, number: signal.Signals) -> bool:
    """Whether a process has a handler of its own for a signal."""
    status = Path(f"/proc/{process}/status").read_text()
    (mask,) = (int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(mask >> (number - 1) & 1)


def test_a_check_for_some_time(hub: Hub, raceloop: Command):
    """Nothing is on the bus, and that is no clean bill of health."""
    answer = raceloop("dbw", "check", by_socketcand(hub), "--seconds", "0.2")
    assert_one_line(answer, by_socketcand(hub), "no frame in 0.")


def test_a_serial_adapter(monkeypatch: pytest.MonkeyPatch):
    """The text protocol of slcan over a real terminal line, through python-can's interface and pyserial."""
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0}')
    adapter, line = os.openpty()
    try:
        with LiveSource([parse(f"CAN1=slcan:{os.ttyname(line)}", None)], pytest.fail) as source:
            for number in range(COUNT):
                os.write(adapter, b"t%03X8%s\r" % (STEERING.frame_id, steering(number).hex().upper().encode()))
            frames = first(source, COUNT)
    finally:
        os.close(line)
        os.close(adapter)
    assert [bytes(data) for data in frames["data"]] == [steering(number) for number in range(COUNT)]
    assert set(frames["bus"].tolist()) == {Bus.CAN1}


def test_a_simulated_wire():
    """The plug-in simcan, by python-can's entry points, by the wall clock."""
    with (
        can.Bus(interface="simcan", channel="live", queue="priority") as sender,
        LiveSource([parse("CAN1=simcan:live", None)], pytest.fail) as source,
    ):
        for number in range(COUNT):
            sender.send(can.Message(arbitration_id=STEERING.frame_id, data=steering(number), is_extended_id=False))
        frames = first(source, COUNT)
    assert [bytes(data) for data in frames["data"]] == [steering(number) for number in range(COUNT)]
    assert np.all(np.diff(frames["time_us"].astype(np.int64)) > 200)


@pytest.mark.parametrize(
    ("address", "told"),
    [
        ("socketcand:127.0.0.1:1/CAN1", "127.0.0.1:1: no connection: Connection refused"),
        ("socketcand:127.0.0.1:99999/CAN1", "127.0.0.1:99999: no connection: "),
        ("CAN1=socketcand:here", "must be like socketcand:127.0.0.1:29536/can0"),
        ("CAN1=slcan:/dev/none", "slcan:/dev/none: cannot be opened: "),
        ("CAN1=slcan:socket://127.0.0.1:1", "cannot be opened: "),
        ("CAN1=pcan:PCAN_USBBUS1", "pcan:PCAN_USBBUS1: cannot be opened: "),
        ("CAN1=udp_multicast:nowhere", "udp_multicast:nowhere: cannot be opened: "),
        ("CAN1=hub:/nowhere/hub", "no hub there"),
        ("socketcan:vcan3", "CANS at socketcan:vcan3: "),
    ],
)
@pytest.mark.parametrize("task", ["check", "monitor"])
def test_a_bus_that_cannot_be_heard_is_one_line(raceloop: Command, task: str, address: str, told: str):
    if address.startswith("socketcan:") and kernel_has_can():
        address = address.replace("vcan3", "nocan3").replace("socketcan:", "CAN-S=socketcan:")
        told = told.replace("vcan3", "nocan3")
    assert_one_line(raceloop("dbw", task, address), told)


def test_a_channel_that_the_server_does_not_have_is_one_line(raceloop: Command, hub: Hub):
    address = by_socketcand(hub).replace("CAN1", "CAN9")
    assert_one_line(
        raceloop("dbw", "check", f"CAN1={address}"), f"127.0.0.1:{hub.port}: the server answers 'error no such channel"
    )


@pytest.mark.parametrize("answer", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n" * 100, b"< hi >< no >"])
def test_a_server_that_is_none_of_socketcand_is_one_line(raceloop: Command, answer: bytes):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection, _ = server.accept()
            connection.sendall(answer)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(1000):
                pass
            connection.close()

        serving = threading.Thread(target=serve)
        serving.start()
        port = server.getsockname()[1]
        assert_one_line(raceloop("dbw", "check", f"socketcand:127.0.0.1:{port}/CAN1"), f"127.0.0.1:{port}: ")
        serving.join()
