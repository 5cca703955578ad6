"""Every fault of frames and signals against a plain expectation, on a network of its own; all others as they were."""

from __future__ import annotations

import random
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bridge.bus import Network
from bridge.condition import Condition, Situation
from bridge.faults import (
    Babble,
    BusError,
    Corrupt,
    Deaf,
    Delay,
    Drop,
    Duplicate,
    Fault,
    FaultPlan,
    Freeze,
    GnssBias,
    HeartbeatStalled,
    Late,
    Masquerade,
    Noise,
    Offset,
    Onset,
    ParameterAltered,
    Partition,
    Reliability,
    Reorder,
    Replay,
    Scale,
    ScanFrozen,
    ScanOutage,
    ScanSize,
    SensorFrozen,
    SensorOutage,
    Silent,
    StatusCode,
    Stuck,
    WrongIdentifier,
    WrongLength,
)
from bridge.faults.injector import Injection, Injector
from dbc.codec import database
from dbc.errors import CodecError
from dbc.frames import Bus, Flag, Station, iterate
from dbc.states import SsmState
from firmware.parameters import encode_operation
from firmware.tables import own_parameters, parameter_key

TICK_US = 10_000
TICKS = 20
SEED = 5

steering, brake = database.message("steering_cmd"), database.message("brake_pressure_cmd")
request = database.message("req_steer_pos")
position, imu = database.message("gnss_a_position"), database.message("imu_rates")
node, ssm = database.message("node_status"), database.message("ssm_status")
perception, notice = database.message("perception_status"), database.message("sensor_notice")

#: Latitude and longitude of the receiver.
PLACE = (36.27, -115.01)


class Rig:
    """A network on which every station says the same things in every tick, and an injector."""

    def __init__(self) -> None:
        self.network = Network()
        self.situation = Situation(0, 0, 0, 0.0, 0, True)
        self.station = 0.0
        self.silent: set[Station] = set()
        self.stalled: set[Station] = set()
        self.now_us = 0
        self.scenario = SimpleNamespace(profile="V14", seed=SEED)
        self.injector = Injector(self)  # type: ignore[arg-type]

    def inject(self, fault: Fault, **times: Any) -> Injection:
        return self.injector.add(FaultPlan(fault=fault, **times))

    def tick(self) -> None:
        tick = self.now_us // TICK_US
        self.network.begin_tick(self.now_us, self.now_us + TICK_US)
        self.injector.begin_tick(self.now_us)
        self.network.submit(Station.SENSORS, position.frame(*PLACE) + imu.frame(0.1, 0.2, 0.01 * tick, tick))
        self.network.transmit(Bus.CAN_S)
        for number in (0, 1):
            self.network.submit(Station.AUTONOMY, node.frame(number, 0, 100, 1000 + tick, 0))
            self.network.submit(Station.AUTONOMY, perception.frame(5 + number, 0, 100, 3000 + tick, 0))
            self.network.submit(Station.AUTONOMY, notice.frame(3 + number, 2000 + tick, 64, 0))
        self.network.transmit(Bus.CAN_A)
        self.network.submit(Station.OBC, steering.frame(tick, tick) + brake.frame(100.0, tick))
        self.network.transmit(Bus.CAN1, Bus.CAN_A)
        self.network.submit(Station.RAPTOR, request.finish(request.frame(*self._request(tick)), tick))
        self.network.transmit(Bus.CAN3)
        self.network.end_tick()
        self.now_us += TICK_US
        self.situation = self.situation._replace(time_us=self.now_us)

    def _request(self, tick: int) -> list[float]:
        return [float(tick if index == 0 else 0) for index, _ in enumerate(request.signals)]

    def run(self, ticks: int = TICKS) -> None:
        for _ in range(ticks):
            self.tick()

    def frames(self) -> list[tuple[int, int, int, int, int, int, bytes]]:
        """The log as tick, bus, id, dlc, flags, sender, data, in the order of the wire."""
        log = self.network.log_view()
        return [
            (int(row["time_us"]) // TICK_US, *(int(row[name]) for name in ("bus", "id", "dlc", "flags", "sender")),
             row["data"].tobytes())
            for row in log
        ]  # fmt: skip


def of(codec: Any) -> Callable[[tuple[Any, ...]], bool]:
    return lambda row: (row[1], row[2]) == (codec.bus, codec.frame_id) and not row[4] & Flag.ERROR


