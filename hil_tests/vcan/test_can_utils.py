"""can-utils as foreign programs on the buses: what they record, send and play back is what we mean."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from can.io.canutils import CanutilsLogReader
from can_utils import INTERFACES, PATIENCE_S, candump, process, read_lines

from bridge.bus import CHANNELS
from bridge.log_writer import CANDUMP, FrameLogs
from bridge.realtime.link import CanLink
from dbc.buses import DATABASES, DIRECTORY, Bus
from dbc.codec import MessageCodec, database
from dbc.frames import FRAME_DTYPE, Flag

pytestmark = pytest.mark.vcan

SEED = 20260822
BATCH = 50
"""Frames on their way to a foreign program at one time: well below what a socket holds."""
FLOOD = 20_000
"""Frames, more than the socket of a link holds."""
CANTOOLS = {bus: cantools.database.load_file(DIRECTORY / f"{stem}.dbc") for stem, bus in DATABASES.items()}


@pytest.fixture
def buses() -> Iterator[dict[Bus, can.BusABC]]:
    """python-can on all four interfaces."""
    with ExitStack() as stack:
        yield {
            bus: stack.enter_context(can.Bus(interface="socketcan", channel=name)) for bus, name in INTERFACES.items()
        }


def random_frames(count: int) -> np.ndarray:
    """Frames of every message in turn, with values that its signals hold."""
    print(f"seed {SEED}")
    random = np.random.default_rng(SEED)
    messages = list(database)
    frames = b"".join(random_frame(messages[n % len(messages)], random, 1_000_000 + 100 * n) for n in range(count))
    return np.frombuffer(frames, FRAME_DTYPE)


def random_frame(message: MessageCodec, random: np.random.Generator, time_us: int) -> bytes:
    values = [random.uniform(*message.limits(signal)) for signal in message.signals]
    return message.frame(*values, time_us=time_us)


def as_message(frame: np.void) -> can.Message:
    """The frame as python-can sends it."""
    return can.Message(
        arbitration_id=int(frame["id"]),
        is_extended_id=bool(frame["flags"] & Flag.EXTENDED),
        data=bytes(frame["data"])[: frame["dlc"]],
    )


def essence(message: can.Message) -> tuple[int, bool, bytes]:
    return message.arbitration_id, message.is_extended_id, bytes(message.data)


def test_candump_records_what_was_sent(buses: dict[Bus, can.BusABC], tmp_path: Path) -> None:
    frames = random_frames(20 * BATCH)
    with candump() as recorder, (tmp_path / "candump.log").open("w") as log:
        for begin in range(0, len(frames), BATCH):
            batch = frames[begin : begin + BATCH]
            for frame in batch:
                buses[Bus(frame["bus"])].send(as_message(frame))
            log.writelines(read_lines(recorder, len(batch)))

    with CanutilsLogReader(tmp_path / "candump.log") as reader:
        recorded = list(reader)
    for bus, interface in INTERFACES.items():
        sent = [as_message(frame) for frame in frames if frame["bus"] == bus]
        heard = [message for message in recorded if message.channel == interface]
        assert sent
        assert [message.timestamp for message in heard] == sorted(message.timestamp for message in heard)
        assert [essence(message) for message in heard] == [essence(message) for message in sent]
        for message in heard:
            codec = database.find(bus, message.arbitration_id, message.is_extended_id)
            decoded = CANTOOLS[bus].decode_message(
                message.arbitration_id, message.data, decode_choices=False, force_extended_id=message.is_extended_id
            )
            assert codec is not None
            assert [decoded[name] for name in codec.signals] == pytest.approx(codec.decode(message.data))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("123#DEADBEEF", can.Message(arbitration_id=0x123, is_extended_id=False, data=[0xDE, 0xAD, 0xBE, 0xEF])),
        ("7FF#", can.Message(arbitration_id=0x7FF, is_extended_id=False)),
        ("1FFFFFFF#0102030405060708", can.Message(arbitration_id=0x1FFFFFFF, data=range(1, 9))),
        ("100#R", can.Message(arbitration_id=0x100, is_extended_id=False, is_remote_frame=True)),
    ],
)
def test_cansend_is_heard(buses: dict[Bus, can.BusABC], text: str, message: can.Message) -> None:
    subprocess.run(["cansend", INTERFACES[Bus.CAN_A], text], check=True)
    heard = buses[Bus.CAN_A].recv(PATIENCE_S)
    assert heard is not None
    assert heard.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)
    assert [buses[bus].recv(0.0) for bus in (Bus.CAN1, Bus.CAN3, Bus.CAN_S)] == [None] * 3


def test_canplayer_plays_our_recording(buses: dict[Bus, can.BusABC], tmp_path: Path) -> None:
    frames = random_frames(4 * BATCH)
    logs = FrameLogs(tmp_path)
    logs.write(frames.tobytes())
    logs.close()
    assignment = [f"{INTERFACES[bus]}={channel}" for bus, channel in CHANNELS.items()]
    with process("canplayer", "-I", str(tmp_path / CANDUMP), *assignment) as player:
        for bus, interface in INTERFACES.items():
            for frame in frames[frames["bus"] == bus]:
                heard = buses[bus].recv(PATIENCE_S)
                assert heard is not None, interface
                assert essence(heard) == essence(as_message(frame))
        assert player.wait(PATIENCE_S) == 0
    assert [bus.recv(0.0) for bus in buses.values()] == [None] * len(buses)


def test_every_frame_of_a_flood_is_received_or_counted_as_lost() -> None:
    interface = INTERFACES[Bus.CAN1]
    with CanLink(f"socketcan:{interface}", Bus.CAN1) as link:
        subprocess.run(["cangen", interface, "-g", "0", "-i", "-n", str(FLOOD)], check=True, timeout=4 * PATIENCE_S)
        first = drain(link)
        assert 0 < len(first) < FLOOD
        # The kernel tells of what it dropped along with the next frame.
        subprocess.run(["cansend", interface, "123#01"], check=True)
        (last,) = drain(link)
        assert (last["id"], last["dlc"], last["data"][0]) == (0x123, 1, 1)
        assert link.statistics.received == len(first) + 1
        assert link.statistics.received + link.statistics.overflows == FLOOD + 1
        times = first["time_us"].astype(np.int64)
        assert (np.diff(times) >= 0).all()


def drain(link: CanLink) -> np.ndarray:
    pieces = []
    while len(piece := link.receive()):
        pieces.append(piece)
    return np.concatenate(pieces)
