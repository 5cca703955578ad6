"""How a measurement is set up: which ECU, how fast, how long, where."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bridge.surroundings import TICK_US
from tools.jitter.cyclictest import CyclicTest
from tools.jitter.stimulus import Ecu
from tools.realtime_run import PHASES_US, RealTimeOptions

_SECOND_NS = 1_000_000_000

_SPARE_NS = 5 * _SECOND_NS


@dataclass(frozen=True)
class Setup:
    """Settings of a measurement.

    Attributes
    ----------
    ecu : what is measured.
    rate_hz : cycles per second, 10 to 1000. At others than 100 the firmware's time runs faster or slower.
    seconds : how long each part of the measurement takes.
    options : buses, core and priority.
    """

    ecu: Ecu
    rate_hz: float = 100.0
    seconds: float = 30.0
    options: RealTimeOptions = field(default_factory=RealTimeOptions)

    @property
    def period_ns(self) -> int:
        """Of the cycle; whole microseconds, as stations take it."""
        return round(1e6 / self.rate_hz) * 1000

    @property
    def cycles(self) -> int:
        """How many there are."""
        return max(1, round(self.seconds * _SECOND_NS / self.period_ns))

    @property
    def phase_us(self) -> int:
        """When the ECU's cycle begins within the period: where it does in the whole loop. The stimulus begins at 0."""
        return PHASES_US[self.ecu.name] * self.period_ns // 1000 // TICK_US

    @property
    def recorded_cycles(self) -> int:
        """Cycles that a stimulus or a log needs: for some seconds more, until all have been stopped."""
        return self.cycles + _SPARE_NS // self.period_ns

    def cyclictest(self, epoch_ns: int, result: Path) -> CyclicTest:
        """A cyclictest on the ECU's core, with its priority and its period, but never at the same time."""
        deadline_ns = epoch_ns + self.phase_us * 1000 + self.period_ns // 2
        placement = self.options.placement
        return CyclicTest(self.period_ns, deadline_ns, placement.priority, placement.cpu, result)