def clean() -> list[tuple[Any, ...]]:
    rig = Rig()
    rig.run()
    return rig.frames()


CLEAN = clean()
"""The log without a fault."""

BEGIN, END = 5, 12
DURING: dict[str, Any] = {
    "onset": Onset(Condition(time_us=BEGIN * TICK_US)),
    "for_us": (END - BEGIN) * TICK_US,
}


def during(fault: Fault, codec: Any) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]], Injection]:
    """Frames of a message without and with a fault in ticks 5 to 11; all others, and those outside, are as before."""
    rig = Rig()
    injection = rig.inject(fault, **DURING)
    rig.run()
    log = rig.frames()
    mine = of(codec)
    assert [row for row in log if not mine(row)] == [row for row in CLEAN if not mine(row)]
    outside = [row for row in log if mine(row) and not BEGIN <= row[0] < END]
    assert outside == [row for row in CLEAN if mine(row) and not BEGIN <= row[0] < END]
    assert injection.last_us == (END - 1) * TICK_US
    assert injection.ended_us == END * TICK_US
    assert not injection.active
    assert rig.network.losses() == 0
    during = [row for row in CLEAN if mine(row) and BEGIN <= row[0] < END]
    return during, [row for row in log if mine(row) and BEGIN <= row[0] < END], injection


def befallen(fault: Fault, codec: Any) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]], Injection]:
    """As `during`, of a fault that befalls the very first frame too."""
    before, after, injection = during(fault, codec)
    assert injection.first_us == BEGIN * TICK_US
    return before, after, injection


def test_an_armed_fault_changes_nothing() -> None:
    rig = Rig()
    injection = rig.inject(Drop(message="steering_cmd"), onset=Onset(Condition(time_us=10**9)))
    rig.run()
    assert rig.frames() == CLEAN
    assert (injection.active, injection.done, injection.count, injection.first_us) == (False, False, 0, None)


def test_diverted_frames_come_to_the_bus_as_they_would_have() -> None:
    rig = Rig()
    injection = rig.inject(Offset(message="steering_cmd", signal="steering_motor_ang_cmd", value=0.0))
    rig.run()
    assert rig.network.handle.diverting
    assert rig.frames() == CLEAN
    assert injection.count == 0


def test_drop() -> None:
    _, after, injection = befallen(Drop(message="steering_cmd"), steering)
    assert after == []
    assert injection.count == END - BEGIN


def test_drop_by_chance_is_that_of_the_seed() -> None:
    def kept(seed: int) -> list[int]:
        rig = Rig()
        injection = rig.inject(Drop(message="steering_cmd", probability=0.3), seed=seed)
        rig.run(200)
        ticks = [row[0] for row in rig.frames() if of(steering)(row)]
        assert injection.count == 200 - len(ticks)
        return ticks

    generator = random.Random(8)
    assert kept(8) == [tick for tick in range(200) if generator.random() >= 0.3] != kept(9)


@pytest.mark.parametrize("fault", [Delay(message="steering_cmd", ticks=3), Delay(message="steering_cmd", ticks=9)])
def test_delay(fault: Delay) -> None:
    rig = Rig()
    injection = rig.inject(fault, **DURING)
    rig.run(30)
    values = [(row[0], steering.decode(row[6])[1]) for row in rig.frames() if of(steering)(row)]
    due = [(tick + (fault.ticks if BEGIN <= tick < END else 0), float(tick)) for tick in range(30)]
    assert sorted(values) == sorted(due)
    assert injection.count == END - BEGIN


def test_late_is_for_all_that_a_station_sends() -> None:
    rig = Rig()
    rig.inject(Late(station=Station.OBC, ticks=2))
    rig.run(30)
    for codec in (steering, brake):
        assert [row[0] for row in rig.frames() if of(codec)(row)] == list(range(2, 30))
    assert [row[0] for row in rig.frames() if of(imu)(row)] == list(range(30))


def test_duplicate() -> None:
    before, after, _ = befallen(Duplicate(message="steering_cmd", copies=2), steering)
    assert after == [row for row in before for _ in range(3)]


def test_corrupt_named_bits() -> None:
    before, after, _ = befallen(Corrupt(message="steering_cmd", bits=(0, 9, 63)), steering)
    for old, new in zip(before, after, strict=True):
        assert old[:6] == new[:6]
        difference = int.from_bytes(old[6], "little") ^ int.from_bytes(new[6], "little")
        assert difference == sum(1 << bit for bit in (0, 9, 63) if bit < 8 * steering.length)


