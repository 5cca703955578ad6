"""Taps: a python-can interface on the bench's buses sees all traffic and can take part in it."""

from __future__ import annotations

import can
import pytest

from autonomy.partition import AutonomyPartition
from autonomy.track_files import load_track
from autonomy.vehicle import VehicleLimits, load_vehicle
from bridge.bench import Bench
from bridge.scenario import load_scenario
from bridge.tap import RECEIVE_MAX, Taps
from dbc.codec import database
from dbc.errors import ConfigurationError
from dbc.frames import Bus, Station, iterate
from tools.run import DEFAULT_SCENARIO, build_bench


@pytest.fixture
def wire():
    """Our end and the user's end of a virtual CAN interface."""
    inside, outside = (can.Bus(interface="virtual", channel="tap test") for _ in range(2))
    yield inside, outside
    inside.shutdown()
    outside.shutdown()


def tapped(name: str, bus: can.BusABC) -> Bench:
    scenario = load_scenario(DEFAULT_SCENARIO)
    vehicle = VehicleLimits.from_parameters(scenario.vehicle, load_vehicle(scenario.vehicle))
    return Bench.from_scenario(
        scenario, load_track, lambda _, road: AutonomyPartition(road, vehicle), None, {name: bus}
    )


def received(bus: can.BusABC) -> list[can.Message]:
    messages = []
    while (message := bus.recv(timeout=0.0)) is not None:
        messages.append(message)
    return messages


def test_a_tap_sees_every_frame_of_its_bus_and_no_other(wire):
    inside, outside = wire
    with tapped("CAN3", inside) as bench:
        for _ in range(50):
            bench.tick()
        expected = [frame for frame in iterate(bench.network.log_view().tobytes()) if frame.bus == Bus.CAN3]
    messages = received(outside)
    assert len(messages) == len(expected) > 500
    for message, frame in zip(messages, expected, strict=True):
        assert message.arbitration_id == frame.id
        assert bytes(message.data) == frame.data[: frame.dlc]


def test_a_run_with_a_listening_tap_is_the_same_run(wire):
    inside, _ = wire
    logs = []
    for bench in (tapped("CAN1", inside), build_bench(load_scenario(DEFAULT_SCENARIO))):
        with bench:
            for _ in range(50):
                bench.tick()
            logs.append(bench.network.drain_log().tobytes())
    assert logs[0] == logs[1]


def test_frames_from_outside_reach_the_stations_at_the_next_tick_and_are_not_mirrored(wire):
    inside, outside = wire
    summary = database.message("base_to_car_summary")
    with tapped("CAN1", inside) as bench:
        for _ in range(20):
            bench.tick()
        received(outside)
        before_us = bench.now_us
        outside.send(can.Message(arbitration_id=0x7A5, is_extended_id=False, data=b"hello"))
        bench.tick()
        injected = [frame for frame in iterate(bench.network.log_view().tobytes()) if frame.id == 0x7A5]
        assert len(injected) == 1
        assert injected[0].sender == Station.NONE
        assert before_us <= injected[0].time_us < bench.now_us
        assert 0x7A5 not in [message.arbitration_id for message in received(outside)]
        bench.tick()
        rejected = bench.obc.rejected_frames
        outside.send(can.Message(arbitration_id=summary.frame_id, is_extended_id=False, data=b"\x11"))
        for _ in range(2):
            bench.tick()
        assert bench.obc.rejected_frames == rejected + 1  # shorter than its DBC says: counted, dropped


def test_a_flood_from_outside_is_taken_in_portions(wire):
    inside, outside = wire
    taps = Taps({"CAN1": inside})
    for number in range(RECEIVE_MAX + 10):
        outside.send(can.Message(arbitration_id=number, is_extended_id=False, data=b""))
    assert [frame.id for frame in iterate(taps.receive())] == list(range(RECEIVE_MAX))
    assert len(list(iterate(taps.receive()))) == 10
    assert taps.receive() == b""


def test_kinds_of_frames_survive_and_can_fd_stays_outside(wire):
    inside, outside = wire
    taps = Taps({"CANS": inside})
    outside.send(can.Message(arbitration_id=0x1ABCDEF, is_extended_id=True, data=bytes(range(8))))
    outside.send(can.Message(arbitration_id=5, is_extended_id=False, is_remote_frame=True, dlc=3))
    extended, remote = iterate(taps.receive())
    assert (extended.id, extended.flags, extended.dlc, extended.data) == (0x1ABCDEF, 1, 8, bytes(range(8)))
    assert (remote.id, remote.flags, remote.dlc, remote.bus) == (5, 2, 3, Bus.CAN_S)


def test_unknown_bus_is_refused(wire):
    with pytest.raises(ConfigurationError, match="CAN2: unknown bus; allowed are CAN1, CAN3, CANA, CANS, CANR"):
        Taps({"CAN2": wire[0]})
