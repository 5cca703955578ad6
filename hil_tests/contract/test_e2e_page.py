"""docs/e2e.md says what the firmware is held to: its tables are those of the tests."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from e2e_receivers import addressed_to, receivers, timeout_ms
from e2e_verdicts import MISSED, OUTCOMES, PLAUSIBILITY, ROWS, Protection, Verdict, protection

from dbc.frames import Station

PAGE = Path(__file__).resolve().parents[2] / "docs" / "e2e.md"

NAMES = {Station.OBC: "OBC", Station.RAPTOR: "Raptor", Station.SPACE_DRIVE: "Space Drive"}


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ["---"] * len(head), *map(list, rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def in_words(verdict: Verdict) -> str:
    words = [f"dropped: {reason}" for reason in sorted(verdict - {MISSED})]
    return ", ".join(words + [MISSED] * (MISSED in verdict)) or "-"


def verdict_table() -> str:
    return table(
        ["fault", "how it shows", *(kind.value for kind in Protection)],
        ([row.fault, row.shape, *(in_words(row.verdicts[kind]) for kind in Protection)] for row in ROWS),
    )


def message_table() -> str:
    rows = []
    for receiver in receivers():
        for facts in addressed_to(receiver.station):
            if receiver.receptions_of(facts):
                name, limit = facts.message.name, timeout_ms(receiver.station, facts)
                age = "-" if limit is None else str(limit)
                rows.append([f"`{name}`", facts.bus.label, NAMES[receiver.station], protection(facts).value, age])
    return table(["message", "bus", "receiver", "carries", "missed after, ms"], rows)


def plausibility_table() -> str:
    return table(
        ["command", "bits", *OUTCOMES],
        ([f"`{name}`", str(sum(counts)), *map(str, counts)] for name, counts in PLAUSIBILITY.items()),
    )


def test_the_page_has_the_tables_that_the_tests_hold_the_firmware_to() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for expected in (verdict_table(), message_table(), plausibility_table()):
        assert expected in page, f"put this into {PAGE.name}:\n{expected}"
