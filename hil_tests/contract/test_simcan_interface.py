"""simcan as a python-can interface: what python-can's own back-to-back tests ask of two buses on one wire, and what
only a bus with time and errors can do. Time is simulated: nothing here sleeps."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from itertools import pairwise

import can
import pytest

from bridge.bus import CHANNELS
from bridge.simcan import Disturbance, SimCanBus, find_channel
from bridge.tap import Taps
from dbc.codec import database
from dbc.frames import Bus, frame_array

Pair = tuple[can.BusABC, can.BusABC]


def open_bus(**options: object) -> can.BusABC:
    return can.Bus(interface="simcan", **{"channel": "test", "clock": "simulated", "fd": True, **options})


@pytest.fixture
def pair() -> Iterator[Pair]:
    with open_bus(data_bitrate=2_000_000) as one, open_bus(data_bitrate=2_000_000) as other:
        yield one, other


def message(identifier: int = 0x123, data: bytes = b"", **details: object) -> can.Message:
    return can.Message(**{"arbitration_id": identifier, "is_extended_id": False, "data": data, **details})


# --- back to back ---

MESSAGES = {
    "standard": message(0x100, bytes([100, 200, 255])),
    "extended": message(0x1234_5678, bytes([10, 11, 12, 13, 14, 15]), is_extended_id=True),
    "remote": message(0x200, None, is_remote_frame=True, dlc=4),
    "extended remote": message(0x1234_5678, None, is_remote_frame=True, is_extended_id=True, dlc=0),
    "no data": message(0x300),
    "lowest": message(0),
    "highest": message(0x7FF, bytes([255] * 8)),
    "highest extended": message(0x1FFF_FFFF, bytes(8), is_extended_id=True),
    "FD": message(0x400, bytes(range(64)), is_fd=True),
    "FD with switch": message(0x400, bytes(range(48)), is_fd=True, bitrate_switch=True),
    "FD extended": message(0x1ABC_DEF0, bytes(range(12)), is_fd=True, bitrate_switch=True, is_extended_id=True),
    "FD from a passive node": message(0x401, b"12345", is_fd=True, error_state_indicator=True),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_message_arrives_as_it_was_sent(pair: Pair, name: str):
    sent = MESSAGES[name]
    for sender, receiver in (pair, pair[::-1]):
        sender.send(sent)
        received = receiver.recv(timeout=0.5)
        assert received is not None
        assert received.equals(sent, timestamp_delta=None, check_channel=False, check_direction=False)
        assert received.is_rx
        assert received.channel == "test"
        assert receiver.recv(timeout=0.01) is None
        assert sender.recv(timeout=0.01) is None


def test_nothing_comes_when_nothing_was_sent(pair: Pair):
    assert pair[0].recv(timeout=0.1) is None
    assert pair[1].recv(timeout=0) is None


def test_stamps_are_seconds_of_the_wire_between_sending_and_receiving(pair: Pair):
    one, other = pair
    one.send(message())
    first = other.recv(timeout=1)
    assert other.recv(timeout=1) is None
    one.send(message())
    second = other.recv(timeout=1)
    assert first is not None
    assert second is not None
    # Of 11 bits without data: 44 bits and stuffing, 2 us each; the wait began at the end of the first.
    assert second.timestamp - first.timestamp == pytest.approx(1 + 100e-6, abs=10e-6)
    assert 88e-6 <= first.timestamp <= 110e-6


def test_messages_are_the_receivers_own(pair: Pair):
    one, other = pair
    with open_bus(data_bitrate=2_000_000) as third:
        sent = message(data=b"abc")
        one.send(sent)
        sent.data[0] = 0
        received = [bus.recv(timeout=1) for bus in (other, third)]
        assert [bytes(found.data) for found in received if found is not None] == [b"abc", b"abc"]
        assert received[0] is not received[1]


def test_own_messages_are_heard_when_asked_for():
    with open_bus(receive_own_messages=True) as one, open_bus() as other:
        one.send(message(data=b"me"))
        own = one.recv(timeout=1)
        assert own is not None
        assert not own.is_rx
        assert other.recv(timeout=1) is not None


def test_filters_choose_messages_but_never_hide_errors(pair: Pair):
    one, other = pair
    other.set_filters([{"can_id": 0x100, "can_mask": 0x700, "extended": False}])
    for identifier in (0x200, 0x123, 0x7FF):
        one.send(message(identifier))
    found = other.recv(timeout=1)
    assert found is not None
    assert found.arbitration_id == 0x123
    assert other.recv(timeout=0.1) is None
    other.disturb(Disturbance())
    one.send(message(0x200))
    error = other.recv(timeout=0.1)
    assert error is not None
    assert error.is_error_frame


def test_periodic_messages_come_to_the_microsecond_in_turns_and_stop(pair: Pair):
    one, other = pair
    messages = [message(0x50, bytes([number])) for number in range(3)]
    task = one.send_periodic(messages, 0.01)
    received = [other.recv(timeout=1) for _ in range(30)]
    stamps = [found.timestamp for found in received if found is not None]
    assert [found.data[0] for found in received if found is not None] == [0, 1, 2] * 10
    assert stamps[-1] - stamps[0] == pytest.approx(0.29, abs=5e-6)
    task.modify_data([message(0x50, b"new")] * 3)
    changed = other.recv(timeout=1)
    assert changed is not None
    assert bytes(changed.data) == b"new"
    task.stop()
    assert other.recv(timeout=1) is None
    task.start()
    assert other.recv(timeout=1) is not None
    task.stop()
    one.send_periodic(messages, 0.01)
    assert other.recv(timeout=1) is not None
    one.stop_all_periodic_tasks()
    assert other.recv(timeout=1) is None


def test_periodic_messages_end_with_their_duration_and_are_modified_one_by_one(pair: Pair):
    one, other = pair

    def count(sent: can.Message) -> None:
        sent.data[0] += 1

    one.send_periodic(message(0x60, bytes(1)), 0.01, duration=0.1, modifier_callback=count)
    values = []
    while (found := other.recv(timeout=0.5)) is not None:
        values.append(found.data[0])
    assert values == list(range(1, 11))


def test_thread_safe_bus_and_notifier_by_the_wall_clock():
    """Two threads send 200 messages each, a notifier's thread hears them, as fast as 1 Mbit/s allows."""
    heard: list[can.Message] = []
    complete = threading.Event()

    def listen(found: can.Message) -> None:
        heard.append(found)
        if len(heard) == 400:
            complete.set()

    with (
        can.Bus(interface="simcan", channel="wall", bitrate=1_000_000) as one,
        can.Bus(interface="simcan", channel="wall", bitrate=1_000_000) as other,
    ):
        notifier = can.Notifier(other, [listen], timeout=0.1)
        began = time.time()
        threads = [
            threading.Thread(target=lambda base=base: [one.send(message(base + n)) for n in range(200)])
            for base in (0x100, 0x200)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert complete.wait(30)
        notifier.stop()
        assert time.time() - began > 0.018  # 400 frames of at least 47 us
        assert sorted(found.arbitration_id for found in heard) == [*range(0x100, 0x1C8), *range(0x200, 0x2C8)]
        assert all(began - 0.1 <= found.timestamp <= time.time() + 0.1 for found in heard)
        assert all(one.timestamp < next_one.timestamp for one, next_one in pairwise(heard))


@pytest.mark.usefixtures("pair")
def test_closed_bus_says_so_and_the_wire_is_gone():
    bus = open_bus(channel="short")
    assert {"interface": "simcan", "channel": "short"} in SimCanBus._detect_available_configs()
    bus.shutdown()
    bus.shutdown()
    with pytest.raises(can.CanOperationError, match="closed"):
        bus.send(message())
    with pytest.raises(can.CanOperationError, match="closed"):
        bus.recv(timeout=0)
    with pytest.raises(can.CanOperationError, match="no bus is on this channel; there are test"):
        find_channel("short")


# --- what only a bus with time and errors does ---


def test_lower_identifiers_go_first_but_not_past_the_head_of_a_fifo_queue():
    with open_bus(queue="priority") as one, open_bus(queue="fifo") as other, open_bus() as ear:
        for identifier in (0x300, 0x100):
            one.send(message(identifier, bytes(8)))
        for identifier in (0x400, 0x080):
            other.send(message(identifier, bytes(8)))
        order = []
        while (found := ear.recv(timeout=0.01)) is not None:
            order.append(found.arbitration_id)
        # The first queue sends by identifier; in the second 0x80 waits behind 0x400.
        assert order == [0x100, 0x300, 0x400, 0x080]


def test_load_and_delays_are_those_of_the_wire(pair: Pair):
    one, other = pair
    one.send_periodic(message(0x10, bytes(8)), 0.001)
    one.send_periodic(message(0x20, bytes(8)), 0.001)
    assert other.recv(timeout=0) is None
    for _ in range(200):
        assert other.recv(timeout=1) is not None
    first, second = one.delays()
    assert (first.identifier, second.identifier, first.frames, second.frames) == (0x10, 0x20, 100, 100)
    assert first.worst_us == 0
    assert 222 + 6 <= second.worst_us <= 270  # the other's frame and its intermission
    assert second.worst_response_us > second.worst_us + 222
    assert one.load() == pytest.approx(2 * (second.worst_us) / 1000, abs=0.02)


def test_errors_are_heard_counted_and_survived(pair: Pair):
    one, other = pair
    one.disturb(Disturbance(count=3, identifier=0x10))
    one.send(message(0x10, b"late"))
    found = [other.recv(timeout=1) for _ in range(4)]
    assert [event.is_error_frame for event in found if event is not None] == [True, True, True, False]
    assert [event.data[7] for event in found[:3] if event is not None] == [1, 2, 3]
    assert one.error_counters == (3 * 8 - 1, 0)
    assert other.error_counters == (0, 2)
    own = [one.recv(timeout=0) for _ in range(3)]
    assert [event.data[6] for event in own if event is not None] == [8, 16, 24]


@pytest.mark.parametrize("restart_ms", [0, 50])
def test_bus_off_stops_the_node_until_it_recovers(restart_ms: int):
    with open_bus(restart_ms=restart_ms) as one, open_bus() as other:
        one.disturb(Disturbance(count=32))
        one.send(message(0x10))
        while (found := one.recv(timeout=0.01)) is not None:
            last = found
        assert last.arbitration_id & 0x40  # CAN_ERR_BUSOFF
        assert one.state is can.BusState.ERROR
        with pytest.raises(can.CanOperationError, match="off the bus"):
            one.send(message(0x10))
        if not restart_ms:
            assert one.recv(timeout=10) is None
            one.restart()
        back = one.recv(timeout=0.1)
        assert back is not None
        assert back.arbitration_id & 0x100  # CAN_ERR_RESTARTED
        assert one.state is can.BusState.ACTIVE
        while other.recv(timeout=0) is not None:
            pass
        one.send(message(0x11))
        assert other.recv(timeout=0.1).arbitration_id == 0x11


def test_nobody_there_to_acknowledge():
    with open_bus() as alone:
        alone.send(message(0x10))
        error = alone.recv(timeout=0.01)
        assert error is not None
        assert error.is_error_frame
        assert error.arbitration_id & 0x20  # CAN_ERR_ACK
        assert alone.recv(timeout=0.1) is not None
        with open_bus() as other:
            while (found := other.recv(timeout=0.1)) is not None and found.is_error_frame:
                pass
            assert found is not None
            assert found.arbitration_id == 0x10


def test_listener_hears_and_does_not_send(pair: Pair):
    with open_bus(listen_only=True, data_bitrate=2_000_000) as ear:
        assert ear.state is can.BusState.PASSIVE
        pair[0].send(message(0x33))
        assert ear.recv(timeout=1).arbitration_id == 0x33
        with pytest.raises(can.CanOperationError, match="only listens"):
            ear.send(message())
        ear.state = can.BusState.ACTIVE
        ear.send(message(0x34))
        assert pair[1].recv(timeout=1).arbitration_id == 0x33
        assert pair[1].recv(timeout=1).arbitration_id == 0x34
        with pytest.raises(ValueError, match="ACTIVE and PASSIVE"):
            ear.state = can.BusState.ERROR


def test_full_queue_is_told_or_waited_for(pair: Pair):
    one, _ = pair
    for number in range(512):
        one.send(message(number))
    with pytest.raises(can.CanOperationError, match="transmit queue is full"):
        one.send(message(0x700))
    one.send(message(0x700), timeout=0.1)
    assert find_channel("test").model.statistics.lost == 0  # what is refused was never the bus's
    one.flush_tx_buffer()
    one.send(message(0x701))


def test_two_runs_with_random_errors_are_the_same():
    def run() -> list[tuple[float, int, bool]]:
        with open_bus() as one, open_bus() as other:
            one.wire.set_bit_error_rate(1e-3, seed=3)
            one.send_periodic(message(0x10, bytes(8)), 0.001, duration=0.2)
            found = []
            while (event := other.recv(timeout=0.05)) is not None:
                found.append((event.timestamp, event.arbitration_id, event.is_error_frame))
            return found

    first = run()
    assert first == run()
    assert sum(error for _, _, error in first) > 10
    assert sum(not error for _, _, error in first) == 200


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"bitrate": 250_000}, "runs at 500000 bit/s, data at 2000000 bit/s, by the simulated clock; 250000"),
        ({"data_bitrate": 2_000_000, "clock": "wall"}, "by the simulated clock"),
        ({"queue": "lifo"}, "queue 'lifo'; allowed are fifo, priority"),
        ({"clock": "sundial"}, "clock 'sundial'; allowed are wall, simulated"),
        ({"channel": "new", "bitrate": 700_001}, "700001 and 700001 bit/s; allowed are divisors of 1e9"),
        ({"channel": "new", "data_bitrate": 9_000_000}, "500000 and 9000000 bit/s; allowed are divisors of 1e9"),
    ],
)
@pytest.mark.usefixtures("pair")
def test_options_that_cannot_be_are_refused(options: dict[str, object], text: str):
    with pytest.raises(can.CanInitializationError, match=text):
        open_bus(**options)