def test_corrupt_random_bits() -> None:
    before, after, _ = befallen(Corrupt(message="brake_pressure_cmd", random_bits=3), brake)
    patterns = set()
    for old, new in zip(before, after, strict=True):
        difference = int.from_bytes(old[6], "little") ^ int.from_bytes(new[6], "little")
        assert difference.bit_count() == 3
        assert difference < 1 << 8 * brake.length
        patterns.add(difference)
    assert len(patterns) > 1


def test_corrupt_breaks_the_crc() -> None:
    _, after, _ = befallen(Corrupt(message="req_steer_pos", bits=(0,)), request)
    assert after
    for row in after:
        assert request.seal(bytes(16) + row[6])[16:] != row[6]


def test_replay() -> None:
    before, after, injection = during(Replay(message="steering_cmd", age=3), steering)
    assert [row[6] for row in after] == [row[6] for row in before[:3] + before[:-3]]
    assert (injection.count, injection.first_us) == (END - BEGIN - 3, (BEGIN + 3) * TICK_US)


def test_reorder_swaps_neighbours_and_keeps_none_back() -> None:
    rig = Rig()
    rig.inject(Reorder(message="steering_cmd"), **DURING)
    rig.run()
    log = [(row[0], steering.decode(row[6])[1]) for row in rig.frames() if of(steering)(row)]
    swapped = [(6, 6), (6, 5), (8, 8), (8, 7), (10, 10), (10, 9), (12, 11)]  # the odd one when the fault ends
    assert log == [(t, t) for t in range(5)] + swapped + [(t, t) for t in range(12, TICKS)]


def test_a_deaf_station_hears_nothing_and_all_others_what_they_heard() -> None:
    heard: dict[bool, dict[Station, list[bytes]]] = {}
    for deaf in (False, True):
        rig = Rig()
        if deaf:
            rig.inject(Deaf(station=Station.OBC), **DURING)
        heard[deaf] = {station: [] for station in Station}
        for _ in range(TICKS):
            rig.tick()
            for station in Station:
                heard[deaf][station].append(rig.network.take(station))
        assert rig.frames() == CLEAN
    for station in Station:
        expected = list(heard[False][station])
        if station is Station.OBC:
            assert all(expected[BEGIN:END])
            expected[BEGIN:END] = [b""] * (END - BEGIN)
        assert heard[True][station] == expected


def test_wrong_length() -> None:
    before, after, _ = befallen(WrongLength(message="steering_cmd", length=1), steering)
    assert [(row[3], row[6]) for row in after] == [(1, old[6][:1] + bytes(7)) for old in before]


def test_wrong_identifier() -> None:
    rig = Rig()
    rig.inject(WrongIdentifier(message="steering_cmd", identifier=0x123), **DURING)
    rig.run()
    moved = [row for row in rig.frames() if row[2] == 0x123]
    expected = [row for row in CLEAN if of(steering)(row) and BEGIN <= row[0] < END]
    assert [(row[0], row[1], *row[3:]) for row in moved] == [(row[0], row[1], *row[3:]) for row in expected]
    rest = [row for row in rig.frames() if row[2] != 0x123]
    assert sorted(rest) == sorted(row for row in CLEAN if row not in expected)


def test_masquerade_in_the_place_of_the_owner() -> None:
    """What the owner would have sent, but for the signal; from another station, and right in counter and CRC."""
    place = request.signals.index("cntrl_pos")
    fault = Masquerade(message="req_steer_pos", station=Station.SENSORS, signal="cntrl_pos", value=77.0)
    before, after, injection = befallen(fault, request)
    assert injection.count == END - BEGIN
    for owner, forged in zip(before, after, strict=True):
        values = list(request.decode(owner[6]))
        values[place] = 77.0
        tick = owner[0]
        expected = request.finish(request.frame(*values), tick)[-8:]
        assert forged == (*owner[:5], Station.SENSORS, expected)


