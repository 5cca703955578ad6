"""What a bench did from a point on: all frames on its buses, and the car's motion and brakes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bridge.bench import Bench
from bridge.safety.track import TrackEdges
from dbc.codec import profile
from dbc.frames import FRAME_DTYPE

_OUTPUTS = ("distance", "brake_pressure_front", "x", "y")


class Trace:
    """Follows a bench tick by tick.

    Parameters
    ----------
    bench : between two ticks.

    Attributes
    ----------
    begin_us : where it begins.
    """

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.begin_us = bench.now_us
        self._places = [bench.plant.output_names.index(name) for name in _OUTPUTS]
        self._frames: list[NDArray[np.uint64]] = []
        self._rows: list[list[float]] = [self._row()]
        self._columns: dict[str, dict[str, tuple[NDArray[np.uint64], NDArray[np.float64]]]] | None = None

    def run_to(self, goal: Callable[[], bool], until_us: int) -> bool:
        """Tick until a goal is reached, or a time has come; returns whether the goal was."""
        while not goal():
            if self.bench.now_us >= until_us:
                return False
            self._tick()
        return True

    def run_until(self, until_us: int) -> None:
        """Tick up to a time."""
        self.run_to(lambda: False, until_us)

    def signal(self, message: str, signal: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Times on the bus in microseconds, and physical values; empty when none was sent."""
        if self._columns is None:
            frames = np.concatenate([np.empty(0, np.uint64), *self._frames]).view(FRAME_DTYPE)
            order = np.argsort(frames["time_us"], kind="stable")
            self._columns = profile(self.bench.scenario.profile).decode_columns(frames[order])
        times, values = self._columns.get(message, {}).get(signal, (np.empty(0, np.uint64), np.empty(0)))
        return times.astype(np.int64), values

    def truth(self, name: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Times of ticks, and an output of the plant at them."""
        rows = np.array(self._rows)
        return rows[:, 0].astype(np.int64), rows[:, 1 + _OUTPUTS.index(name)]

    def beyond_edge(self, edges: TrackEdges) -> float:
        """How far the centre of gravity was beyond an edge of the track at most, m; 0 when it never was."""
        _, x = self.truth("x")
        _, y = self.truth("y")
        return max(0.0, float(edges.beyond(x, y).max()))

    def _tick(self) -> None:
        network = self.bench.network
        first = 0 if network.log_half_full else network.logged()
        self.bench.tick()
        self._frames.append(network.log_view(first).view(np.uint64).copy())
        self._rows.append(self._row())
        self._columns = None

    def _row(self) -> list[float]:
        outputs = self.bench.plant.outputs
        return [float(self.bench.now_us), *(float(outputs[place]) for place in self._places)]
