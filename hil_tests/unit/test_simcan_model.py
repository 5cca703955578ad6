"""simcan's bus model: arbitration, errors, fault confinement and CAN FD against plain references."""

from __future__ import annotations

import random
import re

import pytest
from simcan_wire import NEVER_NS, Wire

from bridge._native import ffi, lib

SEED = 29
DISTURBED = {"id": 0, "mask": 0, "bit": 30, "sender": lib.CAN_BUS_NOBODY, "receiver": lib.CAN_BUS_NOBODY}
ERROR_BITS = 6 + 6 + 8  # flag, echo, delimiter
INTERMISSION = 3


def disturb(wire: Wire, count: int, **details: int) -> bool:
    planned = ffi.new("can_bus_disturbance *", {**DISTURBED, "count": count, **details})
    return bool(lib.can_bus_disturb(wire.model, planned))


def errors_of(wire: Wire, node: int) -> tuple[int, int]:
    return wire.node(node).transmit_errors, wire.node(node).receive_errors


# --- arbitration and time ---


def reference_schedule(queues: list[list[tuple[int, int, int]]], bit_ns: int, fifo: bool) -> list[tuple[int, int]]:
    """Identifier and end of each frame, of `(release, identifier, bits)` per node, by looking at all of them again
    and again."""
    left = [list(queue) for queue in queues]
    now, sent = 0, []
    while any(left):
        ready = []
        for queue in left:
            released = [entry for entry in queue if entry[0] <= now]
            if released:
                head = released[0] if fifo else min(released, key=lambda entry: (entry[1], queue.index(entry)))
                ready.append((head[1], head, queue))
        if not ready:
            now = min(queue[0][0] if fifo else min(queue)[0] for queue in left if queue)
            continue
        identifier, head, queue = min(ready, key=lambda entry: entry[0])
        sent.append((identifier, (now + head[2] * bit_ns) // 1000))
        now += (head[2] + INTERMISSION) * bit_ns
        queue.remove(head)
    return sent


@pytest.mark.parametrize("fifo", [False, True])
def test_arbitration_as_a_plain_search_finds_it(fifo: bool):
    print(f"seed {SEED}; again: pytest {__file__}")
    generator = random.Random(SEED)
    for _ in range(60):
        wire = Wire()
        queues: list[list[tuple[int, int, int]]] = []
        submissions = []
        for index in range(generator.randrange(2, 6)):
            node = wire.join(lib.CAN_BUS_FIFO if fifo else 0)
            releases = sorted(generator.randrange(6_000_000) for _ in range(generator.randrange(1, 25)))
            queue = []
            for release in releases:
                identifier = generator.randrange(40) * 8 + index  # no two nodes share one
                frame = wire.frame(identifier, generator.randbytes(generator.randrange(9)))
                queue.append((release, identifier, wire.bits(frame)))
                submissions.append((release, node, frame))
            queues.append(queue)
        for release, node, frame in sorted(submissions, key=lambda entry: entry[0]):
            assert wire.submit(node, frame, release)
        wire.run(NEVER_NS)
        assert [(event.frame.id, event.frame.time_us) for event in wire.events] == reference_schedule(
            queues, wire.bit_ns, fifo
        )


def test_run_in_steps_is_run_at_once():
    generator = random.Random(SEED)
    results = []
    for step_ns in (1_000, 77_777, NEVER_NS):
        generator.seed(SEED)
        wire = Wire()
        nodes = [wire.join() for _ in range(3)]
        lib.can_bus_set_bit_error_rate(wire.model, 1e-3, 5)
        for _ in range(60):
            frame = wire.frame(generator.randrange(2048), generator.randbytes(8))
            wire.submit(generator.choice(nodes), frame, generator.randrange(10_000_000))
        until = 0
        while lib.can_bus_next_ns(wire.model) != NEVER_NS:
            until = min(until + step_ns, NEVER_NS)
            wire.run(until)
        results.append([bytes(ffi.buffer(event)) for event in wire.events])
    assert results[0] == results[1] == results[2]
    assert len(results[0]) > 60  # some were destroyed and sent again


def test_what_is_on_the_wire_cannot_be_overtaken():
    wire = Wire()
    one, other = wire.join(), wire.join()
    low = wire.frame(0x700, bytes(8))
    wire.submit(one, low)
    assert wire.run(1_000) == []
    wire.submit(one, wire.frame(0x001), 1_000)
    wire.submit(other, wire.frame(0x000), 1_000)
    assert [event.frame.id for event in wire.run(NEVER_NS)] == [0x700, 0x000, 0x001]


def test_next_event_is_when_it_happens():
    wire = Wire()
    node, _ = wire.join(), wire.join()
    assert lib.can_bus_next_ns(wire.model) == NEVER_NS
    frame = wire.frame(5, b"abc")
    wire.submit(node, frame, 40_000)
    assert lib.can_bus_next_ns(wire.model) == 40_000
    assert wire.run(40_001) == []
    end_ns = 40_000 + wire.bits(frame) * wire.bit_ns
    assert lib.can_bus_next_ns(wire.model) == end_ns
    assert wire.run(end_ns) == []
    assert len(wire.run(end_ns + 1)) == 1


def test_same_frame_of_two_nodes_is_one_frame_on_the_wire():
    wire = Wire()
    nodes = [wire.join() for _ in range(3)]
    for node in nodes[:2]:
        wire.submit(node, wire.frame(9, b"same"))
    assert len(wire.run(NEVER_NS)) == 1
    assert wire.model.statistics.frames == 1
    assert [wire.node(node).pending_count for node in nodes] == [0, 0, 0]


def test_different_frames_of_one_identifier_destroy_each_other_until_both_are_off_the_bus():
    wire = Wire()
    nodes = [wire.join() for _ in range(3)]
    for node, data in zip(nodes, (b"one", b"two"), strict=False):
        wire.submit(node, wire.frame(9, data))
    wire.run(NEVER_NS)
    assert [event.frame.flags for event in wire.events] == [lib.CAN_FLAG_ERROR] * 32
    assert [wire.node(node).state for node in nodes] == [lib.CAN_BUS_OFF, lib.CAN_BUS_OFF, lib.CAN_BUS_ERROR_ACTIVE]
    assert errors_of(wire, nodes[2]) == (0, 32)


# --- fault confinement ---


def test_destroyed_frame_costs_its_bits_and_an_error_frame_and_is_sent_again():
    wire = Wire()
    sender, receiver = wire.join(), wire.join()
    frame = wire.frame(0x123, bytes(range(8)))
    assert disturb(wire, 1, bit=30)
    wire.submit(sender, frame)
    error, sent = wire.run(NEVER_NS)
    first_ns = (31 + ERROR_BITS) * wire.bit_ns
    assert error.frame.flags == lib.CAN_FLAG_ERROR
    assert error.frame.time_us == first_ns // 1000
    assert error.frame.id & lib.CAN_BUS_ERROR_PROTOCOL
    assert (error.frame.data[6], error.frame.data[7]) == (8, 0)
    assert sent.frame.id == 0x123
    assert sent.frame.time_us == (first_ns + (INTERMISSION + wire.bits(frame)) * wire.bit_ns) // 1000
    assert errors_of(wire, sender) == (7, 0)
    assert errors_of(wire, receiver) == (0, 0)
    counts = wire.model.statistics
    assert (counts.frames, counts.errors) == (1, 1)
    assert counts.bits == 31 + ERROR_BITS + INTERMISSION + wire.bits(frame) + INTERMISSION


def test_only_what_was_planned_is_disturbed():
    wire = Wire()
    sender, _ = wire.join(), wire.join()
    assert disturb(wire, 1, id=0x20, mask=0xFFFF_FFFF)
    for identifier in (0x10, 0x20, 0x30):
        wire.submit(sender, wire.frame(identifier))
    kinds = [(event.frame.flags, event.frame.id & 0x7FF) for event in wire.run(NEVER_NS)]
    assert [kind for kind in kinds if kind[0] == 0] == [(0, 0x10), (0, 0x20), (0, 0x30)]
    assert [kind[0] for kind in kinds] == [0, lib.CAN_FLAG_ERROR, 0, 0]


def test_counters_states_and_bus_off_come_at_the_standards_limits():
    """8 for each destroyed frame: error-passive from 128, off the bus from 256."""
    wire = Wire()
    sender, receiver = wire.join(), wire.join()
    assert disturb(wire, 1000)
    wire.submit(sender, wire.frame(1))
    states, warned = [], []
    for count in range(1, 33):
        (event,) = wire.run(lib.can_bus_next_ns(wire.model) + 1) or wire.run(lib.can_bus_next_ns(wire.model) + 1)
        states.append(wire.node(sender).state)
        warned.append(event.frame.data[1])
        assert errors_of(wire, sender)[0] == 8 * count
        assert errors_of(wire, receiver)[1] == count
    active, passive, off = lib.CAN_BUS_ERROR_ACTIVE, lib.CAN_BUS_ERROR_PASSIVE, lib.CAN_BUS_OFF
    assert states == [active] * 15 + [passive] * 16 + [off]
    assert warned == [0] * 11 + [lib.CAN_BUS_WARNING_SEND] * 4 + [lib.CAN_BUS_PASSIVE_SEND] * 17
    assert wire.events[-1].frame.id & lib.CAN_BUS_ERROR_OFF
    assert not wire.submit(sender, wire.frame(1))
    assert lib.can_bus_next_ns(wire.model) == NEVER_NS
    assert wire.node(sender).cancelled == 1


def test_error_passive_sender_waits_eight_more_bits():
    wire = Wire()
    sender, _ = wire.join(), wire.join()
    frame = wire.frame(2)
    assert disturb(wire, 17)
    for _ in range(2):
        wire.submit(sender, frame)
    *_, first, second = wire.run(NEVER_NS)
    gap_bits = (second.frame.time_us - first.frame.time_us) * 1000 // wire.bit_ns - wire.bits(frame)
    assert gap_bits == INTERMISSION + 8
    assert errors_of(wire, sender)[0] == 17 * 8 - 2


def test_frames_that_go_through_bring_a_passive_node_back():
    wire = Wire()
    sender, receiver = wire.join(), wire.join()
    passive, active = lib.CAN_BUS_ERROR_PASSIVE, lib.CAN_BUS_ERROR_ACTIVE
    assert disturb(wire, 20, receiver=receiver)
    wire.submit(sender, wire.frame(2))
    wire.run(NEVER_NS)
    # 9 for each error that it saw alone; the first good frame sets a receiver's counter to 127.
    assert errors_of(wire, receiver) == (0, 127)
    assert (wire.node(sender).state, wire.node(receiver).state) == (passive, active)
    for count in range(1, 40):
        wire.submit(sender, wire.frame(2))
        wire.run(NEVER_NS)
        assert errors_of(wire, sender) == (20 * 8 - 1 - count, 0)
        assert errors_of(wire, receiver) == (0, 127 - count)
        assert wire.node(sender).state == (passive if 20 * 8 - 1 - count > 127 else active)


def test_receiver_that_is_alone_with_its_error_counts_nine():
    wire = Wire()
    sender, broken, fine = wire.join(), wire.join(), wire.join()
    frame = wire.frame(0x55, b"abc")
    assert disturb(wire, 1, receiver=broken)
    wire.submit(sender, frame)
    error, _ = wire.run(NEVER_NS)
    assert error.frame.time_us == (wire.bits(frame) - 7 + ERROR_BITS) * wire.bit_ns // 1000
    assert errors_of(wire, sender) == (7, 0)
    assert errors_of(wire, broken) == (0, 8)  # 9, and one good frame
    assert errors_of(wire, fine) == (0, 0)


def test_nobody_acknowledges_who_is_alone_and_it_never_goes_off_the_bus():
    wire = Wire()
    sender = wire.join()
    frame = wire.frame(0x321, b"abc")
    wire.submit(sender, frame)
    events = wire.run(100_000_000)
    assert all(event.frame.id & lib.CAN_BUS_ERROR_NO_ACK for event in events)
    assert errors_of(wire, sender) == (128, 0)
    assert wire.node(sender).state == lib.CAN_BUS_ERROR_PASSIVE
    # Up to the acknowledge slot, flag, delimiter, intermission, and suspended transmission.
    period_us = (wire.bits(frame) - 7 - 1 + 6 + 8 + INTERMISSION + 8) * wire.bit_ns // 1000
    assert events[-1].frame.time_us - events[-2].frame.time_us == period_us
    wire.join()
    after = wire.run(102_000_000)
    assert [event.frame.id for event in after if event.frame.flags == 0] == [0x321]
    assert wire.run(NEVER_NS) == []


def test_listener_neither_acknowledges_nor_sends():
    wire = Wire()
    sender, listener = wire.join(), wire.join(lib.CAN_BUS_LISTEN_ONLY)
    assert not wire.submit(listener, wire.frame(1))
    wire.submit(sender, wire.frame(1))
    assert all(event.frame.flags == lib.CAN_FLAG_ERROR for event in wire.run(10_000_000))


def test_recovery_takes_128_times_11_recessive_bits():
    wire = Wire()
    sender, _ = wire.join(), wire.join()
    assert disturb(wire, 32)
    wire.submit(sender, wire.frame(1))
    wire.run(NEVER_NS)
    assert wire.node(sender).state == lib.CAN_BUS_OFF
    restart_ns = wire.model.free_ns + 5_000_000
    lib.can_bus_restart(wire.model, sender, restart_ns)
    back_ns = restart_ns + 128 * 11 * wire.bit_ns
    assert lib.can_bus_next_ns(wire.model) == back_ns
    assert wire.run(back_ns) == []
    (event,) = wire.run(back_ns + 1)
    assert event.frame.id & lib.CAN_BUS_ERROR_RESTARTED
    assert wire.node(sender).state == lib.CAN_BUS_ERROR_ACTIVE
    assert errors_of(wire, sender) == (0, 0)
    wire.submit(sender, wire.frame(1), back_ns)
    assert [event.frame.id for event in wire.run(NEVER_NS)] == [1]


def test_each_frame_of_others_counts_as_one_sequence_of_recessive_bits():
    wire = Wire()
    sender, other, _ = (wire.join() for _ in range(3))
    wire.node(sender).restart_ns = 1
    assert disturb(wire, 32)
    wire.submit(sender, wire.frame(1))
    wire.run(wire.model.free_ns + 1)
    while wire.node(sender).state != lib.CAN_BUS_OFF:
        wire.run(lib.can_bus_next_ns(wire.model) + 1)
    for _ in range(300):
        assert wire.submit(other, wire.frame(0x10, b"x"))
    events = []
    while wire.node(sender).state == lib.CAN_BUS_OFF:
        events += wire.run(lib.can_bus_next_ns(wire.model) + 1)
    # One by one back to back: the pause of 1 ns misses the first sequence.
    assert sum(event.frame.flags == 0 for event in events) == 128


def test_random_errors_come_at_their_rate_and_again_with_the_same_seed():
    rate, count = 2e-4, 500
    runs = []
    for seed in (1, 1, 2):
        wire = Wire()
        sender, _ = wire.join(), wire.join()
        lib.can_bus_set_bit_error_rate(wire.model, rate, seed)
        for number in range(count):
            wire.submit(sender, wire.frame(number % 2048, bytes(8)), number * 1_000_000)
        runs.append([bytes(ffi.buffer(event)) for event in wire.run(NEVER_NS)])
        counts = wire.model.statistics
        assert counts.frames == count
        expected = rate * (counts.bits - counts.errors * 23)
        assert abs(counts.errors - expected) < 4 * expected**0.5
    assert runs[0] == runs[1] != runs[2]


def test_too_many_planned_errors_are_refused():
    wire = Wire()
    assert all(disturb(wire, 1) for _ in range(lib.CAN_BUS_DISTURBANCES_MAX))
    assert not disturb(wire, 1)


# --- nodes ---


def test_full_queue_refuses_and_counts():
    wire = Wire()
    node, _ = wire.join(), wire.join()
    assert all(wire.submit(node, wire.frame(1)) for _ in range(lib.CAN_BUS_PENDING_MAX))
    assert not wire.submit(node, wire.frame(1))
    assert wire.model.statistics.lost == 1
    assert len(wire.run(NEVER_NS)) == lib.CAN_BUS_PENDING_MAX
    assert wire.submit(node, wire.frame(1))


def test_who_leaves_takes_its_queue_along_but_not_what_is_on_the_wire():
    wire = Wire()
    leaver, stays = wire.join(), wire.join()
    wire.join()
    for identifier in (1, 2, 3):
        wire.submit(leaver, wire.frame(identifier))
    wire.run(2_000)
    lib.can_bus_leave(wire.model, leaver)
    assert not lib.can_bus_join(wire.model, leaver, 0)  # not before the wire is free
    wire.submit(stays, wire.frame(9), 3_000)
    assert [event.frame.id for event in wire.run(NEVER_NS)] == [1, 9]
    assert wire.model.free_count == lib.CAN_BUS_PENDING_MAX
    assert lib.can_bus_join(wire.model, leaver, 0)
    assert not lib.can_bus_join(wire.model, lib.CAN_BUS_NODES_MAX, 0)


def test_disturbed_leaver_leaves_nothing_behind():
    wire = Wire()
    leaver, _ = wire.join(), wire.join()
    assert disturb(wire, 1)
    wire.submit(leaver, wire.frame(1))
    wire.run(2_000)
    lib.can_bus_leave(wire.model, leaver)
    assert [event.frame.flags for event in wire.run(NEVER_NS)] == [lib.CAN_FLAG_ERROR]
    assert wire.model.free_count == lib.CAN_BUS_PENDING_MAX


def test_more_identifiers_than_rows_are_sent_but_not_followed():
    wire = Wire()
    node, _ = wire.join(), wire.join()
    for identifier in range(lib.CAN_BUS_MESSAGES_MAX + 40):
        wire.submit(node, wire.frame(identifier), identifier * 1_000_000)
    assert len(wire.run(NEVER_NS)) == lib.CAN_BUS_MESSAGES_MAX + 40
    assert sum(row.frames for row in wire.model.messages) == lib.CAN_BUS_MESSAGES_MAX


def test_no_call_with_any_bytes_does_harm():
    print(f"seed {SEED}; again: pytest {__file__}")
    generator = random.Random(SEED)
    wire = Wire(500_000, 2_000_000)
    for _ in range(lib.CAN_BUS_NODES_MAX):
        wire.join(generator.randrange(8))
    now = 0
    for _ in range(4000):
        frame = ffi.new("can_bus_frame *")
        ffi.memmove(frame, generator.randbytes(ffi.sizeof("can_bus_frame")), ffi.sizeof("can_bus_frame"))
        choice = generator.randrange(40)
        if choice == 0:
            lib.can_bus_leave(wire.model, generator.randrange(36))
        elif choice == 1:
            lib.can_bus_join(wire.model, generator.randrange(36), generator.randrange(8))
        elif choice == 2:
            lib.can_bus_restart(wire.model, generator.randrange(36), now)
        elif choice == 3:
            disturb(wire, 3, receiver=generator.randrange(36), bit=generator.randrange(65536))
        elif choice == 4:
            lib.can_bus_flush(wire.model, generator.randrange(36))
        else:
            wire.submit(generator.randrange(36), frame, now)
        now += generator.randrange(400_000)
        wire.run(now)
        pending = sum(node.pending_count for node in wire.model.nodes)
        assert pending + wire.model.free_count == lib.CAN_BUS_PENDING_MAX
    assert wire.model.statistics.frames > 100


# --- CAN FD ---

FD_SIZES = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


def fd_reference(identifier: int, data: bytes, extended: bool, switched: bool, passive: bool) -> tuple[int, int, int]:
    """Nominal, fast and stuff bits by writing the frame down as text (ISO 11898-1:2015, 10.4.2 and 10.5)."""
    if extended:
        head = f"0{identifier >> 18:011b}11{identifier & 0x3FFFF:018b}010{switched:d}"
    else:
        head = f"0{identifier:011b}0010{switched:d}"
    code = FD_SIZES.index(len(data))
    stream = head + f"{passive:d}{code:04b}" + "".join(f"{byte:08b}" for byte in data)
    stuffed, position = stream, 0
    inserted_at = []
    while match := re.compile("00000|11111").search(stuffed, position):
        if match.end() == len(stuffed):
            break  # a fixed stuff bit follows
        bit = "1" if match.group()[0] == "0" else "0"
        inserted_at.append(match.end() - len(inserted_at))
        stuffed = stuffed[: match.end()] + bit + stuffed[match.end() :]
        position = match.end()
    in_head = sum(place < len(head) for place in inserted_at)
    crc = 4 + (17 if len(data) <= 16 else 21)
    fixed = len(range(0, crc, 4))
    fast = len(stream) - len(head) + len(inserted_at) - in_head + crc + fixed + 1
    return len(head) + in_head + 9, fast, len(inserted_at) + fixed


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("switched", [False, True])
def test_fd_frames_have_the_length_of_the_written_down_frame(extended: bool, switched: bool):
    print(f"seed {SEED}; again: pytest {__file__}")
    generator = random.Random(SEED)
    wire = Wire(500_000, 2_000_000)
    for size in FD_SIZES:
        for fill in (None, 0x00, 0xFF, 0x1F, 0xF0, None, None):
            data = generator.randbytes(size) if fill is None else bytes([fill] * size)
            identifier = generator.choice((0, generator.getrandbits(29 if extended else 11)))
            passive = generator.random() < 0.5
            flags = (
                lib.CAN_WIRE_FLAG_FD
                | lib.CAN_FLAG_EXTENDED * extended
                | lib.CAN_WIRE_FLAG_BRS * switched
                | lib.CAN_WIRE_FLAG_ESI * passive
            )
            frame = wire.frame(identifier, data, flags)
            length = lib.can_wire_fd_bits(ffi.addressof(wire.model, "wire"), ffi.addressof(frame, "frame"), frame.more)
            found = (length.head + length.tail, length.fast, length.stuff)
            assert found == fd_reference(identifier, data, extended, switched, passive), (size, fill, identifier)


def test_fd_frame_with_switch_is_as_fast_as_its_two_rates():
    data = bytes(range(64))
    ends = []
    for flags in (lib.CAN_WIRE_FLAG_FD, lib.CAN_WIRE_FLAG_FD | lib.CAN_WIRE_FLAG_BRS):
        wire = Wire(500_000, 5_000_000)
        sender, _ = wire.join(), wire.join()
        wire.submit(sender, wire.frame(0x123, data, flags))
        (event,) = wire.run(NEVER_NS)
        assert bytes(event.frame.data) + bytes(event.more) == data
        slow, fast, _ = fd_reference(0x123, data, False, bool(flags & lib.CAN_WIRE_FLAG_BRS), False)
        rate_ns = 200 if flags & lib.CAN_WIRE_FLAG_BRS else 2000
        assert event.frame.time_us == (slow * 2000 + fast * rate_ns) // 1000
        ends.append(event.frame.time_us)
    assert ends[0] > 6 * ends[1]


def test_classic_node_destroys_fd_frames():
    wire = Wire(500_000, 2_000_000)
    sender, classic = wire.join(), wire.join(lib.CAN_BUS_CLASSIC)
    wire.submit(sender, wire.frame(0x123, bytes(12), lib.CAN_WIRE_FLAG_FD))
    (error,) = wire.run(80_000)
    assert error.frame.time_us == (15 + ERROR_BITS) * 2
    assert errors_of(wire, classic) == (0, 1)
    lib.can_bus_leave(wire.model, classic)
    wire.join()
    assert [event.frame.flags for event in wire.run(NEVER_NS)][-1] == lib.CAN_WIRE_FLAG_FD


@pytest.mark.parametrize(("rate", "data_rate"), [(0, 0), (999, 999), (700_001, 500_000), (2_000_000, 2_000_000)])
def test_impossible_bit_rate_delivers_nothing(rate: int, data_rate: int):
    wire = Wire(rate, data_rate)
    node, _ = wire.join(), wire.join()
    wire.submit(node, wire.frame(1))
    assert wire.run(NEVER_NS) == []
    assert lib.can_bus_next_ns(wire.model) == NEVER_NS
