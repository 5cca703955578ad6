"""firmware/common/codec.c, function by function, through the binding."""

from __future__ import annotations

import math
from typing import Any

import pytest
from crccheck.crc import Crc16CcittFalse

from dbc._codec import ffi, lib
from dbc.codec import database
from dbc.frames import FRAME_SIZE, Bus, Flag, Frame, Station

STEERING_CMD = 1402
REQ_STEER_POS = 32


def c_frame(frame: bytes) -> Any:
    pointer = ffi.new("can_frame *")
    ffi.buffer(pointer)[:] = frame
    return pointer


def steering_frame(
    counter: int, *, dlc: int = 8, flags: int = 0, identifier: int = STEERING_CMD, bus: int = Bus.CAN1
) -> Any:
    data = database.message("steering_cmd").encode(12.5, counter)
    return c_frame(Frame(0, identifier, bus, dlc, flags, Station.OBC, data).pack())


def request_frame(counter: int) -> Any:
    """A Space Drive request with its counter and CRC in place."""
    message = database.message("req_steer_pos")
    return c_frame(message.finish(message.frame(0x4000, 50, 1, 0, 0, 0), counter))


def receive(rx: Any, frame: Any, now_us: int = 0) -> int:
    return int(lib.codec_receive(rx, frame, now_us))


# --- the binding and the C types agree


def test_frame_is_24_bytes_in_c_and_python() -> None:
    assert ffi.sizeof("can_frame") == FRAME_SIZE == lib.CAN_FRAME_SIZE == 24
    offsets = {name: field.offset for name, field in ffi.typeof("can_frame").fields}
    assert offsets == {"time_us": 0, "id": 8, "bus": 12, "dlc": 13, "flags": 14, "sender": 15, "data": 16}


def test_enums_equal_those_of_the_firmware() -> None:
    buses = ffi.typeof("enum can_bus").relements
    stations = ffi.typeof("enum can_station").relements
    flags = ffi.typeof("enum can_frame_flag").relements
    c_bus_names = {Bus.CAN1: "CAN_BUS_1", Bus.CAN3: "CAN_BUS_3"}
    c_bus_names |= {Bus.CAN_A: "CAN_BUS_A", Bus.CAN_S: "CAN_BUS_S", Bus.CAN_R: "CAN_BUS_R"}
    assert buses == {c_bus_names[bus]: bus.value for bus in Bus} | {"CAN_BUS_COUNT": len(Bus)}
    assert stations == {f"CAN_STATION_{s.name}": s.value for s in Station} | {"CAN_STATION_COUNT": len(Station)}
    assert flags == {f"CAN_FLAG_{flag.name}": flag.value for flag in Flag}


# --- codec_find


def test_find_returns_every_row_and_nothing_else() -> None:
    for index in range(lib.codec_table_count):
        row = lib.codec_table[index]
        found = lib.codec_find(row.bus, row.id, bool(row.extended))
        assert found == ffi.addressof(lib.codec_table[index])
        # the same id in the other format, on no bus, and next door if nobody lives there
        assert lib.codec_find(row.bus, row.id, not row.extended) == ffi.NULL
        assert lib.codec_find(lib.CAN_BUS_COUNT, row.id, bool(row.extended)) == ffi.NULL


@pytest.mark.parametrize("number", range(lib.CODEC_PROFILE_COUNT))
def test_every_profile_finds_its_own_rows(number: int) -> None:
    profile = lib.codec_profiles + number
    rows = profile.messages
    for index in range(profile.count):
        row = rows[index]
        assert lib.codec_find_in(profile, row.bus, row.id, bool(row.extended)) == rows + index
        assert lib.codec_find_in(profile, row.bus, row.id, not row.extended) == ffi.NULL
    if number == lib.CODEC_PROFILE_V14:
        assert rows == ffi.addressof(lib.codec_table, 0)


def test_a_profile_accepts_by_its_own_lengths() -> None:
    """misc_report has five bytes in V14 and six in V26."""
    message = ffi.new("const codec_message **")
    frame = c_frame(Frame(0, 1304, Bus.CAN1, 5, 0, Station.NONE, bytes(8)).pack())
    assert lib.codec_accept(frame, message) == lib.CODEC_OK
    assert lib.codec_accept_in(lib.codec_profiles + lib.CODEC_PROFILE_V26, frame, message) == lib.CODEC_SHORT_FRAME
    assert message[0].dlc == 6


@pytest.mark.parametrize("bus", list(Bus))
def test_find_knows_exactly_the_ids_of_its_bus(bus: Bus) -> None:
    known = {message.frame_id for message in database if message.bus == bus and not message.extended}
    found = {identifier for identifier in range(0x800) if lib.codec_find(bus, identifier, False) != ffi.NULL}
    assert found == known


