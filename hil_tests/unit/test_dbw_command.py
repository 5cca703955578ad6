"""Drive-by-wire gate and encoding: what may leave, and what stands on the wire."""

from __future__ import annotations

import math
import random
from typing import Any

import cantools.database
import pytest
from obc_harness import Outbox

from bridge._native import ffi, lib
from dbc.frames import Bus, Frame, iterate
from dbc.network import DIRECTORY

CAN1 = cantools.database.load_file(DIRECTORY / "raptor.dbc")
NOT_FINITE = [math.nan, math.inf, -math.inf]
LIMITS = {
    "full_brake_pressure": 6.0e6,
    "steered_brake_pressure": 3.5e6,
    "holding_brake_pressure": 2.0e6,
    "steering_limit": 0.26,
    "steering_slew": 100.0,
    "steering_ratio": 15.0,
    "throttle_limit": 0.9,
    "traction_aim": 3,
    "traction_range": 4,
}


class Dbw:
    """The gate with a demand that drives, and what it sent, decoded by cantools."""

    def __init__(self, capacity: int = 64, **limits: float) -> None:
        self.c = ffi.new("dbw_command *")
        self.limits = ffi.new("dbw_limits *", LIMITS | limits)
        self.outbox = Outbox(capacity)
        self.violations = 0
        self.frames: list[Frame] = []

    def step(self, **demand: Any) -> dict[str, dict[str, float]]:
        values = {"mode": lib.DBW_DRIVE, "steer": True} | demand
        self.violations = lib.dbw_command_step(self.c, ffi.new("dbw_demand *", values), self.limits, self.outbox.c)
        return self.take()

    def take(self) -> dict[str, dict[str, float]]:
        self.frames = list(iterate(self.outbox.take()))
        found = {}
        for frame in self.frames:
            message = CAN1.get_message_by_frame_id(frame.id)
            assert (frame.bus, frame.flags) == (Bus.CAN1, 0)
            assert frame.dlc == message.length
            found[message.name] = message.decode(frame.data, decode_choices=False)
        return found


def brake(sent: dict[str, dict[str, float]]) -> float:
    return sent["brake_pressure_cmd"]["brake_pressure_cmd"]


def throttle(sent: dict[str, dict[str, float]]) -> float:
    return sent["accelerator_cmd"]["acc_pedal_cmd"]


def steering(sent: dict[str, dict[str, float]]) -> float:
    return sent["steering_cmd"]["steering_motor_ang_cmd"]


def test_messages_of_one_cycle() -> None:
    dbw = Dbw()
    sent = dbw.step(
        throttle=0.5,
        road_wheel_angle=0.1,
        gear=2,
        acceleration=(4.9, -9.80665, 0.5),
        marelli_track_flag=9,
        marelli_vehicle_flag=25,
        marelli_sector_flag=37,
    )
    assert [frame.id for frame in dbw.frames] == [1400, 1401, 1402, 1403, 1405, 1406, 1450]
    assert throttle(sent) == pytest.approx(50.0)
    assert brake(sent) == 0
    assert steering(sent) == 86.0  # 0.1 rad * 15 = 85.94 degrees, to the nearest half degree
    assert sent["gear_shift_cmd"] == {"desired_gear": 2}
    assert sent["ct_report_2"] == {
        "marelli_track_flag_ack": 9,
        "marelli_vehicle_flag_ack": 25,
        "marelli_sector_flag_ack": 37,
    }
    assert sent["dash_switches_cmd"] == {"driver_traction_aim_switch": 3, "driver_traction_range_switch": 4}
    assert sent["ct_vehicle_acc_feedback"] == {
        "long_ct_vehicle_acc_fbk": pytest.approx(0.5),
        "lat_ct_vehicle_acc_fbk": pytest.approx(-1.0),
        "vertical_ct_vehicle_acc_fbk": pytest.approx(0.05),
    }
    assert dbw.violations == 0


def test_counters_run_over_all_eight_bits() -> None:
    dbw = Dbw()
    for cycle in range(600):
        sent = dbw.step()
        for name, signal in (
            ("brake_pressure_cmd", "brk_pressure_cmd_counter"),
            ("accelerator_cmd", "acc_pedal_cmd_counter"),
            ("steering_cmd", "steering_motor_cmd_counter"),
        ):
            assert sent[name][signal] == cycle % 256


def test_ct_report_counter_and_acknowledgements() -> None:
    dbw = Dbw()
    for cycle in range(300):
        report = ffi.new("dbw_ct_report *", {"ct_state": 9, "track_flag": 4, "vehicle_flag": 8, "vehicle_number": 5})
        lib.dbw_command_ct_report(dbw.c, report, dbw.outbox.c)
        assert dbw.take()["ct_report"] == {
            "veh_sig_ack": 8,
            "track_cond_ack": 4,
            "ct_state": 9,
            "ct_state_rolling_counter": cycle % 256,
            "veh_num": 5,
        }


