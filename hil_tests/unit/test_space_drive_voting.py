"""Space Drive: three channels per axis, outvoting, exclusion, loss of an axis."""

from __future__ import annotations

import math
import random

import pytest
from actuator_ecus import DEG, FULL_BRAKE, STEERED_BRAKE, Requests, SpaceDrive

from bridge._native import ffi, lib

NAN, INF = math.nan, math.inf
SEED = 20


def vote(values: list[float], usable: list[bool], tolerance: float) -> tuple[bool, float, list[bool]]:
    ballot = lib.voter_vote(ffi.new("float[3]", values), ffi.new("bool[3]", usable), tolerance)
    return bool(ballot.valid), float(ballot.value), [bool(flag) for flag in ballot.deviates]


def test_three_channels_give_the_median() -> None:
    generator = random.Random(SEED)
    print(f"seed {SEED}")
    for _ in range(500):
        values = [generator.uniform(-100, 100) for _ in range(3)]
        as_float = list(ffi.new("float[3]", values))
        valid, value, deviates = vote(values, [True] * 3, 5.0)
        assert valid
        assert value == sorted(as_float)[1]
        assert deviates == [abs(x - value) > 5.0 for x in as_float]


@pytest.mark.parametrize(
    ("values", "usable", "expected"),
    [
        ([1.0, 3.0, NAN], [True, True, False], (True, 2.0, [False, False, False])),
        ([NAN, 1.0, 9.0], [False, True, True], (True, 5.0, [False, True, True])),
        ([1.0, NAN, NAN], [True, False, False], (False, 0.0, [False, False, False])),
        ([NAN, NAN, NAN], [False, False, False], (False, 0.0, [False, False, False])),
        ([1.0, 1.0, 99.0], [True, True, True], (True, 1.0, [False, False, True])),
        ([0.0, 50.0, 99.0], [True, True, True], (True, 50.0, [True, False, True])),
        ([-4.0, 0.0, 4.0], [True, True, True], (True, 0.0, [False, False, False])),
        ([1.0, 5.0, NAN], [True, True, False], (True, 3.0, [False, False, False])),
    ],
)
def test_degraded_votes(values: list[float], usable: list[bool], expected: tuple[bool, float, list[bool]]) -> None:
    assert vote(values, usable, 4.0) == expected


def test_what_lies_behind_the_three_channels_has_no_vote() -> None:
    values, usable = ffi.new("float[4]", [1.0, 3.0, NAN, 99.0]), ffi.new("bool[4]", [True, True, False, True])
    ballot = lib.voter_vote(values, usable, 4.0)
    assert (ballot.valid, ballot.value) == (True, 2.0)


def driving(steer: float = 0.2, brake: float = 1.0e6) -> tuple[SpaceDrive, Requests]:
    drive, requests = SpaceDrive(), Requests(steer, brake)
    for _ in range(20):
        drive.tick(requests.frames())
    assert drive.drive.steer_motor_demand == pytest.approx(steer, abs=2.6e-4)
    assert drive.drive.brake_pressure_demand == pytest.approx(brake, abs=200)
    drive.follow = False
    return drive, requests


@pytest.mark.parametrize("channel", [0, 1, 2])
@pytest.mark.parametrize(
    ("axis", "wrong"),
    [
        ("steer", NAN),
        ("steer", INF),
        ("steer", -4.5),
        ("steer", 1.0),
        ("brake", NAN),
        ("brake", -INF),
        ("brake", 9.0e6),
        ("brake", 5.0e6),
    ],
)
def test_one_wrong_sensor_is_outvoted_and_reported(channel: int, axis: str, wrong: float) -> None:
    drive, requests = driving()
    sensors = drive.wired.steer_motor_angle if axis == "steer" else drive.wired.brake_pressure
    sensors[channel] = wrong
    sent = [drive.tick(requests.frames()) for _ in range(30)]
    assert drive.c.emergency == 0
    assert drive.drive.steer_motor_demand == pytest.approx(0.2, abs=2.6e-4)
    assert drive.drive.brake_pressure_demand == pytest.approx(1.0e6, abs=200)
    for other in range(3):
        position = sent[-1].value(f"calb_{axis}_pos_{other + 1}", "plausibity")
        assert position == (2.0 if other == channel else 0.0)
        errors = [m.of(f"act_err_{axis}_{other + 1}") for m in sent]
        newest = next(rows[-1] for rows in reversed(errors) if rows)
        expected = {f"err_srv_mtr_pos_sen_{other + 1}"} if other == channel else set()
        if other == channel and math.isfinite(wrong) and wrong in {1.0, 5.0e6}:
            expected |= {"psn_sen_srv_mtr_implausible"}
        assert {name for name, value in newest.items() if value} == expected


def test_an_invalid_sensor_sends_the_invalid_count() -> None:
    drive, requests = driving()
    drive.wired.steer_motor_angle[1] = NAN
    sent = drive.tick(requests.frames())
    assert sent.value("calb_steer_pos_2", "cur_steer_pos_steering_pos_2") == 0xFFFF
    assert sent.value("calb_steer_pos_1", "cur_steer_pos_steering_pos_1") == round(0x4000 * (1 + 0.2 / (240 * DEG)))


