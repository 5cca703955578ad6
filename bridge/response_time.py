"""Worst-case response times of periodic messages on a CAN bus: the bound beside which a measured delay is judged.

R. I. Davis, A. Burns, R. J. Bril, J. J. Lukkien: Controller Area Network (CAN) schedulability analysis: refuted,
revisited and revised. Real-Time Systems 35 (2007), equations 1, 2 and 5 to 9. It holds for nodes that send by
identifier, on a bus without errors.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

#: Stuffed bits of a frame beside its data: 11-bit and 29-bit identifiers.
_STUFFED_BITS = {False: 34, True: 54}

#: Bits that are never stuffed, with the intermission.
_PLAIN_BITS = 13


@dataclass(frozen=True)
class PeriodicMessage:
    """A message that is queued again and again.

    Attributes
    ----------
    rank : the lower, the more important; as `(extended, identifier)` sorts when all identifiers are of one kind.
    length_ns : longest time on the wire, with stuff bits and intermission.
    period_ns : shortest time between two of them.
    jitter_ns : by which one may be queued late.
    """

    rank: int
    length_ns: int
    period_ns: int
    jitter_ns: int = 0


def longest_ns(data_bytes: int, extended: bool, bit_ns: int) -> int:
    """Longest time of a classic frame on the wire, stuff bits and intermission included (equation 1, either kind)."""
    stuffed = _STUFFED_BITS[extended] + 8 * data_bytes
    return (stuffed + _PLAIN_BITS + (stuffed - 1) // 4) * bit_ns


def load(messages: Iterable[PeriodicMessage]) -> float:
    """Part of the time in which the bus is busy when all frames are of the longest form."""
    return sum(message.length_ns / message.period_ns for message in messages)


def response_times_ns(messages: Iterable[PeriodicMessage], bit_ns: int) -> list[int | None]:
    """Longest time from the moment at which a message should have been queued to the end of its intermission, ns.

    Parameters
    ----------
    messages : all on the bus, of different rank.
    bit_ns : time of a bit.

    Returns
    -------
    list
        In the order of the messages; None where there is no bound, because those that are as important or more fill
        the bus.
    """
    every = list(messages)
    return [_response_ns(message, every, bit_ns) for message in every]


def _response_ns(message: PeriodicMessage, every: list[PeriodicMessage], bit_ns: int) -> int | None:
    higher = [other for other in every if other.rank < message.rank]
    if load([*higher, message]) >= 1.0:
        return None
    blocking_ns = max((other.length_ns for other in every if other.rank > message.rank), default=0)

    def interference_ns(window_ns: int, others: list[PeriodicMessage]) -> int:
        return sum(-(-(window_ns + other.jitter_ns) // other.period_ns) * other.length_ns for other in others)

    busy_ns, before_ns = message.length_ns, 0
    while busy_ns != before_ns:
        busy_ns, before_ns = blocking_ns + interference_ns(busy_ns, [*higher, message]), busy_ns
    worst_ns, queueing_ns = 0, blocking_ns
    for instance in range(-(-(busy_ns + message.jitter_ns) // message.period_ns)):
        own_ns, before_ns = instance * message.length_ns, -1
        while queueing_ns != before_ns:
            before_ns = queueing_ns
            queueing_ns = blocking_ns + own_ns + interference_ns(queueing_ns + bit_ns, higher)
        response_ns = message.jitter_ns + queueing_ns - instance * message.period_ns + message.length_ns
        worst_ns = max(worst_ns, response_ns)
        queueing_ns += message.length_ns
    return worst_ns