def test_masquerade_ahead_of_the_owner_takes_its_next_counter() -> None:
    rig = Rig()
    fault = Masquerade(
        message="steering_cmd", station=Station.RAPTOR, signal="steering_motor_ang_cmd", value=-7.0, owner_heard=True
    )
    injection = rig.inject(fault, **DURING)
    rig.run()
    forged = [(tick, Station.RAPTOR, -7.0, tick) for tick in range(BEGIN + 1, END)]
    owners = [(tick, Station.OBC, tick, tick) for tick in range(TICKS)]
    seen = [(row[0], row[5], *steering.decode(row[6])) for row in rig.frames() if of(steering)(row)]
    assert seen == sorted([*forged, *owners], key=lambda row: (row[0], row[1] == Station.OBC))
    assert injection.count == len(forged)
    assert [row for row in rig.frames() if row[4] & Flag.ERROR] == []


def test_masquerade_does_not_befall_a_frame_without_its_content() -> None:
    rig = Rig()
    rig.inject(WrongLength(message="steering_cmd", length=1))
    masquerade = rig.inject(Masquerade(message="steering_cmd", station=Station.RAPTOR))
    rig.run()
    assert masquerade.count == 0


def hears(rig: Rig, station: Station, codec: Any, sender: Station) -> bool:
    return any(
        (frame.bus, frame.id, frame.sender) == (codec.bus, codec.frame_id, sender)
        for frame in iterate(rig.network.take(station))
    )


def test_partition_of_a_station_is_for_one_bus_in_both_directions() -> None:
    rig = Rig()
    rig.run(BEGIN)
    members = list(rig.network.handle.members)
    injection = rig.inject(Partition(bus=Bus.CAN1, station=Station.OBC))
    rig.network.take(Station.OBC)
    rig.network.take(Station.RAPTOR)
    rig.tick()
    assert injection.count == 2, "both commands are lost"
    rig.network.submit(Station.RAPTOR, database.message("misc_report").frame(*[0.0] * 5))
    rig.network.transmit(Bus.CAN1)
    assert {frame.bus for frame in iterate(rig.network.take(Station.OBC))} == {Bus.CAN_A, Bus.CAN_S}
    assert not hears(rig, Station.RAPTOR, steering, Station.OBC)
    injection.cancel()
    assert list(rig.network.handle.members) == members
    rig.tick()
    assert hears(rig, Station.RAPTOR, steering, Station.OBC)


def test_partition_of_a_whole_bus_leaves_the_others() -> None:
    rig = Rig()
    rig.inject(Partition(bus=Bus.CAN3), **DURING)
    rig.run()
    gone = [row for row in CLEAN if row[1] == Bus.CAN3 and BEGIN <= row[0] < END]
    assert gone
    assert sorted(rig.frames()) == sorted(row for row in CLEAN if row not in gone)


def test_silent_station() -> None:
    rig = Rig()
    rig.inject(Silent(station=Station.OBC), **DURING)
    rig.run()
    gone = [row for row in CLEAN if row[5] == Station.OBC and BEGIN <= row[0] < END]
    assert gone
    assert sorted(rig.frames()) == sorted(row for row in CLEAN if row not in gone)


def test_bus_error_destroys_frames_and_the_sender_repeats_them() -> None:
    rig = Rig()
    injection = rig.inject(BusError(message="steering_cmd", errors=3), onset=Onset(Condition(time_us=BEGIN * TICK_US)))
    rig.run()
    errors = [row for row in rig.frames() if row[4] & Flag.ERROR]
    assert [row[:2] for row in errors] == [(BEGIN, Bus.CAN1)] * 3
    assert [row for row in rig.frames() if of(steering)(row)] == [row for row in CLEAN if of(steering)(row)]
    assert (injection.count, injection.done, injection.ended_us) == (3, True, (BEGIN + 1) * TICK_US)


def test_bus_error_without_end_takes_the_sender_off_the_bus_until_it_is_cancelled() -> None:
    rig = Rig()
    injection = rig.inject(BusError(message="steering_cmd"), onset=Onset(Condition(time_us=BEGIN * TICK_US)))
    rig.run(40)
    assert rig.network.handle.buses[Bus.CAN1].nodes[Station.OBC].state in (2, 3)
    assert injection.count >= 16
    injection.cancel()
    assert rig.network.handle.buses[Bus.CAN1].disturbance_count == 0
    sent = len([row for row in rig.frames() if of(steering)(row)])
    rig.run(40)
    assert len([row for row in rig.frames() if of(steering)(row)]) > sent


