"""`python -m tools.tracking_bench`: all who take part are in its tables, and errors are those of the seeds."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tools.opponent_scenes import MANOEUVRES
from tools.tracking_bench import CLEAN, CLUTTER, COUNTED, Contender, follow, main, names


def test_tables_hold_everybody(capsys: pytest.CaptureFixture[str]):
    assert main(["--runs", "1"]) in (0, 1)  # how fast the machine is, is not tested
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.strip("│ ").split("│")] for line in out.splitlines() if line.startswith("│")]
    assert [row[0] for row in rows] == [*names(), "1 cars", "5 cars", *[*MANOEUVRES, "all"] * 2]
    for row in rows[: len(names()) + 2]:
        mean, median, p99, most, processor = (float(cell) for cell in row[1:])
        assert 0.0 < median <= p99 <= most
        assert 0.0 < mean <= most
        assert processor > 0.0
    for row in rows[len(names()) + 2 :]:
        for cell in row[1:]:
            position, velocity = map(float, cell.split())
            assert 0.0 < position < 0.5
            assert 0.0 < velocity < 4.0


@pytest.mark.parametrize("sensor", [CLEAN, CLUTTER], ids=["clean", "clutter"])
def test_all_follow_the_same_car(sensor):
    runs = []
    for _ in range(2):
        runs.append({name: Contender() for name in names()})
        follow(MANOEUVRES["turn"](), sensor, 3, runs[-1])
    for name in names():
        assert runs[0][name].errors == runs[1][name].errors
        assert len(runs[0][name].errors) == len(runs[0][name].wall_ms) == 161 - COUNTED
    # Where nothing is doubtful, the filter and filterpy's are one.
    if sensor is CLEAN:
        np.testing.assert_allclose(runs[0]["filter"].errors, runs[0]["filterpy"].errors, rtol=1e-4, atol=1e-5)


def test_runs_must_be_there(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["--runs", "0"])
    assert ended.value.code == 2
    assert re.search(r"--runs is 0; must be at least 1$", capsys.readouterr().err.strip())
