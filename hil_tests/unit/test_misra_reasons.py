"""The judge of the MISRA findings: nothing without a reason, no reason without a finding."""

from __future__ import annotations

import pytest

from firmware import misra

FOUND = """\
firmware/obc/ssm.c:12: misra-c2012-15.5: misra violation
firmware/ports/linux/realtime.c:8: misra-c2012-21.6: misra violation
bridge/native/blf.c:52: shiftTooManyBits: Shifting 32-bit value by 32 bits
"""


def reasons(*lines: str) -> list[misra.Deviation]:
    return misra.read_deviations("\n".join(("# a comment", *lines)))


def test_everything_needs_a_reason() -> None:
    wrong = misra.judge(misra.read_findings(FOUND), reasons("15.5 any early", "21.6 host prints"))
    assert wrong == ["bridge/native/blf.c:52: shiftTooManyBits: no reason in misra.txt"]


def test_a_reason_holds_where_it_says() -> None:
    lines = ("15.5 host early", "21.6 firmware/ports/linux/realtime.c prints", "shiftTooManyBits any no")
    wrong = misra.judge(misra.read_findings(FOUND), reasons(*lines))
    assert wrong == [
        "firmware/obc/ssm.c:12: 15.5: no reason in misra.txt", "misra.txt: 15.5 host: nothing is found for it",
    ]  # fmt: skip


def test_a_line_without_reason_is_none() -> None:
    with pytest.raises(ValueError, match=r"15\.5 any: RULE WHERE REASON"):
        reasons("15.5 any")


def test_the_file_is_read_whole() -> None:
    deviations = misra.read_deviations(misra.REASONS.read_text())
    assert len(deviations) > 40
    assert len({(d.rule, d.where) for d in deviations}) == len(deviations)
