"""The option `--bus` of the commands below `raceloop dbw`."""

from __future__ import annotations

from dbc.buses import Bus
from dbc.errors import CodecError


def bus_of(label: str) -> Bus:
    """The bus of a label.

    Raises
    ------
    CodecError
        When there is none; says which there are.
    """
    labels = {bus.label: bus for bus in Bus}
    if label not in labels:
        raise CodecError(f"--bus {label}: no such bus; allowed are {', '.join(labels)}")
    return labels[label]
