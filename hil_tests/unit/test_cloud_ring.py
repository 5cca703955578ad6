"""LiDAR scans in shared memory: newest first, no waiting, none that is torn, no trust in anybody's survival."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from bridge._native import ffi, lib
from bridge.realtime.cloud import Cloud, CloudReceiver, CloudSender
from bridge.sensors.lidar import PERIOD_US
from dbc.errors import ConfigurationError

SEED = 20261201
POINTS_MAX = 92160


@pytest.fixture(params=["disk", "memory"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    if request.param == "disk":
        yield tmp_path
        return
    with TemporaryDirectory(dir="/dev/shm") as name:
        yield Path(name)


@pytest.fixture
def ends(folder: Path) -> Iterator[tuple[CloudSender, CloudReceiver]]:
    with CloudSender(folder / "clouds") as sender, CloudReceiver(folder / "clouds") as receiver:
        yield sender, receiver


def scan(value: float, points: int = 5, columns: int = 4) -> Cloud:
    """All values of which are the same."""
    return np.full((points, columns), value, np.float32)


@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (801, 3), (1, 4), (60_000, 4), (POINTS_MAX, 4)])
def test_a_scan_arrives_as_it_was_sent(ends, shape: tuple[int, int]):
    print(f"seed {SEED}")
    sender, receiver = ends
    sent = np.random.default_rng(SEED).random(shape, np.float32)
    sender.send(0, scan(7.0, 3))  # what is left of it in the file shows nowhere
    sender.send(0, sent)
    received = receiver.newest(0)
    assert received is not None
    assert (received.dtype, received.shape) == (np.float32, shape)
    assert np.array_equal(received, sent)


def test_a_scan_is_its_receiver_s_to_keep(ends):
    sender, receiver = ends
    sender.send(0, scan(1.0))
    first = receiver.newest(0)
    for value in range(2, 10):
        sender.send(0, scan(value))
    assert np.array_equal(first, scan(1.0))


def test_rows_and_columns_of_a_larger_array_arrive(ends):
    sender, receiver = ends
    whole = np.arange(60, dtype=np.float32).reshape(10, 6)
    sender.send(0, whole[::2, 1:4])
    assert np.array_equal(receiver.newest(0), whole[::2, 1:4])


def test_the_newest_is_handed_out_once_and_those_before_it_never(ends):
    sender, receiver = ends
    assert receiver.newest(0) is None
    for value in (1.0, 2.0, 3.0):
        sender.send(0, scan(value))
    assert np.array_equal(receiver.newest(0), scan(3.0))
    assert receiver.newest(0) is None
    sender.send(0, scan(4.0))
    assert np.array_equal(receiver.newest(0), scan(4.0))
    assert sender.lost == 2


def test_scans_that_nobody_looked_at_are_lost(ends):
    sender, receiver = ends
    for number in range(1, 11):
        sender.send(0, scan(number))
        assert sender.lost == number - 1
    receiver.newest(0)
    sender.send(0, scan(11.0))
    assert sender.lost == 9


def test_a_scan_that_is_too_large_is_lost_and_the_one_before_it_is_there(ends):
    sender, receiver = ends
    sender.send(0, scan(1.0))
    sender.send(0, scan(2.0, POINTS_MAX + 1))
    assert sender.lost == 1
    assert np.array_equal(receiver.newest(0), scan(1.0))


def test_an_end_that_has_let_go_is_of_no_use_and_no_harm(ends):
    sender, receiver = ends
    sender.send(0, scan(1.0))
    receiver.close()
    assert receiver.newest(0) is None
    sender.close()
    before = sender.lost
    sender.send(PERIOD_US, scan(2.0))
    assert sender.lost == before + 1
    sender.close()
    receiver.close()


def test_what_is_a_period_old_is_gone(ends):
    sender, receiver = ends
    sender.send(1000, scan(1.0))
    assert receiver.newest(1000 + PERIOD_US) is None
    assert receiver.newest(1000) is None
    sender.send(1000, scan(2.0))
    assert np.array_equal(receiver.newest(1000 + PERIOD_US - 1), scan(2.0))


def test_the_future_waits_for_its_time(ends):
    """A plant that is ahead, by a scan or more, takes nothing away from an autonomy that comes late."""
    sender, receiver = ends
    for number in range(3):
        sender.send(number * PERIOD_US, scan(number))
    assert receiver.newest(-1) is None
    for number in range(3):
        assert np.array_equal(receiver.newest(number * PERIOD_US), scan(number))
        assert receiver.newest(number * PERIOD_US) is None


def attached(path: Path, stack: ExitStack) -> object:
    """The memory of a ring, to do by hand what a sender or a receiver does in one piece."""
    return stack.enter_context(CloudReceiver(path))._ring


@pytest.mark.parametrize("more", [lib.CLOUD_RING_PLACES - 1, lib.CLOUD_RING_PLACES, 2 * lib.CLOUD_RING_PLACES])
def test_a_writer_that_laps_the_reader_is_noticed(ends, folder: Path, more: int):
    """Between finding a scan and copying it, so many others come."""
    sender, receiver = ends
    with ExitStack() as stack:
        ring, found = attached(folder / "clouds", stack), ffi.new("cloud_scan *")
        sender.send(0, scan(1.0))
        assert lib.cloud_ring_find(ring, 0, found)
        for value in range(2, 2 + more):
            sender.send(0, scan(value))
        values = np.full((5, 4), -1.0, np.float32)
        whole = lib.cloud_ring_copy(ring, found, ffi.from_buffer("float[]", values))
        assert whole == (more < lib.CLOUD_RING_PLACES)
        assert np.array_equal(values, scan(1.0 if whole else -1.0))
    assert np.array_equal(receiver.newest(0), scan(1.0 + more))


PLACE_BYTES = (lib.cloud_ring_size() - 24) // lib.CLOUD_RING_PLACES
"""The ring's mark, newest and seen number come first; the number of a place comes first in it."""


