"""RES-1: the tracking table of the paper's solo lap, met or beaten, whatever the noise.

Asymmetry of the plant and noise of GNSS and IMU are on, as in every run.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bridge.scenario import load_scenario, load_vehicle
from tools.recorded import Recorded
from tools.run import DEFAULT_SCENARIO, build_bench
from tools.summary import driving_summary
from tools.tracking import PAPER

SCENARIO = load_scenario(DEFAULT_SCENARIO)


@pytest.mark.parametrize("seed", [SCENARIO.seed, 1, 7])
def test_every_figure_is_at_or_below_the_papers(seed: int, tmp_path: Path) -> None:
    assert load_vehicle(SCENARIO.vehicle)["oval_asymmetry"] == 1.0
    with build_bench(replace(SCENARIO, seed=seed), tmp_path) as bench:
        assert bench.run()
        recording = bench.finish()
        assert recording is not None
        assert bench.monitor.faults == []
    summary = driving_summary(Recorded(recording.signals, recording.truth))
    for row, paper in zip(summary["tracking"], PAPER, strict=True):
        assert row["samples"] > 500
        for figure in ("cte_max_m", "cte_abs_mean_m", "cte_std_m", "yaw_error_max_rad"):
            assert row[figure] <= getattr(paper, figure), (seed, row["speed_range_kmh"], figure)
            assert row[figure] > 0.001, "too good to be true: the noise is off"
    assert summary["yaw_error_share_in_band"] >= 0.97
