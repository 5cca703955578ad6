"""What an ECU hears and feels in a lap: recorded from the lock-step bench, cycle by cycle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi
from bridge.bench import Bench
from bridge.scenario import Scenario, load_scenario
from bridge.surroundings import TICK_US
from dbc.frames import Bus, Station
from tools.run import DEFAULT_SCENARIO, build_bench


@dataclass(frozen=True)
class Ecu:
    """An ECU that can run alone.

    Attributes
    ----------
    name : as on the command line; its executable is ``raceloop-`` and this.
    station : its number.
    buses : that it sits on.
    command : message whose frames on the bus are measured; sent in every cycle.
    inputs : buses with what its command follows from, and what that is.
    wired : attribute of `bridge.wiring.Wiring` with its wired inputs, or None.
    """

    name: str
    station: Station
    buses: tuple[Bus, ...]
    command: str
    inputs: Mapping[Bus, str]
    wired: str | None


#: The ECUs by name.
ECUS = {
    ecu.name: ecu
    for ecu in (
        Ecu(
            "obc",
            Station.OBC,
            (Bus.CAN1, Bus.CAN_A, Bus.CAN_S),
            "brake_pressure_cmd",
            {Bus.CAN_S: "from CAN-S (sensors)", Bus.CAN_A: "from CAN-A (estimate)"},
            None,
        ),
        Ecu(
            "raptor",
            Station.RAPTOR,
            (Bus.CAN1, Bus.CAN3),
            "req_brake_pos",
            {Bus.CAN1: "from CAN1 (commands)"},
            "raptor_in",
        ),
        Ecu(
            "space-drive",
            Station.SPACE_DRIVE,
            (Bus.CAN3,),
            "calb_brake_pos_1",
            {Bus.CAN3: "from CAN3 (requests)"},
            "space_drive_in",
        ),
    )
}

#: Stations in the order in which they speak within a tick (`Bench.tick`).
_ORDER = (Station.SENSORS, Station.OPERATOR, Station.AUTONOMY, Station.OBC, Station.RAPTOR, Station.SPACE_DRIVE)


@dataclass(frozen=True)
class Stimulus:
    """Inputs of an ECU from power-on.

    Attributes
    ----------
    frames : what others send on its buses, array of `FRAME_DTYPE` in order of arrival.
    bounds : the frames of cycle k are ``frames[bounds[k]:bounds[k + 1]]``; one more than there are cycles.
    wired : one row of bytes per cycle, the C struct of its wired inputs; no columns for an ECU without any.
    """

    frames: NDArray[np.void]
    bounds: NDArray[np.int64]
    wired: NDArray[np.uint8]

    @property
    def cycles(self) -> int:
        """Cycles that it lasts."""
        return len(self.bounds) - 1

    def save(self, path: Path) -> None:
        """Write it to a file."""
        with path.open("wb") as file:
            np.savez(file, frames=self.frames, bounds=self.bounds, wired=self.wired)

    @classmethod
    def load(cls, path: Path) -> Stimulus:
        """Read it from a file that `save` wrote."""
        with np.load(path) as arrays:
            return cls(arrays["frames"], arrays["bounds"], arrays["wired"])


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