def test_bus_error_thirty_two_times_is_bus_off_for_a_tenth_of_a_second() -> None:
    rig = Rig()
    rig.inject(BusError(message="steering_cmd", errors=32), onset=Onset(Condition(time_us=BEGIN * TICK_US)))
    rig.run()
    heard = {row[0] for row in rig.frames() if of(brake)(row)}
    assert heard.isdisjoint(range(BEGIN + 1, BEGIN + 10))
    assert heard >= {*range(BEGIN), *range(BEGIN + 11, TICKS)}
    assert rig.network.handle.buses[Bus.CAN1].nodes[Station.OBC].state == 1


def test_babble_wins_the_bus_and_no_other_one() -> None:
    rig = Rig()
    rig.inject(Babble(station=Station.OBC, bus=Bus.CAN1, frames_per_tick=45), **DURING)
    rig.run()
    during = [row for row in rig.frames() if row[1] == Bus.CAN1 and BEGIN + 1 <= row[0] < END]
    assert {row[2] for row in during} == {0}
    assert [row for row in rig.frames() if row[1] != Bus.CAN1] == [row for row in CLEAN if row[1] != Bus.CAN1]


# --- signals: right counter, right CRC


def test_stuck_signal() -> None:
    fault = Stuck(message="steering_cmd", signal="steering_motor_ang_cmd", value=-30.5)
    before, after, _ = befallen(fault, steering)
    for old, new in zip(before, after, strict=True):
        assert steering.decode(new[6]) == (-30.5, *steering.decode(old[6])[1:])


def test_freeze_and_stuck_counter() -> None:
    counter = "steering_motor_cmd_counter"
    before, after, injection = during(Freeze(message="steering_cmd", signal=counter), steering)
    for old, new in zip(before, after, strict=True):
        assert steering.decode(new[6]) == (steering.decode(old[6])[0], float(BEGIN))
    assert injection.count == END - BEGIN - 1  # the first one is itself


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (Offset(message="steering_cmd", signal="steering_motor_ang_cmd", value=2.5), lambda value: value + 2.5),
        (Offset(message="steering_cmd", signal="steering_motor_ang_cmd", value=1e6), lambda _: 511.5),
        (Scale(message="steering_cmd", signal="steering_motor_ang_cmd", factor=-2.0), lambda value: -2.0 * value),
    ],
)
def test_offset_and_scale(fault: Fault, expected: Callable[[float], float]) -> None:
    before, after, _ = befallen(fault, steering)
    for old, new in zip(before, after, strict=True):
        value, counter = steering.decode(old[6])
        assert steering.decode(new[6]) == (expected(value), counter)


def test_noise_has_its_sigma_and_is_that_of_the_seed() -> None:
    def errors(seed: int) -> list[float]:
        rig = Rig()
        rig.inject(Noise(message="imu_rates", signal="imu_roll_rate", sigma=0.5), seed=seed)
        rig.run(200)
        return [imu.decode(row[6])[0] - 0.1 for row in rig.frames() if of(imu)(row)]

    once = errors(3)
    assert once == errors(3) != errors(4)
    assert np.std(once) == pytest.approx(0.5, rel=0.15)  # three sigma of a sample of 200
    assert abs(np.mean(once)) < 3 * 0.5 / np.sqrt(200)


def test_signals_of_a_message_with_crc_are_sealed_again() -> None:
    before, after, _ = befallen(Stuck(message="req_steer_pos", signal=request.signals[0], value=3.0), request)
    assert after
    for old, new in zip(before, after, strict=True):
        assert old[6] != new[6]
        assert request.decode(new[6])[0] == 3.0
        assert request.seal(bytes(16) + new[6])[16:] == new[6]


def test_heartbeat_and_status_are_those_of_one_node() -> None:
    for fault, place, expected in (
        (HeartbeatStalled(node="planning"), "node_heartbeat", 1000.0 + BEGIN),
        (StatusCode(node="planning", code=200), "node_status_code", 200.0),
    ):
        rig = Rig()
        rig.inject(fault, **DURING)
        rig.run()
        for old, new in zip(
            [row for row in CLEAN if of(node)(row)], [row for row in rig.frames() if of(node)(row)], strict=True
        ):
            was, now = (dict(zip(node.signals, node.decode(row[6]), strict=True)) for row in (old, new))
            if was["node_id"] == 1.0 and BEGIN <= old[0] < END:
                was[place] = expected
            assert now == was


