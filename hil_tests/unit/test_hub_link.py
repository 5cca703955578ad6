"""A station's link to the hub: hello, frames with their times, a hub that is slow, wrong, gone or back."""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import monotonic_ns, sleep

import pytest
from link_ends import LIMIT_S, HubSocket, Link, Peer, frame

from bridge._native import ffi, lib
from dbc.frames import Bus, Flag, Frame


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[HubSocket]:
    hub = HubSocket(tmp_path / "hub")
    yield hub
    hub.close()


@pytest.fixture
def link() -> Iterator[Link]:
    link = Link()
    yield link
    link.close()


@pytest.fixture
def peer(hub: HubSocket, link: Link) -> Iterator[Peer]:
    peer = hub.join(link)
    yield peer
    peer.close()


# --- opening ---


@pytest.mark.parametrize(
    "address", ["", "hub", "hub:", "socketcan", "socketcan:", "can:vcan0", "/run/hub", "Hub:/run/x", f"hub:{'x' * 124}"]
)
def test_what_is_no_address_is_refused(link: Link, address: str):
    assert link.open(address) == errno.EINVAL
    assert link.c.state == lib.CAN_LINK_CLOSED
    assert "socketcan:INTERFACE or hub:PATH" in ffi.string(lib.can_link_error_text(errno.EINVAL)).decode()


def test_a_bus_that_does_not_exist_and_too_many_filters_are_refused(hub: HubSocket, link: Link):
    assert link.open(hub.address, bus=lib.CAN_BUS_COUNT) == errno.EINVAL
    assert link.open(hub.address, filters=[(1, False)] * (lib.CAN_LINK_FILTERS_MAX + 1)) == errno.EINVAL
    hub.socket.settimeout(0.0)
    with pytest.raises(BlockingIOError):
        hub.socket.accept()


def test_hello_carries_bus_and_filters(hub: HubSocket, link: Link):
    filters = [(0x578, False), (0x9F80201, True)]
    peer = hub.join(link, bus=Bus.CAN_A, filters=filters)
    assert (peer.bus, peer.filter_count, peer.filters) == (Bus.CAN_A, 2, filters)
    assert (link.c.state, link.c.stamps, link.c.bus) == (lib.CAN_LINK_UP, True, Bus.CAN_A)
    peer.close()


def test_hello_tells_no_filter_from_nothing_wanted(hub: HubSocket):
    links = [Link(), Link()]
    everything = hub.join(links[0], filters=None)
    nothing = hub.join(links[1], filters=[])
    assert (everything.filter_count, everything.filters) == (lib.CAN_LINK_EVERYTHING, [])
    assert (nothing.filter_count, nothing.filters) == (0, [])
    for one in [*links, everything, nothing]:
        one.close()


def test_no_hub(hub: HubSocket, link: Link, tmp_path: Path):
    assert link.open(f"hub:{tmp_path}/absent") == errno.ENOENT
    hub.close()
    assert link.open(hub.address) == errno.ECONNREFUSED
    assert link.c.state == lib.CAN_LINK_CLOSED
    for error in (errno.ENOENT, errno.ECONNREFUSED):
        assert "raceloop hub" in ffi.string(lib.can_link_error_text(error)).decode()


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (struct.pack("<IIi", lib.HUB_MAGIC, lib.HUB_VERSION + 1, 0), errno.EPROTO),
        (struct.pack("<IIi", 0, lib.HUB_VERSION, 0), errno.EPROTO),
        (b"HTTP/1.1 400 Bad Request", errno.EPROTO),
        (struct.pack("<IIi", lib.HUB_MAGIC, lib.HUB_VERSION, errno.EADDRINUSE), errno.EADDRINUSE),
        (None, errno.ECONNRESET),
    ],
)
def test_a_hub_that_does_not_welcome(hub: HubSocket, link: Link, answer: bytes | None, error: int):
    with ThreadPoolExecutor(1) as pool:
        opened = pool.submit(link.open, hub.address)
        peer = hub.accept()
        if answer is not None:
            peer.socket.send(answer)
        peer.close()
        assert opened.result() == error
    assert link.c.state == lib.CAN_LINK_CLOSED
    assert link.c.last_error == error


def test_a_hub_that_does_not_answer_is_given_up(hub: HubSocket, link: Link):
    begin_ns = monotonic_ns()
    assert link.open(hub.address) == errno.ETIMEDOUT
    assert 0.9 < (monotonic_ns() - begin_ns) * 1e-9 < LIMIT_S