def test_a_sender_that_died_in_the_middle_is_not_waited_for_and_can_be_replaced(ends, folder: Path):
    sender, receiver = ends
    sender.send(0, scan(1.0))
    sender.send(0, scan(2.0))
    with (folder / "clouds").open("r+b") as file:
        file.seek(24 + 2 * PLACE_BYTES)
        assert int.from_bytes(file.read(8), "little") == 2
        file.seek(24 + 2 * PLACE_BYTES)
        file.write(bytes(8))
    assert np.array_equal(receiver.newest(0), scan(1.0))
    sender.close()
    with CloudSender(folder / "clouds") as successor:
        successor.send(0, scan(3.0))
    assert np.array_equal(receiver.newest(0), scan(3.0))


def test_a_receiver_that_starts_anew_goes_on(folder: Path):
    with CloudReceiver(folder / "clouds") as receiver, CloudSender(folder / "clouds") as sender:
        sender.send(0, scan(1.0))
        assert receiver.newest(0) is not None
        receiver.close()
        with CloudReceiver(folder / "clouds") as successor:
            assert successor.newest(0) is None
            sender.send(0, scan(2.0))
            assert np.array_equal(successor.newest(0), scan(2.0))
        assert sender.lost == 0
    assert [path.name for path in folder.iterdir()] == ["clouds"]


# --- two processes ---

LARGE = 20_000


@contextmanager
def sending(path: Path) -> Iterator[None]:
    """A process that sends large scans of one value each, as fast as it can."""
    child = os.fork()
    if child == 0:
        with CloudSender(path) as sender:
            while True:
                for value in range(1, 1000):
                    sender.send(0, scan(value, LARGE))
    try:
        yield
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_every_scan_from_another_process_is_whole(folder: Path):
    seen = set()
    with CloudReceiver(folder / "clouds") as receiver, sending(folder / "clouds"):
        for _ in range(50_000_000):
            cloud = receiver.newest(0)
            if cloud is not None:
                assert cloud.shape == (LARGE, 4)
                assert (cloud == cloud[0, 0]).all()
                seen.add(float(cloud[0, 0]))
                if len(seen) == 200:
                    break
    assert len(seen) == 200


def test_a_copy_that_the_sender_tears_is_refused(folder: Path):
    """The reader waits, with a scan that it has found, until the sender comes round to it: then it copies."""
    torn = whole = 0
    first, later = ffi.new("cloud_scan *"), ffi.new("cloud_scan *")
    values = np.empty((LARGE, 4), np.float32)
    with ExitStack() as stack:
        ring = attached(folder / "clouds", stack)
        stack.enter_context(sending(folder / "clouds"))
        for _ in range(50_000_000):
            if torn >= 20 and whole >= 20:
                break
            if not lib.cloud_ring_find(ring, 0, first):
                continue
            rounds = lib.CLOUD_RING_PLACES - 1 if whole >= 20 else 1
            for _ in range(50_000_000):
                if lib.cloud_ring_find(ring, 0, later) and later.number >= first.number + rounds:
                    break
            if lib.cloud_ring_copy(ring, first, ffi.from_buffer("float[]", values)):
                assert (values == values[0, 0]).all()
                whole += 1
            else:
                torn += 1
    assert torn >= 20
    assert whole >= 20


# --- mistakes ---


def test_files_that_are_no_clouds_are_refused(tmp_path: Path):
    (tmp_path / "short").write_bytes(b"once upon a time")
    (tmp_path / "zeros").write_bytes(bytes(lib.cloud_ring_size()))
    for end in (CloudSender, CloudReceiver):
        for name in ("short", "zeros"):
            with pytest.raises(ConfigurationError, match=rf"{name}: no file of clouds of this version of raceloop$"):
                end(tmp_path / name)
        with pytest.raises(ConfigurationError, match=r"none/clouds: cannot be the file of clouds: No such file"):
            end(tmp_path / "none" / "clouds")
        with pytest.raises(ConfigurationError, match=r": cannot be the file of clouds: Is a directory$"):
            end(tmp_path)
