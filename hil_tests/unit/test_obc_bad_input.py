"""Wrong configurations beyond the parameter matrix: floods, late ones, empty ones, and random frames."""

from __future__ import annotations

import random

import pytest
from obc_harness import OPERATION, ObcHarness

from bridge._native import lib
from dbc.buses import car_buses
from dbc.codec import database
from dbc.frames import iterate
from firmware.parameters import load_operation
from firmware.tables import parameter_key

GOOD = dict(load_operation(OPERATION))
RESULT = database.message("parameter_result")


def results(harness: ObcHarness) -> list[tuple[int, int]]:
    decoded = [RESULT.decode(frame.data) for frame in harness.log if frame.id == RESULT.frame_id]
    return [(int(key), int(status)) for key, status, _ in decoded]


def test_an_empty_configuration_is_a_full_brake() -> None:
    harness = ObcHarness()
    harness.configure({})
    for _ in range(40):
        harness.tick()
        assert (harness.brake_kpa, harness.throttle) == (4500, 0)
    assert harness.state == lib.SSM_FULL_BRAKE
    assert harness.value("parameter_summary", "summary_missing") == len(GOOD)


def test_a_good_configuration_after_a_bad_one_comes_too_late() -> None:
    harness = ObcHarness()
    harness.configure(GOOD | {"max_speed": -1.0})
    harness.run(40)
    harness.configure()
    harness.run(300)
    assert harness.state == lib.SSM_FULL_BRAKE
    assert (harness.brake_kpa, harness.throttle) == (4500, 0)
    assert [status for _, status in results(harness)].count(lib.PARAMETER_LATE) == len(GOOD) + 1
    assert harness.ct_state == lib.CT_PWR_ON


def test_every_offence_of_a_thoroughly_bad_file_is_told_without_a_flood() -> None:
    harness = ObcHarness()
    bad = dict.fromkeys(GOOD, "text") | {f"no_such_key_{index}": index for index in range(50)}
    harness.configure(bad)
    most = 0
    for _ in range(60):
        sent = harness.tick()
        most = max(most, sum(frame.id == RESULT.frame_id for frame in iterate(sent)))
    assert most <= 5
    wanted = {(parameter_key(name), lib.PARAMETER_WRONG_TYPE) for name in GOOD}
    wanted |= {(parameter_key(f"no_such_key_{index}"), lib.PARAMETER_UNKNOWN_KEY) for index in range(50)}
    assert set(results(harness)) == wanted
    assert len(results(harness)) == len(wanted)
    assert harness.value("parameter_summary", "summary_rejected") == len(wanted)


def test_verdict_is_told_after_all_results() -> None:
    harness = ObcHarness()
    harness.configure(dict.fromkeys(GOOD, "text"))
    while True:
        harness.tick()
        assert harness.now_us < 10_000_000
        if harness.value("parameter_summary", "summary_verdict") != lib.PARAMETER_VERDICT_PENDING:
            break
    assert len(results(harness)) == len(GOOD)


def test_late_write_while_driving_is_reported_and_ignored() -> None:
    harness = ObcHarness()
    harness.drive()
    harness.log.clear()
    harness.configure({"max_speed": 5.0})
    harness.run(3)
    assert results(harness) == [(parameter_key("max_speed"), lib.PARAMETER_LATE), (0, lib.PARAMETER_LATE)]
    assert harness.state == lib.SSM_NOMINAL
    assert harness.value("ssm_status", "ssm_max_speed") == pytest.approx(GOOD["max_speed"], abs=0.03)
    assert harness.value("ssm_status", "ssm_worst_fault") == lib.FAULT_PARAMETER_WRITE_LATE


def test_random_frames_never_release_the_brake() -> None:
    seed = 20263
    print(f"seed {seed}")
    source = random.Random(seed)
    harness = ObcHarness()
    messages = [m for m in database if m.name not in ("parameter_commit",) and m.bus in car_buses()]
    for _ in range(300):
        frames = []
        for _ in range(source.randrange(40)):
            message = source.choice(messages)
            frame = next(iterate(message.frame(*(0.0 for _ in message.signals))))
            frames.append(frame._replace(dlc=source.randrange(12), data=source.randbytes(8)).pack())
        harness.tick(b"".join(frames))
        assert (harness.brake_kpa, harness.throttle) == (4500, 0)
        assert harness.state != lib.SSM_NOMINAL
