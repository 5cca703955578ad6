"""The state behind `raceloop dbw monitor`, and a recording in steps, beside a slow count of the same."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from dbc.codec import database
from dbc.frames import FRAME_STRUCT, Bus, Flag, frame_array
from tools.dbw.message_table import UNKNOWN_MAX, Address, MessageTable
from tools.dbw.monitor import Line, picture
from tools.dbw.playback import steps

SEED = 20221103
STEERING = database.message("steering_cmd")
GEAR = database.message("gear_shift_cmd")

Frames = NDArray[np.void]


def steering(number: int, time_us: int) -> bytes:
    return STEERING.frame(-105.5, number % 256, time_us=time_us)


def address(codec=STEERING) -> Address:
    return Address(codec.bus, codec.extended, codec.frame_id)


def words(lines: list[Line]) -> str:
    return "\n".join(line.text.plain for line in lines)


@dataclass
class Counted:
    """What a loop over single frames keeps of one message."""

    times: list[int] = field(default_factory=list)
    data: bytes = b""


def random_frames(count: int) -> Frames:
    random = np.random.default_rng(SEED)
    known = [(codec.bus, codec.extended, codec.frame_id) for codec in list(database)[:20]]
    frames = bytearray()
    for number in range(count):
        bus, extended, frame_id = (
            known[random.integers(len(known))] if number % 5 else (random.integers(4), False, 0x7F0)
        )
        flags = Flag.EXTENDED * extended | Flag.REMOTE * (number % 31 == 0)
        frames += FRAME_STRUCT.pack(1000 * number, int(frame_id), int(bus), 8, flags, 0, random.bytes(8))
    return frame_array(bytes(frames))


@pytest.mark.parametrize("piece", [1, 7, 1000])
def test_rows_are_what_a_loop_over_the_frames_counts(piece: int):
    print(f"seed {SEED}")
    frames = random_frames(1000)
    expected: dict[Address, Counted] = {}
    for time_us, frame_id, bus, dlc, flags, _, data in FRAME_STRUCT.iter_unpack(frames.tobytes()):
        if not flags & Flag.REMOTE:
            counted = expected.setdefault(Address(Bus(bus), bool(flags & Flag.EXTENDED), frame_id), Counted())
            counted.times.append(time_us)
            counted.data = data[:dlc]
    table = MessageTable()
    for begin in range(0, len(frames), piece):
        part = frames[begin : begin + piece]
        table.update(part, int(part["time_us"].max()))
    assert set(table.rows) == set(expected)
    for key, counted in expected.items():
        row = table.rows[key]
        assert (row.count, row.last_us, row.heard_us) == (len(counted.times), counted.times[-1], counted.times[-1])
        assert row.data == counted.data
        assert row.period_us == counted.times[-1] - counted.times[-2]
        assert row.mean_us == pytest.approx(np.mean(np.diff(counted.times)))
        assert row.codec is database.find(key.bus, key.frame_id, key.extended)


def test_ages_go_by_the_clock_of_who_looks():
    """Whose time has nothing to do with that of the frames."""
    table = MessageTable()
    frames = frame_array(steering(0, 5_000_000) + GEAR.frame(1, time_us=5_030_000))
    table.update(frames, 100_000)
    assert table.rows[address(GEAR)].age_us(100_000) == 0
    assert table.rows[address()].age_us(100_000) == 30_000
    timeout_us = STEERING.timeout_us
    assert not table.rows[address()].stale(70_000 + timeout_us)
    assert table.rows[address()].stale(70_001 + timeout_us)


def test_unknown_identifiers_do_not_fill_the_memory():
    table = MessageTable()
    flood = b"".join(
        FRAME_STRUCT.pack(number, 0x10000 + number, 0, 8, Flag.EXTENDED, 0, bytes(8)) for number in range(500)
    )
    table.update(frame_array(flood + steering(0, 500)), 500)
    assert len(table.rows) == UNKNOWN_MAX + 1
    assert address() in table.rows


def test_the_picture_has_values_and_what_is_wrong():
    table = MessageTable()
    sent = [steering(number, time_us) for number, time_us in ((0, 0), (1, 10_000), (1, 20_000), (4, 28_000))]
    sent.append(database.message("ct_report").frame(1, 0, 9, 0, 5, time_us=30_000))
    sent.append(FRAME_STRUCT.pack(31_000, 0x123, 0, 2, 0, 0, b"\x01\xab" + bytes(6)))
    table.update(frame_array(b"".join(sent)), 31_000)
    page = picture(table, 31_000)
    text = words(page)
    assert text.startswith("6 frames of 3 messages, 2 offending\n")
    rows = [line.text.plain.split() for line in page]
    assert ["CAN1", "57A", "steering_cmd", "OBC", "4", "8.0", "9.3", "3.0", "4"] in rows
    assert "steering_motor_ang_cmd -105.5 deg" in text
    assert "steering_motor_cmd_counter counter stuck 1, steering_motor_cmd_counter counter jump 1" in text
    assert "ct_state NOM_RACE" in text
    assert "01 AB" in text
    assert "unknown identifier 1" in text
    red = {line.text.plain.split()[1] for line in page if line.text.style == "red" and line.indent == 0}
    assert red == {"57A", "123"}
    assert "stale" not in text
    assert "stale" in words(picture(table, 31_000 + STEERING.timeout_us + 10_000))


@pytest.mark.parametrize(("pattern", "count"), [("steering*", 1), ("57B", 1), ("*", 2), ("*report*", 0)])
def test_patterns_choose_messages(pattern: str, count: int):
    table = MessageTable()
    table.update(frame_array(steering(0, 0) + GEAR.frame(1)), 0)
    assert sum(line.text.plain.startswith("CAN1") for line in picture(table, 0, [pattern])) == count


def test_frames_that_are_too_short_show_their_bytes():
    table = MessageTable()
    table.update(frame_array(FRAME_STRUCT.pack(0, STEERING.frame_id, 0, 2, 0, 0, b"\x2d\x07" + bytes(6))), 0)
    text = words(picture(table, 0))
    assert "2D 07" in text
    assert "too short 1" in text


def times(*times_us: int) -> Frames:
    return frame_array(b"".join(steering(0, time_us) for time_us in times_us))


def test_a_recording_in_steps():
    """Every frame once, in its order; a gap is steps without frames."""
    chunks = [times(5_000_000, 5_000_100), times(5_000_900, 5_003_500), times(5_003_600)]
    played = [(frames["time_us"].tolist(), time_us) for frames, time_us in steps(chunks, 1000)]
    assert played == [
        ([5_000_000, 5_000_100], 100),
        ([5_000_900], 1000),
        ([], 2000),
        ([], 3000),
        ([5_003_500], 3500),
        ([5_003_600], 3600),
    ]


def test_a_clock_that_goes_back_stands_still():
    played = [(frames["time_us"].tolist(), time_us) for frames, time_us in steps([times(9000, 2000, 9500)], 1000)]
    assert played == [([9000, 2000, 9500], 500)]
