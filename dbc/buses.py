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
    CAN_R = 4

    @property
    def label(self) -> str:
        """Name for people: CAN1, CAN3, CAN-A, CAN-S, CAN-R."""
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


def car_buses(radar: bool = False) -> tuple[Bus, ...]:
    """Buses of a car; CAN-R is there when it has the radar."""
    return tuple(bus for bus in Bus if radar or bus is not Bus.CAN_R)


_BESIDE_CAN1: Mapping[str, Bus] = {
    "space_drive": Bus.CAN3,
    "autonomy": Bus.CAN_A,
    "sensors": Bus.CAN_S,
    "radar_esr": Bus.CAN_R,
}

#: DBC files by profile, then by stem, in the order of their buses. A profile is a public layout of CAN1: V14 is that of
#: the AV-21, V26 that of the AV-24. The other buses are the same in all. ``enum codec_profile_index`` has this order.
PROFILES: Mapping[str, Mapping[str, Bus]] = MappingProxyType(
    {
        "V14": MappingProxyType({"raptor": Bus.CAN1, **_BESIDE_CAN1}),
        "V26": MappingProxyType({"raptor_v26": Bus.CAN1, **_BESIDE_CAN1}),
    }
)

#: Profile of the car that the firmware was written for: what is meant where none is named.
DEFAULT_PROFILE = "V14"

#: DBC files of that profile.
DATABASES: Mapping[str, Bus] = PROFILES[DEFAULT_PROFILE]

#: All DBC files by stem.
STEMS: tuple[str, ...] = tuple(dict.fromkeys(stem for databases in PROFILES.values() for stem in databases))