@pytest.mark.usefixtures("pair")
def test_more_nodes_than_a_wire_has_are_refused():
    more = [open_bus(data_bitrate=2_000_000) for _ in range(30)]
    with pytest.raises(can.CanInitializationError, match="32 nodes"):
        open_bus(data_bitrate=2_000_000)
    for bus in more:
        bus.shutdown()


def test_fd_message_needs_an_fd_bus():
    with open_bus(fd=False) as classic, pytest.raises(can.CanOperationError, match="without fd=True"):
        classic.send(message(data=bytes(12), is_fd=True))
    assert open_bus_protocol(fd=True) is can.CanProtocol.CAN_FD
    assert open_bus_protocol(fd=False) is can.CanProtocol.CAN_20


def open_bus_protocol(fd: bool) -> can.CanProtocol:
    with open_bus(fd=fd) as bus:
        return bus.protocol


def test_bench_taps_its_buses_onto_a_simulated_wire():
    steering = database.message("steering_cmd")
    with open_bus(fd=False) as tap, open_bus(fd=False) as program:
        taps = Taps({CHANNELS[Bus.CAN1]: tap})
        taps.mirror(frame_array(steering.frame(-105.5, 5)))
        seen = program.recv(timeout=0.1)
        assert seen is not None
        assert steering.decode(bytes(seen.data)) == (-105.5, 5.0)
        program.send(message(steering.frame_id, steering.encode(10.0, 6)))
        assert tap.recv(timeout=0.1) is not None
        program.send(message(steering.frame_id, steering.encode(10.0, 6)))
        assert program.recv(timeout=0.001) is None
        assert len(taps.receive()) == 24
