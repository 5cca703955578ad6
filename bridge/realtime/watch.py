"""Rules by which a real-time run is watched: which station has stopped cycling, when a run is over. No clock here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

#: A station that has not cycled for this long is said to have stopped.
STALL_US = 500_000

#: One that has not come back for this long counts as failed.
LOST_US = 2_000_000

#: What happens after a failure is watched at least and at most this long: the rest of the car brings itself to a stop.
AFTERMATH_MIN_US = 3_000_000
AFTERMATH_MAX_US = 20_000_000

#: Grace for the plant, which ends the run when its time is up.
OVERTIME_US = 5_000_000


@dataclass(frozen=True)
class Stall:
    """A station stopped cycling, or cycles again.

    Attributes
    ----------
    name : of the station.
    since_us : when its newest cycle was seen.
    over : true when it cycles again.
    """

    name: str
    since_us: int
    over: bool


class CycleWatch:
    """Finds stations that have stopped cycling although their processes live."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[int, int]] = {}
        self._stalled: dict[str, int] = {}

    def update(self, now_us: int, cycles: Mapping[str, int]) -> list[Stall]:
        """Take how many cycles each running station has made; returns what has changed.

        Parameters
        ----------
        now_us : time of the look. Before the epoch, at 0, nothing is due.
        cycles : by name, of the stations that run.
        """
        changes = []
        for name in [name for name in self._seen if name not in cycles]:
            del self._seen[name]
            self._stalled.pop(name, None)
        for name, count in cycles.items():
            known, since_us = self._seen.get(name, (-1, now_us))
            if count != known:
                if name in self._stalled:
                    changes.append(Stall(name, self._stalled.pop(name), over=True))
                self._seen[name] = (count, now_us)
            elif name not in self._stalled and now_us - max(since_us, 0) >= STALL_US:
                self._stalled[name] = since_us
                changes.append(Stall(name, since_us, over=False))
        return changes

    def lost(self, now_us: int) -> list[str]:
        """Stations that have been stopped for so long that nobody waits for them."""
        return [name for name, since_us in self._stalled.items() if now_us - max(since_us, 0) >= LOST_US]


class RunWatch:
    """Decides when a run is over that the plant has not ended.

    Parameters
    ----------
    time_limit_us : of the scenario.

    Attributes
    ----------
    failed_us : when the first part failed; None while all is well.
    """

    def __init__(self, time_limit_us: int) -> None:
        self._limit_us = time_limit_us + OVERTIME_US
        self.failed_us: int | None = None

    def fail(self, now_us: int) -> None:
        """A part has failed."""
        if self.failed_us is None:
            self.failed_us = now_us

    def over(self, now_us: int, stands: bool) -> bool:
        """True when there is nothing more to see.

        Parameters
        ----------
        stands : the car stands, or there is no car any more.
        """
        if now_us >= self._limit_us:
            return True
        if self.failed_us is None:
            return False
        after_us = now_us - self.failed_us
        return after_us >= AFTERMATH_MAX_US or (stands and after_us >= AFTERMATH_MIN_US)