@pytest.mark.parametrize("limit", [0.0, -1.0e6, *NOT_FINITE])
def test_a_pressure_limit_that_is_none_makes_nothing_of_no_brake(limit: float) -> None:
    assert brake(Dbw(holding_brake_pressure=limit).step(mode=lib.DBW_HOLD)) == 6000
    assert brake(Dbw(full_brake_pressure=limit).step(mode=lib.DBW_FULL_BRAKE)) == 4500
    assert brake(Dbw(full_brake_pressure=limit, holding_brake_pressure=limit).step(mode=lib.DBW_HOLD)) == 4500
    steered = {"mode": lib.DBW_FULL_BRAKE, "steer": True, "wheels_follow": True}
    assert brake(Dbw(steered_brake_pressure=limit).step(**steered)) == 6000
    assert brake(Dbw(steered_brake_pressure=limit, full_brake_pressure=limit).step(**steered)) == 4500


@pytest.mark.parametrize("mode", [lib.DBW_FULL_BRAKE, 3, 255])
def test_full_brake_and_modes_that_do_not_exist(mode: int) -> None:
    sent = Dbw().step(mode=mode, throttle=1.0, brake_pressure=0.0)
    assert (brake(sent), throttle(sent)) == (6000, 0)


@pytest.mark.parametrize("mode", [lib.DBW_FULL_BRAKE, 255])
@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize("steer", [False, True])
def test_full_brake_of_wheels_that_are_steered_and_follow(mode: int, steer: bool, follow: bool) -> None:
    sent = Dbw().step(mode=mode, steer=steer, wheels_follow=follow)
    assert (brake(sent), throttle(sent)) == (3500 if steer and follow else 6000, 0)


def test_hold() -> None:
    sent = Dbw().step(mode=lib.DBW_HOLD, throttle=1.0, brake_pressure=0.0)
    assert (brake(sent), throttle(sent)) == (2000, 0)


def test_zeroed_demand_and_limits_are_a_full_brake() -> None:
    dbw = Dbw()
    dbw.limits = ffi.new("dbw_limits *")
    lib.dbw_command_step(dbw.c, ffi.new("dbw_demand *"), dbw.limits, dbw.outbox.c)
    sent = dbw.take()
    assert (brake(sent), throttle(sent), steering(sent)) == (4500, 0, 0)


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize(
    ("field", "bit"),
    [
        ("road_wheel_angle", lib.DBW_VIOLATION_STEERING),
        ("throttle", lib.DBW_VIOLATION_THROTTLE),
        ("brake_pressure", lib.DBW_VIOLATION_BRAKE),
    ],
)
def test_a_command_that_is_not_finite_brakes_and_keeps_the_wheels(field: str, bit: int, value: float) -> None:
    dbw = Dbw()
    dbw.step(road_wheel_angle=0.05, throttle=0.5)
    sent = dbw.step(**{"road_wheel_angle": 0.05, "throttle": 0.5, field: value})
    assert (brake(sent), throttle(sent)) == (6000, 0)
    assert steering(sent) == 43.0
    assert dbw.violations == bit


@pytest.mark.parametrize("value", NOT_FINITE)
def test_commands_that_are_not_followed_cannot_violate(value: float) -> None:
    dbw = Dbw()
    sent = dbw.step(mode=lib.DBW_HOLD, steer=False, road_wheel_angle=value, throttle=value, brake_pressure=value)
    assert (brake(sent), throttle(sent), steering(sent), dbw.violations) == (2000, 0, 0, 0)
    sent = dbw.step(acceleration=(value, value, value))
    assert all(math.isfinite(g) for g in sent["ct_vehicle_acc_feedback"].values())


def test_limits_clamp() -> None:
    dbw = Dbw()
    assert throttle(dbw.step(throttle=5.0)) == pytest.approx(90.0)
    assert throttle(dbw.step(throttle=-5.0)) == 0
    assert brake(dbw.step(brake_pressure=9e9)) == 6000
    assert brake(dbw.step(brake_pressure=-1.0)) == 0
    left, right = steering(dbw.step(road_wheel_angle=3.0)), steering(dbw.step(road_wheel_angle=-3.0))
    assert (left, right) == (223.5, -223.5)  # 0.26 rad * 15
    assert dbw.violations == 0


