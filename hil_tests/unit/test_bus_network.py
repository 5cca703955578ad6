"""The network of buses: order, time stamps, who hears whom, load, and bounded queues that count what they lose."""

from __future__ import annotations

import random

import numpy as np
import pytest

from bridge._native import ffi, lib
from bridge.bus import BIT_RATES, Network
from dbc.frames import FRAME_STRUCT, Bus, Station, iterate

TICK_US = 10_000
SEED = 7
WIRE = ffi.new("can_wire *")
lib.can_wire_init(WIRE)


def frame(bus: Bus, identifier: int, data: bytes = bytes(8), flags: int = 0) -> bytes:
    return FRAME_STRUCT.pack(0, identifier, bus, len(data), flags, 0, data.ljust(8, b"\0"))


def wire_bits(raw: bytes) -> int:
    return lib.can_wire_bits(WIRE, ffi.from_buffer("can_frame *", raw), ffi.new("uint32_t *"))


def one_tick(network: Network, station: Station, frames: bytes, *buses: Bus, tick: int = 0) -> None:
    network.begin_tick(tick * TICK_US, (tick + 1) * TICK_US)
    network.submit(station, frames)
    network.transmit(*buses)
    network.end_tick()


def test_pending_frames_go_out_by_identifier_and_in_order_of_submission():
    network = Network()
    identifiers = [300, 5, 300, 77, 5, 1400]
    frames = b"".join(frame(Bus.CAN1, identifier, bytes([place])) for place, identifier in enumerate(identifiers))
    one_tick(network, Station.OBC, frames, Bus.CAN1)
    received = [(f.id, f.data[0]) for f in iterate(network.take(Station.RAPTOR))]
    assert received == [(5, 1), (5, 4), (77, 3), (300, 0), (300, 2), (1400, 5)]


@pytest.mark.parametrize("bus", list(Bus))
def test_stamps_are_ends_of_frames_at_the_bit_rate(bus: Bus):
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    frames = [
        frame(bus, identifier, generator.randbytes(8)) for identifier in sorted(generator.sample(range(2048), 20))
    ]
    network = Network()
    one_tick(network, Station.NONE, b"".join(frames), bus, tick=3)
    cursor_ns = 3 * TICK_US * 1000
    for raw, sent in zip(frames, iterate(network.log_view().tobytes()), strict=True):
        end_ns = cursor_ns + wire_bits(raw) * 10**9 // BIT_RATES[bus]
        assert sent.time_us == end_ns // 1000
        cursor_ns = end_ns + 3 * 10**9 // BIT_RATES[bus]


def test_second_call_in_a_tick_waits_for_the_bus():
    network = Network()
    network.begin_tick(0, TICK_US)
    for _ in range(2):
        network.submit(Station.OBC, frame(Bus.CAN1, 100))
        network.transmit(Bus.CAN1)
    first, second = iterate(network.take(Station.RAPTOR))
    assert second.time_us - first.time_us == (wire_bits(frame(Bus.CAN1, 100)) + 3) * 2


@pytest.mark.parametrize(
    ("bus", "members"),
    [
        (Bus.CAN1, {Station.OBC, Station.RAPTOR}),
        (Bus.CAN3, {Station.RAPTOR, Station.SPACE_DRIVE}),
        (Bus.CAN_A, {Station.AUTONOMY, Station.OPERATOR, Station.OBC}),
        (Bus.CAN_S, {Station.SENSORS, Station.AUTONOMY, Station.OBC}),
        (Bus.CAN_R, {Station.SENSORS, Station.AUTONOMY}),
    ],
)
def test_every_station_on_the_bus_but_the_sender_receives(bus: Bus, members: set[Station]):
    for sender in (Station.NONE, *members):
        network = Network()
        one_tick(network, sender, frame(bus, 42), bus)
        hearing = {station for station in Station if network.take(station)}
        assert hearing == members - {sender}
        assert network.logged() == 1
        assert network.log_view()["sender"][0] == sender


def test_what_does_not_fit_waits_behind_what_is_on_the_wire():
    network = Network()
    count = 60  # about 120 bits of 2 us each: some 40 fit into 10 ms
    one_tick(network, Station.OBC, b"".join(frame(Bus.CAN1, 1000 + i) for i in range(count)), Bus.CAN1)
    first = [f.id for f in iterate(network.take(Station.RAPTOR))]
    assert 30 < len(first) < count
    assert network.statistics()[Bus.CAN1].deferred == count - len(first)
    one_tick(network, Station.OBC, frame(Bus.CAN1, 1), Bus.CAN1, tick=1)
    second = list(iterate(network.take(Station.RAPTOR)))
    on_the_wire = 1000 + len(first)
    assert [f.id for f in second] == [on_the_wire, 1, *range(on_the_wire + 1, 1000 + count)]
    assert all(TICK_US <= f.time_us < 2 * TICK_US for f in second)
    assert network.losses() == 0


