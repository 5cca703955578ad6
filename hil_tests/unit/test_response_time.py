"""Worst-case response times: the published example, and the bus model, which no message may make wait longer."""

from __future__ import annotations

import random

import pytest
from simcan_wire import Wire, frame_of_bits

from bridge.response_time import PeriodicMessage, load, longest_ns, response_times_ns

SEED = 2007
MS = 1_000_000
BIT_NS = 8_000  # 125 kbit/s

#: Table 3 of Davis et al.: three messages of 125 bits, that is 1 ms; periods 2.5, 3.5 and 3.5 ms.
PUBLISHED = [PeriodicMessage(rank, MS, period) for rank, period in ((1, 2_500_000), (2, 3_500_000), (3, 3_500_000))]


def test_longest_frames_are_those_of_the_paper():
    assert longest_ns(8, False, 1) == 135
    assert longest_ns(8, True, 1) == 160
    assert [longest_ns(count, False, 1) for count in range(9)] == [55 + 10 * count for count in range(9)]
    assert [longest_ns(count, True, 1) for count in range(9)] == [80 + 10 * count for count in range(9)]


def test_published_example_has_the_published_response_times():
    """The earlier analysis gave 3 ms for the last message, whose deadline is 3.25 ms; it is 3.5 ms."""
    assert response_times_ns(PUBLISHED, BIT_NS) == [2 * MS, 3 * MS, 3_500_000]


def test_published_example_on_the_bus_reaches_its_bound():
    wire = Wire(125_000)
    nodes = [wire.join() for _ in PUBLISHED]
    frames = [frame_of_bits(message.rank, 125, wire) for message in PUBLISHED]
    releases = sorted(
        (at, place) for place, message in enumerate(PUBLISHED) for at in range(0, 70 * MS, message.period_ns)
    )
    for at, place in releases:
        wire.submit(nodes[place], frames[place], at)
    wire.run(80 * MS)
    intermission_ns = 3 * BIT_NS
    worst = [wire.worst_response_ns(message.rank) + intermission_ns for message in PUBLISHED]
    assert worst[2] == 3_500_000
    assert worst[1] <= 3 * MS
    assert worst[0] <= 2 * MS


def test_blocked_by_the_longest_frame_that_has_just_begun():
    wire = Wire(125_000)
    low, high = wire.join(), wire.join()
    wire.submit(low, frame_of_bits(3, 125, wire), 0)
    wire.submit(high, frame_of_bits(1, 125, wire), 1)
    wire.run(10 * MS)
    assert wire.worst_response_ns(1) + 3 * BIT_NS == 2 * MS - 1


def test_no_message_of_random_sets_waits_longer_than_its_bound():
    print(f"seed {SEED}; again: pytest {__file__}")
    generator = random.Random(SEED)
    judged = near = 0
    for trial in range(40):
        count = generator.randrange(3, 12)
        lengths = [generator.randrange(9) for _ in range(count)]
        # Two frames of the same kind may differ in stuff bits; the bound takes the longest.
        messages = [
            PeriodicMessage(rank, longest_ns(length, False, 2000), generator.choice((2, 5, 10, 20)) * MS)
            for rank, length in enumerate(lengths, start=1)
        ]
        bounds = response_times_ns(messages, 2000)
        wire = Wire(500_000)
        nodes = [wire.join() for _ in messages]
        releases = []
        for place, message in enumerate(messages):
            # Every second set is queued all at once, which is nearly the worst that can happen.
            first = generator.randrange(message.period_ns) if trial % 2 else 0
            releases += [(at, place) for at in range(first, 100 * MS, message.period_ns)]
        for at, place in sorted(releases):
            wire.run(at)
            wire.submit(nodes[place], wire.frame(messages[place].rank, generator.randbytes(lengths[place])), at)
        wire.run(200 * MS)
        for message, bound in zip(messages, bounds, strict=True):
            if bound is not None:
                worst = wire.worst_response_ns(message.rank)
                assert worst <= bound, message
                judged += 1
                near += worst > 0.5 * bound
    assert judged > 200
    assert near > judged / 3  # the bound is no number that is never neared


def test_full_bus_has_no_bound_for_what_does_not_fit():
    messages = [PeriodicMessage(rank, MS, 2 * MS) for rank in range(3)]
    assert load(messages) == pytest.approx(1.5)
    assert response_times_ns(messages, BIT_NS)[2] is None
    assert response_times_ns(messages, BIT_NS)[0] == 2 * MS


def test_lateness_counts_for_itself_and_for_those_below():
    late = [PeriodicMessage(1, MS, 10 * MS, 3 * MS), PeriodicMessage(2, MS, 10 * MS)]
    assert response_times_ns(late, BIT_NS) == [5 * MS, 2 * MS]
