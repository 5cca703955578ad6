"""dbc/codec.py and dbc/frames.py: the Python face of the codec."""

from __future__ import annotations

import math
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from dbc._codec import ffi, lib
from dbc.buses import DATABASES, DIRECTORY, PROFILES
from dbc.codec import Codec, database, profile
from dbc.errors import CodecError, ConfigurationError
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Bus, Flag, Frame, Station, frame_array, iterate

STEERING = database.message("steering_cmd")


def test_message_knows_its_address_and_timing() -> None:
    assert (STEERING.bus, STEERING.frame_id, STEERING.extended, STEERING.length) == (Bus.CAN1, 1402, False, 8)
    assert (STEERING.sender, STEERING.cycle_us, STEERING.timeout_us) == (Station.OBC, 10_000, 100_000)
    assert STEERING.signals == ("steering_motor_ang_cmd", "steering_motor_cmd_counter")
    assert STEERING.index == lib.CODEC_RAPTOR_STEERING_CMD
    assert database.find(Bus.CAN1, 1402) is STEERING
    assert database.find(Bus.CAN1, 1402, extended=True) is None


def test_names_are_unique_over_all_buses() -> None:
    assert len({message.name for message in database}) == len(database) == lib.CODEC_MESSAGE_COUNT


def test_a_profile_is_made_once_and_the_cars_own_is_the_database() -> None:
    assert profile("V14") is database
    assert profile("V26") is profile("V26") is not database
    assert [profile(name).profile for name in PROFILES] == ["V14", "V26"]
    names = [ffi.string(lib.codec_values_profiles[number].name).decode() for number in range(lib.CODEC_PROFILE_COUNT)]
    assert names == list(PROFILES)
    with pytest.raises(CodecError, match=r"^no profile is called 'V27'; there are V14, V26$"):
        profile("V27")


def test_profiles_accept_their_own_frames() -> None:
    """misc_report grew by a byte: the longer one passes for both, the shorter one for V14 alone."""
    new, old = profile("V26"), database
    frames = frame_array(
        old.message("misc_report").frame(13.2, 9, 1, 7, 4) + new.message("misc_report").frame(13.2, 9, 1, 8, 4, 50)
    )
    assert old.identify(frames).tolist() == [old.message("misc_report").index] * 2
    assert new.identify(frames).tolist() == [lib.CODEC_SHORT_FRAME, new.message("misc_report").index]
    assert new.message("misc_report").decode(frames["data"][1].tobytes()[:6]) == pytest.approx((13.2, 9, 1, 8, 4, 50))
    novatel = frame_array(new.message("novatel_report").frame(36.27, -115.01))
    assert old.identify(novatel).tolist() == [lib.CODEC_UNKNOWN_ID]
    assert list(new.decode_columns(novatel)) == ["novatel_report"]
    assert new.find(Bus.CAN3, 32).frame_id == old.find(Bus.CAN3, 32).frame_id == 32  # type: ignore[union-attr]


def test_frame_holds_address_time_and_data() -> None:
    frame = STEERING.frame(-105.5, 5, time_us=123_456_789_012)
    assert len(frame) == FRAME_SIZE
    (decoded,) = iterate(frame)
    data = bytes.fromhex("2d07050000000000")
    assert decoded == Frame(123_456_789_012, 1402, Bus.CAN1, 8, 0, Station.OBC, data)
    assert decoded.pack() == frame
    assert STEERING.encode(-105.5, 5) == data
    assert STEERING.decode(data) == (-105.5, 5.0)
    (other,) = iterate(STEERING.frame(0, 0, sender=Station.NONE))
    assert other.sender == Station.NONE


def test_extended_frame_carries_its_flag() -> None:
    message = database.message("speed_over_ground_novatel")
    (frame,) = iterate(message.frame(12.34))
    assert (frame.id, frame.flags) == (0x09F80201, Flag.EXTENDED)
    assert database.find(Bus.CAN3, frame.id, extended=True) is message


