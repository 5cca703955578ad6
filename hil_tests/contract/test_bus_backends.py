"""The contract of a bus: one class of tests that every bus of raceloop passes.

Nothing is proved by waiting: that a station does not hear a frame is shown by a marker that is sent after it, when
somebody else has heard it already, and is the first that the station hears.
"""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from bus_backends import (
    Backend,
    HubFromPythonCan,
    HubLinks,
    HubPythonCan,
    HubToPythonCan,
    InProcess,
    Loss,
    Member,
    SocketCanFromPythonCan,
    SocketCanLinks,
    SocketCanToPythonCan,
)
from hub_process import BOUND_S, data_frame

from bridge.realtime.link import Filter
from dbc.frames import Bus, Flag, Frame

SEED = 42
MARKER = 0x7FF
"""The lowest priority: on a bus that arbitrates it comes behind what was sent before it."""

Wire = tuple[int, int, int, bytes]


def wire(frame: Frame) -> Wire:
    """What travels: identifier, flags, length, data."""
    return frame.id, frame.flags, frame.dlc, frame.data


def receive(member: Member, count: int) -> list[Frame]:
    """The next `count` frames."""
    frames: list[Frame] = []
    end = time.monotonic() + BOUND_S
    while len(frames) < count:
        frames += member.take(BOUND_S)
        assert time.monotonic() < end, f"{len(frames)} of {count} frames in {BOUND_S} s"
    assert len(frames) == count, [wire(frame) for frame in frames[count:]]
    return frames


def hears(member: Member, *frames: Frame) -> None:
    """These are the next frames of the station, and no other."""
    assert [wire(frame) for frame in receive(member, len(frames))] == [wire(frame) for frame in frames]


def random_frames(generator: random.Random, bus: Bus, count: int) -> list[Frame]:
    frames = []
    for _ in range(count):
        extended = generator.random() < 0.5
        identifier = generator.getrandbits(29) if extended else generator.randrange(MARKER)
        data = generator.randbytes(generator.randrange(9))
        frames.append(data_frame(bus, identifier, data, Flag.EXTENDED if extended else 0))
    return frames


