"""Every fault of the fault table has a way to bring it about, or a reason why there is none."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

import scenarios
from bridge.faults.provocations import (
    OPERATING_STATES,
    Duration,
    Provocation,
    Provoker,
    load_provocations,
)
from bridge.safety.monitor import properties
from dbc.codec import database
from dbc.errors import ConfigurationError
from firmware.tables import own_faults

FILE = scenarios.DIRECTORY / "campaigns" / "provocations.yaml"
FAULTS = {fault.name: fault for fault in own_faults()}
PROVOCATIONS = load_provocations(FILE, database)
ALL = [one for layer in PROVOCATIONS.values() for one in layer.values()]
PROVOKER = Provoker(scenarios.DIRECTORY / "operations" / "solo.yaml", database)
DIAGNOSTIC = database.message("diagnostic_report").signals


def test_every_fault_of_the_table_can_be_brought_about_and_no_other() -> None:
    assert list(PROVOCATIONS["ssm"]) == list(FAULTS)
    assert all(one.plans or one.reason for one in ALL)
    assert all(
        one.perception == (one.layer == "ssm" and "perception_required" in FAULTS[one.name].detection) for one in ALL
    )


@pytest.mark.parametrize("one", ALL, ids=lambda one: f"{one.layer}-{one.name}")
def test_what_a_provocation_names_is_there(one: Provocation) -> None:
    assert set(one.companions) <= set(FAULTS) - {one.name}
    assert set(one.excused) <= set(properties())
    assert set(one.diagnostic) <= set(DIAGNOSTIC)
    assert set(one.exceptions) < set(OPERATING_STATES)
    assert bool(one.reaction) == (one.layer != "ssm" and bool(one.plans))


@pytest.mark.parametrize("one", [one for one in ALL if one.plans], ids=lambda one: f"{one.layer}-{one.name}")
def test_durations_lie_on_either_side_of_the_condition(one: Provocation) -> None:
    cycles = FAULTS[one.name].debounce_cycles if one.layer == "ssm" else 1
    earliest, latest = PROVOKER.condition_us(one, 1_000_000)
    assert 1_000_000 <= earliest <= latest <= 2_000_000
    assert PROVOKER.plans(one, Duration.PERMANENT, cycles)
    at, below = PROVOKER.plans(one, Duration.AT, cycles), PROVOKER.plans(one, Duration.BELOW, cycles)
    assert at is not None
    for plan in at:
        plan.check(database)
        assert plan.for_us or plan.for_frames
    for shorter, longer in zip(below or (), at, strict=bool(below)):
        lasts = [(plan.times, plan.for_us or 0, plan.for_frames or 0) for plan in (shorter, longer)]
        assert lasts[0] < lasts[1]


#: By hand, from scenarios/operations/solo.yaml, the configurations in C and the order of the tick.
@pytest.mark.parametrize(
    ("layer", "name", "condition_ms", "below", "at"),
    [
        ("ssm", "imu_timeout", 50, 50, 60),  # last sample 10 ms before; older than 50 ms from 60 ms behind it on
        ("ssm", "gnss_a_timeout", 110, 40 + 100, 40 + 150),  # begins behind a sample, 40 ms before the next
        ("ssm", "estimation_failed", 0, 1, 2),
        ("ssm", "estimate_lost", 0, 4, 5),
        ("ssm", "misc_report_missing", 210, 20, 21),  # a tick later on the computer's side, sender and silence alike
        ("ssm", "est1_front_brake", 10, 1, 2),
        ("ssm", "race_control_lost", 920, 9, 10),
        ("ssm", "executive_late", 50, 40, 50),
        ("ssm", "lidar_frozen", 110, 2, 3),  # last scan 50 ms before; the same for 150 ms from 160 ms behind it on
        ("ssm", "radar_wrong_size", 0, 0, 1),
        ("ssm", "lidar_wrong_size", 0, 1, 2),  # for 100 ms
        ("ssm", "tracking_stalled", 240, 24, 25),
        ("ssm", "prediction_failed", 0, 1, 2),
        ("raptor", "obc_silent", 100, 100, 110),
        ("raptor", "brake_out_of_range", 20, 2, 3),
        ("raptor", "space_drive_silent", 110, 100, 110),
        ("space_drive", "brake_request_missing", 50, 5, 6),
        ("space_drive", "two_brake_channels_deviate", 50, 50, 60),
    ],
)
def test_conditions_and_durations_by_hand(layer: str, name: str, condition_ms: int, below: int, at: int) -> None:
    one = PROVOCATIONS[layer][name]
    cycles = FAULTS[name].debounce_cycles if layer == "ssm" else 1
    assert PROVOKER.condition_us(one, 0) == (condition_ms * 1000, condition_ms * 1000)
    for duration, expected in ((Duration.BELOW, below), (Duration.AT, at)):
        plans = PROVOKER.plans(one, duration, cycles) or ()
        assert [plan.for_frames or (plan.for_us or 0) // 1000 for plan in plans[:1]] == ([expected] if expected else [])


@pytest.mark.parametrize(
    ("entry", "key", "words"),
    [
        ({}, "ssm.imu_jump", "must hold either faults or reason"),
        ({"reason": "no", "faults": [{"fault": "engine_stall"}]}, "ssm.imu_jump", "must hold either"),
        ({"faults": [{"fault": "gremlin"}]}, "ssm.imu_jump.faults[0].fault", "allowed are"),
        ({"faults": [{"fault": "drop"}]}, "ssm.imu_jump.faults[0]", "needs either a message or a station"),
        ({"reason": "no", "detection": {"limit": "x"}, "colour": 1}, "ssm.imu_jump.colour", "unknown key"),
        (
            {"faults": [{"fault": "engine_stall"}], "detection": {"limit": "max_sped"}},
            "ssm.imu_jump.detection",
            "no operation parameter is called 'max_sped'",
        ),
        (
            {"faults": [{"fault": "engine_stall"}], "detection": {"limit": ["raptor.patience_ms"]}},
            "ssm.imu_jump.detection",
            "the configuration of raptor has no 'patience_ms'",
        ),
        ({"faults": [{"fault": "engine_stall"}], "except": {"flight": "no"}}, "ssm.imu_jump.except.flight", "unknown"),
    ],
)
def test_wrong_files_are_one_line(tmp_path: Path, entry: object, key: str, words: str) -> None:
    path = tmp_path / "provocations.yaml"
    path.write_text(yaml.safe_dump({"raptor": {}, "space_drive": {}, "ssm": {"imu_jump": entry}}))
    with pytest.raises(ConfigurationError) as caught:
        load_provocations(path, database)
    assert caught.value.key == key
    assert words in caught.value.problem
    assert "\n" not in str(caught.value)