# --- codec_accept and codec_receive


@pytest.mark.parametrize(
    ("frame", "status"),
    [
        pytest.param(steering_frame(1), lib.CODEC_OK, id="good"),
        pytest.param(steering_frame(1, dlc=9), lib.CODEC_OK, id="dlc 9 counts as 8"),
        pytest.param(steering_frame(1, dlc=15), lib.CODEC_OK, id="dlc 15 counts as 8"),
        pytest.param(steering_frame(1, dlc=7), lib.CODEC_SHORT_FRAME, id="one byte short"),
        pytest.param(steering_frame(1, dlc=0), lib.CODEC_SHORT_FRAME, id="empty"),
        pytest.param(steering_frame(1, identifier=0x7FF), lib.CODEC_UNKNOWN_ID, id="unknown id"),
        pytest.param(steering_frame(1, bus=Bus.CAN3), lib.CODEC_UNKNOWN_ID, id="other bus"),
        pytest.param(steering_frame(1, bus=200), lib.CODEC_UNKNOWN_ID, id="no such bus"),
        pytest.param(steering_frame(1, flags=Flag.EXTENDED), lib.CODEC_UNKNOWN_ID, id="same id, 29 bits"),
        pytest.param(steering_frame(1, flags=Flag.REMOTE), lib.CODEC_REMOTE_FRAME, id="remote"),
        pytest.param(steering_frame(1, flags=Flag.ERROR), lib.CODEC_ERROR_FRAME, id="error"),
        pytest.param(steering_frame(1, flags=Flag.ERROR | Flag.REMOTE), lib.CODEC_ERROR_FRAME, id="error goes first"),
    ],
)
def test_accept_and_receive_agree_on_the_frame(frame: Any, status: int) -> None:
    message = ffi.new("const codec_message **", ffi.addressof(lib.codec_table, 0))
    assert lib.codec_accept(frame, message) == status
    assert (message[0] != ffi.NULL) == (status not in (lib.CODEC_UNKNOWN_ID, lib.CODEC_ERROR_FRAME))

    rx = ffi.new("codec_rx *")
    assert receive(rx, frame, now_us=77) == status
    good = status == lib.CODEC_OK
    assert (rx.valid, rx.rejected, rx.seen, rx.last_status) == (int(good), int(not good), good, status)
    assert rx.last_valid_us == (77 if good else 0)
    assert rx.counter_known == good  # a frame that is not accepted does not move the counter


def test_short_report_is_accepted_from_its_own_length_on() -> None:
    message = database.message("steering_report")
    assert message.length == 3
    for dlc, status in ((2, lib.CODEC_SHORT_FRAME), (3, lib.CODEC_OK), (8, lib.CODEC_OK)):
        frame = c_frame(message.frame(1.0, 1))
        frame.dlc = dlc
        assert receive(ffi.new("codec_rx *"), frame) == status


def test_zeroed_reception_takes_counter_zero_first() -> None:
    rx = ffi.new("codec_rx *")
    assert receive(rx, steering_frame(0)) == lib.CODEC_OK


def test_counter_must_change_but_may_jump() -> None:
    rx = ffi.new("codec_rx *")
    for now_us, counter in enumerate((5, 6, 0, 7, 255, 3)):
        assert receive(rx, steering_frame(counter), now_us) == lib.CODEC_OK
    assert receive(rx, steering_frame(3), 100) == lib.CODEC_COUNTER_STUCK
    assert receive(rx, steering_frame(3), 101) == lib.CODEC_COUNTER_STUCK
    assert (rx.valid, rx.rejected, rx.last_valid_us) == (6, 2, 5)
    assert receive(rx, steering_frame(4), 102) == lib.CODEC_OK
    assert rx.last_valid_us == 102


def test_message_without_counter_may_repeat() -> None:
    rx = ffi.new("codec_rx *")
    frame = c_frame(database.message("gear_shift_cmd").frame(4))
    assert [receive(rx, frame, now_us) for now_us in range(3)] == [lib.CODEC_OK] * 3
    assert not rx.counter_known


def test_counter_over_two_bytes() -> None:
    """raptor_rolling_counter begins at bit 19."""
    message = database.message("misc_report")
    rx = ffi.new("codec_rx *")
    for counter in (0x0F, 0x1F, 0x20, 0xFF):
        assert receive(rx, c_frame(message.frame(13.2, 9, 1, counter, 4))) == lib.CODEC_OK
        assert rx.counter == counter
    # neighbours of the field do not count as a change
    assert receive(rx, c_frame(message.frame(0, 0, 0, 0xFF, 0))) == lib.CODEC_COUNTER_STUCK


