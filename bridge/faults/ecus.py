"""Faults of computers: reset, power loss, hang, slowness, a clock that drifts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bridge.faults.fault import BenchFault, Memory, parameter
from dbc.buses import Station
from dbc.codec import Codec
from dbc.errors import CodecError

if TYPE_CHECKING:
    from bridge.bench import Bench

#: Stations that run firmware, and so have a power-on state.
ECUS = (Station.OBC, Station.RAPTOR, Station.SPACE_DRIVE)

_MILLION = 1_000_000


@dataclass(frozen=True, kw_only=True)
class EcuFault(BenchFault):
    """Befalls one of the stations that run firmware."""

    station: Station

    def check(self, database: Codec) -> None:
        if self.station not in ECUS:
            raise CodecError(f"{self.kind}: station {self.station.name}; allowed are {', '.join(s.name for s in ECUS)}")


@dataclass(frozen=True, kw_only=True)
class Reset(EcuFault):
    """The ECU starts anew from its power-on state: once, without a pause."""

    kind = "reset"
    ends_by_itself = True

    def tick(self, bench: Bench, memory: Memory) -> int:
        bench.power_on(self.station)
        return 1

    def is_over(self, memory: Memory) -> bool:
        return True


@dataclass(frozen=True, kw_only=True)
class PowerLoss(EcuFault):
    """The ECU has no power; when it comes back, it starts anew. A Raptor's outputs fall off meanwhile."""

    kind = "power_loss"

    def begin(self, bench: Bench, memory: Memory) -> None:
        bench.silent.add(self.station)

    def tick(self, bench: Bench, memory: Memory) -> int:
        return 1

    def end(self, bench: Bench, memory: Memory) -> None:
        bench.silent.discard(self.station)
        bench.power_on(self.station)


@dataclass(frozen=True, kw_only=True)
class ClockDrift(EcuFault):
    """The ECU's clock runs fast or slow: it ticks more or less often, and takes each for 10 ms.

    What it has gained or lost stays when the fault is over. Counted are the ticks too many or too few.

    Attributes
    ----------
    ppm : parts per million, above 0 fast.
    """

    kind = "clock_drift"
    ppm: int = parameter(minimum=-900_000, maximum=1_000_000)

    def tick(self, bench: Bench, memory: Memory) -> int:
        clock = bench.clocks[self.station]
        clock.catch_up()
        gained = memory.kept.get("gained", 0) + self.ppm
        whole = int(gained / _MILLION)  # towards zero
        memory.kept["gained"] = gained - whole * _MILLION
        clock.ticks = 1 + whole
        return abs(whole)

    def end(self, bench: Bench, memory: Memory) -> None:
        bench.clocks[self.station].catch_up()


@dataclass(frozen=True, kw_only=True)
class Hang(BenchFault):
    """The station does not tick: it sends nothing, what it receives is lost, its outputs stay as they are."""

    kind = "hang"
    station: Station

    def begin(self, bench: Bench, memory: Memory) -> None:
        bench.stalled.add(self.station)

    def tick(self, bench: Bench, memory: Memory) -> int:
        bench.network.take(self.station)
        return 1

    def end(self, bench: Bench, memory: Memory) -> None:
        bench.network.take(self.station)
        bench.stalled.discard(self.station)


@dataclass(frozen=True, kw_only=True)
class Slow(BenchFault):
    """The station ticks only every so many ticks, and then sees all that has come meanwhile."""

    kind = "slow"
    station: Station
    every: int = parameter(minimum=2, maximum=100)

    def tick(self, bench: Bench, memory: Memory) -> int:
        runs = (memory.number + 1) % self.every == 0
        if runs:
            bench.stalled.discard(self.station)
        else:
            bench.stalled.add(self.station)
        return 0 if runs else 1

    def end(self, bench: Bench, memory: Memory) -> None:
        bench.stalled.discard(self.station)
