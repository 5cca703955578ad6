"""What the frames of each identifier had to wait on a bus model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bridge._native import lib


@dataclass(frozen=True)
class MessageDelay:
    """What the frames of one identifier had to wait.

    Attributes
    ----------
    identifier, extended : address.
    frames : sent.
    mean_us, worst_us : from being ready to the start of the transmission that succeeded, us.
    worst_response_us : from being ready to the end of frame, us.
    """

    identifier: int
    extended: bool
    frames: int
    mean_us: float
    worst_us: float
    worst_response_us: float


def message_delays(model: Any) -> list[MessageDelay]:
    """All identifiers that a C struct `can_bus_model` has sent, in order."""
    rows = (model.messages[place] for place in range(lib.CAN_BUS_MESSAGES_MAX))
    found = [
        MessageDelay(
            row.id,
            bool(row.extended),
            row.frames,
            row.total_queueing_ns / row.frames / 1000,
            row.worst_queueing_ns / 1000,
            row.worst_response_ns / 1000,
        )
        for row in rows
        if row.frames
    ]
    return sorted(found, key=lambda delay: (delay.extended, delay.identifier))