def test_stamps_lie_in_their_tick_and_rise_under_random_load():
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    network = Network()
    last = dict.fromkeys(Bus, 0)
    sent = received = 0
    for tick in range(300):
        network.begin_tick(tick * TICK_US, (tick + 1) * TICK_US)
        for _ in range(3):
            frames = [
                frame(generator.choice(list(Bus)), generator.randrange(2048)) for _ in range(generator.randrange(60))
            ]
            network.submit(Station.NONE, b"".join(frames))
            sent += len(frames)
            network.transmit(*Bus)
        network.end_tick()
        for station in Station:
            network.take(station)
        ordered = network.drain_log()
        received += len(ordered)
        assert np.all(np.diff(ordered["time_us"].astype(np.int64)) >= 0)
        assert np.all(ordered["time_us"] // TICK_US == tick)
        for bus in Bus:
            times = ordered["time_us"][ordered["bus"] == bus]
            if len(times):
                assert times[0] > last[bus]
                assert np.all(np.diff(times.astype(np.int64)) > 0)
                last[bus] = int(times[-1])
    assert network.losses() == 0
    assert 0 <= sent - received < 4 * lib.CAN_BUS_PENDING_MAX


def test_load_is_busy_time_over_time():
    network = Network()
    raw = frame(Bus.CAN1, 0x555, b"\x55" * 8)
    for tick in range(100):
        one_tick(network, Station.OBC, raw * (10 if tick == 50 else 5), Bus.CAN1, tick=tick)
        network.take(Station.RAPTOR)
    statistics = network.statistics()[Bus.CAN1]
    bits = wire_bits(raw) + 3
    assert statistics.frames == 505
    assert statistics.bits == 505 * bits
    assert statistics.load == pytest.approx(505 * bits * 2 / (100 * TICK_US))
    assert statistics.load_peak == pytest.approx(10 * bits * 2 / TICK_US)
    assert network.statistics()[Bus.CAN3].frames == 0


def test_full_queue_refuses_and_counts():
    network = Network()
    network.begin_tick(0, TICK_US)
    network.submit(Station.OBC, frame(Bus.CAN1, 1) * (lib.CAN_BUS_PENDING_MAX + 5))
    assert network.statistics()[Bus.CAN1].lost == 5
    assert network.losses() == 5


def test_full_inbox_and_full_log_count():
    network = Network()
    for tick in range(lib.NETWORK_LOG_MAX // 30 + 2):
        one_tick(network, Station.OBC, frame(Bus.CAN1, 1) * 30, Bus.CAN1, tick=tick)
    sent = network.statistics()[Bus.CAN1].frames
    assert network.logged() == lib.NETWORK_LOG_MAX
    assert network.handle.log_lost == sent - lib.NETWORK_LOG_MAX
    assert network.handle.inboxes[Station.RAPTOR].lost == sent - lib.NETWORK_INBOX_MAX
    assert network.losses() == 2 * sent - lib.NETWORK_LOG_MAX - lib.NETWORK_INBOX_MAX


def test_frame_for_no_bus_is_counted():
    network = Network()
    network.begin_tick(0, TICK_US)
    network.submit(Station.OBC, FRAME_STRUCT.pack(0, 1, 9, 8, 0, 0, bytes(8)))
    assert network.losses() == 1


def test_half_a_frame_is_refused():
    network = Network()
    with pytest.raises(ValueError, match="not whole frames"):
        network.submit(Station.OBC, bytes(25))


def test_watch_keeps_the_newest_data_frame_of_its_identifier():
    network = Network()
    watch = network.watch(Bus.CAN1, 1304)
    one_tick(network, Station.RAPTOR, frame(Bus.CAN1, 1304, b"old") + frame(Bus.CAN3, 1304, b"no"), Bus.CAN1, Bus.CAN3)
    one_tick(network, Station.RAPTOR, frame(Bus.CAN1, 1304, b"new") + frame(Bus.CAN1, 1305, b"no"), Bus.CAN1, tick=1)
    remote = frame(Bus.CAN1, 1304, b"", flags=lib.CAN_FLAG_REMOTE)
    one_tick(network, Station.RAPTOR, remote, Bus.CAN1, tick=2)
    assert watch.updates == 2
    assert bytes(watch.frame.data)[:3] == b"new"
    for identifier in range(15):
        network.watch(Bus.CAN1, identifier)
    with pytest.raises(ValueError, match="16"):
        network.watch(Bus.CAN1, 15)


def test_impossible_bit_rate_delivers_nothing():
    for rate in (0, 999, 700_001, 2_000_000):
        network = Network(dict.fromkeys(Bus, rate))
        one_tick(network, Station.OBC, frame(Bus.CAN1, 1), Bus.CAN1)
        assert network.take(Station.RAPTOR) == b""
        assert network.statistics()[Bus.CAN1].deferred == 1


def test_two_stations_with_one_identifier_go_off_the_bus_and_come_back():
    network = Network()
    for station in (Station.OBC, Station.RAPTOR):
        network.submit(station, frame(Bus.CAN1, 42, bytes([station])))
    for tick in range(30):
        one_tick(network, Station.SPACE_DRIVE, b"", Bus.CAN1, tick=tick)
        if tick == 1:
            one_tick(network, Station.OBC, frame(Bus.CAN1, 42), Bus.CAN1, tick=tick)
    nodes = network.handle.buses[Bus.CAN1].nodes
    assert [nodes[station].state for station in (Station.OBC, Station.RAPTOR)] == [lib.CAN_BUS_ERROR_ACTIVE] * 2
    heard = list(iterate(network.take(Station.RAPTOR)))
    assert all(f.flags == lib.CAN_FLAG_ERROR for f in heard)
    back = [f for f in heard if f.id & lib.CAN_BUS_ERROR_RESTARTED]
    assert len(back) == 1  # that of the other one; its own is its own
    off = [f for f in heard if f.id & lib.CAN_BUS_ERROR_OFF]
    assert back[0].time_us == pytest.approx(off[0].time_us + 100_000 + 128 * 11 * 2, abs=10)
    assert network.statistics()[Bus.CAN1].lost == 1  # submitted while it was off


def test_diverted_frames_wait_for_whoever_changes_them_and_keep_their_sender():
    network = Network()
    seen = []

    def alter(frames: bytes) -> bytes:
        seen.append(frames)
        return frames[24:] + frames[:24]

    network.divert(alter)
    frames = frame(Bus.CAN1, 7) + frame(Bus.CAN_A, 8) + frame(Bus.CAN1, 7, b"2")
    one_tick(network, Station.OBC, frames, Bus.CAN_A, Bus.CAN1)
    network.divert(None)
    one_tick(network, Station.RAPTOR, frame(Bus.CAN1, 9), Bus.CAN1, tick=1)
    assert len(seen) == 1
    assert [f.sender for f in iterate(seen[0])] == [Station.OBC] * 3
    received = [(f.id, f.sender, f.data[:1]) for f in iterate(network.take(Station.RAPTOR))]
    assert received == [(7, Station.OBC, b"2"), (7, Station.OBC, b"\0")]
    assert [(f.id, f.sender) for f in iterate(network.take(Station.OBC))] == [(9, Station.RAPTOR)]
    assert network.losses() == 0


def test_diverted_frames_that_find_no_room_are_counted():
    network = Network()
    network.divert(lambda _frames: b"")
    one_tick(network, Station.OBC, frame(Bus.CAN1, 7) * (lib.NETWORK_DIVERTED_MAX + 3), Bus.CAN1)
    assert network.losses() == 3
    assert network.logged() == 0


def test_what_is_left_of_planned_errors_is_forgotten():
    network = Network()
    model = ffi.addressof(network.handle.buses, Bus.CAN1)
    nobody = lib.CAN_BUS_NOBODY
    for identifier, sender, count in ((7, Station.OBC, 5), (8, Station.OBC, 1), (7, Station.RAPTOR, 2)):
        planned = {"id": identifier, "mask": 0x7FF, "count": count, "bit": 40, "sender": sender, "receiver": nobody}
        assert lib.can_bus_disturb(model, ffi.new("can_bus_disturbance *", planned))
    one_tick(network, Station.OBC, frame(Bus.CAN1, 9), Bus.CAN1)
    assert lib.can_bus_calm(model, 7, Station.OBC) == 5
    assert lib.can_bus_calm(model, 7, Station.OBC) == 0
    assert [(model.disturbances[place].id, model.disturbances[place].sender) for place in range(2)] == [
        (8, Station.OBC),
        (7, Station.RAPTOR),
    ]
    assert model.disturbance_count == 2
    network.take(Station.RAPTOR)
    one_tick(network, Station.OBC, frame(Bus.CAN1, 7), Bus.CAN1, tick=1)
    assert [f.id for f in iterate(network.take(Station.RAPTOR))] == [7]
