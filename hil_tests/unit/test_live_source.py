"""Buses in use as a stream: pieces, ends and losses, on python-can's virtual buses with the time in our hands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain

import can
import numpy as np
import pytest

from dbc.errors import BusError, RaceloopError
from dbc.frames import FRAME_STRUCT, Bus, Flag, Frame, iterate
from tools.dbw.listeners import socketcand_frame
from tools.dbw.live_source import PIECE_S, POLL_S, LiveSource, looks_live, parse
from tools.dbw.source import is_live, read_source


class HandClock:
    """A clock that only waiting moves; what is due happens while one waits."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.due: list[tuple[float, Callable[[], object]]] = []

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        while self.due and self.due[0][0] <= self.now_s:
            self.due.pop(0)[1]()


@pytest.fixture
def senders(request: pytest.FixtureRequest) -> Iterator[list[can.BusABC]]:
    """Two virtual buses of this test's own."""
    names = [f"{request.node.name} {number}" for number in range(2)]
    buses = [can.Bus(interface="virtual", channel=name) for name in names]
    yield buses
    for bus in buses:
        bus.shutdown()


def addresses(senders: list[can.BusABC]) -> list[str]:
    return [f"{bus.label}=virtual:{sender.channel_id}" for bus, sender in zip(Bus, senders, strict=False)]


def message(number: int) -> can.Message:
    return can.Message(arbitration_id=number, is_extended_id=False, data=[number], timestamp=number)


def heard(source: LiveSource, seconds: float | None, stopped: Callable[[], bool] = lambda: False) -> list[list[int]]:
    """Identifiers by piece, with the bus in the hundreds."""
    return [
        [frame.id + 100 * frame.bus for frame in iterate(piece.tobytes())] for piece in source.chunks(seconds, stopped)
    ]


def test_frames_of_several_buses_come_in_pieces(senders: list[can.BusABC]):
    clock = HandClock()
    clock.due = [
        (0.01, lambda: senders[0].send(message(1))),
        (0.02, lambda: senders[1].send(message(2))),
        (0.25, lambda: senders[0].send(message(3))),
    ]
    opened = [parse(address, None) for address in addresses(senders)]
    with LiveSource(opened, pytest.fail, clock) as source:
        pieces = heard(source, 0.3)
    assert [piece for piece in pieces if piece] == [[1, 102], [3]]
    assert len(pieces) in (round(0.3 / PIECE_S), round(0.3 / PIECE_S) + 1)
    assert clock.now_s == pytest.approx(0.3, abs=2 * POLL_S)


def test_a_flood_is_passed_on_at_once_and_no_frame_is_lost(senders: list[can.BusABC]):
    clock = HandClock()
    sent = [number % 2000 for number in range(10_000)]

    def flood() -> None:
        for number in sent:
            senders[0].send(can.Message(arbitration_id=number, is_extended_id=False))

    clock.due = [(0.0, flood)]
    with LiveSource([parse(addresses(senders)[0], None)], pytest.fail, clock) as source:
        pieces = heard(source, 0.2)
    assert list(chain(*pieces)) == sent


def test_it_ends_when_asked_to_with_what_is_there(senders: list[can.BusABC]):
    clock = HandClock()
    asked: list[bool] = []

    def last() -> None:
        senders[0].send(message(7))
        asked.append(True)

    clock.due = [(0.05, last)]
    with LiveSource([parse(addresses(senders)[0], None)], pytest.fail, clock) as source:
        assert heard(source, None, lambda: bool(asked)) == [[7]]
    assert clock.now_s < 0.1


def test_silence_is_an_error(senders: list[can.BusABC]):
    with (
        LiveSource([parse(addresses(senders)[0], None)], pytest.fail, HandClock()) as source,
        pytest.raises(BusError, match=r"^CAN1=virtual:.*: no frame in 0\.5 s$"),
    ):
        heard(source, 0.5)


def test_a_bus_that_ends_is_told_and_the_other_one_goes_on(senders: list[can.BusABC]):
    clock = HandClock()
    told: list[tuple[int, str]] = []
    with LiveSource(
        [parse(address, None) for address in addresses(senders)], lambda *what: told.append(what), clock
    ) as source:
        clock.due = [
            (0.05, lambda: senders[0].send(message(1))),
            (0.15, source._ears[1].listener.close),  # the driver's end, as when a cable is pulled
            (0.25, lambda: senders[0].send(message(2))),
        ]
        pieces = heard(source, 0.4)
    assert list(chain(*pieces)) == [1, 2]
    assert [count for count, _ in told] == [1]
    assert told[0][1].startswith("CAN3=virtual:")


