"""Figures of a cycle against numpy, scipy and cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from jitter_samples import EPOCH_NS, PERIOD_NS, records
from numpy.typing import NDArray
from scipy import stats

from tools.jitter.figures import (
    Distribution,
    age_at_output,
    cycle_times,
    newest_input,
    output_of_cycle,
    overruns,
    skipped_cycles,
    source_of,
    spacing,
    spacing_error,
    worst_cycles,
)

SEED = 20261122


def samples(count: int) -> NDArray[np.float64]:
    """Times as a timer gives them: many small, few large, in whole nanoseconds."""
    return np.round(np.random.default_rng(SEED).gamma(2.0, 30.0, count), 3)


@pytest.mark.parametrize("count", [1, 2, 99, 100, 101, 999, 1000, 1001, 54321])
def test_figures_are_those_of_numpy_and_scipy(count: int):
    values = samples(count)
    figures = Distribution.of(values).figures()
    assert figures.count == count
    assert figures.minimum == values.min()
    assert figures.maximum == values.max()
    assert figures.mean == pytest.approx(values.mean(), rel=1e-12)
    assert figures.rsd == pytest.approx(stats.variation(values), rel=1e-9, abs=1e-12)
    for thousandth, figure, enough in ((500, figures.p50, 2), (990, figures.p99, 100), (999, figures.p99_9, 1000)):
        if count < enough:
            assert figure is None
        else:
            rank = -(-count * thousandth // 1000)  # in whole numbers: numpy's own rank is off by one at 1000 samples
            assert figure == np.sort(values)[rank - 1]
            assert figure == pytest.approx(np.percentile(values, thousandth / 10, method="inverted_cdf"), rel=0.03)


def test_percentile_of_thousand_leaves_one_above():
    distribution = Distribution.of(np.arange(1.0, 1001.0))
    assert distribution.percentile(99.9) == 999.0
    assert distribution.percentile(99.0) == 990.0
    assert Distribution.of(np.arange(1.0, 1000.0)).percentile(99.9) is None


def test_histogram_gives_the_figures_of_its_samples():
    values = np.floor(samples(20_000))
    counted = {float(value): int(count) for value, count in zip(*np.unique(values, return_counts=True), strict=True)}
    whole, histogram = Distribution.of(values).figures(), Distribution.of_histogram(counted).figures()
    assert histogram == whole


def test_no_samples_no_figures():
    figures = Distribution.of([]).figures()
    assert figures.count == 0
    assert figures.maximum is figures.p50 is figures.mean is figures.rsd is None


def test_zero_has_no_relative_deviation():
    assert Distribution.of([0.0, 0.0]).figures().rsd is None


def test_a_cycle_taken_apart():
    times = cycle_times(records(3), PERIOD_NS)
    assert times.lateness.tolist() == [60.0] * 3
    assert times.execution.tolist() == [200.0] * 3
    assert times.processor.tolist() == [150.0] * 3
    assert times.preempted.tolist() == [50.0] * 3
    assert times.queued.tolist() == [25.0] * 3  # 75 us of waiting, 50 of which were preemption
    assert times.response.tolist() == [260.0] * 3
    assert times.period.tolist() == [10_000.0] * 2


def test_a_stall_counts_from_the_first_slot_that_it_cost():
    """As cyclictest counts it: one sample with all of it."""
    cycles = records(10)
    for name in ("wake_ns", "received_ns", "ticked_ns", "sent_ns"):
        cycles[name][4] += 3_000_000
    cycles["skipped"][4] = 2
    times = cycle_times(cycles, PERIOD_NS)
    assert times.lateness.tolist() == [60.0] * 4 + [23_060.0] + [60.0] * 5
    assert times.response[4] == 23_260.0


def test_queueing_is_never_more_than_the_lateness_nor_less_than_nothing():
    cycles = records(2)
    cycles["run_queue_ns"] = [5_000_000, 0]
    assert cycle_times(cycles, PERIOD_NS).queued.tolist() == [60.0, 0.0]


def test_processor_time_is_never_more_than_the_cycle():
    cycles = records(1)
    cycles["cpu_ns"] = 201_000  # read with another clock
    times = cycle_times(cycles, PERIOD_NS)
    assert times.processor.tolist() == [200.0]
    assert times.preempted.tolist() == [0.0]


def test_skipped_and_overrun_cycles_are_counted():
    cycles = records(100)
    assert (skipped_cycles(cycles), overruns(cycles, PERIOD_NS)) == (0, 0)
    cycles["sent_ns"][10] = cycles["deadline_ns"][10] + PERIOD_NS  # done just when the next is due
    assert overruns(cycles, PERIOD_NS) == 0
    cycles["sent_ns"][10] += 1
    cycles["skipped"][[20, 30]] = [1, 3]
    assert (skipped_cycles(cycles), overruns(cycles, PERIOD_NS)) == (4, 1)


def test_worst_cycles_end_last():
    cycles = records(50)
    cycles["sent_ns"][7] += 900_000
    cycles["wake_ns"][30] += 700_000
    cycles["sent_ns"][30] += 700_000
    assert worst_cycles(cycle_times(cycles, PERIOD_NS), 3) == [7, 30, 0]
    assert len(worst_cycles(cycle_times(cycles, PERIOD_NS), 99)) == 50


def test_spacing_of_frames():
    stamps = EPOCH_NS + np.array([0, 10_000, 20_300, 29_900, 40_000]) * 1000
    assert spacing(stamps).tolist() == [10_000.0, 10_300.0, 9_600.0, 10_100.0]
    assert spacing_error(stamps, PERIOD_NS).tolist() == [0.0, 300.0, 400.0, 100.0]
    assert spacing_error(stamps[:1], PERIOD_NS).size == 0


def test_age_from_input_to_output():
    cycles = records(4)
    due = cycles["deadline_ns"].astype(np.int64)
    cycles["newest_ns"][:, 3] = [0, due[1] - 1_000_000, 0, due[3] - 500_000]
    newest = newest_input(cycles, 3)
    # A cycle that reads nothing new works with what it has.
    assert newest.tolist() == [0, due[1] - 1_000_000, due[1] - 1_000_000, due[3] - 500_000]
    sent = cycles["sent_ns"].astype(np.int64)
    output = output_of_cycle(cycles, sent[[0, 1, 3]])  # the third cycle's frame was lost
    assert output.tolist() == [sent[0], sent[1], 0, sent[3]]
    assert age_at_output(newest, output).tolist() == [1260.0, 760.0]


def test_output_belongs_to_the_cycle_that_made_it():
    cycles = records(3)
    ticked = cycles["ticked_ns"].astype(np.int64)
    stamps = np.array([ticked[0] - 5_000, ticked[0] // 1000 * 1000, ticked[0] + 40_000, ticked[2]])
    # Before the first cycle's output: nobody's. Two of one cycle: the first counts.
    assert output_of_cycle(cycles, stamps).tolist() == [stamps[1], 0, stamps[3]]
    assert output_of_cycle(cycles, stamps[:0]).tolist() == [0, 0, 0]


def test_chain_of_two_stations():
    """Sensor at 100, 200, 300; the first station answers at 150, 250, 350; the second saw 0, 150, 260 and 349."""
    outputs, inputs = np.array([150, 250, 350]), np.array([100, 200, 300])
    assert source_of(np.array([0, 150, 260, 349, 149]), outputs, inputs).tolist() == [0, 100, 200, 200, 0]
    # The first station sent nothing in its second cycle.
    assert source_of(np.array([260]), np.array([150, 0, 350]), inputs).tolist() == [100]
    assert source_of(np.array([260]), np.zeros(3, dtype=np.int64), inputs).tolist() == [0]
