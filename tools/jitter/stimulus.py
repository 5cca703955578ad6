"""What an ECU hears and feels, cycle by cycle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dbc.frames import Bus, Station


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