def test_a_short_disturbance_does_not_exclude() -> None:
    drive, requests = driving()
    drive.wired.steer_motor_angle[0] = 2.0
    for _ in range(5):
        drive.tick(requests.frames())
    drive.wired.steer_motor_angle[0] = 0.2
    drive.tick(requests.frames())
    assert not drive.c.steer.channels[0].excluded
    assert drive.c.emergency == 0


def test_an_excluded_channel_stays_out_until_restart() -> None:
    drive, requests = driving()
    drive.wired.brake_pressure[2] = 4.0e6
    for _ in range(10):
        drive.tick(requests.frames())
    drive.wired.brake_pressure[2] = 1.0e6
    for _ in range(200):
        drive.tick(requests.frames())
    assert drive.c.brake.channels[2].implausible
    assert drive.tick(requests.frames()).value("calb_brake_pos_3", "plausibity") == 2
    lib.space_drive_init(drive.c, ffi.NULL)
    assert not drive.c.brake.channels[2].excluded


@pytest.mark.parametrize("axis", ["steer", "brake"])
@pytest.mark.parametrize("wrong", [(NAN, NAN), (1.0, 3.0), (NAN, 2.0)], ids=["both dead", "both off", "one each"])
def test_two_wrong_sensors_are_an_emergency(axis: str, wrong: tuple[float, float]) -> None:
    drive, requests = driving()
    sensors = drive.wired.steer_motor_angle if axis == "steer" else drive.wired.brake_pressure
    scale = 1.0 if axis == "steer" else 2.0e6
    sensors[0], sensors[2] = wrong[0] * scale, wrong[1] * scale
    for _ in range(15):
        drive.tick(requests.frames())
    expected = lib.SPACE_DRIVE_EMERGENCY_STEER_SENSORS if axis == "steer" else lib.SPACE_DRIVE_EMERGENCY_BRAKE_SENSORS
    assert drive.c.emergency == expected
    assert drive.drive.brake_pressure_demand == (FULL_BRAKE if axis == "steer" else STEERED_BRAKE)
    assert drive.drive.steer_motor_demand == pytest.approx(0.2, abs=2.6e-4)


def test_of_two_channels_left_a_disagreement_is_an_emergency() -> None:
    drive, requests = driving()
    drive.wired.steer_motor_angle[0] = NAN
    for _ in range(10):
        drive.tick(requests.frames())
    assert drive.c.emergency == 0
    drive.wired.steer_motor_angle[1] = 0.2 + 6 * DEG
    for _ in range(10):
        drive.tick(requests.frames())
    assert drive.c.emergency == lib.SPACE_DRIVE_EMERGENCY_STEER_SENSORS


def deafen(drive: SpaceDrive, requests: Requests, channels: tuple[int, ...], ticks: int = 30) -> None:
    """Tick while these channels' steering receivers take every request for a repeated one."""
    for _ in range(ticks):
        for channel in channels:
            drive.c.steer.channels[channel].request.rx.counter = (requests.counter + 1) % 256
        drive.tick(requests.frames())


def test_a_channel_that_lost_its_receiver_does_not_pull_the_others() -> None:
    drive, requests = driving(steer=0.1)
    drive.follow = True
    requests.steer = 0.3
    deafen(drive, requests, (0,))
    assert drive.c.emergency == 0
    assert drive.drive.steer_motor_demand == pytest.approx(0.3, abs=2.6e-4)


def test_two_channels_that_lost_their_receivers_are_an_emergency() -> None:
    drive, requests = driving()
    deafen(drive, requests, (0, 2))
    assert drive.c.emergency == lib.SPACE_DRIVE_EMERGENCY_STEER_REQUESTS
    assert drive.drive.brake_pressure_demand == FULL_BRAKE


def test_of_two_channels_left_one_that_lost_its_receiver_is_an_emergency() -> None:
    drive, requests = driving()
    drive.wired.steer_motor_angle[1] = NAN
    for _ in range(10):
        drive.tick(requests.frames())
    assert drive.c.emergency == 0
    deafen(drive, requests, (0,))
    assert drive.c.emergency == lib.SPACE_DRIVE_EMERGENCY_STEER_REQUESTS


def test_the_lead_over_the_own_sensor_is_bounded() -> None:
    drive, requests = driving(steer=0.0)
    requests.steer = 200 * DEG
    drive.tick(requests.frames())
    assert drive.drive.steer_motor_demand == pytest.approx(60 * DEG, abs=1e-4)


@pytest.mark.parametrize(
    ("position", "counts"),
    [(-240 * DEG, 0), (0.0, 0x4000), (240 * DEG, 0x8000), (-9.0, 0), (9.0, 0x8000), (60 * DEG, 0x5000)],
)
def test_steering_counts(position: float, counts: int) -> None:
    config = ffi.addressof(lib.space_drive_config_default, "steer")
    assert lib.space_drive_axis_counts(config, position) == counts


@pytest.mark.parametrize(("pressure", "counts"), [(0.0, 0x4000), (6.0e6, 0), (3.0e6, 0x2000), (-1.0e5, 0x4000)])
def test_brake_counts(pressure: float, counts: int) -> None:
    config = ffi.addressof(lib.space_drive_config_default, "brake")
    assert lib.space_drive_axis_counts(config, pressure) == counts
