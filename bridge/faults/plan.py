"""When a fault is there: its onset, how long it lasts, how often it comes back."""

from __future__ import annotations

from dataclasses import dataclass, field

from bridge.condition import Condition
from bridge.faults.fault import Fault, FrameFault
from dbc.codec import Codec
from dbc.errors import CodecError
from dbc.states import SsmState


@dataclass(frozen=True)
class Onset:
    """All that is given must hold at once; nothing given holds from power-on.

    Attributes
    ----------
    condition : as of the scenario's steps.
    ssm_state : the System Status Manager is in this state.
    station_m : the car is at least this far along the lap.
    message, frames : at least so many frames of a message were sent since power-on.
    """

    condition: Condition = field(default_factory=Condition)
    ssm_state: SsmState | None = None
    station_m: float | None = None
    message: str | None = None
    frames: int = 1


@dataclass(frozen=True, kw_only=True)
class FaultPlan:
    """A fault with its times.

    Attributes
    ----------
    fault : what goes wrong.
    onset : when it begins.
    for_us, for_frames : how long it lasts, by time or by frames befallen, whichever is over first; else for good.
    times, every_us : how often it begins, and how long after its last begin it does so again.
    seed : of its randomness; by default it comes from the scenario's seed and the place among the faults.
    """

    fault: Fault
    onset: Onset = field(default_factory=Onset)
    for_us: int | None = None
    for_frames: int | None = None
    times: int = 1
    every_us: int = 0
    seed: int | None = None

    def check(self, database: Codec) -> None:
        """See whether it makes sense with the messages of a profile.

        Raises
        ------
        CodecError
            When not: says what is allowed.
        """
        self.fault.check(database)
        if self.onset.message is not None:
            database.message(self.onset.message)
        if self.for_frames is not None and not isinstance(self.fault, FrameFault):
            raise CodecError(f"{self.fault.kind} befalls no single frames; it lasts for_s or for good")
        if self.times > 1 and not self.every_us:
            raise CodecError("a fault that begins several times needs every_s")
        if self.times > 1 and self.for_us is None and self.for_frames is None and not self.fault.ends_by_itself:
            raise CodecError("a fault that begins several times needs for_s or for_frames")
