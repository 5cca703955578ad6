"""`python -m tools.link_bench`: every way and every transport is in its tables, with figures that can be."""

from __future__ import annotations

import re

import pytest

from tools.link_bench import WAYS, main

TRANSPORTS = ["local, packets", "local, datagrams", "TCP"]


def test_tables_hold_every_way(capsys: pytest.CaptureFixture[str]):
    assert main(["--rounds", "1"]) == 0
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.strip("│ ").split("│")] for line in out.splitlines() if line.startswith("│")]
    names = [row[0] for row in rows]
    assert names == [*WAYS] * 3 + TRANSPORTS + [*WAYS] + TRANSPORTS
    for row in rows:
        values = [float(cell) for cell in row[1:]]
        assert all(value > 0 for value in values), row
        if len(values) == 4:
            assert values == sorted(values), row


def test_rounds_must_be_there(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["--rounds", "0"])
    assert ended.value.code == 2
    assert re.search(r"--rounds is 0; must be at least 1$", capsys.readouterr().err.strip())
