"""Records what an ECU hears and feels in a lap, from the lock-step bench."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi
from bridge.bench import Bench
from bridge.scenario import Scenario, load_scenario
from bridge.surroundings import TICK_US
from dbc.frames import Station
from tools.jitter.stimulus import Ecu, Stimulus
from tools.run import DEFAULT_SCENARIO, build_bench

#: Stations in the order in which they speak within a tick (`Bench.tick`).
_ORDER = (Station.SENSORS, Station.OPERATOR, Station.AUTONOMY, Station.OBC, Station.RAPTOR, Station.SPACE_DRIVE)


def record_stimulus(ecu: Ecu, cycles: int, scenario: Scenario | None = None) -> Stimulus:
    """Run the bench in lock step from power-on and keep what one ECU hears.

    Parameters
    ----------
    ecu : whose inputs.
    cycles : how many; the bench goes on after the end of the scenario, with a car that stands.
    scenario : the shipped solo lap by default.

    Raises
    ------
    RaceloopError
        When a file of the scenario is wrong.
    """
    frames = []
    wired = bytearray()
    with build_bench(scenario or load_scenario(DEFAULT_SCENARIO)) as bench:
        for _ in range(cycles):
            if bench.network.log_half_full:
                frames.append(_heard(ecu, bench.network.drain_log()))
            bench.tick()
            if ecu.wired is not None:
                wired += ffi.buffer(_wired_struct(ecu, bench))
        frames.append(_heard(ecu, bench.network.drain_log()))
    everything = np.concatenate(frames)
    speaks_later = list(_ORDER[_ORDER.index(ecu.station) + 1 :])  # heard in the next tick
    delivered = everything["time_us"].astype(np.int64) // TICK_US + np.isin(everything["sender"], speaks_later)
    order = np.lexsort((everything["time_us"], delivered))
    bounds = np.searchsorted(delivered[order], np.arange(cycles + 1))
    return Stimulus(
        frames=everything[order][: bounds[-1]],
        bounds=bounds.astype(np.int64),
        wired=np.frombuffer(bytes(wired), dtype=np.uint8).reshape(cycles, -1),
    )


def _heard(ecu: Ecu, log: NDArray[np.void]) -> NDArray[np.void]:
    """Frames of others on the ECU's buses."""
    heard: NDArray[np.void] = log[np.isin(log["bus"], ecu.buses) & (log["sender"] != ecu.station)]
    return heard


def _wired_struct(ecu: Ecu, bench: Bench) -> Any:
    assert ecu.wired is not None
    return getattr(bench.wiring, ecu.wired)
