"""`python -m tools.estimation_bench`: all parts are in its tables, runs follow from their seeds."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tools.estimation_bench import INNOVATION, PARTS, REPORTED, assumed_runs, bench_runs, main
from tools.estimation_scene import on_paper


def test_tables_hold_every_part(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--runs", "3", "--seconds", "4", "--seed", "7", "--laps", "1"]) in (0, 1)  # speed is not tested
    page = capsys.readouterr().out
    assert page.startswith("3 runs of 4 s, seeds 7 to 9\n")
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in page.splitlines() if line.startswith("│")]
    motion = [*list(PARTS)[1:], INNOVATION]
    studied, timed = rows[:-2], rows[-2:]
    assert [row[0] for row in studied] == [*PARTS, INNOVATION, *[*motion, REPORTED, *motion] * 2]
    for row in studied:
        assert float(row[2].split(" ± ")[0]) > 0.0
        low, high = map(float, row[3].split())
        assert low < int(row[1]) < high
        assert 0.0 <= float(row[4]) <= 100.0
        assert 1 <= int(row[6]) <= 80
    for row in timed:
        mean, median, p99, most = map(float, row[1:])
        assert 0.0 < median <= p99 <= most
        assert mean <= most
    assert re.search(r"lap by lap: min (\d+\.\d\d), median \1, max \1$", page, re.MULTILINE)


def test_runs_follow_from_their_seeds() -> None:
    for runs in (lambda seeds: assumed_runs(2, seeds), lambda seeds: bench_runs(on_paper(2), seeds)[0]):
        first, other = runs([3, 4])
        (again,) = runs([3])
        for name, squares in first.squares.items():
            np.testing.assert_array_equal(squares, again.squares[name])
            assert not np.array_equal(squares, other.squares[name])


@pytest.mark.parametrize(
    "arguments", [["--runs", "1"], ["--seconds", "0"], ["--seed", "-1"], ["--laps", "0"], ["--runs", "many"]]
)
def test_arguments_out_of_range(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
