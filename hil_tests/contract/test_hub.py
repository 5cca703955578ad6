"""The hub by itself: it starts and ends cleanly, and no client of it can hurt another."""

from __future__ import annotations

import errno
import gc
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from select import select

import can
import pytest
from hub_process import BOUND_S, Hub, RawStation, data_frame, hello, stations, until

from bridge._native import lib
from bridge.realtime.programs import program
from dbc.errors import RaceloopError
from dbc.frames import Bus, Flag, Frame

RACELOOP = Path(sys.executable).with_name("raceloop")


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    with Hub(tmp_path) as running:
        yield running


def run_hub(*arguments: object) -> subprocess.CompletedProcess[str]:
    """A hub that is expected to end by itself."""
    return subprocess.run(
        [program("raceloop-hub"), *map(str, arguments)], capture_output=True, text=True, timeout=BOUND_S, check=False
    )


def assert_one_line(answer: subprocess.CompletedProcess[str], *words: object) -> None:
    assert answer.returncode == 2, answer
    assert answer.stdout == ""
    assert answer.stderr.startswith("raceloop-hub: ")
    assert len(answer.stderr.splitlines()) == 1, answer.stderr
    for word in words:
        assert str(word) in answer.stderr


def assert_forwards(hub: Hub, log_lines: int | None = None) -> None:
    """The bus works for everybody: a local station and a socketcand client hear each other and a third hears both."""
    with stations(hub, Bus.CAN3, Bus.CAN3) as (station, listener), hub.client("CAN3") as client:
        client.send(can.Message(arbitration_id=0x321, is_extended_id=False, data=b"works"))
        for hearing in (station, listener):
            assert [(f.id, f.data[:5]) for f in hearing.frames()] == [(0x321, b"works")]
        station.send(data_frame(Bus.CAN3, 0x322, b"too"))
        assert [(f.id, f.data[:3]) for f in listener.frames()] == [(0x322, b"too")]
        message = client.recv(BOUND_S)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x322, b"too")
    if log_lines is not None:
        assert len(hub.log()) == log_lines, hub.log()


# --- start and end ---


@pytest.mark.parametrize("with_signal", [signal.SIGTERM, signal.SIGINT])
def test_ends_cleanly_and_leaves_nothing(tmp_path: Path, with_signal: signal.Signals):
    hub = Hub(tmp_path)
    station = RawStation(hub).join(Bus.CAN1)
    client = socket.create_connection(("127.0.0.1", hub.port), BOUND_S)
    assert client.recv(100) == b"< hi >"
    assert hub.stop(with_signal) == 0
    assert station.is_sent_away()
    assert client.recv(100) == b""
    station.close()
    client.close()
    assert hub.log() == []
    assert [path.name for path in tmp_path.iterdir()] == ["hub.log"]
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", hub.port), BOUND_S)


def test_listens_on_loopback_only_and_its_local_socket_is_private(hub: Hub):
    listeners = [
        line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:] if line.split()[3] == "0A"
    ]
    assert [address for address in listeners if address.endswith(f":{hub.port:04X}")] == [f"0100007F:{hub.port:04X}"]
    listeners = [
        line.split()[1] for line in Path("/proc/net/tcp6").read_text().splitlines()[1:] if line.split()[3] == "0A"
    ]
    assert not [address for address in listeners if address.endswith(f":{hub.port:04X}")]
    assert hub.local.stat().st_mode & 0o777 == 0o700


def test_socket_file_of_a_hub_that_was_killed_is_replaced(tmp_path: Path):
    dead = Hub(tmp_path)
    dead.stop(signal.SIGKILL)
    assert dead.local.is_socket()
    with Hub(tmp_path) as hub:
        assert_forwards(hub)
    assert not hub.local.exists()


def test_a_second_hub_does_not_disturb_the_first(hub: Hub):
    assert_one_line(run_hub("--local", hub.local), hub.local, "a hub is alive there")
    assert_forwards(hub, log_lines=0)
    assert hub.local.is_socket()


