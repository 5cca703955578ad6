"""The C codec against cantools' Python codec, against golden frames, and against itself."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator

import numpy as np
import pytest
from cantools.database.can import Message

from dbc.codec import MessageCodec, database
from dbc.errors import CodecError
from dbc.frames import frame_array, iterate
from dbc.network import load_network, raw_limits

SEED = int(os.environ.get("RACELOOP_SEED", "20210107"))
RANDOM_ROWS = 200

DEFINITIONS = {facts.message.name: facts.message for facts in load_network()}
MESSAGES = [pytest.param(message, id=message.name) for message in database]


def reference_encode(definition: Message, values: tuple[float, ...]) -> bytes:
    """cantools' encoding; not strict, since the declared ranges of the public layouts are wrong in places."""
    data = dict(zip((signal.name for signal in definition.signals), values, strict=True))
    return definition.encode(data, scaling=True, padding=False, strict=False).ljust(8, b"\0")


def reference_decode(definition: Message, data: bytes) -> tuple[float, ...]:
    decoded = definition.decode(data, decode_choices=False, allow_excess=True)
    return tuple(float(decoded[signal.name]) for signal in definition.signals)


def physical(definition: Message, raw: tuple[int, ...]) -> tuple[float, ...]:
    return tuple(signal.scale * value + signal.offset for signal, value in zip(definition.signals, raw, strict=True))


def boundary_rows(definition: Message) -> Iterator[tuple[int, ...]]:
    """Each signal at its ends and around zero, with all others at their lowest, then at their highest value."""
    limits = [raw_limits(signal) for signal in definition.signals]
    for background in (0, 1):
        base = [ends[background] for ends in limits]
        yield tuple(base)
        for index, (low, high) in enumerate(limits):
            for value in sorted({low, low + 1, -1, 0, 1, high - 1, high}):
                if low <= value <= high:
                    yield (*base[:index], value, *base[index + 1 :])


def check_row(message: MessageCodec, definition: Message, raw: tuple[int, ...]) -> None:
    values = physical(definition, raw)
    data = message.encode(*values)
    assert data == reference_encode(definition, values), raw
    decoded = message.decode(data)
    assert decoded == reference_decode(definition, data) == values, raw
    assert message.encode(*decoded) == data


def test_messages_are_those_of_the_dbc_files() -> None:
    assert [message.name for message in database] == list(DEFINITIONS)
    for message in database:
        definition = DEFINITIONS[message.name]
        assert message.signals == tuple(signal.name for signal in definition.signals)
        assert (message.frame_id, message.extended, message.length) == (
            definition.frame_id,
            definition.is_extended_frame,
            definition.length,
        )


@pytest.mark.parametrize("message", MESSAGES)
def test_boundary_values(message: MessageCodec) -> None:
    definition = DEFINITIONS[message.name]
    for raw in boundary_rows(definition):
        check_row(message, definition, raw)


@pytest.mark.parametrize("message", MESSAGES)
def test_random_raw_values(message: MessageCodec) -> None:
    print("RACELOOP_SEED", SEED)
    definition = DEFINITIONS[message.name]
    generator = np.random.default_rng([SEED, message.index])
    limits = [raw_limits(signal) for signal in definition.signals]
    for _ in range(RANDOM_ROWS):
        check_row(message, definition, tuple(int(generator.integers(low, high + 1)) for low, high in limits))


@pytest.mark.parametrize("message", MESSAGES)
def test_random_values_between_the_steps_round_alike(message: MessageCodec) -> None:
    """Physical values off the grid, as controllers compute them; single frames and batch must agree."""
    print("RACELOOP_SEED", SEED)
    definition = DEFINITIONS[message.name]
    generator = np.random.default_rng([SEED, message.index, 1])
    limits = [message.limits(name) for name in message.signals]
    rows = np.column_stack([generator.uniform(low, high, RANDOM_ROWS) for low, high in limits])
    batch = [frame.data for frame in iterate(message.frames(rows))]
    assert batch == [reference_encode(definition, tuple(row)) for row in rows.tolist()]
    assert batch == [message.encode(*row) for row in rows.tolist()]


@pytest.mark.parametrize("message", MESSAGES)
def test_random_data_decodes_alike(message: MessageCodec) -> None:
    print("RACELOOP_SEED", SEED)
    definition = DEFINITIONS[message.name]
    generator = np.random.default_rng([SEED, message.index, 2])
    frames = frame_array(message.frames(np.tile([message.limits(name)[0] for name in message.signals], (50, 1)))).copy()
    frames["data"] = generator.integers(0, 256, (50, 8))
    columns = database.decode_columns(frames)[message.name]
    for row, data in enumerate(frames["data"]):
        reference = reference_decode(definition, data.tobytes())
        assert message.decode(data.tobytes()) == reference
        assert tuple(columns[name][1][row] for name in message.signals) == reference


@pytest.mark.parametrize("message", MESSAGES)
def test_just_outside_the_bits_is_refused(message: MessageCodec) -> None:
    """The generated C would wrap these silently; each signal alone must be refused, by name."""
    definition = DEFINITIONS[message.name]
    middle = [message.limits(name)[0] for name in message.signals]
    for index, signal in enumerate(definition.signals):
        low, high = raw_limits(signal)
        for raw in (low - 1, high + 1, low - 0.51, high + 0.51, float("nan"), float("inf"), float("-inf")):
            values = list(middle)
            values[index] = signal.scale * raw + signal.offset
            with pytest.raises(CodecError, match=rf"^{message.name}\.{signal.name}: "):
                message.encode(*values)
        for raw in (low - 0.49, high + 0.49):  # still rounds to the last step
            values = list(middle)
            values[index] = signal.scale * raw + signal.offset
            message.encode(*values)


