"""Campaign files: what they mean, and what is said of those that are wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

import scenarios
from bridge.campaign.file import Campaign, load_campaign, run_id
from bridge.faults.provocations import LAYERS, load_provocations
from dbc.codec import database
from dbc.errors import ConfigurationError
from firmware.tables import own_faults

FOLDER = scenarios.DIRECTORY / "campaigns"
CONTENT: dict[str, Any] = {
    "name": "mine",
    "scenario": str(scenarios.DIRECTORY / "short_drive.yaml"),
    "onsets": [{"from_s": 1.0, "to_s": 2.0, "every_ms": 500}, {"from_s": 2.0, "to_s": 3.0, "every_ms": 1000}],
    "watch_s": 0.5,
    "faults": {"brake_lost": {"faults": [{"fault": "drop", "message": "brake_pressure_cmd"}]}},
}


def written(folder: Path, changes: dict[str, Any]) -> Path:
    path = folder / "campaign.yaml"
    path.write_text(yaml.safe_dump(CONTENT | changes))
    return path


def loaded(folder: Path, changes: dict[str, Any]) -> Campaign:
    return load_campaign(written(folder, changes))


def test_grids_are_joined_and_the_longest_watch_counts(tmp_path: Path) -> None:
    grids = [*CONTENT["onsets"], {"from_s": 1.5, "to_s": 1.5, "every_ms": 10, "watch_s": 4.0}]
    campaign = loaded(tmp_path, {"onsets": grids})
    assert campaign.onsets_us == {1_000_000: 0, 1_500_000: 4_000_000, 2_000_000: 0, 3_000_000: 0}
    assert list(campaign.onsets_us) == sorted(campaign.onsets_us)
    assert campaign.count == 4
    assert [run_id(campaign.faults[0], onset_us) for onset_us in campaign.onsets_us][1] == "brake_lost@1500"
    assert campaign.find("brake_lost@1500") == (campaign.faults[0], 1_500_000)


FAULT = CONTENT["faults"]["brake_lost"]


@pytest.mark.parametrize(
    ("changes", "key", "words"),
    [
        ({"onsets": []}, "onsets", "at least one"),
        ({"onsets": [{"from_s": 2.0, "to_s": 1.0, "every_ms": 10}]}, "onsets[0].to_s", "at least from_s"),
        ({"onsets": [{"from_s": 2.0, "to_s": 41.0, "every_ms": 10}]}, "onsets[0].to_s", "the drive ends at 40 s"),
        ({"onsets": [{"from_s": 2.005, "to_s": 3.0, "every_ms": 10}]}, "onsets[0].from_s", "whole ticks"),
        ({"onsets": [{"from_s": 2.0, "to_s": 3.0, "every_ms": 15}]}, "onsets[0].every_ms", "whole ticks"),
        ({"scenario": "nowhere.yaml"}, "scenario", "no such file"),
        ({"every_ms": 3}, "every_ms", "unknown key"),
        ({"faults": {}}, "faults", "there must be faults"),
        ({"faults": {"a": {"faults": [{"fault": "melt"}]}}}, "faults.a.faults[0].fault", "allowed are"),
        ({"faults": {"a": {"faults": [{"fault": "drop", "message": "nothing"}]}}}, "faults.a.faults[0]", "no message"),
        (
            {"faults": {"a": {"faults": [{"fault": "drop", "message": "ct_report", "when": {"time_s": 1.0}}]}}},
            "faults.a.faults[0].when",
            "the campaign has the onsets",
        ),
        ({"faults": {"a": FAULT | {"excused": {"SAFE-99": "why"}}}}, "faults.a.excused.SAFE-99", "allowed are SAFE-1,"),
        ({"faults": {"a": FAULT | {"excused": {"SAFE-1": ""}}}}, "faults.a.excused.SAFE-1", "must be a text"),
        ({"provocations": {"file": "none.yaml"}}, "provocations.file", "no such file"),
        (
            {"provocations": {"file": str(FOLDER / "provocations.yaml"), "excused": {"ssm.nothing": {"SAFE-1": "x"}}}},
            "provocations.excused.ssm.nothing",
            "none of provocations.yaml",
        ),
        (
            {"provocations": {"file": str(FOLDER / "provocations.yaml")}, "faults": {"ssm.sd_failure": FAULT}},
            "faults.ssm.sd_failure",
            "another name",
        ),
    ],
)
def test_a_file_that_is_wrong(tmp_path: Path, changes: dict[str, Any], key: str, words: str) -> None:
    path = written(tmp_path, changes)
    with pytest.raises(ConfigurationError) as caught:
        load_campaign(path)
    assert (caught.value.file, caught.value.key) == (str(path), key)
    assert words in caught.value.problem
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("run", ["brake_lost@1250", "brake_lost", "other@1000", "brake_lost@-1"])
def test_a_run_that_is_none(tmp_path: Path, run: str) -> None:
    with pytest.raises(ConfigurationError, match="a run is FAULT@ONSET_MS"):
        loaded(tmp_path, {}).find(run)


def test_the_shipped_campaign_is_large_and_has_every_fault_of_the_tables() -> None:
    campaign = load_campaign(FOLDER / "single_faults.yaml")
    assert campaign.count >= 30_000
    names = {fault.name for fault in campaign.faults}
    provocations = load_provocations(FOLDER / "provocations.yaml", database)
    rows = {f"{layer}.{name}": one for layer in LAYERS for name, one in provocations[layer].items() if one.plans}
    of_perception = {name for name, one in rows.items() if one.perception}
    possible = rows.keys() - of_perception
    assert possible <= names
    assert not of_perception & names, "the car drives alone"
    assert {f"ssm.{fault.name}" for fault in own_faults()} <= names | of_perception
    assert len(names - possible) >= 60
    kinds = {plan.fault.kind for fault in campaign.faults for plan in fault.plans}
    assert len(kinds) > 25


def test_the_fingerprint_is_that_of_all_that_the_results_follow_from(tmp_path: Path) -> None:
    first = loaded(tmp_path, {}).fingerprint()
    assert loaded(tmp_path, {}).fingerprint() == first
    assert loaded(tmp_path, {"watch_s": 0.6}).fingerprint() != first
    sources = {path.name for path in loaded(tmp_path, {}).inputs()}
    assert {"campaign.yaml", "short_drive.yaml", "lvms.yaml", "av21.yaml", "solo.yaml"} <= sources
    assert {"bench.py", "partition.py", "raptor.dbc", "faults.yaml"} <= sources
    assert any(name.startswith("_native") and name.endswith(".so") for name in sources)
    operation = tmp_path / "solo.yaml"
    operation.write_text((scenarios.DIRECTORY / "operations" / "solo.yaml").read_text())
    scenario = yaml.safe_load((scenarios.DIRECTORY / "short_drive.yaml").read_text())
    for key in ("track", "vehicle"):
        scenario[key] = str(scenarios.DIRECTORY / scenario[key])
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(scenario | {"operation": "solo.yaml"}))
    before = loaded(tmp_path, {"scenario": "mine.yaml"}).fingerprint()
    operation.write_text(operation.read_text() + "\n# changed\n")
    assert loaded(tmp_path, {"scenario": "mine.yaml"}).fingerprint() != before
