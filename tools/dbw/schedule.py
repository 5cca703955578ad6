"""`raceloop dbw schedule`: whether cyclic messages are through before their next ones, in the worst case."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from bridge.bus import BIT_RATES
from bridge.response_time import PeriodicMessage, load, longest_ns, response_times_ns
from dbc.buses import Bus
from dbc.codec import Codec, MessageCodec
from dbc.errors import CodecError
from tools.dbw.bus_option import bus_of
from tools.exit_status import ExitStatus

_MS = 1_000_000
_RATES = (1000, 1_000_000)


@dataclass(frozen=True)
class ScheduledMessage:
    """A message with the longest time that its slowest frame needs.

    Attributes
    ----------
    codec : the message.
    frames : in one cycle.
    cycle_ns, longest_ns, response_ns : cycle; longest time on the wire; longest time from being ready to the end of the
        intermission, None when there is no bound.
    """

    codec: MessageCodec
    frames: int
    cycle_ns: int
    longest_ns: int
    response_ns: int | None

    @property
    def fits(self) -> bool:
        """Whether it is through before the next one is ready."""
        return self.response_ns is not None and self.response_ns <= self.cycle_ns


def messages_of(database: Codec, bus: Bus) -> list[MessageCodec]:
    """Those on one bus."""
    return [codec for codec in database if codec.bus is bus]


def analyse(database: Codec, bus: Bus, bit_rate: int, all_at_ns: int | None) -> tuple[float, list[ScheduledMessage]]:
    """Load of the bus, and every message in order of importance; those without a cycle are left out.

    Parameters
    ----------
    database, bus : the messages, and which of them.
    bit_rate : bit/s, a divisor of 1e9.
    all_at_ns : cycle of all of them, those without one included; None: as the DBC file says.
    """
    bit_ns = 10**9 // bit_rate
    # 29-bit identifiers lose against 11-bit ones of the same first bits, as in arbitration.
    ordered = sorted(
        messages_of(database, bus),
        key=lambda codec: (codec.frame_id if codec.extended else codec.frame_id << 18, codec.extended),
    )
    chosen: list[tuple[MessageCodec, int]] = []
    for codec in ordered:
        cycle_ns = codec.cycle_us * 1000 if all_at_ns is None else all_at_ns
        if cycle_ns:
            chosen.append((codec, cycle_ns))
    periodic: list[PeriodicMessage] = []
    owners: list[int] = []
    for place, (codec, cycle_ns) in enumerate(chosen):
        for _ in range(database.facts(codec.name).frames_per_cycle):
            owners.append(place)
            periodic.append(PeriodicMessage(len(periodic), longest_ns(codec.length, codec.extended, bit_ns), cycle_ns))
    responses = response_times_ns(periodic, bit_ns)
    rows = []
    for place, (codec, cycle_ns) in enumerate(chosen):
        mine = [number for number, owner in enumerate(owners) if owner == place]
        slowest = responses[mine[-1]]  # each of them may be the last of its cycle; it is the least important
        rows.append(ScheduledMessage(codec, len(mine), cycle_ns, periodic[mine[0]].length_ns, slowest))
    return load(periodic), rows


def schedule(database: Codec, bus: str, bit_rate: int | None, all_at_ms: float | None, console: Console) -> int:
    """Print the messages and the verdict; returns the exit status, a miss when something does not fit.

    Raises
    ------
    CodecError
        When there is no such bus, or a bus cannot have the bit rate.
    """
    chosen = bus_of(bus)
    rate = BIT_RATES[chosen] if bit_rate is None else bit_rate
    if not _RATES[0] <= rate <= _RATES[1] or 10**9 % rate:
        raise CodecError(f"--bit-rate {rate}; allowed are divisors of 1000000000 from {_RATES[0]} to {_RATES[1]}")
    part, rows = analyse(database, chosen, rate, None if all_at_ms is None else round(all_at_ms * _MS))
    console.print(f"{'message':<28}   id  bytes  cycle ms  longest ms  worst case ms", markup=False)
    for row in rows:
        codec = row.codec
        times = f" x {row.frames}" if row.frames > 1 else ""
        worst = "no bound" if row.response_ns is None else f"{row.response_ns / _MS:.2f}"
        console.print(
            f"{codec.name + times:<28}  {codec.frame_id:03X}  {codec.length:>5}  {row.cycle_ns / _MS:>8g}"
            f"  {row.longest_ns / _MS:>10.3f}  {worst:>13}{'' if row.fits else '  late'}",
            markup=False,
        )
    late = sum(not row.fits for row in rows)
    verdict = "all are through before their next ones" if not late else f"{late} of {len(rows)} do not fit"
    events = len(messages_of(database, chosen)) - len(rows)
    beside = f"; {events} that {'is' if events == 1 else 'are'} sent on events not counted" if events else ""
    console.print(
        f"{bus} at {rate} bit/s: load {part:.1%} with all frames at their longest; {verdict}{beside}", markup=False
    )
    return ExitStatus.MISSED if late else ExitStatus.DONE