def test_steering_wider_than_the_wire() -> None:
    dbw = Dbw(steering_limit=9.0, steering_slew=1.0e4)
    assert steering(dbw.step(road_wheel_angle=9.0)) == 511.5
    assert steering(dbw.step(road_wheel_angle=-9.0)) == -512.0


def test_slew_rate_and_hold() -> None:
    dbw = Dbw(steering_slew=0.5)
    angles = [steering(dbw.step(road_wheel_angle=0.26)) for _ in range(3)]
    assert angles == [round(2 * math.degrees(0.005 * n * 15)) / 2 for n in (1, 2, 3)]
    assert [steering(dbw.step(steer=False, road_wheel_angle=-0.2)) for _ in range(5)] == [angles[-1]] * 5
    assert steering(dbw.step(road_wheel_angle=-0.26)) == angles[1]


@pytest.mark.parametrize("found", [0.1, -0.1])
def test_wheels_are_taken_over_where_they_are_found(found: float) -> None:
    dbw = Dbw(steering_slew=0.6)
    there = pytest.approx(math.degrees(found * 15), abs=0.25)
    assert steering(dbw.step(steer=False, wheels_found=found)) == 0  # not known
    assert steering(dbw.step(steer=False, wheels_found=math.nan, wheels_known=True)) == 0
    assert steering(dbw.step(steer=False, wheels_found=found, wheels_known=True)) == there
    # Once only: from then on the command leads and the wheels follow.
    assert steering(dbw.step(steer=False, wheels_found=0.2, wheels_known=True)) == there
    followed = steering(dbw.step(road_wheel_angle=0.0, wheels_found=0.2, wheels_known=True))
    assert abs(followed) == pytest.approx(math.degrees((0.1 - 0.006) * 15), abs=0.25)


def test_wheels_beyond_the_limit_are_taken_over_at_the_limit() -> None:
    assert steering(Dbw().step(steer=False, wheels_found=0.3, wheels_known=True)) == pytest.approx(223.5, abs=0.25)


def test_rounding_to_the_nearest_step() -> None:
    seed = 20261
    print(f"seed {seed}")
    source = random.Random(seed)
    dbw = Dbw()
    for _ in range(500):
        angle, pressure = source.uniform(-0.26, 0.26), source.uniform(1.0e3, 6.0e6)
        sent = dbw.step(road_wheel_angle=angle, brake_pressure=pressure)
        assert abs(steering(sent) - math.degrees(angle * 15.0)) <= 0.25 + 1e-4
        assert abs(brake(sent) - pressure / 1000.0) <= 0.5 + 1e-3
        sent = dbw.step(throttle=(wish := source.uniform(0.0, 0.9)))
        assert abs(throttle(sent) - 100.0 * wish) <= 0.005 + 1e-4


def test_throttle_and_brake_never_together() -> None:
    seed = 20262
    print(f"seed {seed}")
    source = random.Random(seed)
    dbw = Dbw()
    pool = [*NOT_FINITE, 0.0, -0.0, 1.0, -1.0, 1e-3, 500.0, 1e6, 1e38]
    both = 0
    for _ in range(2000):
        sent = dbw.step(
            mode=source.randrange(4), throttle=source.choice(pool), brake_pressure=source.choice(pool), steer=False
        )
        assert throttle(sent) == 0 or brake(sent) == 0
        both += throttle(sent) > 0
    assert both > 0


def test_gear_on_change_and_every_100_ms() -> None:
    dbw = Dbw()
    sent_in = [cycle for cycle in range(35) if "gear_shift_cmd" in dbw.step(gear=1 if cycle < 24 else 2)]
    assert sent_in == [0, 10, 20, 24, 34]


def test_gear_follows_the_mode() -> None:
    dbw = Dbw()
    dbw.step(gear=4)
    assert dbw.c.gear == 4
    dbw.step(gear=7)
    assert dbw.c.gear == 6, "the gearbox has six"
    dbw.step(mode=lib.DBW_FULL_BRAKE, gear=1)
    assert dbw.c.gear == 6, "a car that brakes to a halt keeps its gear"
    dbw.step(mode=lib.DBW_FULL_BRAKE, gear=1, standing_still=True)
    assert dbw.c.gear == 0


@pytest.mark.parametrize("capacity", range(8))
def test_full_outbox_loses_frames_and_counts_them(capacity: int) -> None:
    dbw = Dbw(capacity)
    sent = dbw.step(gear=1)
    assert len(sent) == min(capacity, 7)
    assert dbw.outbox.c.dropped == max(7 - capacity, 0)


def test_ct_report_into_a_full_outbox() -> None:
    dbw = Dbw(0)
    lib.dbw_command_ct_report(dbw.c, ffi.new("dbw_ct_report *"), dbw.outbox.c)
    assert dbw.outbox.c.dropped == 1