def test_batch_equals_single_frames() -> None:
    values = np.array([[-512.0, 0], [0.5, 17], [511.5, 255]])
    times = [10, 20, 30]
    batch = STEERING.frames(values, time_us=times, sender=Station.AUTONOMY)
    single = b"".join(
        STEERING.frame(*row, time_us=time, sender=Station.AUTONOMY) for row, time in zip(values, times, strict=True)
    )
    assert batch == single
    assert STEERING.frames(np.empty((0, 2))) == b""
    assert STEERING.frames(values[:, :][::2]) == STEERING.frame(*values[0]) + STEERING.frame(*values[2])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 511.75, -512.26, 1e300])
def test_value_that_does_not_fit_is_refused_by_name(value: float) -> None:
    with pytest.raises(CodecError, match=r"^steering_cmd\.steering_motor_ang_cmd: .*allowed is -512 to 511\.5$"):
        STEERING.encode(value, 0)
    with pytest.raises(CodecError, match="steering_motor_ang_cmd"):
        STEERING.frame(value, 0)
    with pytest.raises(CodecError, match=r"^row 1: steering_cmd\.steering_motor_ang_cmd"):
        STEERING.frames([[0, 0], [value, 0]])


def test_second_value_is_named_too() -> None:
    with pytest.raises(CodecError, match=r"steering_motor_cmd_counter: 256 is out of range; allowed is 0 to 255"):
        STEERING.encode(0, 256)


@pytest.mark.parametrize("values", [(), (1.0,), (1.0, 2.0, 3.0)])
def test_wrong_number_of_values(values: tuple[float, ...]) -> None:
    problem = r"needs 2 values \(steering_motor_ang_cmd, steering_motor_cmd_counter\), not"
    with pytest.raises(CodecError, match=problem):
        STEERING.encode(*values)
    with pytest.raises(CodecError, match=problem):
        STEERING.frame(*values)
    with pytest.raises(CodecError, match=r"shape \(n, 2\)"):
        STEERING.frames([values])


def test_refused_values_leave_no_trace_in_the_next_encoding() -> None:
    reference = STEERING.encode(1.0, 2)
    for bad in ((math.nan, 1), (1.0, 999)):
        with pytest.raises(CodecError):
            STEERING.encode(*bad)
    assert STEERING.encode(1.0, 2) == reference


def test_decode_takes_longer_but_not_shorter_data() -> None:
    report = database.message("steering_report")
    data = bytes.fromhex("2d0711")
    assert report.decode(data) == report.decode(data + b"\xff" * 5) == (-105.5, 17.0)
    assert report.decode(memoryview(data)) == report.decode(bytearray(data)) == (-105.5, 17.0)
    with pytest.raises(CodecError, match="steering_report has 3 data bytes, not 2"):
        report.decode(data[:2])


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(CodecError, match="no message is called 'sterring_cmd'; the nearest is 'steering_cmd'"):
        database.message("sterring_cmd")
    with pytest.raises(CodecError, match="no message is called ''"):
        database.message("")
    with pytest.raises(CodecError, match="no signal of steering_cmd is called 'angle'"):
        STEERING.limits("angle")


def test_finish_writes_counter_and_crc() -> None:
    message = database.message("req_steer_pos")
    frame = message.finish(message.frame(0x4000, 50, 1, 0, 0, 0), 0x103)
    (decoded,) = iterate(frame)
    assert message.decode(decoded.data)[4] == 3
    assert message.decode(decoded.data)[5] != 0
    with pytest.raises(CodecError, match="24 bytes, not 8"):
        message.finish(bytes(8), 0)


def test_units_and_value_tables_come_from_the_dbc_file() -> None:
    report = database.message("misc_report")
    assert report.units == ("V", "", "", "", "")
    assert report.choices["sys_state"][9] == "DRIVING"
    assert report.definition.comment


