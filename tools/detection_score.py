"""Scores of detection by distance: objects of several sources against where the cars were.

An object is true when its middle is near the car's; of several, the most credible one counts and the others are false.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from autonomy.detection.road_objects import RoadObjects
from autonomy.frenet import FloatArray

#: The paper's bins, m.
BINS_M = ((0, 50), (50, 100), (100, 120))
#: How near to a car's middle an object's has to be, m: the gate in which TUM's tracker matches.
MATCH_M = 5.0
SOURCES = ("LiDAR", "radar", "fused")


@dataclass(frozen=True)
class Sample:
    """One scene: middle of the car, shape (2,), m, if there is one, and the objects of each source.

    All are in one vehicle frame.
    """

    car: FloatArray | None
    objects: dict[str, RoadObjects]


@dataclass
class Score:
    """What a source made of the scenes of one bin.

    Attributes
    ----------
    cars : that were there.
    errors : m, of those that were found.
    verdicts : confidence of every object, and whether it is true.
    """

    cars: int = 0
    errors: list[float] = field(default_factory=list)
    verdicts: list[tuple[float, bool]] = field(default_factory=list)

    @property
    def recall(self) -> float:
        """Found of those that were there."""
        return len(self.errors) / self.cars if self.cars else 0.0

    @property
    def precision(self) -> float:
        """True objects of all."""
        return len(self.errors) / len(self.verdicts) if self.verdicts else 0.0

    @property
    def position_rms(self) -> float | None:
        """Root of the mean square of the errors, m; None when nothing was found."""
        return rms(self.errors)

    @property
    def average_precision(self) -> float:
        """See `average_precision`."""
        return average_precision(self.verdicts, self.cars)


def rms(values: Sequence[float]) -> float | None:
    """Root of the mean square; None of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def average_precision(verdicts: Sequence[tuple[float, bool]], cars: int) -> float:
    """Area under the precision over recall, precision being the best at that recall or beyond (PASCAL VOC 2010).

    Objects of the same confidence come in together.
    """
    if not cars or not verdicts:
        return 0.0
    ordered = sorted(verdicts, key=lambda verdict: -verdict[0])
    confidence = np.array([one for one, _ in ordered])
    last = np.append(np.flatnonzero(np.diff(confidence)), len(ordered) - 1)
    true = np.cumsum([is_true for _, is_true in ordered])[last]
    precision = np.maximum.accumulate((true / (last + 1.0))[::-1])[::-1]
    return float(np.sum(np.diff(true, prepend=0) / cars * precision))


def evaluate(samples: Sequence[Sample]) -> dict[str, list[Score]]:
    """Score of each source in each bin. What is false counts where it is; what is beyond the bins does not count."""
    scores = {source: [Score() for _ in BINS_M] for source in SOURCES}
    for sample in samples:
        for source, found in sample.objects.items():
            car = np.full(2, np.inf) if sample.car is None else sample.car
            off = np.hypot(found["x"] - car[0], found["y"] - car[1])
            # The most credible of those that are near enough; of equally credible ones the nearest.
            near = np.flatnonzero(off <= MATCH_M).tolist()
            best = min(near, key=lambda row: (-found["confidence"][row], off[row]), default=None)
            place = bin_of(float(np.hypot(*car)))
            if place is not None:
                scores[source][place].cars += 1
            for row, one in enumerate(found):
                here = place if row == best else bin_of(float(np.hypot(one["x"], one["y"])))
                if here is not None:
                    scores[source][here].verdicts.append((float(one["confidence"]), row == best))
                    if row == best:
                        scores[source][here].errors.append(float(off[row]))
    return scores


def show(console: Console, scores: dict[str, list[Score]]) -> None:
    """Print the table."""
    table = Table(Column("m", no_wrap=True), "", "cars", "AP", "recall", "precision", "median m off", "RMS m off")
    for column in table.columns[2:]:
        column.justify = "right"
    for place, (start, end) in enumerate(BINS_M):
        for source in SOURCES:
            score = scores[source][place]
            errors = (
                (f"{statistics.median(score.errors):.2f}", f"{score.position_rms:.2f}") if score.errors else ("-", "-")
            )
            figures = (score.average_precision, score.recall, score.precision)
            bin_ = f"{start} to {end}" if source == SOURCES[0] else ""
            table.add_row(bin_, source, str(score.cars), *(f"{figure:.2f}" for figure in figures), *errors)
    console.print(table)


def bin_of(distance: float) -> int | None:
    """The bin that a distance, m, belongs to; None beyond all."""
    return next((place for place, (start, end) in enumerate(BINS_M) if start <= distance < end), None)
