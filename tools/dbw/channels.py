"""What loggers and interfaces call the car's buses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from bridge.bus import CHANNELS
from dbc.errors import ConfigurationError
from dbc.frames import Bus

#: Their names, or interfaces and channels numbered in their order.
NAMES: Mapping[str, Bus] = MappingProxyType(
    {
        **{name: bus for bus, name in CHANNELS.items()},
        **{bus.label: bus for bus in Bus},
        **{f"vcan{int(bus)}": bus for bus in Bus},
        **{f"can{int(bus)}": bus for bus in Bus},
        **{str(int(bus)): bus for bus in Bus},
    }
)

BusOf = Callable[[object], Bus]
"""Gives the bus of a channel, as a reader calls it."""


def bus_of(channel: object, chosen: Bus | None, source: str | Path) -> Bus:
    """The bus behind a channel.

    Parameters
    ----------
    channel : as a log or an interface calls it.
    chosen : what the user says it is, whatever it is called; None for nothing.
    source : to be named when it is none.

    Raises
    ------
    ConfigurationError
        When no bus of the car is called so.
    """
    bus = NAMES.get(str(channel)) if chosen is None else chosen
    if bus is None:
        last = max(Bus)
        allowed = f"{', '.join(CHANNELS.values())}, vcan0 to vcan{last}, 0 to {last}; or say --bus"
        raise ConfigurationError(source, f"channel {channel}", f"unknown; allowed are {allowed}")
    return bus
