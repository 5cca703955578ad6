"""Frames of the ESR radar: the DBC file against the public layout, packing against cantools and bits by hand."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dbc.buses import DIRECTORY, STEMS, Bus, Station
from dbc.frames import iterate
from dbc.network import bit_rate, load_database, raw_limits
from dbc.radar_tracks import (
    FIRST_ID,
    TRACK_DTYPE,
    TRACKS,
    RangeMode,
    Tracks,
    TrackStatus,
    on_wire,
    pack,
    resolution,
    rolling_counts,
    track_frames,
    unpack,
    wire_limits,
)

SEED = 64
PATH = DIRECTORY / "radar_esr.dbc"
DATABASE = load_database(PATH)
#: Of a track frame in opendbc's ESR.dbc: start, length, signed, scale; the start is the most significant bit.
PUBLIC = {
    "CAN_TX_TRACK_ONCOMING": (0, 1, False, 1.0),
    "CAN_TX_TRACK_GROUPING_CHANGED": (1, 1, False, 1.0),
    "CAN_TX_TRACK_LAT_RATE": (7, 6, True, 0.25),
    "CAN_TX_TRACK_ANGLE": (12, 10, True, 0.1),
    "CAN_TX_TRACK_STATUS": (15, 3, False, 1.0),
    "CAN_TX_TRACK_RANGE": (18, 11, False, 0.1),
    "CAN_TX_TRACK_RANGE_ACCEL": (33, 10, True, 0.05),
    "CAN_TX_TRACK_WIDTH": (37, 4, False, 0.5),
    "CAN_TX_TRACK_ROLLING_COUNT": (38, 1, False, 1.0),
    "CAN_TX_TRACK_BRIDGE_OBJECT": (39, 1, False, 1.0),
    "CAN_TX_TRACK_RANGE_RATE": (53, 14, True, 0.01),
    "CAN_TX_TRACK_MED_RANGE_MODE": (55, 2, False, 1.0),
}
COLUMNS = ("range", "angle", "range_rate", "range_acceleration", "lateral_rate", "width")


def random_tracks(generator: np.random.Generator, count: int, beyond: float = 1.0) -> Tracks:
    """Tracks anywhere within the wire's limits, or by a factor beyond them."""
    tracks = np.zeros(count, dtype=TRACK_DTYPE)
    tracks["id"] = generator.permutation(TRACKS)[:count] + 1
    tracks["status"], tracks["mode"] = generator.integers(1, 8, count), generator.integers(0, 4, count)
    tracks["oncoming"], tracks["rolling_count"] = generator.integers(0, 2, (2, count))
    for name in COLUMNS:
        low, high = wire_limits(name)
        tracks[name] = generator.uniform(beyond * low, beyond * high, count)
    return tracks


def by_hand(values: dict[str, int]) -> bytes:
    """A frame bit by bit: down from the start within a byte, then on at bit 7 of the next."""
    data = bytearray(8)
    for name, value in values.items():
        start, length, *_ = PUBLIC[name]
        byte, bit = divmod(start, 8)
        for place in reversed(range(length)):
            data[byte] |= ((value >> place) & 1) << bit
            byte, bit = (byte, bit - 1) if bit else (byte + 1, 7)
    return bytes(data)


def test_all_64_tracks_have_the_public_layout() -> None:
    for number in range(TRACKS):
        message: Any = DATABASE.get_message_by_frame_id(FIRST_ID + number)
        actual = {s.name: (s.start, s.length, s.is_signed, float(s.scale)) for s in message.signals}
        assert (message.name, message.length, actual) == (f"Target{number + 1}", 8, PUBLIC)
        assert {(s.byte_order, s.offset) for s in message.signals} == {("big_endian", 0)}


def test_the_file_is_what_the_others_are_and_none_of_theirs() -> None:
    assert bit_rate(PATH, DATABASE) == 500_000
    assert PATH.stem in STEMS
    layouts = Path(__file__).parents[1] / "contract" / "layouts.csv"
    with layouts.open(newline="", encoding="ascii") as file:
        on_can1 = {
            int(row["id"]) for row in csv.DictReader(file) if row["database"] == "raptor" and "x" not in row["id"]
        }
    shared = on_can1 & {message.frame_id for message in DATABASE.messages}
    assert shared, "the reason why a radar has a bus of its own"
    for message in DATABASE.messages:
        assert message.comment
        for item in message.signals:
            stated = tuple(
                item.dbc.attributes[n].value if n in item.dbc.attributes else 0 for n in ("RawMin", "RawMax")
            )
            assert stated == raw_limits(item)
            assert [low * item.scale + item.offset for low in raw_limits(item)] == pytest.approx(
                [item.minimum, item.maximum]
            )


