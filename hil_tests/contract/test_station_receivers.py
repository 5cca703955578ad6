"""Who the DBC files say reads a message, and who really does: the filters of the ECUs come from the former."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import FRAME_SIZE, Bus, Station
from dbc.network import MessageFacts, own_network

NETWORK = own_network()
TICKS = 3


def obc_tick(ecu: Any, now_us: int, frames: Any, count: int, out: Any) -> None:
    lib.obc_tick(ecu, now_us, frames, count, out)


def raptor_tick(ecu: Any, now_us: int, frames: Any, count: int, out: Any) -> None:
    lib.raptor_tick(ecu, now_us, ffi.new("raptor_wired_in *"), frames, count, ffi.new("raptor_wired_out *"), out)


def space_drive_tick(ecu: Any, now_us: int, frames: Any, count: int, out: Any) -> None:
    wired, drive = ffi.new("space_drive_wired_in *"), ffi.new("space_drive_wired_out *")
    lib.space_drive_tick(ecu, now_us, wired, frames, count, drive, out)


def state_after(station: Station, frame: bytes) -> bytes:
    """All of an ECU's state after a few ticks, in one of which it received the frame, if any."""
    kind, init, tick = ECUS[station]
    ecu = ffi.new(f"{kind} *")
    init(ecu)
    storage = ffi.new("can_frame[]", 256)
    out = ffi.new("can_outbox *", {"frames": storage, "capacity": 256})
    received = ffi.new("can_frame *")
    ffi.memmove(received, frame, len(frame))
    for number in range(TICKS):
        out.count = 0
        tick(ecu, 10_000 * number, received, len(frame) // FRAME_SIZE if number == 1 else 0, out)
    return bytes(ffi.buffer(ecu))


ECUS: dict[Station, tuple[str, Callable[[Any], None], Callable[[Any, int, Any, int, Any], None]]] = {
    Station.OBC: ("obc", lib.obc_init, obc_tick),
    Station.RAPTOR: ("raptor", lambda ecu: lib.raptor_init(ecu, ffi.NULL), raptor_tick),
    Station.SPACE_DRIVE: ("space_drive", lambda ecu: lib.space_drive_init(ecu, ffi.NULL), space_drive_tick),
}


def reads(station: Station, facts: MessageFacts) -> bool:
    """True when a valid frame of the message leaves a trace in the ECU."""
    message = database.message(facts.message.name)
    for fill in (1.0, 0.0):  # a shutdown is two ones, and other messages accept no ones
        values = [min(max(fill, message.limits(name)[0]), message.limits(name)[1]) for name in message.signals]
        frame = message.finish(message.frame(*values), 3)
        if state_after(station, frame) != state_after(station, b""):
            return True
    return False


def read_by(station: Station) -> set[str]:
    return {facts.message.name for facts in NETWORK if reads(station, facts)}


def meant_for(station: Station) -> set[str]:
    return {facts.message.name for facts in NETWORK if station in facts.receivers}


def filters(station: Station, bus: Bus) -> set[tuple[int, bool]]:
    array = ffi.new("can_link_filter[]", lib.CAN_LINK_FILTERS_MAX)
    count = lib.ecu_bus_filters(station, bus, array)
    chosen = [(array[i].id, bool(array[i].extended)) for i in range(count)]
    assert len(set(chosen)) == count
    return set(chosen)


@pytest.mark.parametrize("station", ECUS)
def test_an_ecu_reads_nothing_that_is_not_meant_for_it(station: Station):
    read = read_by(station)
    assert read
    assert read <= meant_for(station)


def test_what_the_firmware_leaves_unread():
    """Addressed to it by the public layout, and of no use to this firmware."""
    assert meant_for(Station.SPACE_DRIVE) - read_by(Station.SPACE_DRIVE) == set()
    assert meant_for(Station.RAPTOR) - read_by(Station.RAPTOR) == {
        "ct_report_2", "ct_vehicle_acc_feedback", "speed_over_ground_novatel",
    }  # fmt: skip
    wheels = ("FL", "FR", "RL", "RR")
    assert meant_for(Station.OBC) - read_by(Station.OBC) == {
        *(f"Tire_Pressure_{wheel}" for wheel in wheels),
        *(f"Tire_Temp_{wheel}_{place}" for wheel in wheels for place in (1, 2, 3, 4)),
        "base_to_car_timing", "marelli_report_2", "mylaps_report_1", "mylaps_report_2",
        "pt_report_2", "pt_report_3", "rest_of_field", "steering_report_extd",
        "wheel_potentiometer_data", "wheel_strain_gauge",
    }  # fmt: skip


def test_the_codec_table_has_the_receivers_of_the_files():
    for index, facts in enumerate(NETWORK):
        expected = sum(1 << station for station in facts.receivers)
        assert lib.codec_table[index].receivers == expected, facts.message.name


@pytest.mark.parametrize("station", [station for station in Station if station != Station.NONE])
@pytest.mark.parametrize("bus", Bus)
def test_filters_are_what_is_meant_for_a_station_and_what_it_sends(station: Station, bus: Bus):
    expected = {
        (facts.message.frame_id, facts.message.is_extended_frame)
        for facts in NETWORK
        if facts.bus == bus and (station in facts.receivers or facts.sender == station)
    }
    assert filters(station, bus) == expected
    assert len(expected) < lib.CAN_LINK_FILTERS_MAX


def test_no_filters_for_a_bus_that_a_station_is_not_on():
    assert filters(Station.SPACE_DRIVE, Bus.CAN1) == set()
    assert filters(Station.OBC, Bus.CAN3) == set()


@pytest.mark.parametrize("facts", NETWORK, ids=lambda facts: facts.message.name)
@pytest.mark.parametrize("station", ECUS)
def test_a_frame_is_judged_by_its_sender_and_its_age(station: Station, facts: MessageFacts):
    fresh_us, now_us = 100_000, 5_000_000
    frame = ffi.new(
        "can_frame *",
        {"id": facts.message.frame_id, "bus": facts.bus, "flags": int(facts.message.is_extended_frame), "dlc": 8},
    )

    def judge(time_us: int) -> int:
        frame.time_us = time_us
        return int(lib.ecu_bus_judge(station, frame, now_us, fresh_us))

    ours = facts.sender == station
    assert judge(now_us) == (lib.ECU_BUS_SECOND_SENDER if ours else lib.ECU_BUS_TAKE)
    assert judge(now_us - fresh_us) == (lib.ECU_BUS_SECOND_SENDER if ours else lib.ECU_BUS_TAKE)
    assert judge(now_us - fresh_us - 1) == (lib.ECU_BUS_SECOND_SENDER if ours else lib.ECU_BUS_LATE)
    assert judge(now_us + 3_000) == (lib.ECU_BUS_SECOND_SENDER if ours else lib.ECU_BUS_TAKE)
    frame.flags = lib.CAN_FLAG_ERROR
    assert judge(now_us) == lib.ECU_BUS_TAKE, "the id of an error frame is none"