def test_nodes_of_perception_report_in_their_own_message() -> None:
    for fault, place, expected in (
        (HeartbeatStalled(node="tracking"), "perception_heartbeat", 3000.0 + BEGIN),
        (StatusCode(node="tracking", code=200), "perception_status_code", 200.0),
        (Reliability(node="tracking", percent=20.0), "perception_reliability", 20.0),
    ):
        before, after, _ = during(fault, perception)
        for old, new in zip(before, after, strict=True):
            was, now = (dict(zip(perception.signals, perception.decode(row[6]), strict=True)) for row in (old, new))
            assert now == (was | {place: expected} if was["perception_id"] == 5.0 else was)


@pytest.mark.parametrize(
    ("fault", "change"),
    [
        (ScanFrozen(scanner="radar"), {"sensor_sequence": 2000.0 + BEGIN}),
        (ScanSize(scanner="radar", size=63), {"sensor_data_size": 63.0}),
        (ScanOutage(scanner="radar"), None),
    ],
)
def test_scans_of_one_sensor(fault: Fault, change: dict[str, float] | None) -> None:
    before, after, _ = during(fault, notice)
    was, now = (
        [dict(zip(notice.signals, notice.decode(row[6]), strict=True)) for row in rows] for rows in (before, after)
    )
    assert {values["sensor_id"] for values in was} == {3.0, 4.0}
    expected = [values for values in was if change is not None or values["sensor_id"] == 3.0]
    assert now == [values | (change or {}) if values["sensor_id"] == 4.0 else values for values in expected]


# --- sensors and parameters


def test_sensor_outage_and_freeze() -> None:
    rig = Rig()
    rig.inject(SensorOutage(sensor="gnss_a"), **DURING)
    rig.inject(SensorFrozen(sensor="imu"), **DURING)
    rig.run()
    log = rig.frames()
    assert [row[0] for row in log if of(position)(row)] == [*range(BEGIN), *range(END, TICKS)]
    for tick, row in enumerate(row for row in log if of(imu)(row)):
        *_, yaw_rate, counter = imu.decode(row[6])
        assert yaw_rate == pytest.approx(0.01 * (BEGIN if BEGIN <= tick < END else tick))
        assert counter == tick


def test_gnss_bias_is_in_metres() -> None:
    _, after, _ = befallen(GnssBias(sensor="gnss_a", east=5.0, north=-3.0), position)
    latitude, longitude = position.decode(after[0][6])
    # Length of a degree on WGS 84, from its series (American Practical Navigator, 2002, table 7).
    phi = np.radians(PLACE[0])
    of_latitude = 111132.92 - 559.82 * np.cos(2 * phi) + 1.175 * np.cos(4 * phi)
    of_longitude = 111412.84 * np.cos(phi) - 93.5 * np.cos(3 * phi) + 0.118 * np.cos(5 * phi)
    assert (latitude - PLACE[0]) * of_latitude == pytest.approx(-3.0, abs=0.02)
    assert (longitude - PLACE[1]) * of_longitude == pytest.approx(5.0, abs=0.02)


def test_parameter_altered() -> None:
    schema = own_parameters()
    operation = [("max_speed", 63.0), ("max_cross_track_error", 2.0)]
    sent = encode_operation(operation, schema)
    rig = Rig()
    injection = rig.inject(ParameterAltered(name="max_speed", value=90.0))
    rig.network.begin_tick(0, TICK_US)
    rig.injector.begin_tick(0)
    rig.network.submit(Station.OPERATOR, b"".join(sent))
    rig.network.transmit(Bus.CAN_A)
    got = [frame.data for frame in iterate(rig.network.take(Station.OBC))]
    expected = encode_operation([("max_speed", 90.0), operation[1]], schema)
    assert got == [frame[16:] for frame in expected] != [frame[16:] for frame in sent]
    assert injection.count == 1
    assert parameter_key("max_speed") == database.message("parameter_write").decode(got[0])[0]


# --- onset, duration, repetition


@pytest.mark.parametrize(
    ("onset", "first"),
    [
        (Onset(), 0),
        (Onset(Condition(time_us=70_000)), 7),
        (Onset(message="steering_cmd", frames=4), 4),
        (Onset(Condition(time_us=60_000), message="steering_cmd", frames=4), 6),
    ],
)
def test_onset(onset: Onset, first: int) -> None:
    rig = Rig()
    injection = rig.inject(Drop(message="brake_pressure_cmd"), onset=onset)
    rig.run()
    assert [row[0] for row in rig.frames() if of(brake)(row)] == list(range(first))
    assert injection.first_us == first * TICK_US
    assert injection.active
    assert injection.ended_us is None


