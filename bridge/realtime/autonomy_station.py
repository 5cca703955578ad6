"""Autonomy as a station on CAN-S, CAN-A and, in a car with the radar, CAN-R, with the LiDARs' points."""

from __future__ import annotations

from bridge.interfaces import EndableAutonomy
from bridge.realtime.cloud import CloudReceiver


class AutonomyStation:
    """Ticks autonomy once per slot; a slot that passed unused is not made up for.

    Parameters
    ----------
    autonomy : from outside, see `bridge.interfaces`.
    clouds : of the plant's station; None for a car without LiDARs.
    """

    over = False

    def __init__(self, autonomy: EndableAutonomy, clouds: CloudReceiver | None = None) -> None:
        self._autonomy = autonomy
        self._clouds = clouds

    def step(self, now_us: int, received: bytes) -> bytes:
        """One cycle, see `bridge.realtime.station.Station`."""
        cloud = None if self._clouds is None else self._clouds.newest(now_us)
        return self._autonomy.tick(now_us, received, cloud)

    def end(self) -> bytes:
        """The modules say that they are inactive, so that the SSM reads an orderly stop before the silence."""
        return self._autonomy.end()