class BusContract:
    """What holds on every bus."""

    @pytest.fixture
    def backend(self, tmp_path: Path) -> Iterator[Backend]:
        raise NotImplementedError

    @pytest.fixture
    def members(self) -> Iterator[list[Member]]:
        """Stations to be sent away at the end."""
        joined: list[Member] = []
        yield joined
        for member in joined:
            member.leave()

    @pytest.fixture
    def join(self, backend: Backend, members: list[Member]):
        def join(bus: Bus = Bus.CAN1, filters: list[Filter] | None = None, sends: bool = False) -> Member:
            members.append(backend.join(bus, filters, sends))
            return members[-1]

        return join

    @pytest.mark.parametrize("bus", list(Bus))
    def test_everybody_else_on_the_bus_hears_and_nobody_on_another(self, join, members: list[Member], bus: Bus):
        sender, first, second = join(bus, sends=True), join(bus), join(bus)
        for other in Bus:
            if other is bus:
                continue
            elsewhere, marker_sender = join(other), join(other, sends=True)
            sender.send(data_frame(bus, 0x123, b"here"))
            hears(first, data_frame(bus, 0x123, b"here"))
            hears(second, data_frame(bus, 0x123, b"here"))
            marker_sender.send(data_frame(other, MARKER))
            (heard,) = receive(elsewhere, 1)
            assert (heard.id, heard.bus) == (MARKER, other)
            for member in (elsewhere, marker_sender):
                member.leave()
                members.remove(member)

    def test_a_station_does_not_hear_itself(self, join):
        sender, other = join(sends=True), join()
        sender.send(data_frame(Bus.CAN1, 5), data_frame(Bus.CAN1, 6))
        hears(other, data_frame(Bus.CAN1, 5), data_frame(Bus.CAN1, 6))
        other.send(data_frame(Bus.CAN1, MARKER))
        hears(sender, data_frame(Bus.CAN1, MARKER))

    def test_frames_of_a_sender_keep_their_order(self, backend: Backend, join):
        print(f"seed {SEED}")
        generator = random.Random(SEED)
        sender, first, second = join(sends=True), join(), join()
        frames = [
            data_frame(Bus.CAN1, generator.choice([0x10, 0x20, 0x30, 0x700]), number.to_bytes(2, "big"))
            for number in range(200)  # python-can keeps 278 that it has not read
        ]
        sender.send(*frames)
        expected = sorted(frames, key=lambda frame: frame.id) if backend.arbitrates else frames
        hears(first, *expected)
        hears(second, *expected)

    def test_frames_of_two_senders_keep_the_order_of_each(self, join):
        senders, listener = [join(sends=True), join()], join()
        for number in range(100):
            for place, sender in enumerate(senders):
                sender.send(data_frame(Bus.CAN1, 0x100 + place, bytes([place, number])))
        frames = receive(listener, 200)
        for place in range(2):
            assert [frame.data[1] for frame in frames if frame.data[0] == place] == list(range(100))

    def test_all_lengths_and_data_arrive_as_sent(self, join):
        print(f"seed {SEED}")
        generator = random.Random(SEED)
        sender, listener = join(sends=True), join()
        patterns = [bytes(8), b"\xff" * 8, b"\x00\x0a\x20\x3c\x3e\x7f\x80\xfe", generator.randbytes(8)]
        for pattern in patterns:
            for length in range(9):
                sender.send(data_frame(Bus.CAN1, 0x100, pattern[:length]))
                hears(listener, data_frame(Bus.CAN1, 0x100, pattern[:length]))

    @pytest.mark.parametrize("identifier", [0, 1, 0x123, 0x7FF])
    def test_identifiers_of_11_and_29_bits_do_not_mix(self, backend: Backend, join, identifier: int):
        short = data_frame(Bus.CAN1, identifier, b"11")
        long = data_frame(Bus.CAN1, identifier, b"29", Flag.EXTENDED)
        sender, listener = join(sends=True), join()
        filtered = [join(filters=[Filter(identifier)]), join(filters=[Filter(identifier, True)])]
        for frame in (short, long):
            sender.send(frame)
            hears(listener, frame)
        if backend.filters:
            hears(filtered[0], short)
            hears(filtered[1], long)

    def test_the_largest_identifiers(self, join):
        sender, listener = join(sends=True), join()
        for identifier, flags in ((0x7FF, 0), (0x800, Flag.EXTENDED), (0x1FFFFFFF, Flag.EXTENDED)):
            sender.send(data_frame(Bus.CAN1, identifier, b"x", flags))
            hears(listener, data_frame(Bus.CAN1, identifier, b"x", flags))

    def test_remote_frames_arrive_or_are_dropped_as_stated(self, backend: Backend, join):
        remote = data_frame(Bus.CAN1, 0x123, b"", Flag.REMOTE)._replace(dlc=4)
        sender, listener = join(sends=True), join()
        sender.send(remote)
        sender.send(data_frame(Bus.CAN1, MARKER))
        hears(listener, *([remote] if backend.remote else []), data_frame(Bus.CAN1, MARKER))

    def test_filters_let_through_what_they_name(self, backend: Backend, join):
        print(f"seed {SEED}")
        generator = random.Random(SEED)
        sender, listener = join(sends=True), join()
        wanted = {(generator.randrange(30), generator.random() < 0.5) for _ in range(20)}
        chosen = join(filters=[Filter(MARKER), *(Filter(*pair) for pair in wanted)])
        nothing = join(filters=[Filter(MARKER)])
        frames = [
            data_frame(Bus.CAN1, generator.randrange(30), bytes([number]), generator.choice([0, Flag.EXTENDED]))
            for number in range(200)
        ]
        marker = data_frame(Bus.CAN1, MARKER)
        for frame in (*frames, marker):
            sender.send(frame)
            hears(listener, frame)
        if not backend.filters:
            return
        heard = [frame for frame in frames if (frame.id, bool(frame.flags & Flag.EXTENDED)) in wanted]
        assert 0 < len(heard) < len(frames)
        hears(chosen, *heard, marker)
        hears(nothing, marker)

    def test_stamps_rise_and_lie_between_sending_and_receiving(self, backend: Backend, join):
        print(f"seed {SEED}")
        generator = random.Random(SEED)
        senders, listeners = [join(sends=True), join()], [join(), join(sends=True)]
        last_us = [0, 0]
        for _ in range(50):
            frames = random_frames(generator, Bus.CAN1, generator.randrange(1, 8))
            before_us = [listener.now_us() for listener in listeners]
            for frame in frames:
                # Two stations that send one identifier at once would destroy each other's frames.
                senders[frame.id % 2].send(frame)
            for place, listener in enumerate(listeners):
                stamps_us = [frame.time_us for frame in receive(listener, len(frames))]
                after_us = listener.now_us()
                assert stamps_us == sorted(stamps_us)
                assert stamps_us[0] >= last_us[place]
                assert before_us[place] - backend.clock_slack_us <= stamps_us[0]
                assert stamps_us[-1] <= after_us + backend.clock_slack_us
                last_us[place] = stamps_us[-1]

    def test_who_joins_late_hears_what_comes_after(self, join):
        sender, witness = join(sends=True), join()
        sender.send(data_frame(Bus.CAN1, 1))
        hears(witness, data_frame(Bus.CAN1, 1))
        late = join()
        sender.send(data_frame(Bus.CAN1, 2))
        hears(late, data_frame(Bus.CAN1, 2))
        hears(witness, data_frame(Bus.CAN1, 2))

    def test_leaving_is_noticed_by_nobody(self, join, members: list[Member]):
        sender, listener, leaver = join(sends=True), join(), join()
        sender.send(data_frame(Bus.CAN1, 1))
        hears(listener, data_frame(Bus.CAN1, 1))
        leaver.leave()  # with a frame that it has not read
        members.remove(leaver)
        for number in range(2, 20):
            assert sender.send(data_frame(Bus.CAN1, number)) == 1
            hears(listener, data_frame(Bus.CAN1, number))
        listener.send(data_frame(Bus.CAN1, MARKER))
        hears(sender, data_frame(Bus.CAN1, MARKER))

    def test_a_flood_is_bounded_and_counted_and_the_bus_goes_on(self, backend: Backend, join):
        sender, quick, slow = join(sends=True), join(), join()
        sent = 0

        def send(count: int) -> None:
            nonlocal sent
            frames = [data_frame(Bus.CAN1, 0x100, number.to_bytes(4, "big")) for number in range(sent, sent + count)]
            for frame in frames:
                assert sender.send(frame) == 1
            hears(quick, *frames)
            sent += count

        while not backend.has_lost(slow, sent):
            send(25)
            assert sent < 1_000_000

        heard: list[Frame] = []
        end = time.monotonic() + BOUND_S
        while not heard or int.from_bytes(heard[-1].data[:4], "big") < sent - 1:
            heard += slow.take(0.0)
            send(1)
            heard += slow.take(0.1)
            assert time.monotonic() < end
        data = [frame for frame in heard if not frame.flags & Flag.ERROR]
        numbers = [int.from_bytes(frame.data[:4], "big") for frame in data]
        assert numbers == sorted(set(numbers)), "in order, none twice"
        assert numbers[0] == 0, "what had come first was kept"
        assert 0 < len(data) < sent
        if slow.loss is Loss.COUNTED:
            assert slow.lost() == sent - len(data)
        assert (len(heard) > len(data)) == (slow.loss is Loss.ERROR_FRAME)

        frame = data_frame(Bus.CAN1, MARKER, b"goes on")
        sender.send(frame)
        hears(quick, frame)
        hears(slow, frame)


class TestInProcess(BusContract):
    @pytest.fixture
    def backend(self) -> Iterator[Backend]:
        return InProcess()


class OnHub(BusContract):
    kind: type

    @pytest.fixture
    def backend(self, tmp_path: Path) -> Iterator[Backend]:
        backend = self.kind(tmp_path)
        yield backend
        backend.close()


class TestHubLinks(OnHub):
    kind = HubLinks


class TestHubPythonCan(OnHub):
    kind = HubPythonCan


class TestHubToPythonCan(OnHub):
    kind = HubToPythonCan


class TestHubFromPythonCan(OnHub):
    kind = HubFromPythonCan


class OnSocketCan(BusContract):
    kind: type

    @pytest.fixture
    def backend(self) -> Backend:
        return self.kind()


@pytest.mark.vcan
class TestSocketCanLinks(OnSocketCan):
    kind = SocketCanLinks


@pytest.mark.vcan
class TestSocketCanToPythonCan(OnSocketCan):
    kind = SocketCanToPythonCan


@pytest.mark.vcan
class TestSocketCanFromPythonCan(OnSocketCan):
    kind = SocketCanFromPythonCan
