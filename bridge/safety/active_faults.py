"""Which faults are active, as the fault_events tell, and what they leave of the limits for degraded driving."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bridge.safety.series import Series, Times

_ALL = (np.inf, np.inf)


class ActiveFaults:
    """Follows the faults that limit speed and acceleration.

    Parameters
    ----------
    shares : by id, what each leaves of the speed and of the acceleration, as fractions.
    """

    def __init__(self, shares: Mapping[int, tuple[float, float]]) -> None:
        self._shares = shares
        self._active: set[int] = set()
        self._times = [-1]
        self._least = [_ALL]

    def update(self, events: Series, status: Series) -> None:
        """Take the new rows of fault_event and ssm_status."""
        none_active = status.times[status.fresh :][status["ssm_active_faults"][status.fresh :] == 0]
        for row in range(events.fresh, len(events.times)):
            time_us, fault = int(events.times[row]), int(events["fault_id"][row])
            self._forget(none_active, time_us)
            if fault in self._shares:
                (self._active.add if events["fault_active"][row] else self._active.discard)(fault)
                self._note(time_us)
        self._forget(none_active, np.inf)
        if len(status.times):
            old = max(bisect_left(self._times, status.times[0]) - 1, 0)
            del self._times[:old], self._least[:old]

    def least(self, at: Times) -> NDArray[np.float64]:
        """Least shares of speed and acceleration that were told before each time, infinite with none.

        Returns
        -------
        array of shape (len(at), 2).
        """
        return np.array(self._least)[np.searchsorted(self._times, at) - 1]

    def _forget(self, none_active: Times, until_us: float) -> None:
        """A status with no active fault ends them all, as after a restart, which tells no events."""
        place = int(np.searchsorted(none_active, self._times[-1], side="right"))
        if self._active and place < len(none_active) and none_active[place] < until_us:
            self._active.clear()
            self._note(int(none_active[place]))

    def _note(self, time_us: int) -> None:
        left = [self._shares[one] for one in self._active] or [_ALL]
        self._times.append(time_us)
        self._least.append((min(speed for speed, _ in left), min(acceleration for _, acceleration in left)))
