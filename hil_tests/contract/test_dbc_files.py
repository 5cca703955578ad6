"""The DBC files as sources: layout, what they promise, and whether other CAN tools can read them."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import pytest
from cantools.database.can import Signal

from dbc.buses import DIRECTORY, PROFILES, STEMS, Bus
from dbc.network import MessageFacts, load_database, own_network, raw_limits
from dbc.protocol_page import bus_load

#: Facts of the public layouts, written down apart from the DBC files. An id with an x has 29 bits.
LAYOUTS = Path(__file__).parent / "layouts.csv"

NETWORK = own_network()
V26 = own_network(profile="V26")
#: Every message of every DBC file.
EVERY = [*NETWORK, *(facts for facts in V26 if facts.bus == Bus.CAN1)]
IDS = [f"{facts.database}.{facts.message.name}" for facts in EVERY]
MESSAGES = {facts.message.name: facts for facts in NETWORK}
V26_MESSAGES = {facts.message.name: facts for facts in V26}
BIT_RATES = {Bus.CAN1: 500_000, Bus.CAN3: 500_000, Bus.CAN_A: 1_000_000, Bus.CAN_S: 500_000, Bus.CAN_R: 500_000}


def signal(message: str, name: str, messages: Mapping[str, MessageFacts] = MESSAGES) -> Signal:
    return messages[message].message.get_signal_by_name(name)


def facts_of(facts: MessageFacts, item: Signal) -> tuple[object, ...]:
    message = facts.message
    identifier = f"{'x' if message.is_extended_frame else ''}{message.frame_id}"
    order = "little" if item.byte_order == "little_endian" else "big"
    layout = (item.start, item.length, order, int(item.is_signed), float(item.scale), float(item.offset))
    return (facts.database, message.name, identifier, message.length, item.name, *layout)


@pytest.mark.parametrize(("stem", "messages"), [("raptor", 47), ("raptor_v26", 53), ("space_drive", 22)])
def test_public_layout_bit_for_bit(stem: str, messages: int) -> None:
    with LAYOUTS.open(newline="", encoding="ascii") as file:
        expected = {
            (
                *(row["database"], row["message"], row["id"], int(row["dlc"]), row["signal"]),
                *(int(row["start"]), int(row["length"]), row["order"], int(row["signed"])),
                *(float(row["scale"]), float(row["offset"])),
            )
            for row in csv.DictReader(file)
            if row["database"] == stem
        }
    actual = {facts_of(facts, item) for facts in EVERY if facts.database == stem for item in facts.message.signals}
    assert actual == expected
    assert len({row[1] for row in actual}) == messages


def test_traps_of_the_public_layout_are_kept() -> None:
    counter = signal("misc_report", "raptor_rolling_counter")
    assert (counter.start, counter.length) == (19, 8)
    order = [item.name[-2:] for item in MESSAGES["wheel_potentiometer_data"].message.signals]
    assert order == ["FL", "FR", "RR", "RL"]
    for name in ("pt_report_1", "pt_report_2", "Tire_Pressure_FL", "Tire_Temp_RR_4"):
        assert {item.byte_order for item in MESSAGES[name].message.signals} == {"big_endian"}
    starts = {item.name: item.start for item in MESSAGES["pt_report_1"].message.signals}
    assert [starts[name] for name in ("throttle_position", "current_gear", "engine_speed_rpm")] == [5, 21, 29]
    assert [starts[name] for name in ("vehicle_speed_kmph", "gear_shift_status")] == [45, 61]
    lengths = {name: MESSAGES[name].message.length for name in ("brake_pressure_report", "accelerator_report")}
    assert lengths == {"brake_pressure_report": 5, "accelerator_report": 3}


@pytest.mark.parametrize(
    ("message", "name", "declared", "real"),
    [
        ("steering_cmd", "steering_motor_ang_cmd", (-1024, 1023), (-512, 511.5)),
        ("accelerator_cmd", "acc_pedal_cmd", (-150, 655.35), (-327.68, 327.67)),
        ("accelerator_report", "acc_pedal_fdbk", (0, 65535), (0, 6553.5)),
        ("ct_report", "ct_state_rolling_counter", (0, 9), (0, 255)),
        ("calb_steer_pos_1", "CCIT_CRC", (0, 255), (0, 65535)),
    ],
)
def test_declared_ranges_are_kept_though_the_bits_differ(
    message: str, name: str, declared: tuple[float, float], real: tuple[float, float]
) -> None:
    item = signal(message, name)
    assert (item.minimum, item.maximum) == declared
    assert tuple(raw * item.scale + item.offset for raw in raw_limits(item)) == pytest.approx(real)


@pytest.mark.parametrize(
    ("message", "name", "declared", "real"),
    [
        ("steering_cmd", "steering_motor_ang_cmd", (-1024, 1023), (-512, 511.5)),
        ("steering_report_extd", "average_steering_ang_fdbk", (-1024, 1023), (-512, 511.5)),
        ("brake_report_extd", "F_brk_pos_cmd", (0, 15000), (7500, -15699.39)),
        ("steering_report_extd_2", "motor_duty_cycle_cmd", (-100, 100), (-128, 127)),
        ("pt_report_4", "intake_air_temp_degC", (-40, 120), (-3276.8, 3276.7)),
        ("steering_cmd", "driver_steering_FF_cmd", (0, 3.1), (0, 3.1)),
    ],
)
def test_declared_ranges_of_v26_are_kept(
    message: str, name: str, declared: tuple[float, float], real: tuple[float, float]
) -> None:
    item = signal(message, name, V26_MESSAGES)
    assert (item.minimum, item.maximum) == declared
    assert tuple(raw * item.scale + item.offset for raw in raw_limits(item)) == pytest.approx(real)


def test_profiles_differ_on_can1_alone() -> None:
    for one, other in zip(*([f for f in network if f.bus != Bus.CAN1] for network in (NETWORK, V26)), strict=True):
        assert one.message.name == other.message.name
        assert one.database == other.database
    assert [facts for facts in V26 if facts.bus == Bus.CAN1 and facts.database != "raptor_v26"] == []


def test_what_v26_has_of_v14_means_the_same() -> None:
    """Same sender, period, time-out, value tables and comments where bits are the same: two files, one car."""
    for facts in V26:
        old = MESSAGES.get(facts.message.name)
        if old is None:
            continue
        assert (facts.sender, facts.cycle_ms, facts.timeout_ms) == (old.sender, old.cycle_ms, old.timeout_ms)
        assert (facts.counter is None) == (old.counter is None)
        signals = {item.name: item for item in old.message.signals}
        for item in facts.message.signals:
            if item.name in signals:
                twin = signals[item.name]
                assert (item.unit, item.choices, item.comment) == (twin.unit, twin.choices, twin.comment), item.name
                assert (item.minimum, item.maximum) == (twin.minimum, twin.maximum), item.name


@pytest.mark.parametrize("facts", EVERY, ids=IDS)
def test_raw_limits_are_what_the_bits_hold(facts: MessageFacts) -> None:
    for item in facts.message.signals:
        attributes = item.dbc.attributes if item.dbc is not None else {}
        stated = tuple(attributes[name].value if name in attributes else 0 for name in ("RawMin", "RawMax"))
        assert stated == raw_limits(item), item.name


def test_own_layouts_declare_what_the_bits_hold() -> None:
    for facts in NETWORK:
        if facts.database in ("autonomy", "sensors"):
            for item in facts.message.signals:
                real = tuple(raw * item.scale + item.offset for raw in raw_limits(item))
                assert (item.minimum, item.maximum) == pytest.approx(real), (facts.message.name, item.name)


def test_every_message_is_described_and_received() -> None:
    for facts in EVERY:
        assert facts.message.comment, facts.message.name
        for item in facts.message.signals:
            assert item.receivers, (facts.message.name, item.name)
            assert set(item.receivers).isdisjoint(facts.message.senders), (facts.message.name, item.name)


def test_time_outs_leave_room_for_lost_frames() -> None:
    for facts in EVERY:
        if facts.timeout_ms:
            assert facts.cycle_ms > 0, facts.message.name
            assert facts.timeout_ms >= 3 * facts.cycle_ms, facts.message.name


@pytest.mark.parametrize("messages", [MESSAGES, V26_MESSAGES], ids=PROFILES)
def test_commands_and_safety_frames_are_supervised(messages: Mapping[str, MessageFacts]) -> None:
    for name in ("brake_pressure_cmd", "accelerator_cmd", "steering_cmd"):
        facts = messages[name]
        assert (facts.cycle_ms, facts.timeout_ms) == (10, 100)
        assert facts.counter is not None
        assert facts.crc is None  # the public CAN1 has none
    for name in (
        "req_steer_pos",
        "req_brake_pos",
        *(f"calb_{axis}_pos_{i}" for axis in ("steer", "brake") for i in (1, 2, 3)),
    ):
        facts = messages[name]
        assert facts.timeout_ms == 50
        assert facts.counter is not None
        assert facts.crc is not None
        assert facts.crc.start == 48


def test_frames_of_one_plan_share_its_counter() -> None:
    """Their plan counter ties points to a plan; as message counter it would make every second point stuck."""
    for name in ("trajectory_header", "trajectory_pose", "trajectory_motion"):
        assert MESSAGES[name].counter is None


@pytest.mark.parametrize(
    ("stem", "limit"),
    [
        ("raptor", 0.60),
        ("raptor_v26", 0.60),
        ("space_drive", 0.60),
        ("autonomy", 0.80),
        ("sensors", 0.60),
        ("radar_esr", 0.60),
    ],
)
def test_bus_load_is_plausible(stem: str, limit: float) -> None:
    bus = next(databases[stem] for databases in PROFILES.values() if stem in databases)
    database = load_database(DIRECTORY / f"{stem}.dbc")
    assert database.dbc is not None
    assert database.dbc.attributes["Baudrate"].value == BIT_RATES[bus]
    load = bus_load([facts for facts in EVERY if facts.database == stem], BIT_RATES[bus])
    assert 0.05 < load.nominal < load.stuffed < limit


@pytest.mark.parametrize("stem", STEMS)
def test_other_can_tools_can_read_it(stem: str) -> None:
    """Names of at most 32 characters, ASCII, values that fit their signals, one value per text."""
    content = (DIRECTORY / f"{stem}.dbc").read_bytes()
    assert content.isascii()
    assert b"\r" not in content
    signals_by_value = defaultdict(list)
    for facts in EVERY:
        if facts.database != stem:
            continue
        assert len(facts.message.name) <= 32
        for item in facts.message.signals:
            assert len(item.name) <= 32
            low, high = raw_limits(item)
            choices = item.choices or {}
            assert all(low <= int(value) <= high for value in choices), item.name
            assert len(set(map(str, choices.values()))) == len(choices), item.name
            signals_by_value[item.name].append(facts.message.name)
    assert signals_by_value


def test_codes_of_the_state_machines() -> None:
    states = {int(value): str(name) for value, name in (signal("ct_report", "ct_state").choices or {}).items()}
    assert (states[1], states[7], states[9], states[12], states[255]) == (
        "PWR_ON",
        "INIT_DRIVING",
        "NOM_RACE",
        "EMRG_SHUTDOWN",
        "DEFAULT",
    )
    assert set(range(1, 13)) <= set(states)
    assert states == {int(v): str(n) for v, n in (signal("vehicle_status", "obc_ct_state").choices or {}).items()}
    states = {int(value): str(name) for value, name in (signal("misc_report", "sys_state").choices or {}).items()}
    assert set(states) == {*range(20), 255}
    assert (states[9], states[14], states[16]) == ("DRIVING", "ACT_TEST_FAIL", "EMERGENCY_SHUTDOWN")
    assert states == {int(v): str(n) for v, n in (signal("vehicle_status", "obc_sys_state").choices or {}).items()}
    shift = {int(v): str(n) for v, n in (signal("pt_report_1", "gear_shift_status").choices or {}).items()}
    assert shift == {0: "UNINITIALISED", 1: "READY", 2: "LOCKED_OUT", 3: "UPSHIFT", 4: "DOWNSHIFT"}