def test_onset_by_station_and_ssm_state() -> None:
    rig = Rig()
    by_place = rig.inject(Drop(message="brake_pressure_cmd"), onset=Onset(station_m=50.0))
    by_state = rig.inject(Drop(message="imu_rates"), onset=Onset(ssm_state=SsmState.DEGRADED))
    rig.run(3)
    assert not by_place.active
    assert not by_state.active  # nor is a state assumed before the first frame
    rig.station = 50.0
    values = [float(SsmState.DEGRADED if name == "ssm_state" else 0) for name in ssm.signals]
    rig.network.submit(Station.OBC, ssm.frame(*values))
    rig.tick()
    assert by_place.active
    rig.tick()
    assert by_state.active


def test_for_frames_and_repetition() -> None:
    rig = Rig()
    injection = rig.inject(
        Drop(message="steering_cmd"),
        onset=Onset(Condition(time_us=20_000)),
        for_frames=2,
        times=3,
        every_us=50_000,
    )
    rig.run()
    gone = {2, 3, 7, 8, 12, 13}
    assert [row[0] for row in rig.frames() if of(steering)(row)] == [t for t in range(TICKS) if t not in gone]
    assert injection.count == 6
    assert injection.done


def test_cancel_ends_it_for_good() -> None:
    rig = Rig()
    injection = rig.inject(Drop(message="steering_cmd"), times=9, every_us=10_000, for_us=10_000)
    rig.run(3)
    injection.cancel()
    injection.cancel()
    rig.run(3)
    assert [row[0] for row in rig.frames() if of(steering)(row)] == [3, 4, 5]
    assert injection.ended_us == 30_000


def test_two_faults_work_one_after_the_other() -> None:
    rig = Rig()
    rig.inject(Offset(message="steering_cmd", signal="steering_motor_ang_cmd", value=10.0))
    rig.inject(Scale(message="steering_cmd", signal="steering_motor_ang_cmd", factor=2.0))
    rig.run(3)
    values = [steering.decode(row[6])[0] for row in rig.frames() if of(steering)(row)]
    assert values == [2.0 * (tick + 10.0) for tick in range(3)]


@pytest.mark.parametrize(
    ("fault", "times", "words"),
    [
        (Drop(), {}, "needs either a message or a station"),
        (Drop(message="steering_cmd", station=Station.OBC), {}, "needs either a message or a station"),
        (Drop(message="steering_cmnd"), {}, "the nearest is 'steering_cmd'"),
        (Freeze(message="steering_cmd", signal="angle"), {}, "no signal of steering_cmd is called 'angle'"),
        (Stuck(message="steering_cmd", signal="steering_motor_ang_cmd", value=600.0), {}, "allowed is -512 to 511.5"),
        (Stuck(message="steering_cmd", signal="steering_motor_ang_cmd", value=float("nan")), {}, "out of range"),
        (Corrupt(message="steering_cmd"), {}, "needs bits or random_bits"),
        (HeartbeatStalled(node="driver"), {}, "there are estimation, planning"),
        (SensorOutage(sensor="gnss_c"), {}, "there are gnss_a, gnss_b, imu"),
        (ScanOutage(scanner="sonar"), {}, "there are lidar, radar"),
        (StatusCode(node="detection", code=200), {}, "there are estimation, planning, wall, lidar_detection"),
        (ParameterAltered(name="max_sped", value=1.0), {}, "the nearest is 'max_speed'"),
        (Drop(message="steering_cmd"), {"times": 2}, "needs every_s"),
        (Drop(message="steering_cmd"), {"times": 2, "every_us": 9}, "needs for_s or for_frames"),
        (Babble(station=Station.OBC, bus=Bus.CAN1), {"for_frames": 2}, "befalls no single frames"),
    ],
)
def test_what_makes_no_sense_is_refused(fault: Fault, times: dict[str, Any], words: str) -> None:
    rig = Rig()
    with pytest.raises(CodecError, match=words):
        rig.inject(fault, **times)
    assert rig.injector.injections == []