def test_decode_columns_sorts_frames_by_message() -> None:
    gear = database.message("gear_shift_cmd")
    frames = b"".join(
        [
            STEERING.frame(1.5, 1, time_us=10),
            gear.frame(3, time_us=11),
            STEERING.frame(-2.0, 2, time_us=20),
            Frame(21, 0x7FF, Bus.CAN1, 8, 0, 0, bytes(8)).pack(),
            Frame(22, 1402, Bus.CAN1, 7, 0, 0, bytes(8)).pack(),
            Frame(23, 1402, Bus.CAN1, 8, Flag.REMOTE, 0, bytes(8)).pack(),
            Frame(24, 1402, Bus.CAN1, 8, Flag.ERROR, 0, bytes(8)).pack(),
        ]
    )
    recorded = frame_array(frames)
    statuses = [lib.CODEC_UNKNOWN_ID, lib.CODEC_SHORT_FRAME, lib.CODEC_REMOTE_FRAME, lib.CODEC_ERROR_FRAME]
    assert database.identify(recorded).tolist() == [STEERING.index, gear.index, STEERING.index, *statuses]
    columns = database.decode_columns(recorded)
    assert set(columns) == {"steering_cmd", "gear_shift_cmd"}
    times, angles = columns["steering_cmd"]["steering_motor_ang_cmd"]
    assert (times.tolist(), angles.tolist()) == ([10, 20], [1.5, -2.0])
    assert columns["steering_cmd"]["steering_motor_cmd_counter"][1].tolist() == [1.0, 2.0]
    assert columns["gear_shift_cmd"]["desired_gear"][1].tolist() == [3.0]
    assert database.decode_columns(recorded[:0]) == {}


def test_frame_array_is_a_view_of_the_c_layout() -> None:
    assert FRAME_DTYPE.itemsize == FRAME_SIZE
    (row,) = frame_array(STEERING.frame(0, 3, time_us=5))
    assert (row["time_us"], row["id"], row["dlc"], row["data"][2]) == (5, 1402, 8, 3)
    with pytest.raises(ValueError, match="multiple"):
        frame_array(bytes(25))
    with pytest.raises(struct.error):
        list(iterate(bytes(25)))


def test_changed_or_missing_dbc_file_is_noticed(tmp_path: Path) -> None:
    for stem in DATABASES:
        shutil.copy(DIRECTORY / f"{stem}.dbc", tmp_path)
    Codec(tmp_path).check_sources()
    path = tmp_path / "sensors.dbc"
    path.write_text(path.read_text(encoding="ascii") + "\n", encoding="ascii")
    with pytest.raises(ConfigurationError, match=r"sensors\.dbc: differs from the file that the codec was built from"):
        Codec(tmp_path).check_sources()
    with pytest.raises(ConfigurationError, match=r"sensors\.dbc: differs"):
        _ = Codec(tmp_path).message("imu_rates").units
    path.unlink()
    with pytest.raises(ConfigurationError, match=r"sensors\.dbc: No such file"):
        Codec(tmp_path).check_sources()


def test_generic_functions_refuse_an_unknown_message() -> None:
    values, data, frame = ffi.new("double[64]"), ffi.new("uint8_t[8]"), ffi.new("can_frame *")
    first, last = lib.CODEC_PROFILE_V14, lib.CODEC_PROFILE_V26
    for where in (
        (first, len(database)),
        (last, len(profile("V26"))),
        (first, 2**32 - 1),
        (lib.CODEC_PROFILE_COUNT, 0),
    ):
        assert lib.codec_values_encode(*where, values, data) == lib.CODEC_UNKNOWN_ID
        assert lib.codec_values_decode(*where, data, 8, values) == lib.CODEC_UNKNOWN_ID
        assert lib.codec_values_frame(*where, 0, 0, values, frame) == lib.CODEC_UNKNOWN_ID
        assert lib.codec_values_frames(*where, ffi.NULL, 0, values, 1, frame) == lib.CODEC_UNKNOWN_ID
        assert lib.codec_values_decode_columns(*where, frame, ffi.NULL, 0, values) == lib.CODEC_UNKNOWN_ID
    assert not any(values)
    assert lib.codec_values_frames(first, STEERING.index, ffi.NULL, 0, values, 1, frame) == lib.CODEC_OK
    assert (frame.id, frame.time_us) == (1402, 0)
