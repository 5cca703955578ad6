"""The Python face of a link, on a real hub: mistakes in one line, states, counts, times since the epoch."""

from __future__ import annotations

import select
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hub_process import BOUND_S, Hub, data_frame, until

from bridge.realtime.link import CanLink, Filter, LinkState
from dbc.errors import BusError
from dbc.frames import FRAME_DTYPE, Bus


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    with Hub(tmp_path) as running:
        yield running


def test_mistakes_are_one_line(tmp_path: Path):
    for address, words in (
        ("vcan0", "socketcan:INTERFACE or hub:PATH"),
        (f"hub:{tmp_path}/absent", "no hub there: raceloop hub starts one"),
        ("hub:" + "x" * 200, "socketcan:INTERFACE or hub:PATH"),
    ):
        with pytest.raises(BusError) as caught:
            CanLink(address, Bus.CAN_A)
        assert str(caught.value).startswith(f"CANA at {address}: ")
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)


def test_too_many_filters(hub: Hub):
    filters = [Filter(number) for number in range(129)]
    with pytest.raises(BusError, match="CAN1: 129 filters; at most 128"):
        CanLink(f"hub:{hub.local}", Bus.CAN1, 0, filters)
    CanLink(f"hub:{hub.local}", Bus.CAN1, 0, filters[:128]).close()


def test_a_hub_without_a_free_place(hub: Hub):
    links = [CanLink(f"hub:{hub.local}", Bus.CAN1) for _ in range(64)]
    with pytest.raises(BusError, match="the hub has no free place"):
        CanLink(f"hub:{hub.local}", Bus.CAN1)
    for link in links:
        link.close()


def test_frames_arrive_as_an_array_with_times_since_the_epoch(hub: Hub):
    epoch_ns = time.monotonic_ns()
    with CanLink(f"hub:{hub.local}", Bus.CAN1, epoch_ns) as one, CanLink(f"hub:{hub.local}", Bus.CAN1) as other:
        assert one.receive().dtype == FRAME_DTYPE
        assert one.receive().size == 0
        frames = b"".join(data_frame(Bus.CAN1, number, b"abc").pack() for number in range(200))
        assert other.send(frames + data_frame(Bus.CAN3, 1).pack()) == 200
        received = np.zeros(0, FRAME_DTYPE)
        while received.size < 200:
            assert select.select([one], [], [], BOUND_S)[0]
            received = np.concatenate([received, one.receive()])
        assert list(received["id"]) == list(range(200))
        assert 0 < received["time_us"][0] * 1000 < time.monotonic_ns() - epoch_ns
        assert one.statistics.received == other.statistics.sent == 200
        assert one.statistics.overflows == other.statistics.refused == 0
    assert (one.state, one.fileno(), one.receive().size, one.send(frames)) == (LinkState.CLOSED, -1, 0, 0)
    assert one.statistics.received == 200
    one.close()


def test_parts_of_frames_are_refused(hub: Hub):
    with CanLink(f"hub:{hub.local}", Bus.CAN1) as link, pytest.raises(ValueError, match="25 bytes"):
        link.send(bytes(25))


def test_a_hub_that_comes_back_is_found_again(tmp_path: Path):
    with Hub(tmp_path) as hub:
        link = CanLink(f"hub:{hub.local}", Bus.CAN1)
        assert (link.state, link.problem) == (LinkState.UP, "")
    until(lambda: link.receive().size == 0 and link.state is LinkState.DOWN, "the link to notice")
    assert link.problem
    assert "\n" not in link.problem
    assert link.fileno() == -1
    with Hub(tmp_path), CanLink(f"hub:{hub.local}", Bus.CAN1) as other:
        until(lambda: link.receive().size == 0 and link.state is LinkState.UP, "the link to come up again")
        assert link.send(data_frame(Bus.CAN1, 5).pack()) == 1
        until(lambda: other.receive().size, "the frame")
        assert link.statistics.outages == 1
    link.close()
