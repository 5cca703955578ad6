"""docs/simcan.md: its programs and commands print what it says."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest

from tools.cli import main

PAGE = Path(__file__).resolve().parents[2] / "docs" / "simcan.md"
SHOWN = re.findall(r"^```(python|sh)\n(.*?)^```\n\n```text\n(.*?)^```", PAGE.read_text(), re.M | re.S)


def test_page_has_programs_and_commands():
    assert [kind for kind, _, _ in SHOWN] == ["python", "python", "sh", "sh"]


@pytest.mark.parametrize(("kind", "source", "text"), SHOWN, ids=[str(number) for number in range(len(SHOWN))])
def test_page_shows_what_is_printed(kind: str, source: str, text: str):
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        if kind == "python":
            exec(compile(source, str(PAGE), "exec"), {})
        else:
            main(shlex.split(source)[1:])
    assert out.getvalue() == text
