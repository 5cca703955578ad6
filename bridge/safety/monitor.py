"""Holds a run to its safety properties, while it goes on."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bridge.safety.frame_rules import CountersAdvance, FrameBlock, FrameBreach, FrameRule, SentByOwner
from bridge.safety.limits import SafetyLimits
from bridge.safety.properties import PROPERTIES, TRUTH, Breach, OnTrack, Property, Scene
from bridge.safety.series import Series
from bridge.safety.statement import Statement
from bridge.safety.track import TrackEdges
from dbc.codec import Codec
from dbc.frames import FRAME_DTYPE

#: Frames that are looked at together: one look costs as much as some hundred frames.
BLOCK_FRAMES = 32768

#: Of each message, what was before stays for so long: longer than any property looks back.
_KEEP_US = 1_000_000

#: Occasions that are kept of one property; all are counted.
OCCASIONS_MAX = 20


@dataclass(frozen=True)
class Violation:
    """One occasion on which a property does not hold.

    Attributes
    ----------
    property_id : of the property.
    time_us, frame : when, and the number of the frame in the recording, from 0; of the plant's truth the newest frame.
    seen, allowed : in words.
    """

    property_id: str
    time_us: int
    frame: int
    seen: str
    allowed: str

    def __str__(self) -> str:
        """One line."""
        return (
            f"{self.property_id} at {self.time_us * 1e-6:.3f} s, frame {self.frame}: {self.seen};"
            f" allowed: {self.allowed}"
        )


class SafetyMonitor:
    """Checks frames and truth in order of time, in pieces of any size; what it keeps does not grow.

    Parameters
    ----------
    limits : what is allowed.
    database : messages of the profile that CAN1 has.
    truth_names : of the plant's outputs, as `add_truth` gets them; empty without a plant.
    edges : left and right edge of the track, see `TrackEdges`; None when the track is not known.
    senders_known : frames say who sent them, and 0 is somebody outside of the car.
    excused : ids of properties that are not checked, because the run breaks them on purpose.

    Attributes
    ----------
    violations : the occasions so far, in order of time within a property; complete after `finish`.
    broken : by id of a property, rows that broke it.
    frames : looked at so far.
    limits : as given.
    checked : ids of the properties that are.
    """

    def __init__(
        self,
        limits: SafetyLimits,
        database: Codec,
        truth_names: Sequence[str] = (),
        edges: tuple[NDArray[np.floating], NDArray[np.floating]] | None = None,
        senders_known: bool = False,
        excused: Collection[str] = (),
    ) -> None:
        self._database = database
        has_truth = set(TRUTH) <= set(truth_names)
        self._truth_columns = np.array([truth_names.index(name) for name in TRUTH] if has_truth else [], np.intp)
        self.limits = limits
        self._properties = [
            kind()
            for kind in PROPERTIES
            if kind.id not in excused and (has_truth or not kind.truth) and (edges is not None or not kind.track)
        ]
        rules: tuple[FrameRule, ...] = (CountersAdvance(database), SentByOwner(database, senders_known))
        self._rules = [rule for rule in rules if rule.id not in excused]
        names = dict.fromkeys(name for one in self._properties for name in one.messages)
        messages = {name: database.message(name) for name in names}
        self._scene = Scene(
            limits,
            messages,
            {name: Series(messages[name].signals) for name in names},
            Series(TRUTH if has_truth else ()),
            None if edges is None else TrackEdges(*edges),
        )
        self._pending: list[NDArray[np.uint64]] = []
        self._pending_count = 0
        self._rows: list[tuple[int, NDArray[np.float64]]] = []
        self.violations: list[Violation] = []
        self.broken: dict[str, int] = {}
        self.frames = 0
        self.checked = (*(one.id for one in self._properties), *(rule.id for rule in self._rules))

    def add_truth(self, time_us: int, outputs: NDArray[np.float64]) -> None:
        """Take the plant's outputs at one time; shape (len(truth_names),)."""
        self._rows.append((time_us, outputs[self._truth_columns]))

    def update(self, frames: NDArray[np.void]) -> None:
        """Take frames in order of time; array of `FRAME_DTYPE`, copied if it is looked at later."""
        # As words, which numpy joins several times as fast as records.
        self._pending.append(np.ascontiguousarray(frames).view(np.uint64))
        self._pending_count += len(frames)
        if self._pending_count >= BLOCK_FRAMES:
            self._look(final=False)

    @property
    def excursion_m(self) -> float:
        """How far the car was beyond the edges of the track while nobody could steer it, m; not part of SAFE-15."""
        return max((one.excursion_m for one in self._properties if isinstance(one, OnTrack)), default=0.0)

    def look(self) -> None:
        """Look at what there is, but for what needs to know more first."""
        self._look(final=False)

    def finish(self) -> None:
        """Look at everything that is left."""
        self._look(final=True)
        self.violations.sort(key=lambda one: (one.time_us, one.frame))

    def _look(self, final: bool) -> None:
        frames: NDArray[np.void] = np.concatenate([np.empty(0, np.uint64), *self._pending]).view(FRAME_DTYPE)
        times = np.array([time_us for time_us, _ in self._rows], np.int64)
        until, rows_until = len(frames), len(times)
        if self._truth_columns.size and not final:
            # Only what both are known of.
            newest_us = int(times[-1]) if rows_until else -1
            while until and frames["time_us"][until - 1] > newest_us:
                until -= 1
            last_us = int(frames["time_us"][until - 1]) if until else -1
            rows_until = int(np.searchsorted(times, last_us, side="right"))
        self._take(frames[:until], times[:rows_until], [outputs for _, outputs in self._rows[:rows_until]])
        del self._rows[:rows_until]
        self._pending = [frames[until:].view(np.uint64)]
        self._pending_count = len(frames) - until

    def _take(self, frames: NDArray[np.void], times: NDArray[np.int64], rows: list[NDArray[np.float64]]) -> None:
        block = FrameBlock.of(frames, self._database)
        for rule in self._rules:
            self._note_frames(rule, block, rule.check(block))
        for name, series in self._scene.series.items():
            codec = self._scene.messages[name]
            mine = block.of_message(codec.index)
            words = block.words[mine]
            values = codec.columns(words.view(FRAME_DTYPE)[:, 0])
            series.add(words[:, 0].astype(np.int64), block.order[mine] + self.frames, values, _KEEP_US)
        newest = np.searchsorted(block.times, times, side="right") + self.frames - 1
        outputs = np.array(rows).reshape(len(rows), len(self._truth_columns))
        self._scene.truth.add(times, np.maximum(newest, 0), outputs.T, _KEEP_US)
        self._scene.look_for_launch()
        for one in self._properties:
            for breach in one.check(self._scene):
                self._note(one, breach)
        self.frames += len(frames)

    def _note(self, one: Property, breach: Breach) -> None:
        series, rows = breach.series, breach.rows
        count = int(np.count_nonzero(rows[series.fresh :]))
        if not count:
            return
        self.broken[one.id] = self.broken.get(one.id, 0) + count
        onsets = rows & ~np.concatenate(([False], rows[:-1]))
        for row in (np.flatnonzero(onsets[series.fresh :]) + series.fresh).tolist():
            allowed = breach.allowed if isinstance(breach.allowed, str) else breach.allowed(row)
            self._keep(one.id, int(series.times[row]), int(series.numbers[row]), breach.seen(row), allowed)

    def _note_frames(self, rule: FrameRule, block: FrameBlock, breaches: Sequence[FrameBreach]) -> None:
        if breaches:
            self.broken[rule.id] = self.broken.get(rule.id, 0) + len(breaches)
        for one in breaches:
            self._keep(rule.id, int(block.times[one.place]), self.frames + one.place, one.seen, one.allowed)

    def _keep(self, property_id: str, time_us: int, frame: int, seen: str, allowed: str) -> None:
        if sum(known.property_id == property_id for known in self.violations) < OCCASIONS_MAX:
            self.violations.append(Violation(property_id, time_us, frame, seen, allowed))


def properties() -> Mapping[str, type[Statement]]:
    """All properties by id, in order."""
    kinds: tuple[type[Statement], ...] = (*PROPERTIES, CountersAdvance, SentByOwner)
    return {one.id: one for one in kinds}
