"""The protocol pages are what the DBC files say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dbc.buses import PROFILES, Bus
from dbc.network import own_network
from dbc.protocol_page import FOLDER, bus_load, main, page_name, protocol_page


@pytest.mark.parametrize("profile", PROFILES)
def test_committed_page_is_up_to_date(profile: str) -> None:
    page = FOLDER / page_name(profile)
    assert page.read_text(encoding="utf-8") == protocol_page(profile=profile), "run python -m dbc.protocol_page"


@pytest.mark.parametrize("profile", PROFILES)
def test_page_names_every_message_and_signal(profile: str) -> None:
    page = protocol_page(profile=profile)
    for facts in own_network(profile=profile):
        shown = profile == "V14" or facts.bus == Bus.CAN1
        assert (f"### {facts.message.name}\n" in page) == shown
        for signal in facts.message.signals:
            assert (f"| {signal.name} | {signal.start}\\|{signal.length} " in page) == shown, signal.name


def test_check_notices_a_difference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--out", str(tmp_path), "--check"]) == 1
    assert main(["--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"protocol.md", "protocol_v26.md"}
    assert main(["--out", str(tmp_path), "--check"]) == 0
    page = tmp_path / "protocol_v26.md"
    page.write_text(page.read_text(encoding="utf-8").replace("steering_cmd", "steering_command", 1), encoding="utf-8")
    capsys.readouterr()
    assert main(["--out", str(tmp_path), "--check"]) == 1
    assert capsys.readouterr().err == f"{page} is out of date; run python -m dbc.protocol_page\n"
    assert main(["--out", str(tmp_path / "nowhere")]) == 2


def test_load_of_one_message_by_hand() -> None:
    """8 bytes, 11-bit id: 111 bits without and 135 with stuff bits; every 10 ms at 500 kbit/s."""
    facts = next(facts for facts in own_network() if facts.message.name == "steering_cmd")
    load = bus_load([facts], 500_000)
    assert load.nominal == pytest.approx(111 * 100 / 500_000)
    assert load.stuffed == pytest.approx(135 * 100 / 500_000)
    assert bus_load([replace(facts, frames_per_cycle=3)], 500_000).nominal == pytest.approx(3 * load.nominal)
    assert bus_load([replace(facts, cycle_ms=0)], 500_000).nominal == 0
    extended = next(facts for facts in own_network() if facts.message.is_extended_frame)
    assert bus_load([replace(extended, cycle_ms=10)], 500_000).nominal == pytest.approx(131 * 100 / 500_000)
    assert bus_load([replace(extended, cycle_ms=10)], 500_000).stuffed == pytest.approx(160 * 100 / 500_000)
