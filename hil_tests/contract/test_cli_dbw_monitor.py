"""`raceloop dbw monitor`: the table of a recording and of buses in use, printed and on a terminal."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli_harness import Command, assert_one_line, command
from hub_process import BOUND_S, Hub, data_frame, stations

from dbc.codec import database
from dbc.frames import Bus

RACELOOP = Path(sys.executable).with_name("raceloop")
STEERING = database.message("steering_cmd")
LOG = "".join(f"({1 + n / 100:.6f}) CAN1 57A#2D07{n % 256:02X}0000000000\n" for n in range(150))


@pytest.fixture
def raceloop(capsys: pytest.CaptureFixture[str]) -> Command:
    return command(capsys)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "drive.log"
    path.write_text(LOG)
    return path


def test_a_recording_is_printed_once(raceloop: Command, log: Path):
    answer = raceloop("dbw", "monitor", log)
    assert (answer.status, answer.error) == (0, "")
    counts, head, row, values = answer.out.splitlines()
    assert counts == "150 frames of 1 messages, 0 offending"
    assert head.split() == ["bus", "id", "message", "from", "frames", "period", "mean", "age", "ms", "counter"]
    assert row.split() == ["CAN1", "57A", "steering_cmd", "OBC", "150", "10.0", "10.0", "0.0", "149"]
    assert values.split() == ["steering_motor_ang_cmd", "-105.5", "deg"]


def test_offenders_are_named(raceloop: Command, log: Path):
    log.write_text(LOG + "(9.000000) CAN1 123#00\nnonsense\n")
    lines = raceloop("dbw", "monitor", log).out.splitlines()
    assert lines[0] == "151 frames of 2 messages, 2 offending"
    assert lines[2].split()[:2] == ["CAN1", "123"]
    assert lines[4].strip() == "unknown identifier 1"
    assert lines[-2].strip() == "stale"
    assert lines[-1] == "recording: unreadable 1: line 152 is no frame: nonsense"


def test_mistakes_are_one_line(raceloop: Command, log: Path, tmp_path: Path):
    assert_one_line(raceloop("dbw", "monitor", tmp_path / "none.log"), "No such file")
    assert_one_line(raceloop("dbw", "monitor", log, "--seconds", "1"), "--seconds is for buses in use")
    assert_one_line(raceloop("dbw", "monitor", log, "--bus", "CAN9"), "allowed are CAN1, CAN3, CAN-A, CAN-S")


class Terminal:
    """A program on a terminal of 100 columns and 20 lines."""

    def __init__(self, *arguments: object) -> None:
        self._ours, theirs = os.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 20, 100, 0, 0))
        self.process = subprocess.Popen(
            [RACELOOP, *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=theirs,
            stderr=subprocess.PIPE,
            env={name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
            | {"TERM": "xterm"},
        )
        os.close(theirs)
        self.text = ""

    def read(self) -> bool:
        """Take what it has written; tells whether more can come."""
        try:
            got = os.read(self._ours, 1 << 16)
        except OSError:  # the program has ended
            return False
        self.text += got.decode()
        return bool(got)

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()
        os.close(self._ours)


def pictures(text: str) -> list[int]:
    """Frames so far, of each picture."""
    return [int(count) for count in re.findall(r"(\d+) frames of", text)]


def test_a_recording_plays_at_its_own_pace_on_a_terminal(log: Path):
    with Terminal("dbw", "monitor", log) as terminal:
        while terminal.read():
            pass
        assert terminal.process.wait(BOUND_S) == 0
    seen = pictures(terminal.text)
    assert seen == sorted(seen)
    assert seen[-1] == 150
    # 1.49 s at four pictures a second; a busy machine may leave some out.
    assert 3 <= len(set(seen)) <= 8
    assert all(count % 25 == 0 for count in seen[:-2])


def test_ctrl_c_leaves_the_last_table(log: Path):
    log.write_text(LOG + "(9999.000000) CAN1 123#00\n")
    with Terminal("dbw", "monitor", log) as terminal:
        while not pictures(terminal.text):
            assert terminal.read()
        terminal.process.send_signal(signal.SIGINT)
        while terminal.read():
            pass
        assert terminal.process.wait(BOUND_S) == 0
    assert terminal.text.rstrip().splitlines()[-2].split()[:3] == ["CAN1", "57A", "steering_cmd"]


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    with Hub(tmp_path / "hub") as running:
        yield running


def test_a_bus_in_use_on_a_terminal(hub: Hub):
    """A message comes, and when it stays away it becomes stale."""
    with Terminal("dbw", "monitor", f"CAN1=hub:{hub.local}") as terminal, stations(hub, Bus.CAN1) as (mouth,):
        while not pictures(terminal.text):
            assert terminal.read()
        mouth.send(data_frame(Bus.CAN1, STEERING.frame_id, STEERING.frame(-105.5, 5)[16:]))
        while "stale" not in terminal.text:
            assert terminal.read()
        terminal.process.send_signal(signal.SIGINT)
        while terminal.read():
            pass
        assert terminal.process.wait(BOUND_S) == 0
    assert "steering_motor_ang_cmd \x1b[1m-105.5 deg" in terminal.text
    assert "1 frames of 1 messages, 1 offending" in terminal.text
    red = re.findall(r"\x1b\[31m([^\x1b]*)", terminal.text)
    assert any("steering_cmd" in part for part in red)
    assert any("stale" in part for part in red)
