"""Autonomy as a station on CAN-S and CAN-A."""

from __future__ import annotations

from bridge.interfaces import EndableAutonomy


class AutonomyStation:
    """Ticks autonomy once per slot; a slot that passed unused is not made up for.

    Parameters
    ----------
    autonomy : from outside, see `bridge.interfaces`.
    """

    over = False

    def __init__(self, autonomy: EndableAutonomy) -> None:
        self._autonomy = autonomy

    def step(self, now_us: int, received: bytes) -> bytes:
        """One cycle, see `bridge.realtime.station.Station`."""
        return self._autonomy.tick(now_us, received)

    def end(self) -> bytes:
        """The modules say that they are inactive, so that the SSM reads an orderly stop before the silence."""
        return self._autonomy.end()
