"""Space Drive: what a request must be, and the emergency brake when requests stop or fail their check."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from actuator_ecus import BRAKE_STOP, DEG, FULL_BRAKE, STEERED_BRAKE, TICK_US, Requests, SpaceDrive, message_frame

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import Bus, Flag, iterate

STEER = lib.SPACE_DRIVE_EMERGENCY_STEER_REQUESTS
BRAKE = lib.SPACE_DRIVE_EMERGENCY_BRAKE_REQUESTS


def changed(frame: bytes, **fields: object) -> bytes:
    return next(iterate(frame))._replace(**fields).pack()  # type: ignore[arg-type]


def corrupted(frame: bytes, bit: int) -> bytes:
    data = bytearray(next(iterate(frame)).data)
    data[bit // 8] ^= 1 << (bit % 8)
    return changed(frame, data=bytes(data))


def driving(steer: float = 0.2, brake: float = 1.0e6) -> tuple[SpaceDrive, Requests]:
    drive, requests = SpaceDrive(), Requests(steer, brake)
    for _ in range(20):
        drive.tick(requests.frames())
    assert drive.c.emergency == 0
    assert drive.drive.brake_pressure_demand == pytest.approx(brake, abs=200)
    return drive, requests


def test_full_brake_from_the_first_tick_without_requests() -> None:
    drive = SpaceDrive()
    assert drive.c.brake_demand == FULL_BRAKE, "in force before anything ran"
    drive.sense(0.4, 0.0)
    drive.follow = False
    for _ in range(100):
        sent = drive.tick()
        assert drive.drive.brake_pressure_demand == FULL_BRAKE
        assert drive.drive.steer_motor_demand == pytest.approx(0.4), "the wheels stay where they are"
    assert drive.c.emergency == 0, "nobody was lost yet"
    assert sent.of("stat_brk_1") == [] or sent.value("stat_brk_1", "strt_initial") == 1


def test_a_zeroed_space_drive_brakes_whatever_it_is_told() -> None:
    drive, requests = SpaceDrive(), Requests()
    ffi.buffer(drive.c)[:] = bytes(ffi.sizeof("space_drive"))
    drive.follow = False
    for counts in (0, 1, 0x2000, 0x4000, 0xFFFF):
        requests.counter += 1
        drive.tick([requests.steer_frame(counts), requests.brake_frame(counts)])
        assert drive.drive.brake_pressure_demand == FULL_BRAKE
        assert drive.drive.steer_motor_demand == 0.0


@pytest.mark.parametrize("axis", ["steer", "brake"])
def test_requests_for_one_axis_alone_release_nothing(axis: str) -> None:
    drive, requests = SpaceDrive(), Requests(0.2, 0.0)
    for _ in range(100):
        frames = requests.frames()
        drive.tick([frames[0 if axis == "steer" else 1]])
        assert drive.drive.brake_pressure_demand == FULL_BRAKE


BadFrame = Callable[[bytes], bytes]

BAD_FRAMES: dict[str, BadFrame] = {
    "bit flipped in the position": lambda frame: corrupted(frame, 3),
    "bit flipped in the counter": lambda frame: corrupted(frame, 41),
    "bit flipped in the CRC": lambda frame: corrupted(frame, 63),
    "short": lambda frame: changed(frame, dlc=7),
    "empty": lambda frame: changed(frame, dlc=0, data=bytes(8)),
    "remote": lambda frame: changed(frame, flags=Flag.REMOTE),
    "all zero": lambda frame: changed(frame, data=bytes(8)),
}


@pytest.mark.parametrize("axis", ["steer", "brake"])
@pytest.mark.parametrize("name", BAD_FRAMES)
def test_three_bad_requests_in_a_row_are_an_emergency(axis: str, name: str) -> None:
    drive, requests = driving()
    place = 0 if axis == "steer" else 1
    for number in range(1, 4):
        frames = requests.frames()
        frames[place] = BAD_FRAMES[name](frames[place])
        drive.tick(frames)
        assert drive.c.emergency == ((STEER if axis == "steer" else BRAKE) if number == 3 else 0)
    assert drive.drive.brake_pressure_demand == (FULL_BRAKE if axis == "steer" else STEERED_BRAKE)
    assert drive.drive.steer_motor_demand == pytest.approx(0.2, abs=2.6e-4)


@pytest.mark.parametrize(
    ("axis", "counts"),
    [("steer", 0x8001), ("steer", 0xFFFE), ("steer", 0xFFFF), ("brake", 0x4001), ("brake", 0x8000), ("brake", 0xFFFF)],
)
def test_a_position_that_is_not_valid_is_never_followed(axis: str, counts: int) -> None:
    drive, requests = driving()
    for number in range(1, 4):
        frames = requests.frames()
        if axis == "steer":
            frames[0] = requests.steer_frame(counts)
        else:
            frames[1] = requests.brake_frame(counts)
        drive.tick(frames)
        if number < 3:
            assert drive.drive.brake_pressure_demand == pytest.approx(1.0e6, abs=200)
        assert drive.drive.steer_motor_demand == pytest.approx(0.2, abs=2.6e-4)
    assert drive.c.emergency == (STEER if axis == "steer" else BRAKE)


@pytest.mark.parametrize("counts", [0, 1, 0x3FFF, 0x4000])
def test_every_end_of_the_brake_range_is_followed(counts: int) -> None:
    drive, requests = driving()
    for _ in range(3):
        requests.counter += 1
        drive.tick([requests.steer_frame(), requests.brake_frame(counts)])
    assert drive.drive.brake_pressure_demand == pytest.approx((1 - counts / 0x4000) * BRAKE_STOP, abs=1)
    assert drive.c.emergency == 0


def test_a_stuck_counter_is_an_emergency_though_frames_arrive() -> None:
    drive, requests = driving()
    frames = requests.frames()
    ticks = 0
    while drive.c.emergency == 0:
        drive.tick(frames)
        ticks += 1
        assert ticks < 10
    assert ticks == 4, "the first one is new, three repeat it"
    assert drive.c.emergency == STEER | BRAKE


@pytest.mark.parametrize(("axis", "cause"), [("steer", STEER), ("brake", BRAKE)])
def test_silence_on_one_axis_is_an_emergency_after_the_time_out(axis: str, cause: int) -> None:
    drive, requests = driving()
    keep = 1 if axis == "steer" else 0
    silent_us = 0
    while drive.c.emergency == 0:
        silent_us += TICK_US
        drive.tick([requests.frames()[keep]])
        assert silent_us < 200_000
    assert silent_us == 60_000, "the first tick at which more than 50 ms have passed"
    assert drive.c.emergency == cause
    assert drive.drive.brake_pressure_demand == (FULL_BRAKE if axis == "steer" else STEERED_BRAKE)


def test_the_emergency_brake_stays_but_the_steering_follows_valid_requests() -> None:
    drive, requests = driving()
    for _ in range(10):
        drive.tick()
    assert drive.c.emergency == STEER | BRAKE
    assert drive.drive.steer_motor_demand == pytest.approx(0.2, abs=2.6e-4)
    requests.steer, requests.brake = -0.3, 0.0
    for _ in range(500):
        drive.tick(requests.frames())
        assert drive.drive.brake_pressure_demand == FULL_BRAKE
    assert drive.drive.steer_motor_demand == pytest.approx(-0.3, abs=2.6e-4)
    lib.space_drive_init(drive.c, ffi.NULL)
    for _ in range(3):
        drive.tick(requests.frames())
    assert drive.drive.brake_pressure_demand == pytest.approx(0.0, abs=200), "a restart does clear it"


def receive(request: Any, frame: bytes, bad_limit: int = 3) -> None:
    pointer = ffi.new("can_frame *")
    ffi.buffer(pointer)[:] = frame
    lib.space_drive_request_receive(request, pointer, 0x4000, bad_limit, 7)


def test_any_number_of_bad_requests_is_too_many() -> None:
    request = ffi.new("space_drive_request *", {"state": lib.SPACE_DRIVE_REQUEST_FRESH})
    limit = 0xFFFF
    for bad in range(1, limit + 3):
        receive(request, bytes(24), limit)
        assert request.bad_in_row == min(bad, limit)
        assert (request.state == lib.SPACE_DRIVE_REQUEST_LOST) == (bad >= limit)


def test_only_the_steering_request_carries_the_speed() -> None:
    """What a brake request has at its place is none."""
    frame = changed(message_frame("req_brake_pos", 1), data=bytes([1, 2, 3, 4, 0, 0, 0, 0]))
    brake, steer = ffi.new("space_drive_request *"), ffi.new("space_drive_request *")
    receive(brake, database.message("req_brake_pos").finish(frame, 1))
    receive(steer, message_frame("req_steer_pos", 1, cntrl_pos=0x0201, veh_speed=0x0403))
    assert (brake.state, brake.counts, brake.speed_kmh) == (lib.SPACE_DRIVE_REQUEST_FRESH, 0x0201, 0)
    assert (steer.state, steer.counts, steer.speed_kmh) == (lib.SPACE_DRIVE_REQUEST_FRESH, 0x0201, 0x0403)


def test_lost_single_frames_are_ridden_through() -> None:
    drive, requests = driving()
    for number in range(300):
        frames = requests.frames()
        drive.tick(frames if number % 3 == 0 else [])
    assert drive.c.emergency == 0
    assert drive.drive.brake_pressure_demand == pytest.approx(1.0e6, abs=200)


def test_two_bad_frames_between_good_ones_are_no_emergency() -> None:
    drive, requests = driving()
    for number in range(300):
        frames = requests.frames()
        drive.tick([corrupted(f, 5) for f in frames] if number % 3 else frames)
    assert drive.c.emergency == 0


@pytest.mark.parametrize(
    "foreign",
    [
        {"bus": Bus.CAN1},
        {"flags": Flag.EXTENDED},
        {"flags": Flag.ERROR},
        {"id": 0x22},
        {"id": 0x7FF},
    ],
    ids=["other bus", "extended id", "error frame", "unknown id", "highest id"],
)
def test_foreign_frames_neither_move_nor_disturb(foreign: dict[str, int]) -> None:
    drive, requests = driving()
    for _ in range(20):
        intruder = changed(message_frame("req_brake_pos", requests.counter + 1, contrl_pos_brk=0), **foreign)
        drive.tick([*requests.frames(), *[intruder] * 4])
    assert drive.c.emergency == 0
    assert drive.drive.brake_pressure_demand == pytest.approx(1.0e6, abs=200)


@pytest.mark.parametrize(
    ("speed", "shutdown", "shutdown_2", "dlc", "honoured"),
    [(0, 1, 1, 8, True), (1, 1, 1, 8, False), (0, 1, 0, 8, False), (0, 0, 1, 8, False), (0, 255, 255, 8, False),
     (0, 1, 1, 7, False)],
)  # fmt: skip
def test_shutdown_holds_the_brake_at_standstill_only(
    speed: int, shutdown: int, shutdown_2: int, dlc: int, honoured: bool
) -> None:
    drive, requests = driving()
    requests.speed_kmh = speed
    order = changed(message_frame("Shutdown_seq", 0, shutdown=shutdown, shutdown_2=shutdown_2), dlc=dlc)
    drive.tick(requests.frames())
    drive.tick([*requests.frames(), order])
    assert bool(drive.c.shutdown) is honoured
    assert drive.drive.brake_pressure_demand == pytest.approx(FULL_BRAKE if honoured else 1.0e6, abs=200)
    for _ in range(20):
        drive.tick()
    assert drive.drive.brake_pressure_demand == FULL_BRAKE
    assert drive.c.emergency == (0 if honoured else STEER | BRAKE)


@pytest.mark.parametrize("channel", range(3))
def test_one_channel_that_heard_of_a_moving_car_is_enough_to_refuse_a_shutdown(channel: int) -> None:
    drive, _ = driving()
    order = message_frame("Shutdown_seq", 0, shutdown=1, shutdown_2=1)
    drive.c.steer.channels[channel].request.speed_kmh = 1
    drive.tick([order])
    assert not drive.c.shutdown
    drive.c.steer.channels[channel].request.speed_kmh = 0
    drive.tick([order])
    assert drive.c.shutdown


def test_a_request_whose_crc_has_the_bytes_of_a_shutdown_is_none() -> None:
    drive = SpaceDrive()
    request = message_frame("req_brake_pos", 6, contrl_pos_brk=12280)
    assert request[-2:] == message_frame("Shutdown_seq", 0, shutdown=1, shutdown_2=1)[-2:]
    drive.tick([request])
    assert drive.c.brake.channels[0].request.state == lib.SPACE_DRIVE_REQUEST_FRESH
    assert not drive.c.shutdown


@pytest.mark.parametrize("shut_down", [False, True])
def test_one_that_is_stopped_brakes_and_calls_it_an_emergency_unless_it_was_shut_down(shut_down: bool) -> None:
    drive, requests = driving()
    if shut_down:
        drive.tick([message_frame("Shutdown_seq", 0, shutdown=1, shutdown_2=1)])
    lib.space_drive_stop(drive.c)
    drive.tick(requests.frames())
    assert drive.c.emergency == (0 if shut_down else lib.SPACE_DRIVE_EMERGENCY_STOPPING)
    assert drive.drive.brake_pressure_demand == FULL_BRAKE


def test_a_configuration_of_ones_own_is_taken() -> None:
    config = ffi.new("space_drive_config *", lib.space_drive_config_default)
    config.steer.timeout_us = config.brake.timeout_us = 90_000
    drive, requests = SpaceDrive(config), Requests()
    drive.tick(requests.frames())
    silent_us = 0
    while drive.c.emergency == 0:
        silent_us += TICK_US
        drive.tick()
        assert silent_us < 200_000
    assert silent_us == 100_000


def test_steering_range_ends_are_reached() -> None:
    for angle in (-240 * DEG, 240 * DEG):
        drive, requests = driving()
        requests.steer = angle
        for _ in range(20):
            drive.tick(requests.frames())
        assert drive.drive.steer_motor_demand == pytest.approx(angle, abs=1e-4)


def test_an_empty_frame_list_and_a_null_list_are_the_same() -> None:
    drive, _ = driving()
    lib.space_drive_tick(drive.c, drive.now_us, drive.wired, ffi.NULL, 0, drive.drive, drive.outbox.c)
    assert drive.drive.brake_pressure_demand == pytest.approx(1.0e6, abs=200)