@pytest.mark.parametrize(
    ("text", "bus", "interface", "channel", "expected"),
    [
        ("socketcan:vcan0", None, "socketcan", "vcan0", Bus.CAN1),
        ("socketcan:can3", None, "socketcan", "can3", Bus.CAN_S),
        ("socketcan:can3", Bus.CAN3, "socketcan", "can3", Bus.CAN3),
        ("CAN-A=slcan:/dev/ttyACM0", None, "slcan", "/dev/ttyACM0", Bus.CAN_A),
        ("CAN-A=slcan:/dev/ttyACM0", Bus.CAN3, "slcan", "/dev/ttyACM0", Bus.CAN_A),
        ("socketcand:127.0.0.1:29536/vcan1", None, "socketcand", "127.0.0.1:29536/vcan1", Bus.CAN3),
        ("CAN1=slcan:socket://127.0.0.1:1234", None, "slcan", "socket://127.0.0.1:1234", Bus.CAN1),
    ],
)
def test_addresses(text: str, bus: Bus | None, interface: str, channel: str, expected: Bus):
    assert looks_live(text)
    assert parse(text, bus) == (text, interface, channel, expected)


@pytest.mark.parametrize("text", ["drive.log", "out/frames.blf", "./a:b.log", "C:\\drive.log", "socketcan:", ":vcan0"])
def test_what_is_no_address(text: str):
    assert not looks_live(text)


@pytest.mark.parametrize(
    ("sources", "told"),
    [
        (["socketcan:vcan9"], "channel vcan9: unknown; allowed are CAN1"),
        (["CAN7=socketcan:vcan0"], "--bus CAN7: no such bus"),
        (["carrier:pigeon"], "carrier: no such file or interface; there are canalystii, "),
        (["a.log", "b.log"], "a.log: either one recording, or one or more buses in use"),
        (["socketcan:vcan0", "b.log"], "b.log: either one recording"),
        (["socketcan:vcan0", "CAN1=socketcan:vcan1"], "CAN1 is there twice"),
    ],
)
def test_a_mistake_in_an_address(sources: list[str], told: str):
    with pytest.raises(RaceloopError, match=r"^[^\n]+$") as caught:
        list(read_source(sources, None, None, pytest.fail))
    assert told in str(caught.value)


def test_seconds_are_for_buses_in_use():
    with pytest.raises(RaceloopError, match=r"^--seconds is for buses in use; drive\.log is none$"):
        list(read_source(["drive.log"], None, 1.0, pytest.fail))


def test_a_file_whose_name_looks_like_an_address_is_a_file(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a:b.log").write_text("(1.000000) CAN1 57A#2D07050000000000\n")
    assert not is_live(["a:b.log"])
    (frames,) = read_source(["a:b.log"], None, None, pytest.fail)
    assert len(frames) == 1


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        (b"< frame 57A 1.5 2D07 ", Frame(1_500_000, 0x57A, 0, 2, 0, 0, b"\x2d\x07" + bytes(6))),
        (b"< frame 0000057A 1.000001 ", Frame(1_000_001, 0x57A, 0, 0, Flag.EXTENDED, 0, bytes(8))),
        (
            b"\r\n< frame 7FF 1700000000.123456 " + b"00" * 8 + b" ",
            Frame(1_700_000_000_123_456, 0x7FF, 0, 8, 0, 0, bytes(8)),
        ),
        (b"< error 004 2.000000 ", Frame(2_000_000, 4, 0, 0, Flag.ERROR, 0, bytes(8))),
    ],
)
def test_frames_of_socketcand(text: bytes, frame: Frame):
    assert socketcand_frame(text, Bus.CAN1) == frame.pack()


@pytest.mark.parametrize(
    "text", [b"", b"< hi ", b"< ok ", b"< frame 57A x 00 ", b"< frame 57A 1.5 0 ", b"< frame", b"\xff"]
)
def test_what_is_no_frame_of_socketcand(text: bytes):
    assert socketcand_frame(text, Bus.CAN1) == b""


def test_a_random_text_of_socketcand_never_fails():
    seed = 20261
    print(f"seed {seed}")
    random = np.random.default_rng(seed)
    good = b"< frame 57A 1.500000 2D07050000000000 "
    whole = 0
    for _ in range(3000):
        text = bytearray(good)
        for place in random.integers(len(text), size=random.integers(1, 4)):
            text[place] = random.integers(256)
        frame = socketcand_frame(bytes(text), Bus.CAN1)
        assert len(frame) in (0, FRAME_STRUCT.size)
        whole += bool(frame)
    assert 0 < whole < 3000