@pytest.mark.parametrize("count", [0, 1, 17, TRACKS])
def test_packing_is_cantools(count: int) -> None:
    print(f"seed {SEED}")
    tracks = random_tracks(np.random.default_rng(SEED + count), count, beyond=1.2)
    data = pack(tracks)
    used = set()
    for track in tracks:
        message: Any = DATABASE.get_message_by_frame_id(FIRST_ID + int(track["id"]) - 1)
        wanted = {
            "CAN_TX_TRACK_STATUS": int(track["status"]),
            "CAN_TX_TRACK_MED_RANGE_MODE": int(track["mode"]),
            "CAN_TX_TRACK_ONCOMING": int(track["oncoming"]),
            "CAN_TX_TRACK_ROLLING_COUNT": int(track["rolling_count"]),
            "CAN_TX_TRACK_GROUPING_CHANGED": 0,
            "CAN_TX_TRACK_BRIDGE_OBJECT": 0,
        }
        for name, value in (
            ("RANGE", track["range"]),
            ("ANGLE", -math.degrees(track["angle"])),
            ("RANGE_RATE", track["range_rate"]),
            ("RANGE_ACCEL", track["range_acceleration"]),
            ("LAT_RATE", -track["lateral_rate"]),
            ("WIDTH", track["width"]),
        ):
            item = message.get_signal_by_name(f"CAN_TX_TRACK_{name}")
            low, high = raw_limits(item)
            wanted[item.name] = min(max(round(value / item.scale), low), high)
        row = data[track["id"] - 1]
        used.add(int(track["id"]) - 1)
        assert bytes(row) == message.encode(wanted, scaling=False)
        assert bytes(row) == by_hand(wanted)
        assert message.decode(bytes(row), scaling=False, decode_choices=False) == wanted
    assert not data[sorted(set(range(TRACKS)) - used)].any()


def test_what_was_packed_comes_back() -> None:
    print(f"seed {SEED}")
    tracks = random_tracks(np.random.default_rng(SEED), TRACKS)
    back = unpack(pack(tracks))
    order = np.argsort(tracks["id"])
    assert back.tobytes() == on_wire(tracks)[order].tobytes()
    assert back.tobytes() == unpack(pack(back)).tobytes()
    for name in COLUMNS:
        half = 0.5 * resolution(name)
        assert np.abs(back[name] - tracks[name][order]).max() <= half * (1.0 + 1e-9)
        assert np.abs(back[name] / resolution(name) - np.rint(back[name] / resolution(name))).max() < 1e-9
    for name in ("id", "status", "mode", "oncoming", "rolling_count"):
        assert (back[name] == tracks[name][order]).all()


def test_what_is_beyond_the_limits_is_sent_as_the_limit() -> None:
    track = np.zeros(1, dtype=TRACK_DTYPE)
    track["id"], track["status"] = 9, TrackStatus.UPDATED
    track["range"], track["range_rate"], track["angle"] = 500.0, -90.0, -1.0  # 57 degrees to the right
    (back,) = unpack(pack(track))
    assert back["range"] == pytest.approx(204.7)
    assert back["range_rate"] == pytest.approx(-81.92)
    assert math.degrees(back["angle"]) == pytest.approx(-51.1)
    assert wire_limits("angle") == pytest.approx((-math.radians(51.1), math.radians(51.2)))


def test_a_frame_without_a_target_is_no_track() -> None:
    data = np.zeros((TRACKS, 8), dtype=np.uint8)
    assert len(unpack(data)) == 0
    data[:, 3] = 100  # a range, and no status
    assert len(unpack(data)) == 0
    data[5, 1] = TrackStatus.COASTED << 5
    (track,) = unpack(data)
    assert (track["id"], track["status"], track["range"]) == (6, TrackStatus.COASTED, pytest.approx(10.0))
    assert track["mode"] == RangeMode.NONE


@pytest.mark.parametrize("rolling_count", [0, 1])
def test_frames_of_a_scan_have_its_rolling_count_with_and_without_a_track(rolling_count: int) -> None:
    print(f"seed {SEED}")
    tracks = random_tracks(np.random.default_rng(SEED), 20)
    tracks["rolling_count"] = rolling_count
    data = pack(tracks, rolling_count)
    assert unpack(data).tobytes() == unpack(pack(tracks)).tobytes()
    assert rolling_counts(data).tolist() == [rolling_count] * TRACKS
    frames = list(iterate(track_frames(tracks, rolling_count)))
    assert [frame.id for frame in frames] == list(range(FIRST_ID, FIRST_ID + TRACKS))
    for frame, row in zip(frames, data, strict=True):
        assert frame == (0, frame.id, Bus.CAN_R, 8, 0, Station.SENSORS, row.tobytes())
        values = DATABASE.decode_message(frame.id, frame.data, decode_choices=False)
        assert values["CAN_TX_TRACK_ROLLING_COUNT"] == rolling_count
        assert (values["CAN_TX_TRACK_STATUS"] != TrackStatus.NO_TARGET) == (frame.id - FIRST_ID + 1 in tracks["id"])
        empty = {name for name, value in values.items() if value}
        assert frame.id - FIRST_ID + 1 in tracks["id"] or empty <= {"CAN_TX_TRACK_ROLLING_COUNT"}


@pytest.mark.parametrize("ids", [[0], [65], [3, 3]])
def test_numbers_that_are_none(ids: list[int]) -> None:
    tracks = np.zeros(len(ids), dtype=TRACK_DTYPE)
    tracks["id"] = ids
    with pytest.raises(ValueError, match="different and 1 to 64"):
        pack(tracks)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_values_that_are_none(value: float) -> None:
    tracks = np.zeros(1, dtype=TRACK_DTYPE)
    tracks["id"], tracks["range_rate"] = 1, value
    for carry in (pack, on_wire):
        with pytest.raises(ValueError, match="range_rate is not finite"):
            carry(tracks)


@pytest.mark.parametrize("shape", [(64, 7), (63, 8), (512,), (0, 8)])
def test_data_of_another_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="shape"):
        unpack(np.zeros(shape, dtype=np.uint8))
    with pytest.raises(ValueError, match="shape"):
        rolling_counts(np.zeros(shape, dtype=np.uint8))