def test_closing_what_was_never_opened_closes_nothing():
    saved = os.dup(0)
    read_end, write_end = os.pipe()
    try:
        os.dup2(read_end, 0)  # so that 0, the fd of a zeroed link, is a descriptor of ours
        link = Link()
        link.close()
        os.fstat(0)
        assert link.receive() == []
        assert link.send(frame(1)) == 0
        assert link.statistics == {}
    finally:
        os.dup2(saved, 0)
        for descriptor in (saved, read_end, write_end):
            os.close(descriptor)


# --- frames ---


def test_received_frames_carry_the_time_since_the_epoch_and_no_sender(hub: HubSocket, link: Link):
    epoch_ns = 1_000_000_500
    peer = hub.join(link, bus=Bus.CAN_S, epoch_ns=epoch_ns)
    sent = Frame(1_234_567, 0x101, Bus.CAN1, 3, 0, 5, b"abc\0\0\0\0\0")
    early = sent._replace(time_us=999_999)
    long = sent._replace(dlc=15, data=b"abcdefgh", flags=Flag.EXTENDED)
    peer.send(sent, early)
    peer.send(long)
    assert link.receive_until(3) == [
        sent._replace(time_us=(1_234_567_000 - epoch_ns) // 1000, bus=Bus.CAN_S, sender=0),
        early._replace(time_us=0, bus=Bus.CAN_S, sender=0),
        long._replace(time_us=(1_234_567_000 - epoch_ns) // 1000, bus=Bus.CAN_S, sender=0, dlc=8),
    ]
    assert link.statistics == {"received": 3}
    peer.close()


def test_what_does_not_fit_waits(link: Link, peer: Peer):
    for packet in range(4):
        peer.send(*(frame(64 * packet + i) for i in range(64)))
    assert link.receive(63) == []  # less than CAN_LINK_RECEIVE_MIN
    first = link.receive(130)
    assert [f.id for f in first] == list(range(128))
    assert [f.id for f in link.receive_until(128)] == list(range(128, 256))
    assert link.receive() == []


@pytest.mark.parametrize("filters", [None, [(0x100, False)]])
def test_remote_frames_pass_no_filter_and_error_frames_every_one(
    hub: HubSocket, link: Link, filters: list[tuple[int, bool]] | None
):
    peer = hub.join(link, filters=filters)
    data, remote, error = frame(0x100), frame(0x100, flags=Flag.REMOTE), frame(0x20, bytes(8), flags=Flag.ERROR)
    peer.send(remote, data, error, remote, data)
    wanted = [data, error, data] if filters else [remote, data, error, remote, data]
    assert link.receive_until(len(wanted)) == wanted
    assert link.statistics == {"received": len(wanted), "error_frames": 1}
    peer.close()


def test_sent_frames_go_in_order_in_packets_of_at_most_64(link: Link, peer: Peer):
    frames = [frame(i, bytes([i]), bus=Bus.CAN1 if i % 3 else Bus.CAN3) for i in range(250)]
    ours = [f for f in frames if f.bus == Bus.CAN1]
    assert link.send(*frames) == len(ours)
    packets = [peer.packet() for _ in range(3)]
    assert [len(packet) for packet in packets] == [64, 64, len(ours) - 128]
    assert [f for packet in packets for f in packet] == ours
    assert link.statistics == {"sent": len(ours)}


def test_nothing_is_sent_for_frames_of_other_buses(link: Link, peer: Peer):
    assert link.send(frame(1, bus=Bus.CAN3), frame(2, bus=Bus.CAN_A)) == 0
    assert link.send(frame(3)) == 1
    assert [f.id for f in peer.packet()] == [3]


def test_a_full_queue_refuses_and_the_link_stays_up(link: Link, peer: Peer):
    rounds = 0
    while "refused" not in link.statistics:
        assert link.c.state == lib.CAN_LINK_UP
        assert rounds < 100_000
        link.send(*(frame(i) for i in range(64)))
        rounds += 1
    assert link.statistics["refused"] == 64
    assert link.c.last_error in (errno.EAGAIN, errno.ENOBUFS)
    for _ in range(rounds - 1):
        assert len(peer.packet()) == 64
    assert link.send(frame(7)) == 1
    assert [f.id for f in peer.packet()] == [7]
    assert link.c.state == lib.CAN_LINK_UP
    assert link.statistics == {"refused": 64, "sent": 64 * (rounds - 1) + 1}


def test_the_hub_tells_what_it_lost(link: Link, peer: Peer):
    peer.socket.send(struct.pack("<IIQ", lib.HUB_MAGIC, lib.HUB_VERSION, 12))
    peer.send(frame(1))
    peer.socket.send(struct.pack("<IIQ", lib.HUB_MAGIC, lib.HUB_VERSION, 30))
    peer.send(frame(2))
    assert [f.id for f in link.receive_until(2)] == [1, 2]
    assert link.statistics == {"received": 2, "overflows": 42}


# --- outages ---


def test_a_hub_that_vanishes_and_returns(hub: HubSocket, link: Link, tmp_path: Path):
    filters = [(0x111, False)]
    first = hub.join(link, bus=Bus.CAN3, filters=filters)
    hub.close()
    first.close()
    link.receive_until_state(lib.CAN_LINK_DOWN)
    assert link.c.last_error in (errno.ECONNREFUSED, errno.ECONNRESET)
    assert link.send(frame(1, bus=Bus.CAN3), frame(2, bus=Bus.CAN3), frame(3, bus=Bus.CAN1)) == 0
    assert link.statistics == {"outages": 1, "undelivered": 2}

    successor = HubSocket(tmp_path / "hub")
    with ThreadPoolExecutor(1) as pool:
        accepted = pool.submit(successor.accept)
        while not accepted.done():
            link.receive()
        assert link.c.state == lib.CAN_LINK_DOWN  # not welcomed yet, and nothing waits for it
        assert link.send(frame(4, bus=Bus.CAN3)) == 0
        peer = accepted.result()
    assert (peer.bus, peer.filters) == (Bus.CAN3, filters)
    peer.welcome()
    link.receive_until_state(lib.CAN_LINK_UP)
    peer.send(frame(0x111))
    assert [f.id for f in link.receive_until(1)] == [0x111]
    assert link.send(frame(5, bus=Bus.CAN3)) == 1
    assert [f.id for f in peer.packet()] == [5]
    assert link.statistics == {"outages": 1, "undelivered": 3, "received": 1, "sent": 1}
    peer.close()
    successor.close()


def test_sending_alone_notices_an_outage_and_its_end(hub: HubSocket, link: Link):
    first = hub.join(link)
    first.close()
    assert link.send(frame(1)) == 0
    assert link.statistics == {"outages": 1, "undelivered": 1}
    link.send(frame(2))  # the hub still listens: a new attempt follows at once
    second = hub.accept()
    second.welcome()
    end_ns = monotonic_ns() + int(LIMIT_S * 1e9)
    while link.send(frame(3)) == 0:
        assert monotonic_ns() < end_ns
        sleep(0.001)
    assert [f.id for f in second.packet()] == [3]
    second.close()


def test_a_hub_that_returns_but_does_not_answer_is_asked_again(hub: HubSocket, link: Link):
    hub.join(link).close()
    link.receive_until_state(lib.CAN_LINK_DOWN)
    link.receive()
    silent = hub.accept()
    with ThreadPoolExecutor(1) as pool:
        accepted = pool.submit(hub.accept)
        while not accepted.done():
            begin_ns = monotonic_ns()
            assert link.receive() == []
            assert monotonic_ns() - begin_ns < LIMIT_S * 1e9
            assert link.c.state == lib.CAN_LINK_DOWN
            sleep(0.001)
        peer = accepted.result()
    assert silent.socket.recv(100) == b""  # the first attempt was given up
    peer.welcome()
    link.receive_until_state(lib.CAN_LINK_UP)
    assert link.statistics == {"outages": 1}
    silent.close()
    peer.close()


def test_attempts_are_a_tenth_of_a_second_apart(hub: HubSocket, link: Link):
    hub.join(link).close()
    hub.close()
    link.receive_until_state(lib.CAN_LINK_DOWN)
    link.receive()  # refused
    first = link.c.retry_ns
    assert first > 0
    while link.c.retry_ns == first:
        link.receive()
    assert link.c.retry_ns - first >= lib.CAN_LINK_RETRY_MS * 1_000_000


def test_rubbish_from_the_hub_is_an_outage(link: Link, peer: Peer):
    peer.send(frame(1))
    peer.socket.send(b"rubbish")
    assert [f.id for f in link.receive()] == [1]
    assert (link.c.state, link.c.last_error) == (lib.CAN_LINK_DOWN, errno.EPROTO)
    assert link.statistics == {"received": 1, "outages": 1}


def test_a_closed_link_stays_closed_and_keeps_its_statistics(link: Link, peer: Peer):
    link.send(frame(1))
    link.close()
    assert link.receive() == []
    assert link.send(frame(2)) == 0
    assert link.c.state == lib.CAN_LINK_CLOSED
    assert link.statistics == {"sent": 1}
    assert [f.id for f in peer.packet()] == [1]
    assert peer.socket.recv(100) == b""
    link.close()


def test_socketcan_says_what_is_missing(link: Link):
    """Where the kernel has CAN it is the interface, else CAN itself."""
    error = link.open("socketcan:no_such_can")
    assert error in (errno.ENODEV, errno.EAFNOSUPPORT)
    assert ffi.string(lib.can_link_error_text(error)).decode()
    assert link.c.state == lib.CAN_LINK_CLOSED
