"""Figures of a cycle: pure functions on arrays. Times are in microseconds unless a name says ns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.float64]
Stamps = NDArray[np.int64]

#: Percentiles of a table, in percent.
PERCENTILES = (50.0, 99.0, 99.9)


@dataclass(frozen=True)
class Figures:
    """What a table row shows of one quantity, microseconds.

    Attributes
    ----------
    count : samples.
    minimum, mean, p50, p99, p99_9, maximum : None when there are too few samples to tell.
    rsd : standard deviation over mean; None without a mean above 0.
    """

    count: int
    minimum: float | None
    mean: float | None
    p50: float | None
    p99: float | None
    p99_9: float | None
    maximum: float | None
    rsd: float | None


@dataclass(frozen=True)
class Distribution:
    """Samples of one quantity as values and how often each came up.

    Attributes
    ----------
    values : distinct, ascending, microseconds.
    counts : of each value.
    """

    values: Times
    counts: Stamps

    @classmethod
    def of(cls, samples: Sequence[float] | Times) -> Distribution:
        """The distribution of samples in any order."""
        values, counts = np.unique(np.asarray(samples, dtype=np.float64), return_counts=True)
        return cls(values, counts.astype(np.int64))

    @classmethod
    def of_histogram(cls, histogram: Mapping[float, int]) -> Distribution:
        """The distribution of a histogram: value to count."""
        values = np.array(sorted(histogram), dtype=np.float64)
        return cls(values, np.array([histogram[value] for value in values], dtype=np.int64))

    @property
    def count(self) -> int:
        """Samples."""
        return int(self.counts.sum())

    def percentile(self, percent: float) -> float | None:
        """The smallest value that at least `percent` of the samples do not exceed.

        None when fewer samples than it takes for one of them to lie above: 100 for 99 %, 1000 for 99.9 %.
        """
        if self.count * (100.0 - percent) < 100.0 - 1e-6:
            return None
        rank = np.ceil(self.count * percent / 100.0 - 1e-9)
        return float(self.values[np.searchsorted(np.cumsum(self.counts), rank)])

    def figures(self) -> Figures:
        """The row of a table."""
        count = self.count
        if count == 0:
            return Figures(0, None, None, None, None, None, None, None)
        mean = float(np.average(self.values, weights=self.counts))
        deviation = float(np.sqrt(np.average((self.values - mean) ** 2, weights=self.counts)))
        p50, p99, p99_9 = (self.percentile(percent) for percent in PERCENTILES)
        return Figures(
            count=count,
            minimum=float(self.values[0]),
            mean=mean,
            p50=p50,
            p99=p99,
            p99_9=p99_9,
            maximum=float(self.values[-1]),
            rsd=deviation / mean if mean > 0.0 else None,
        )


@dataclass(frozen=True)
class CycleTimes:
    """Where the time of every cycle went, microseconds; arrays of one length but `period`, which is one shorter.

    Attributes
    ----------
    lateness : wait returned after the deadline; when slots were skipped, after that of the first of them.
    queued : part of `lateness` in which the thread was ready but another had its processor; the rest is the timer's.
    execution : from the return of the wait to the outputs being with the kernel.
    processor : part of `execution` in which the thread ran.
    preempted : part of `execution` in which it did not.
    response : from that deadline to the end.
    period : from one return of the wait to the next.
    """

    lateness: Times
    queued: Times
    execution: Times
    processor: Times
    preempted: Times
    response: Times
    period: Times


def cycle_times(records: NDArray[np.void], period_ns: int) -> CycleTimes:
    """Take cycle records apart.

    Parameters
    ----------
    records : fields as in `cycle_record` of firmware/ports/linux/cycle_log.h.
    period_ns : of the cycle.
    """
    # A stall that costs whole slots must not look like the rest of a slot: it counts from the first one that was due.
    due = records["deadline_ns"] - records["skipped"].astype(np.uint64) * np.uint64(period_ns)
    lateness = _since(records["wake_ns"], due)
    execution = _since(records["sent_ns"], records["wake_ns"])
    processor = np.minimum(records["cpu_ns"] / 1000.0, execution)
    preempted = execution - processor
    # The kernel counts one waiting time per cycle; what preemption does not explain was spent before the wake-up.
    queued = np.clip(records["run_queue_ns"] / 1000.0 - preempted, 0.0, np.maximum(lateness, 0.0))
    return CycleTimes(
        lateness=lateness,
        queued=queued,
        execution=execution,
        processor=processor,
        preempted=preempted,
        response=_since(records["sent_ns"], due),
        period=_since(records["wake_ns"][1:], records["wake_ns"][:-1]),
    )


def skipped_cycles(records: NDArray[np.void]) -> int:
    """Slots that passed unused."""
    return int(records["skipped"].sum())


def overruns(records: NDArray[np.void], period_ns: int) -> int:
    """Cycles that had not ended when the next one was due."""
    return int(np.count_nonzero(records["sent_ns"] > records["deadline_ns"] + np.uint64(period_ns)))


def worst_cycles(times: CycleTimes, count: int) -> list[int]:
    """Places of the cycles that ended last after their deadline, worst first."""
    order: list[int] = np.argsort(-times.response, kind="stable")[:count].tolist()
    return order


def spacing(stamps_ns: Stamps) -> Times:
    """Times from frame to frame, microseconds; stamps in order."""
    between: Times = np.diff(stamps_ns) / 1000.0
    return between


def spacing_error(stamps_ns: Stamps, period_ns: int) -> Times:
    """How far each spacing is from the period, microseconds, without sign."""
    error: Times = np.abs(np.diff(stamps_ns) - period_ns) / 1000.0
    return error


def newest_input(records: NDArray[np.void], bus: int) -> Stamps:
    """Stamp of the newest frame of a bus that each cycle had, also from cycles before; 0 before the first, ns."""
    newest: Stamps = np.maximum.accumulate(records["newest_ns"][:, bus].astype(np.int64))
    return newest


def output_of_cycle(records: NDArray[np.void], stamps_ns: Stamps) -> Stamps:
    """Stamp of the first of the frames that each cycle sent, 0 for none, ns.

    A frame belongs to the cycle whose logic was the last to end before the frame was on the bus.

    Parameters
    ----------
    records : of one station, in order.
    stamps_ns : of the frames of one message of that station, in order.
    """
    out = np.zeros(len(records), dtype=np.int64)
    # Stamps have whole microseconds: one may lie up to 1 us before the end of the logic that it follows.
    cycle = np.searchsorted(records["ticked_ns"].astype(np.int64), stamps_ns + 999, side="right") - 1
    cycle, first = np.unique(cycle, return_index=True)
    known = cycle >= 0
    out[cycle[known]] = stamps_ns[first[known]]
    return out


def age_at_output(input_ns: Stamps, output_ns: Stamps) -> Times:
    """From input to output, cycle by cycle, microseconds, where both are known (not 0)."""
    known = (input_ns > 0) & (output_ns > 0)
    age: Times = (output_ns[known] - input_ns[known]) / 1000.0
    return age


def source_of(stamps_ns: Stamps, output_ns: Stamps, input_ns: Stamps) -> Stamps:
    """Follow frames back through the station that sent them, ns.

    Parameters
    ----------
    stamps_ns : of frames as a receiver saw them; 0 for none.
    output_ns, input_ns : of the sender's cycles, in order: stamp of the frame sent, and of the input it was made from.

    Returns
    -------
    ndarray
        For each of `stamps_ns` the input behind it: of the cycle that sent the newest frame not after it; 0 for none.
    """
    sent = output_ns > 0
    outputs, inputs = output_ns[sent], input_ns[sent]
    place = np.searchsorted(outputs, stamps_ns, side="right") - 1
    if len(outputs) == 0:
        return np.zeros_like(stamps_ns)
    source: Stamps = np.where((place >= 0) & (stamps_ns > 0), inputs[place], 0)
    return source


def _since(later_ns: NDArray[np.uint64], earlier_ns: NDArray[np.uint64]) -> Times:
    """Difference of two columns of stamps, microseconds."""
    between: Times = (later_ns.astype(np.int64) - earlier_ns.astype(np.int64)) / 1000.0
    return between
