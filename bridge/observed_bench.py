"""A bench for tests: runs to a state, waits for frames with a deadline, and says whether it is in good health."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

from bridge.bench import Bench
from bridge.condition import Condition, Trigger
from bridge.deferred_recorder import DeferredRecorder
from dbc.codec import profile
from dbc.frames import Bus
from firmware.tables import own_faults

#: Longest simulated time that a wait lasts unless the caller says otherwise, s.
PATIENCE_S = 60.0


class MissedError(AssertionError):
    """Something did not happen in time."""


@dataclass(frozen=True)
class Seen:
    """One frame that was waited for.

    Attributes
    ----------
    time_us : its end on the bus.
    signals : physical values by name.
    """

    time_us: int
    signals: dict[str, float]


class ObservedBench(Bench):
    """A bench that a test drives; its log is kept in memory until somebody wants it on disk.

    Attributes
    ----------
    log : what is kept, from `keep_log` on.
    """

    log: DeferredRecorder

    def keep_log(self, folder: Path) -> None:
        """Keep frames and truth from here on; `finish` writes them to a folder."""
        plant = self.plant
        self.log = DeferredRecorder(folder, plant.output_names, plant.output_units, self.scenario.profile)
        self._recorder = self.log

    def run_to(self, goal: Condition | Callable[[], bool], within_s: float = PATIENCE_S) -> int:
        """Tick until a condition of scenarios, or a function of the test, holds.

        Parameters
        ----------
        goal : looked at before the first tick and after every one.
        within_s : simulated time from here on.

        Returns
        -------
        int
            Simulated microseconds that it took.

        Raises
        ------
        MissedError
            When it does not hold in time.
        """
        begin_us = self.now_us
        trigger = Trigger(goal) if isinstance(goal, Condition) else None
        while not (goal() if callable(goal) else trigger is not None and trigger.update(self.situation)):
            if self.now_us - begin_us >= within_s * 1e6:
                raise MissedError(f"{_name(goal)} did not hold within {within_s:g} s, from {begin_us * 1e-6:.2f} s on")
            self.tick()
        return self.now_us - begin_us

    def run_for(self, time_s: float) -> None:
        """Tick for a simulated time."""
        end_us = self.now_us + round(time_s * 1e6)
        while self.now_us < end_us:
            self.tick()

    def wait_for(
        self, message: str, within_s: float, where: Callable[[dict[str, float]], bool] = lambda _signals: True
    ) -> Seen:
        """Tick until a frame of a message is on its bus whose signals are as wanted.

        Parameters
        ----------
        message : by name; frames that were sent before the call do not count.
        within_s : deadline, simulated time from here on to the end of the frame.
        where : takes the physical values by name.

        Raises
        ------
        MissedError
            When there is none in time: says what the last one held.
        CodecError
            When there is no such message.
        """
        codec = profile(self.scenario.profile).message(message)
        begin_us, last = self.now_us, "none was sent"
        while self.now_us - begin_us < within_s * 1e6:
            first = 0 if self.network.log_half_full else self.network.logged()
            self.tick()
            log = self.network.log_view(first)
            for frame in log[
                (log["bus"] == codec.bus) & (log["id"] == codec.frame_id) & (log["flags"] == codec.extended)
            ]:
                signals = dict(zip(codec.signals, codec.decode(frame["data"].tobytes()), strict=True))
                if int(frame["time_us"]) - begin_us <= within_s * 1e6 and where(signals):
                    return Seen(int(frame["time_us"]), signals)
                last = f"the last one held {signals}"
        raise MissedError(f"no such {message} within {within_s:g} s, from {begin_us * 1e-6:.2f} s on; {last}")

    def complaints(self, faults: Collection[str] | None = (), bus_errors: bool = False) -> list[str]:
        """What is not in order, one line each.

        Parameters
        ----------
        faults : that had to happen, by name; no others may. None: any may.
        bus_errors : there may be error frames and lost frames.
        """
        self.drain()
        names = {fault.id: fault.name for fault in own_faults()}
        happened = {
            names.get(event.fault_id, str(event.fault_id)): event
            for event in reversed(self.monitor.faults)
            if event.active
        }
        found = []
        if faults is not None:
            found += [
                f"unexpected fault {name} at {event.time_us * 1e-6:.3f} s, detail {event.detail}"
                for name, event in happened.items()
                if name not in faults
            ]
            found += [f"fault {name} did not happen" for name in faults if name not in happened]
        if not bus_errors:
            errors = {bus: self.network.handle.buses[bus].statistics.errors for bus in Bus}
            found += [f"{count} error frames on {bus.label}" for bus, count in errors.items() if count]
            if self.losses:
                found.append(f"{self.losses} frames lost")
        return found


def _name(goal: Condition | Callable[[], bool]) -> str:
    return str(goal) if isinstance(goal, Condition) else getattr(goal, "__name__", "the condition")
