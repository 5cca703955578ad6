"""Numbers of buses and stations, and the DBC file of each bus."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from pathlib import Path
from types import MappingProxyType

#: Folder of the DBC files.
DIRECTORY = Path(__file__).parent


class Bus(IntEnum):
    """Buses of the bench; ``enum can_bus`` in firmware/common/can_frame.h."""

    CAN1 = 0
    CAN3 = 1
    CAN_A = 2
    CAN_S = 3

    @property
    def label(self) -> str:
        """Name for people and channel name in logs: CAN1, CAN3, CAN-A, CAN-S."""
        return self.name.replace("_", "-")


class Station(IntEnum):
    """Stations that send; ``enum can_station`` in firmware/common/can_frame.h."""

    NONE = 0
    SENSORS = 1
    AUTONOMY = 2
    OBC = 3
    RAPTOR = 4
    SPACE_DRIVE = 5
    OPERATOR = 6


#: DBC files by stem, in the order of their buses.
DATABASES: Mapping[str, Bus] = MappingProxyType(
    {"raptor": Bus.CAN1, "space_drive": Bus.CAN3, "autonomy": Bus.CAN_A, "sensors": Bus.CAN_S}
)