#: Frames that other encoders of the public layouts give; signals that are not named are 0.
GOLDEN: list[tuple[str, str, dict[str, float]]] = [
    ("steering_cmd", "2d07050000000000", {"steering_motor_ang_cmd": -105.5, "steering_motor_cmd_counter": 5}),
    ("steering_cmd", "a401070000000000", {"steering_motor_ang_cmd": 210.0, "steering_motor_cmd_counter": 7}),
    ("accelerator_cmd", "8d0e030000000000", {"acc_pedal_cmd": 37.25, "acc_pedal_cmd_counter": 3}),
    ("brake_pressure_cmd", "be0a060000000000", {"brake_pressure_cmd": 2750, "brk_pressure_cmd_counter": 6}),
    ("gear_shift_cmd", "0400000000000000", {"desired_gear": 4}),
    (
        "ct_report",
        "0001000900070500",
        {"track_cond_ack": 1, "ct_state": 9, "ct_state_rolling_counter": 7, "veh_num": 5},
    ),
    ("ct_report_2", "0119000000000000", {"marelli_track_flag_ack": 1, "marelli_vehicle_flag_ack": 25}),
    ("dash_switches_cmd", "3300000000000000", {"driver_traction_aim_switch": 3, "driver_traction_range_switch": 3}),
    (
        "ct_vehicle_acc_feedback",
        "83fffa0005000000",
        {"long_ct_vehicle_acc_fbk": -1.25, "lat_ct_vehicle_acc_fbk": 2.5, "vertical_ct_vehicle_acc_fbk": 0.05},
    ),
    (
        "misc_report",
        "8409410604",
        {
            "battery_voltage": 13.2,
            "sys_state": 9,
            "mode_switch_state": 1,
            "raptor_rolling_counter": 200,
            "safety_switch_state": 4,
        },
    ),
    (
        "wheel_speed_report",
        "09070c0712071407",
        {"wheel_speed_FL": 180.1, "wheel_speed_FR": 180.4, "wheel_speed_RL": 181.0, "wheel_speed_RR": 181.2},
    ),
    ("steering_report", "2d0711", {"steering_motor_ang_avg_fdbk": -105.5, "steering_motor_fdbk_counter": 17}),
    (
        "brake_pressure_report",
        "be0afc08fa",
        {"brake_pressure_fdbk_front": 2750, "brake_pressure_fdbk_rear": 2300, "brk_pressure_fdbk_counter": 250},
    ),
    ("accelerator_report", "740109", {"acc_pedal_fdbk": 37.2, "acc_pedal_fdbk_counter": 9}),
    (
        "pt_report_1",
        "c05d0105f781c348",
        {
            "throttle_position": 37.2,
            "current_gear": 4,
            "engine_speed_rpm": 6110,
            "vehicle_speed_kmph": 180.5,
            "engine_run_switch": 1,
            "engine_state": 1,
            "gear_shift_status": 1,
        },
    ),
    (
        "pt_report_2",
        "0db11069585c0136",
        {
            "fuel_pressure_kPa": 350.5,
            "engine_oil_pressure_kPa": 420.1,
            "coolant_temperature": 88,
            "transmission_temperature": 92,
            "transmission_pressure_kPa": 310,
        },
    ),
    ("diagnostic_report", "0200480000000000", {"sd_system_failure": 1, "est4_sd_comms_loss": 1, "adlink_hb_lost": 1}),
    (
        "base_to_car_summary",
        "45216407d2040000",
        {
            "base_to_car_heartbeat": 5,
            "track_flag": 4,
            "veh_flag": 1,
            "veh_rank": 2,
            "lap_count": 7,
            "lap_distance": 1234,
            "round_target_speed": 100,
        },
    ),
    (
        "marelli_report_1",
        "0100007301000000",
        {"marelli_track_flag": 1, "marelli_rc_base_sync_check": 1, "marelli_rc_lte_rssi": -71},
    ),
    (
        "Tire_Temp_FL_1",
        "073d076d078004b0",
        {"FL_Tire_Temp_01": 85.3, "FL_Tire_Temp_02": 90.1, "FL_Tire_Temp_03": 92.0, "FL_Tire_Temp_04": 20.0},
    ),
    (
        "req_steer_pos",
        "0040320001030000",
        {"cntrl_pos": 0x4000, "veh_speed": 50, "actv_joystk_steer": 1, "Appl_Message_counter": 3},
    ),
]


@pytest.mark.parametrize(("name", "data", "values"), [pytest.param(*row, id=row[0]) for row in GOLDEN])
def test_golden_frames(name: str, data: str, values: dict[str, float]) -> None:
    message = database.message(name)
    assert set(values) <= set(message.signals)
    expected = bytes.fromhex(data)
    assert len(expected) == message.length
    encoded = message.encode(*(values.get(signal, 0.0) for signal in message.signals))
    assert encoded == expected.ljust(8, b"\0")
    for signal, value in zip(message.signals, message.decode(expected), strict=True):
        assert value == pytest.approx(values.get(signal, 0.0), abs=1e-9)


def test_no_two_messages_share_an_address() -> None:
    for one, other in itertools.combinations(database, 2):
        assert (one.bus, one.extended, one.frame_id) != (other.bus, other.extended, other.frame_id)