def test_a_hub_removes_no_socket_file_but_its_own(tmp_path: Path):
    first = Hub(tmp_path)
    first.local.unlink()
    with Hub(tmp_path) as second:
        assert first.stop() == 0
        assert_forwards(second)


def test_a_file_that_is_no_socket_stays(tmp_path: Path):
    file = tmp_path / "hub"
    file.write_text("mine")
    assert_one_line(run_hub("--local", file), file, "no socket")
    assert file.read_text() == "mine"


def test_port_in_use_is_one_line_and_leaves_no_socket_file(hub: Hub, tmp_path: Path):
    assert_one_line(run_hub("--local", tmp_path / "other", "--port", hub.port), f"--port {hub.port}", "in use")
    assert not (tmp_path / "other").exists()
    assert_forwards(hub, log_lines=0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["nothing to listen on", "--local PATH", "--port N"]),
        (["--port", "65536"], ["--port 65536", "0 to 65535"]),
        (["--port", "-1"], ["--port -1", "0 to 65535"]),
        (["--port=12x"], ["--port 12x", "0 to 65535"]),
        (["--port", ""], ["--port :", "0 to 65535"]),
        (["--priority", "0"], ["--priority 0", "1 to 99"]),
        (["--cpu", "x"], ["--cpu x", "0 to 1023"]),
        (["--port=0", "--cpu", "1023"], ["no processor 1023"]),
        (["--port"], ["--port", "needs a value"]),
        (["--local"], ["--local", "needs a value"]),
        (["--locale", "x"], ["--locale", "--help"]),
        (["--por", "0"], ["--por", "--help"]),
        (["--with-parent=1"], ["--with-parent=1", "--help"]),
        (["-x"], ["-x"]),
        (["CAN1"], ["CAN1"]),
        (["--local", "x" * 108], ["longer than a socket's may be"]),
        (["--local", "/nowhere/hub"], ["/nowhere/hub", "No such file or directory"]),
    ],
)
def test_mistakes_on_the_command_line_are_one_line(arguments: list[str], words: list[str]):
    assert_one_line(run_hub(*arguments), *words)


def test_help_names_every_option():
    answer = run_hub("--help")
    assert (answer.returncode, answer.stderr) == (0, "")
    words = re.findall(r"^  (--\S+)", answer.stdout, re.MULTILINE)
    assert words == ["--local", "--port", "--priority", "--cpu", "--with-parent"]


def test_priority_and_processor_are_taken_or_refused_in_one_line(tmp_path: Path):
    cpu = max(os.sched_getaffinity(0))
    options = ("--priority=3", f"--cpu={cpu}")
    probe = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(3))"
    if subprocess.run([sys.executable, "-c", probe], capture_output=True, check=False).returncode != 0:
        assert_one_line(run_hub("--local", tmp_path / "hub", *options), "no permission for SCHED_FIFO priority 3")
        assert list(tmp_path.iterdir()) == []
        return
    with Hub(tmp_path, *options) as hub:
        process = hub.process.pid
        assert os.sched_getscheduler(process) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        assert os.sched_getparam(process).sched_priority == 3
        assert os.sched_getaffinity(process) == {cpu}
        assert_forwards(hub, log_lines=0)