def test_crc_accepts_the_frame_as_finished() -> None:
    rx = ffi.new("codec_rx *")
    for counter in (0, 1, 2, 255):
        assert receive(rx, request_frame(counter)) == lib.CODEC_OK


@pytest.mark.parametrize("bit", range(64))
def test_every_flipped_bit_fails_the_crc(bit: int) -> None:
    frame = request_frame(9)
    frame.data[bit // 8] ^= 1 << (bit % 8)
    rx = ffi.new("codec_rx *")
    assert receive(rx, frame, 5) == lib.CODEC_CRC_MISMATCH
    assert (rx.valid, rx.rejected, rx.counter_known) == (0, 1, False)


def test_crc_of_another_address_fails() -> None:
    """A brake demand under the steering demand's id: right layout, right CRC, wrong address."""
    message = database.message("req_brake_pos")
    frame = c_frame(message.finish(message.frame(0x4000, 1, 0, 0, 0), 3))
    assert receive(ffi.new("codec_rx *"), frame) == lib.CODEC_OK
    frame.id = REQ_STEER_POS
    assert receive(ffi.new("codec_rx *"), frame) == lib.CODEC_CRC_MISMATCH


def test_wrong_crc_does_not_move_the_counter() -> None:
    rx = ffi.new("codec_rx *")
    assert receive(rx, request_frame(1)) == lib.CODEC_OK
    broken = request_frame(2)
    broken.data[0] ^= 1
    assert receive(rx, broken) == lib.CODEC_CRC_MISMATCH
    assert rx.counter == 1
    assert receive(rx, request_frame(2)) == lib.CODEC_OK


# --- codec_timed_out


@pytest.mark.parametrize(
    ("now_us", "expected"),
    [(1_000_000, False), (1_100_000, False), (1_100_001, True), (2**63, True), (999_999, True), (0, True)],
)
def test_time_out_after_the_last_valid_frame(now_us: int, expected: bool) -> None:
    rx = ffi.new("codec_rx *", {"seen": True, "last_valid_us": 1_000_000})
    assert lib.codec_timed_out(rx, 100, 0, now_us) is expected


@pytest.mark.parametrize(("now_us", "expected"), [(500, False), (100_500, False), (100_501, True), (499, True)])
def test_time_out_of_a_message_never_seen_runs_from_the_start(now_us: int, expected: bool) -> None:
    rx = ffi.new("codec_rx *")
    assert lib.codec_timed_out(rx, 100, 500, now_us) is expected


def test_time_out_zero_never_expires() -> None:
    assert not lib.codec_timed_out(ffi.new("codec_rx *"), 0, 0, 2**64 - 1)


def test_longest_time_out_does_not_overflow() -> None:
    rx = ffi.new("codec_rx *")
    assert not lib.codec_timed_out(rx, 0xFFFF, 0, 65_535_000)
    assert lib.codec_timed_out(rx, 0xFFFF, 0, 65_535_001)


# --- codec_finish


def test_finish_counts_and_wraps_at_the_width_of_the_field() -> None:
    frame = steering_frame(0)
    counter = ffi.new("uint8_t *", 254)
    row = lib.codec_find(Bus.CAN1, STEERING_CMD, False)
    sent = []
    for _ in range(4):
        lib.codec_finish(frame, row, counter)
        sent.append(frame.data[2])
    assert sent == [254, 255, 0, 1]
    assert counter[0] == 2


def test_finish_wraps_a_narrow_counter() -> None:
    row = ffi.new("codec_message *", {"dlc": 8, "counter_start": 6, "counter_length": 4})
    frame = ffi.new("can_frame *", {"data": [0xFF] * 8})
    counter = ffi.new("uint8_t *", 14)
    sent = []
    for _ in range(3):
        lib.codec_finish(frame, row, counter)
        sent.append((int.from_bytes(bytes(frame.data), "little") >> 6) & 0xF)
        assert int.from_bytes(bytes(frame.data), "little") | (0xF << 6) == 2**64 - 1  # the rest stays as it was
    assert sent == [14, 15, 0]


def test_finish_keeps_a_counter_that_is_too_wide_inside_its_field() -> None:
    row = ffi.new("codec_message *", {"dlc": 8, "counter_start": 6, "counter_length": 4})
    frame = ffi.new("can_frame *")
    counter = ffi.new("uint8_t *", 0xFE)
    lib.codec_finish(frame, row, counter)
    assert int.from_bytes(bytes(frame.data), "little") == 0xE << 6
    assert counter[0] == 0xF


def test_finish_writes_no_byte_behind_the_data() -> None:
    """A frame is one of many in an outbox, and ends with its data."""
    row = lib.codec_find(Bus.CAN1, STEERING_CMD, False)
    for filled in (0x00, 0xFF):
        frames = ffi.new("can_frame[2]")
        ffi.buffer(frames)[:] = bytes(ffi.buffer(steering_frame(0))) + bytes([filled]) * FRAME_SIZE
        lib.codec_finish(frames, row, ffi.new("uint8_t *", 7))
        assert bytes(ffi.buffer(frames))[FRAME_SIZE:] == bytes([filled]) * FRAME_SIZE


def test_finish_leaves_a_plain_message_alone() -> None:
    frame = c_frame(database.message("gear_shift_cmd").frame(3))
    before = bytes(ffi.buffer(frame))
    counter = ffi.new("uint8_t *", 9)
    lib.codec_finish(frame, lib.codec_find(Bus.CAN1, 1403, False), counter)
    assert bytes(ffi.buffer(frame)) == before
    assert counter[0] == 9


# --- CRC


def test_crc_check_value() -> None:
    assert lib.codec_crc16(0xFFFF, b"123456789", 9) == 0x29B1


def test_crc_of_nothing_is_its_start() -> None:
    assert lib.codec_crc16(0xABCD, b"", 0) == 0xABCD


def test_crc_against_another_implementation() -> None:
    for length in range(65):
        data = bytes((37 * i * i + 11 * length) & 0xFF for i in range(length))
        assert lib.codec_crc16(0xFFFF, data, length) == Crc16CcittFalse.calc(data)


def test_crc_continues() -> None:
    first = lib.codec_crc16(0xFFFF, b"1234", 4)
    assert lib.codec_crc16(first, b"56789", 5) == 0x29B1


@pytest.mark.parametrize("name", ["req_steer_pos", "req_brake_pos", "calb_steer_pos_1", "calb_brake_pos_3"])
def test_frame_crc_covers_data_then_id(name: str) -> None:
    message = database.message(name)
    lowest = [message.limits(signal)[0] for signal in message.signals]
    frame = c_frame(message.finish(message.frame(0x8000, *lowest[1:]), 200))
    content = bytes(frame.data)[:6] + message.frame_id.to_bytes(2, "little")
    assert int.from_bytes(bytes(frame.data)[6:], "little") == Crc16CcittFalse.calc(content)


# --- codec_clamp


@pytest.mark.parametrize(
    ("value", "expected", "status"),
    [
        (0.25, 0.25, lib.CODEC_OK),
        (-1.0, -1.0, lib.CODEC_OK),
        (2.0, 2.0, lib.CODEC_OK),
        (-0.0, -0.0, lib.CODEC_OK),
        (-1.0000001, -1.0, lib.CODEC_OUT_OF_RANGE),
        (2.0000002, 2.0, lib.CODEC_OUT_OF_RANGE),
        (-3.4e38, -1.0, lib.CODEC_OUT_OF_RANGE),
        (3.4e38, 2.0, lib.CODEC_OUT_OF_RANGE),
        (math.inf, 2.0, lib.CODEC_NOT_FINITE),
        (-math.inf, -1.0, lib.CODEC_NOT_FINITE),
        (math.nan, -1.0, lib.CODEC_NOT_FINITE),
    ],
)
def test_clamp(value: float, expected: float, status: int) -> None:
    verdict = ffi.new("codec_status *", lib.CODEC_UNKNOWN_ID)
    assert lib.codec_clamp(value, -1.0, 2.0, verdict) == expected
    assert verdict[0] == status


def test_clamp_to_one_value() -> None:
    verdict = ffi.new("codec_status *")
    assert lib.codec_clamp(5.0, 3.0, 3.0, verdict) == 3.0
    assert verdict[0] == lib.CODEC_OUT_OF_RANGE


# --- outbox


def test_outbox_drops_what_does_not_fit() -> None:
    storage = ffi.new("can_frame[2]", [{"time_us": 99, "data": [1] * 8}] * 2)
    out = ffi.new("can_outbox *", {"frames": storage, "capacity": 2})
    first = lib.can_outbox_add(out, Bus.CAN3, 0x20, Flag.EXTENDED, 5)
    assert (first.time_us, first.id, first.bus, first.dlc, first.flags) == (0, 0x20, Bus.CAN3, 5, Flag.EXTENDED)
    assert bytes(first.data) == bytes(8)
    assert lib.can_outbox_add(out, Bus.CAN1, 1, 0, 8) != ffi.NULL
    assert lib.can_outbox_add(out, Bus.CAN1, 2, 0, 8) == ffi.NULL
    assert (out.count, out.dropped) == (2, 1)
