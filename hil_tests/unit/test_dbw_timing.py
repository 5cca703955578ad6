"""Times between frames, taken in piece by piece, beside numpy on all of them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tools.dbw.timing import RESOLUTION, Timing

SEED = 20221103


def intervals_of(kind: str) -> NDArray[np.int64]:
    random = np.random.default_rng(SEED)
    return {
        "regular": np.full(5000, 10_000),
        "jitter": 10_000 + random.integers(-2_000, 2_000, 5000),
        "two cycles": random.choice([10_000, 100_000], 5000, p=[0.985, 0.015]),
        "long tail": np.exp(random.normal(9.0, 2.0, 5000)).astype(np.int64) + 1,
        "small": random.integers(1, 40, 5000),
        "one": np.array([123]),
    }[kind].astype(np.int64)


@pytest.mark.parametrize("kind", ["regular", "jitter", "two cycles", "long tail", "small", "one"])
def test_figures_are_those_of_numpy(kind: str):
    intervals = intervals_of(kind)
    timing = Timing()
    for piece in np.array_split(intervals, min(7, len(intervals))):
        timing.add(piece)
    assert (timing.count, timing.shortest, timing.longest) == (len(intervals), intervals.min(), intervals.max())
    assert timing.mean == pytest.approx(intervals.mean())
    assert timing.jitter == pytest.approx(intervals.std(), rel=1e-6, abs=0.1)
    for percent in (1.0, 50.0, 90.0, 99.0, 99.9, 100.0):
        exact = np.percentile(intervals, percent, method="inverted_cdf")
        assert timing.percentile(percent) == pytest.approx(exact, rel=RESOLUTION), (kind, percent, SEED)


def test_the_resolution_is_used_up():
    """The stated bound is not a loose one: some interval is nearly as far off."""
    worst = 0.0
    for interval in range(1000, 3000):
        timing = Timing()
        timing.add(np.array([interval, 1, 1 << 20]))
        worst = max(worst, abs(timing.percentile(50.0) / interval - 1.0))
    assert 0.9 * RESOLUTION < worst <= RESOLUTION


def test_none_and_what_is_off_the_scale():
    assert (Timing().mean, Timing().jitter, Timing().percentile(99.0)) == (0.0, 0.0, 0.0)
    timing = Timing()
    timing.add(np.array([-5, 0, 10**12]))
    assert (timing.shortest, timing.longest) == (-5, 10**12)
    assert -5 <= timing.percentile(1.0) <= 2
    assert timing.percentile(100.0) >= 1 << 26


def test_memory_does_not_grow():
    timing = Timing()
    timing.add(intervals_of("jitter"))
    before = timing._counts.nbytes
    for _ in range(50):
        timing.add(intervals_of("long tail"))
    assert timing._counts.nbytes == before < 16_384