def test_it_ends_with_its_parent(tmp_path: Path):
    """The parent starts it and is killed; nothing of the hub is left."""
    start = "import subprocess, sys; subprocess.Popen(sys.argv[1:]).wait()"
    command = [program("raceloop-hub"), "--local", tmp_path / "hub", "--with-parent"]
    with subprocess.Popen([sys.executable, "-c", start, *map(str, command)], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline().startswith(b"raceloop-hub: local")
        parent.kill()
        assert parent.stdout.read() == b"", "the end of the pipe is the end of the hub"
    assert list(tmp_path.iterdir()) == []


def test_either_door_may_stay_closed(tmp_path: Path):
    for arguments, line in (
        (["--local", tmp_path / "only"], f"raceloop-hub: local {tmp_path / 'only'}\n"),
        (["--port", "0"], r"raceloop-hub: socketcand 127\.0\.0\.1:\d+\n"),
    ):
        with subprocess.Popen(
            [program("raceloop-hub"), *map(str, arguments)], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            assert re.fullmatch(line, process.stdout.readline())
            process.terminate()
            assert process.wait(BOUND_S) == 0


def test_raceloop_hub_becomes_the_hub(tmp_path: Path):
    with subprocess.Popen(
        [RACELOOP, "hub", "--port", "0"],
        stdout=subprocess.PIPE,
        text=True,
        env={"XDG_RUNTIME_DIR": str(tmp_path), "PATH": ""},
    ) as process:
        assert process.stdout is not None
        local = tmp_path / "raceloop" / "hub"
        assert process.stdout.readline().startswith(f"raceloop-hub: local {local}, socketcand 127.0.0.1:")
        assert local.is_socket()
        assert local.parent.stat().st_mode & 0o777 == 0o700
        process.send_signal(signal.SIGINT)
        assert process.wait(BOUND_S) == 0
    assert list(local.parent.iterdir()) == []


def test_a_folder_that_others_can_enter_is_no_place_for_the_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from tools.hub import default_path

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert default_path() == tmp_path / "raceloop" / "hub"
    (tmp_path / "raceloop").chmod(0o755)
    with pytest.raises(RaceloopError, match="only you can enter"):
        default_path()
    (tmp_path / "raceloop").rmdir()
    (tmp_path / "raceloop").symlink_to(tmp_path)
    with pytest.raises(RaceloopError, match="only you can enter"):
        default_path()


def test_the_program_in_the_page_works(hub: Hub):
    page = (Path(__file__).parents[2] / "docs" / "hub.md").read_text()
    (program_text,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    with (
        stations(hub, Bus.CAN1) as (station,),
        subprocess.Popen(
            [sys.executable, "-u", "-c", program_text.replace("29536", str(hub.port))],
            stdout=subprocess.PIPE,
            text=True,
        ) as user,
    ):
        assert [(frame.id, frame.data[:5]) for frame in station.frames()] == [(0x123, b"hello")]
        station.send(data_frame(Bus.CAN1, 0x456, b"\xab"))
        assert user.stdout is not None
        assert re.search(r"ID: +456 .* DL: +1 +ab ", user.stdout.readline())
        user.terminate()


# --- stations that do not keep to the wire ---


@pytest.mark.parametrize(
    ("packet", "error"),
    [
        (b"x", errno.EPROTO),
        (bytes(16), errno.EPROTO),
        (b"GET / HTTP/1.1\r\n\r\n", errno.EPROTO),
        (bytes(5000), errno.EPROTO),
        (hello(0, version=lib.HUB_VERSION + 1), errno.EPROTO),
        (hello(0, [(1, False)])[:-1], errno.EPROTO),
        (hello(0, [(1, False)]) + b"x", errno.EPROTO),
        (hello(0, [(1, False)] * 128)[:500], errno.EPROTO),
        (hello(len(Bus)), errno.EINVAL),
        (hello(0, [(1, False)] * 129), errno.EINVAL),
    ],
    ids=lambda value: f"{len(value)} bytes" if isinstance(value, bytes) else errno.errorcode[value],
)
def test_a_wrong_hello_is_answered_and_sent_away(hub: Hub, packet: bytes, error: int):
    station = RawStation(hub)
    station.socket.send(packet)
    assert station.answer() == (lib.HUB_MAGIC, lib.HUB_VERSION, error)
    assert station.is_sent_away()
    station.close()
    assert "hello" in hub.wait_for_line("sent away")
    assert_forwards(hub, log_lines=1)


@pytest.mark.parametrize("size", [1, 23, 25, 65 * 24, 100_000])
def test_a_packet_that_is_not_frames_is_the_last(hub: Hub, size: int):
    with stations(hub, Bus.CAN1, Bus.CAN1) as (bad, good):
        bad.socket.send(bytes(size))
        assert bad.is_sent_away()
        assert "CAN1" in hub.wait_for_line("sent away")
        assert_forwards(hub, log_lines=1)
        with stations(hub, Bus.CAN1) as (other,):
            other.send(data_frame(Bus.CAN1, 7))
            assert [f.id for f in good.frames()] == [7], "nothing of the broken packet was forwarded"


@pytest.mark.parametrize(
    "bad",
    [
        Frame(0, 0x800, Bus.CAN1, 0, 0, 0, bytes(8)),
        Frame(0, 0x20000000, Bus.CAN1, 0, Flag.EXTENDED, 0, bytes(8)),
        Frame(0, 1, Bus.CAN1, 9, 0, 0, bytes(8)),
        Frame(0, 1, Bus.CAN1, 8, 8, 0, bytes(8)),
        Frame(0, 1, Bus.CAN3, 8, 0, 0, bytes(8)),
        Frame(0, 1, 200, 8, 0, 0, bytes(8)),
    ],
)
def test_frames_that_no_bus_carries_are_dropped_and_counted(hub: Hub, bad: Frame):
    with stations(hub, Bus.CAN1, Bus.CAN1, Bus.CAN3) as (sender, receiver, elsewhere):
        sender.send(bad, data_frame(Bus.CAN1, 1), bad)
        sender.send(bad)
        sender.send(data_frame(Bus.CAN1, 2))
        assert [f.id for f in receiver.frames()] == [1]
        assert [f.id for f in receiver.frames()] == [2]
        with stations(hub, Bus.CAN3) as (other,):
            other.send(data_frame(Bus.CAN3, 3))
        assert [f.id for f in elsewhere.frames()] == [3]
        assert len(hub.log()) == 1
        assert "no CAN bus carries" in hub.log()[0]
    assert "3 frames" in hub.wait_for_line("sent 3")


def test_unused_bytes_and_stray_fields_do_not_travel(hub: Hub):
    with stations(hub, Bus.CAN1, Bus.CAN1) as (sender, receiver):
        sender.send(
            Frame(2**63, 1, Bus.CAN1, 3, 0, 4, b"abcdefgh"), Frame(9, 2, Bus.CAN1, 5, Flag.REMOTE, 4, b"abcdefgh")
        )
        first, second = receiver.frames()
        assert (first.sender, first.dlc, first.data) == (0, 3, b"abc" + bytes(5))
        assert (second.sender, second.dlc, second.flags, second.data) == (0, 5, Flag.REMOTE, bytes(8))
        assert 0 < first.time_us < 2**62


def test_stamps_are_those_of_sending_however_late_the_hub_is(hub: Hub):
    """The kernel stamps what a station sends, so a hub that is stopped moves no stamp."""
    with stations(hub, Bus.CAN1, Bus.CAN1) as (sender, receiver):
        hub.process.send_signal(signal.SIGSTOP)
        state = Path(f"/proc/{hub.process.pid}/stat")
        until(lambda: state.read_text().rpartition(")")[2].split()[0] == "T", "the hub to stop")
        before_us = time.monotonic_ns() // 1000
        sender.send(data_frame(Bus.CAN1, 1))
        after_us = time.monotonic_ns() // 1000
        until(lambda: time.monotonic_ns() // 1000 > after_us + 50_000, "time to pass")
        hub.process.send_signal(signal.SIGCONT)
        (frame,) = receiver.frames()
        assert before_us - 1000 <= frame.time_us <= after_us + 1000


def test_last_words_are_heard_of_who_leaves_without_having_read_all(hub: Hub):
    """The kernel resets a connection that is closed with something unread; what was sent before it is still there."""
    with stations(hub, Bus.CAN1, Bus.CAN1) as (leaver, listener):
        listener.send(data_frame(Bus.CAN1, 1))
        until(lambda: select([leaver.socket], [], [], 0.0)[0], "the frame that is never read")
        hub.process.send_signal(signal.SIGSTOP)
        state = Path(f"/proc/{hub.process.pid}/stat")
        until(lambda: state.read_text().rpartition(")")[2].split()[0] == "T", "the hub to stop")
        leaver.send(data_frame(Bus.CAN1, 2))
        leaver.socket.close()
        hub.process.send_signal(signal.SIGCONT)
        assert [frame.id for frame in listener.frames()] == [2]


def test_error_frames_reach_everybody_whatever_the_filters(hub: Hub):
    with stations(hub, Bus.CAN1) as (sender,), hub.client("CAN1") as client:
        receiver = RawStation(hub).join(Bus.CAN1, [])
        sender.send(Frame(0, 0x42, Bus.CAN1, 8, Flag.ERROR, 0, bytes(range(8))))
        (frame,) = receiver.frames()
        assert (frame.id, frame.flags, frame.data) == (0x42, Flag.ERROR, bytes(range(8)))
        message = client.recv(BOUND_S)
        assert message is not None
        assert (message.is_error_frame, message.arbitration_id) == (True, 0x42)
        receiver.close()


def test_who_connects_and_says_nothing_is_nobodys_trouble(hub: Hub):
    silent = RawStation(hub)
    silent_client = socket.create_connection(("127.0.0.1", hub.port), BOUND_S)
    assert_forwards(hub, log_lines=0)
    silent.close()
    silent_client.close()
    assert_forwards(hub, log_lines=0)


def test_more_stations_than_places_are_refused(hub: Hub):
    joined = [RawStation(hub).join(Bus.CAN1) for _ in range(64)]
    late = RawStation(hub)
    later = RawStation(hub)
    assert later.is_sent_away()
    late.socket.send(hello(Bus.CAN1))
    assert late.answer()[2] == errno.EUSERS
    assert late.is_sent_away()
    later.close()
    assert "64" in hub.wait_for_line("refused")
    assert len(hub.log()) == 2
    joined[0].close()
    until(lambda: _joins(hub), "the place of the one who left")
    for station in (late, *joined):
        station.close()
    assert_forwards(hub)


def _joins(hub: Hub) -> bool:
    station = RawStation(hub)
    try:
        station.join(Bus.CAN1)
    except (AssertionError, BrokenPipeError, ConnectionResetError):
        return False
    finally:
        station.close()
    return True


# --- socketcand clients ---


class Talk:
    """A TCP connection on which the test types for itself."""

    def __init__(self, hub: Hub) -> None:
        self.socket = socket.create_connection(("127.0.0.1", hub.port), BOUND_S)
        self.rest = b""
        assert self.hear() == "< hi >"

    def say(self, text: str | bytes) -> None:
        self.socket.sendall(text.encode() if isinstance(text, str) else text)

    def hear(self) -> str:
        """The next answer or frame; empty at the end of the connection."""
        while b">" not in self.rest:
            try:
                more = self.socket.recv(4096)
            except ConnectionResetError:
                return ""
            if not more:
                assert self.rest == b""
                return ""
            self.rest += more
        text, _, self.rest = self.rest.partition(b">")
        return text.decode() + ">"

    def raw(self, channel: str) -> Talk:
        for request in (f"< open {channel} >", "< rawmode >"):
            self.say(request)
            assert self.hear() == "< ok >"
        return self

    def __enter__(self) -> Talk:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


@pytest.mark.parametrize(
    "text",
    [
        b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"< open \xff >",
        b"< open < open CAN1 >",
        b"< " + b"x" * 200,
        b" > ",
        bytes(4096),
        b"<" * 100_000,
    ],
)
def test_what_is_not_the_protocol_is_sent_away_with_a_reason(hub: Hub, text: bytes):
    with Talk(hub) as talk:
        talk.say(text)
        assert talk.hear() in ("< error this is not the socketcand protocol >", "")
        assert talk.hear() == ""
    hub.wait_for_line("not the socketcand protocol")
    assert_forwards(hub, log_lines=1)


@pytest.mark.parametrize(
    ("requests", "reason"),
    [
        (["< open can0 >"], "no such channel: there are CAN1 CAN3 CANA CANS CANR"),
        (["< open CAN1 >", "< open CAN1 >"], "open already"),
        (["< rawmode >"], "open a channel first"),
        (["< open CAN1 >", "< bcmmode >"], "only rawmode"),
        (["< controlmode >"], "only rawmode"),
        (["< isotpmode >"], "only rawmode"),
        (["< open CAN1 >", "< send 123 0 >"], "rawmode first"),
        (["< hello >"], "unknown request"),
        (["<>"], "unknown request"),
        (["< open CAN1 >", "< rawmode >", "< send 123 2 11 >"], "as many bytes"),
        (["< open CAN1 >", "< rawmode >", "< send 1234 0 >"], "3 or 8 digits"),
        (["< open CAN1 >", "< rawmode >", "< send 123 9 1 2 3 4 5 6 7 8 9 >"], "0 to 8"),
    ],
)
def test_a_wrong_request_is_answered_and_the_next_one_works(hub: Hub, requests: list[str], reason: str):
    with Talk(hub) as talk:
        for request in requests[:-1]:
            talk.say(request)
            assert talk.hear() == "< ok >"
        for _ in range(3):
            talk.say(requests[-1])
            answer = talk.hear()
            assert answer.startswith("< error ")
            assert reason in answer
        talk.say("< echo >")
        assert talk.hear() == "< echo >"
        assert reason in hub.wait_for_line("socketcand client 127.0.0.1:")
        assert_forwards(hub, log_lines=1)


@pytest.mark.parametrize(
    ("alias", "name"), [("vcan0", "CAN1"), ("vcan1", "CAN3"), ("vcan2", "CANA"), ("vcan3", "CANS"), ("vcan4", "CANR")]
)
def test_interfaces_are_other_names_of_the_buses(hub: Hub, alias: str, name: str):
    with Talk(hub) as one, Talk(hub) as other:
        one.raw(alias)
        other.raw(name)
        one.say("< send 12345678 2 A b0 >")
        assert re.fullmatch(r"< frame 12345678 \d+\.\d{6} 0AB0 >", other.hear())


def test_text_may_come_in_any_pieces(hub: Hub):
    with Talk(hub) as talk, Talk(hub) as listener:
        listener.raw("CANA")
        for character in "\r\n<open CANA>\n< rawmode ><send\t7FF 8 1 2 3 4 5 6 7 ff>  < send 001 0  >":
            talk.say(character)
        assert [talk.hear() for _ in range(2)] == ["< ok >"] * 2
        assert re.fullmatch(r"< frame 7FF \d+\.\d{6} 01020304050607FF >", listener.hear())
        assert re.fullmatch(r"< frame 001 \d+\.\d{6}  >", listener.hear()), "python-can needs two blanks for no data"
        talk.say("< send 12")
    assert_forwards(hub, log_lines=0)


def test_many_requests_at_once_keep_their_order(hub: Hub):
    with Talk(hub) as talk, Talk(hub) as listener:
        listener.raw("CAN1")
        talk.raw("CAN1").say("".join(f"<send {number:03X} 0>" for number in range(2048)))
        assert [int(listener.hear().split()[2], 16) for _ in range(2048)] == list(range(2048))


@pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")  # python-can leaves it open when it fails
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_python_can_says_what_is_wrong_with_a_channel(hub: Hub):
    with pytest.raises(can.CanError, match="no such channel"):
        hub.client("can7")
    gc.collect()
    assert_forwards(hub, log_lines=1)


def test_python_can_joins_a_bus_that_is_busy(hub: Hub):
    """Its interface takes the answer to rawmode from one read and refuses a frame behind it."""
    done = threading.Event()
    with stations(hub, Bus.CAN1) as (sender,):

        def flood() -> None:
            number = 0
            while not done.is_set():
                sender.send(data_frame(Bus.CAN1, 5, number.to_bytes(4, "little")))
                number += 1

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            for _ in range(10):
                with hub.client("CAN1") as client:
                    numbers = [
                        int.from_bytes(message.data, "little")
                        for message in (client.recv(BOUND_S) for _ in range(50))
                        if message is not None
                    ]
                    assert numbers == list(range(numbers[0], numbers[0] + 50)), "held back, not lost"
        finally:
            done.set()
            thread.join()


def test_more_clients_than_places_are_refused(hub: Hub):
    talks = [Talk(hub) for _ in range(32)]
    with socket.create_connection(("127.0.0.1", hub.port), BOUND_S) as late:
        assert late.recv(100) == b"< error no place is free >"
    hub.wait_for_line("32 are connected already")
    for talk in talks:
        talk.socket.close()
    assert_forwards(hub)


# --- slow ones ---


def test_a_station_that_does_not_read_loses_frames_hears_how_many_and_delays_nobody(hub: Hub):
    with stations(hub, Bus.CAN1, Bus.CAN1, Bus.CAN1) as (sender, slow, quick):
        sent = 0
        while not hub.log():
            sender.send(data_frame(Bus.CAN1, 1, sent.to_bytes(4, "little")))
            (frame,) = quick.frames()
            assert frame.data[:4] == sent.to_bytes(4, "little")
            sent += 1
            assert sent < 100_000
        received = 0
        packet = slow.packet()
        while len(packet) == 24:
            assert packet[16:20] == received.to_bytes(4, "little")
            received += 1
            if received == sent - 1:
                break
            slow.socket.setblocking(False)
            try:
                packet = slow.packet()
            except BlockingIOError:
                break
        slow.socket.settimeout(BOUND_S)
        sender.send(data_frame(Bus.CAN1, 2))
        loss = slow.packet()
        assert len(loss) == 16
        assert int.from_bytes(loss[8:], "little") == sent - received > 0
        assert [f.id for f in slow.frames()] == [2]
        assert "reads too slowly" in hub.log()[0]
    line = hub.wait_for_line("it read too slowly")
    assert f"lost {sent - received} frames" in line
    assert len(hub.log()) == 2


def test_a_client_that_does_not_read_loses_frames_and_hears_an_overflow(hub: Hub):
    with stations(hub, Bus.CAN1, Bus.CAN1) as (sender, quick), Talk(hub) as slow:
        slow.raw("CAN1")
        sent = 0
        while not hub.log():
            batch = [data_frame(Bus.CAN1, 1, (sent + i).to_bytes(4, "little") + b"full") for i in range(64)]
            sender.send(*batch)
            assert len(quick.frames()) == 64
            sent += 64
            assert sent < 1_000_000
        received = 0
        while True:
            sender.send(data_frame(Bus.CAN1, 2))
            words = slow.hear().split()
            if words[1] == "error":
                break
            if words[2] == "001":
                assert int(words[4], 16) >> 32 == int.from_bytes(received.to_bytes(4, "little"), "big")
                received += 1
            sent += 1
        assert words[2] == "004", "error class: trouble of the controller"
        assert slow.hear().split()[2] == "002"
    line = hub.wait_for_line("it read too slowly")
    match = re.search(r"lost (\d+) frames", line)
    assert match
    assert 0 < int(match[1]) < sent


def test_a_client_that_asks_and_never_reads_is_sent_away(hub: Hub):
    with Talk(hub) as deaf:
        deaf.socket.setblocking(False)

        def ask() -> bool:
            try:
                deaf.socket.send(b"<echo>" * 500)
            except BlockingIOError:
                pass
            except (BrokenPipeError, ConnectionResetError):
                return True
            return False

        until(ask, "the end of the connection")
        assert "does not read its answers" in hub.wait_for_line("sent away")
        assert_forwards(hub, log_lines=1)


def test_nobody_who_reads_the_log_stops_no_bus(tmp_path: Path):
    """More lines than a pipe holds, and nobody empties it."""
    with subprocess.Popen(
        [program("raceloop-hub"), "--local", tmp_path / "hub"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith(b"raceloop-hub: local")
        for _ in range(1500):
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as bad:
                bad.settimeout(BOUND_S)
                bad.connect(str(tmp_path / "hub"))
                bad.send(b"garbage")
                assert len(bad.recv(100)) == 12
        process.terminate()
        assert process.wait(BOUND_S) == 0
        assert process.stderr is not None
        lines = process.stderr.read().splitlines()
        assert 100 < len(lines) < 1500
        assert all(line.startswith(b"raceloop-hub: ") for line in lines), "no line is cut"
