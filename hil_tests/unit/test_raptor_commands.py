"""Raptor: supervision of the onboard computer, and what becomes of its commands."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from actuator_ecus import (
    DEG,
    FULL_BRAKE,
    FULL_BRAKE_COUNTS,
    STEERED_BRAKE,
    TICK_US,
    YELLOW,
    Car,
    Computer,
    car_in,
    message_frame,
)

from bridge._native import ffi, lib
from dbc.frames import Bus, Flag, iterate

EMERGENCY = 16
OBC_LOST = lib.RAPTOR_DIAG_OBC_LOST


def driving(accelerator: float = 30.0, steer_deg: float = 12.0) -> Car:
    car = car_in(9)
    car.computer.brake_kpa, car.computer.accelerator, car.computer.steer_deg = 0.0, accelerator, steer_deg
    car.set_wheels(20.0)
    car.wired.engine_speed = 400.0
    car.run(5)
    assert car.state == 9
    assert car.drive.throttle_demand == pytest.approx(accelerator / 100)
    return car


def stopped(car: Car, brake: float = STEERED_BRAKE) -> None:
    """The reaction: full brake, no throttle, no engine, and it stays."""
    assert car.state == EMERGENCY
    assert car.c.demand.brake == brake
    assert car.space_drive.drive.brake_pressure_demand == pytest.approx(brake, abs=200)
    assert (car.drive.throttle_demand, car.drive.ignition, car.drive.starter) == (0.0, False, False)


def ticks_to_emergency(car: Car, limit: int = 200) -> int:
    for ticks in range(1, limit):
        car.tick()
        if car.state == EMERGENCY:
            return ticks
    raise AssertionError("no emergency")


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("brake_pressure_cmd", lib.RAPTOR_COMMAND_BRAKE_TIMEOUT),
        ("accelerator_cmd", lib.RAPTOR_COMMAND_THROTTLE_TIMEOUT),
        ("steering_cmd", lib.RAPTOR_COMMAND_STEERING_TIMEOUT),
    ],
)
@pytest.mark.parametrize("kind", ["silent", "stuck"])
def test_a_command_that_stops_or_sticks(name: str, fault: int, kind: str) -> None:
    car = driving()
    getattr(car.computer, kind).add(name)
    ticks = ticks_to_emergency(car)
    # A sticking frame repeats the newest counter from its second tick on.
    assert ticks * TICK_US == 110_000 + (TICK_US if kind == "stuck" else 0)
    stuck = lib.RAPTOR_COMMAND_COUNTER_STUCK if kind == "stuck" else 0
    assert car.c.commands.faults == fault | stuck
    stopped(car, FULL_BRAKE if name == "steering_cmd" else STEERED_BRAKE)
    assert car.diagnostic_bits & OBC_LOST
    getattr(car.computer, kind).clear()
    car.run(300)
    stopped(car)
    assert car.diagnostic_bits & OBC_LOST, "the cause can still be read"


@pytest.mark.parametrize("kind", ["silent", "stuck"])
def test_a_ct_report_that_stops_or_sticks(kind: str) -> None:
    car = driving()
    getattr(car.computer, kind).add("ct_report")
    assert 160_000 < ticks_to_emergency(car) * TICK_US <= 260_000
    assert car.c.commands.faults & lib.RAPTOR_COMMAND_CT_REPORT_TIMEOUT
    stopped(car)


def test_the_time_out_is_configurable() -> None:
    config = ffi.new("raptor_config *", lib.raptor_config_default)
    config.command_timeout_ms = 40
    car = car_in(9, config)
    car.computer.silent.add("steering_cmd")
    assert ticks_to_emergency(car) * TICK_US == 50_000


def test_before_the_first_command_full_brake_and_nothing_else() -> None:
    car = Car()
    car.computer.silent = {"brake_pressure_cmd", "accelerator_cmd", "steering_cmd", "ct_report"}
    car.wired.safety_switch = 4
    for _ in range(300):
        sent = car.tick()
        assert car.c.demand.brake == FULL_BRAKE
        assert sent.value("req_brake_pos", "contrl_pos_brk") == FULL_BRAKE_COUNTS
        assert (car.drive.throttle_demand, car.drive.ignition, car.drive.starter) == (0.0, False, False)
    assert car.state == 2
    assert car.diagnostic_bits & OBC_LOST
    assert sent.value("diagnostic_report", "adlink_hb_lost") == 1


@pytest.mark.parametrize("missing", ["brake_pressure_cmd", "accelerator_cmd", "steering_cmd", "ct_report"])
def test_every_command_is_needed_for_the_actuation_test(missing: str) -> None:
    car = Car()
    car.computer.silent = {missing}
    car.wired.safety_switch = 4
    car.run(300)
    assert car.state == 2
    car.computer.silent.clear()
    car.run_until(3, 10)


def send_raw(car: Car, name: str, **values: float) -> None:
    """Replace one of the computer's frames by one with these values for a tick."""
    car.computer.silent.add(name)
    counter = car.computer.counters.get(name, 0)
    car.computer.counters[name] = counter + 1
    car.tick([message_frame(name, counter, **values)])
    car.computer.silent.discard(name)


IMPLAUSIBLE: list[tuple[str, str, float]] = [
    ("brake_pressure_cmd", "brake_pressure_cmd", 6001),
    ("brake_pressure_cmd", "brake_pressure_cmd", 8191),
    ("accelerator_cmd", "acc_pedal_cmd", -0.01),
    ("accelerator_cmd", "acc_pedal_cmd", -327.68),
    ("accelerator_cmd", "acc_pedal_cmd", 100.01),
    ("accelerator_cmd", "acc_pedal_cmd", 327.67),
    ("steering_cmd", "steering_motor_ang_cmd", 240.5),
    ("steering_cmd", "steering_motor_ang_cmd", -240.5),
    ("steering_cmd", "steering_motor_ang_cmd", 511.5),
    ("steering_cmd", "steering_motor_ang_cmd", -512.0),
    ("steering_cmd", "steering_motor_ang_cmd", 102.5),
    ("steering_cmd", "steering_motor_ang_cmd", -78.5),
    ("gear_shift_cmd", "desired_gear", 7),
    ("gear_shift_cmd", "desired_gear", 255),
]


@pytest.mark.parametrize(("name", "signal", "value"), IMPLAUSIBLE)
def test_implausible_values_are_never_used_and_three_in_a_row_stop_the_car(
    name: str, signal: str, value: float
) -> None:
    car = driving()
    before = (car.drive.throttle_demand, car.c.demand.steer, car.drive.gear_demand, car.c.demand.brake)
    for number in range(1, 4):
        send_raw(car, name, **{signal: value})
        if number < 3:
            after = (car.drive.throttle_demand, car.c.demand.steer, car.drive.gear_demand, car.c.demand.brake)
            assert after == before
            assert car.state == 9
    assert car.c.commands.faults & lib.RAPTOR_COMMAND_IMPLAUSIBLE
    stopped(car, FULL_BRAKE if name == "steering_cmd" else STEERED_BRAKE)
    assert car.c.demand.steer == pytest.approx(12 * DEG, abs=1e-6), "the last plausible angle is kept"
    car.computer.steer_deg = 20.0
    send_raw(car, name, **{signal: value})
    angle = 12 if name == "steering_cmd" else 20
    assert car.c.demand.steer == pytest.approx(angle * DEG, abs=1e-6), "who commands nonsense else may steer well"


@pytest.mark.parametrize(("name", "signal", "value"), IMPLAUSIBLE)
def test_two_implausible_values_between_plausible_ones_are_ridden_through(name: str, signal: str, value: float) -> None:
    car = driving()
    for _ in range(10):
        send_raw(car, name, **{signal: value})
        send_raw(car, name, **{signal: value})
        car.run(10)
    assert car.state == 9
    assert car.c.commands.faults == 0


@pytest.mark.parametrize(
    ("name", "signal", "value"),
    [
        ("brake_pressure_cmd", "brake_pressure_cmd", 6000),
        ("accelerator_cmd", "acc_pedal_cmd", 100.0),
        ("accelerator_cmd", "acc_pedal_cmd", 0.0),
        ("steering_cmd", "steering_motor_ang_cmd", 102.0),
        ("steering_cmd", "steering_motor_ang_cmd", -78.0),
    ],
)
def test_the_ends_of_the_ranges_pass(name: str, signal: str, value: float) -> None:
    car = driving()
    for _ in range(10):
        send_raw(car, name, **{signal: value})
    assert car.state == 9
    assert car.c.commands.faults == 0


def test_a_steering_step_is_no_fault_before_driving() -> None:
    car = car_in(8)
    for angle in (0.0, 200.0, -200.0, 240.0, 0.0):
        car.computer.steer_deg = angle
        car.run(3)
    assert car.state == 8
    assert car.c.demand.steer == pytest.approx(0.0, abs=1e-6), "and it moves nothing"


def test_accelerator_and_brake_together() -> None:
    car = driving(accelerator=50.0)
    car.computer.brake_kpa = 1500.0
    assert ticks_to_emergency(car) * TICK_US == 510_000
    assert car.c.commands.faults == lib.RAPTOR_COMMAND_PEDAL_CONFLICT


@pytest.mark.parametrize(("accelerator", "brake_kpa"), [(10.0, 3000.0), (100.0, 500.0), (0.0, 6000.0)])
def test_a_foot_resting_on_a_pedal_is_no_conflict(accelerator: float, brake_kpa: float) -> None:
    car = driving(accelerator)
    car.computer.brake_kpa = brake_kpa
    car.run(100)
    assert car.state == 9


@pytest.mark.parametrize("ct_state", [0, 1, 6, 13, 100, 254, 255, 65_535])
def test_a_contradicting_ct_state_while_driving_stops_the_car(ct_state: int) -> None:
    car = driving()
    car.computer.ct_state = ct_state
    assert 200_000 <= ticks_to_emergency(car) * TICK_US <= 260_000
    assert car.c.commands.faults & lib.RAPTOR_COMMAND_CT_STATE
    stopped(car)


def test_a_computer_that_is_ahead_keeps_a_restarted_raptor_from_testing() -> None:
    car = Car()
    car.computer.ct_state = 9
    car.wired.safety_switch = 4
    car.run(200)
    assert car.state == 2
    assert car.c.demand.brake == STEERED_BRAKE


def foreign(frame: bytes, **fields: object) -> bytes:
    return next(iterate(frame))._replace(**fields).pack()  # type: ignore[arg-type]


DISGUISES: dict[str, Callable[[bytes], bytes]] = {
    "other bus": lambda frame: foreign(frame, bus=Bus.CAN_A),
    "extended": lambda frame: foreign(frame, flags=Flag.EXTENDED),
    "remote": lambda frame: foreign(frame, flags=Flag.REMOTE),
    "error": lambda frame: foreign(frame, flags=Flag.ERROR),
    "short": lambda frame: foreign(frame, dlc=2),
}


@pytest.mark.parametrize("disguise", DISGUISES)
def test_frames_that_are_no_commands_do_not_feed_the_supervision(disguise: str) -> None:
    car = driving()
    car.computer.silent = {"accelerator_cmd"}
    for counter in range(15):
        frame = message_frame("accelerator_cmd", counter, acc_pedal_cmd=90.0)
        car.tick([DISGUISES[disguise](frame)])
        assert car.drive.throttle_demand <= 0.3 + 1e-6
    stopped(car)


@pytest.mark.parametrize("lost", ["accelerator_cmd", ""])
def test_the_brake_wins_over_the_throttle_at_once(lost: str) -> None:
    """A full brake whose accelerator frame is lost leaves the old throttle standing: the engine must not push on."""
    car = driving(accelerator=80.0)
    car.computer.brake_kpa = FULL_BRAKE / 1000
    car.computer.silent = {lost}
    for _ in range(8):
        car.tick()
        assert (car.state, car.c.demand.brake) == (9, FULL_BRAKE)
        assert car.drive.throttle_demand == 0.0
    car.computer.brake_kpa, car.computer.silent = 0.0, set()
    car.tick()
    assert car.drive.throttle_demand == pytest.approx(0.8), "it comes back with the brake released"


def test_throttle_passes_in_driving_only() -> None:
    for state in (1, 2, 3, 4, 5, 13, 6, 7, 8):
        car = car_in(state)
        car.computer.accelerator, car.computer.brake_kpa = 100.0, 0.0
        for _ in range(20):
            sent = car.tick()
            assert car.drive.throttle_demand == 0.0, state
            assert sent.value("accelerator_report", "acc_pedal_fdbk") == 0.0


@pytest.mark.parametrize("fault", [1 << bit for bit in range(8)])
def test_any_command_fault_closes_the_throttle_and_brakes_in_the_same_step(fault: int) -> None:
    """The demand does not wait for the state machine."""
    car = driving()
    car.c.commands.faults = fault
    inputs = ffi.new("raptor_demand_input *", {"commands": ffi.addressof(car.c.commands), "sys_state": 9})
    demand = ffi.addressof(car.c.demand)
    lib.raptor_demand_step(demand, ffi.addressof(car.c.config), inputs, car.now_us)
    steered = fault != lib.RAPTOR_COMMAND_STEERING_TIMEOUT
    assert (demand.throttle, demand.brake) == (0.0, STEERED_BRAKE if steered else FULL_BRAKE)


def test_the_brake_is_held_before_driving_and_follows_the_command_in_it() -> None:
    hold = lib.raptor_config_default.brake_hold
    for state in (1, 2, 4, 5, 6, 8):
        car = car_in(state)
        for commanded_kpa in (0.0, 1000.0, 2500.0, 6000.0):
            car.computer.brake_kpa = commanded_kpa
            car.tick()
            assert car.c.demand.brake == pytest.approx(max(hold, commanded_kpa * 1000.0)), state
    car = driving(accelerator=0.0)
    for commanded_kpa in (0.0, 1.0, 2500.0, 6000.0, 0.0):
        car.computer.brake_kpa = commanded_kpa
        car.tick()
        assert car.c.demand.brake == pytest.approx(commanded_kpa * 1000.0)
        assert car.space_drive.drive.brake_pressure_demand == pytest.approx(commanded_kpa * 1000.0, abs=200)


def test_gears_go_one_by_one_when_the_gearbox_is_ready() -> None:
    car = driving()
    car.computer.gear = 6
    changes: list[tuple[int, int]] = []
    gear = car.drive.gear_demand
    for _ in range(300):
        car.tick()
        if car.drive.gear_demand != gear:
            gear = car.drive.gear_demand
            changes.append((car.now_us, gear))
    assert [g for _, g in changes] == [1, 2, 3, 4, 5, 6]
    assert all(later - earlier >= 300_000 for (earlier, _), (later, _) in pairwise(changes))
    car.computer.gear = 4
    car.run(100)
    assert car.drive.gear_demand == 4


@pytest.mark.parametrize("status", [0, 2, 3, 4])
def test_no_gear_change_while_the_gearbox_is_not_ready(status: int) -> None:
    car = driving()
    car.wired.gear_shift_status = status
    car.computer.gear = 1
    car.run(50)
    assert car.drive.gear_demand == 0


@pytest.mark.parametrize(("waited_ticks", "gear"), [(40, 1), (51, 0)])
def test_an_old_gear_command_holds_the_gear(waited_ticks: int, gear: int) -> None:
    """The gearbox gets ready for a change that was asked for 400 or 510 ms ago."""
    car = driving()
    car.wired.gear_shift_status = 2
    car.computer.gear = 1
    car.run(10)
    while car.computer.tick % 10 != 1:
        car.tick()
    car.computer.silent.add("gear_shift_cmd")
    car.run(waited_ticks - 1)
    assert (car.state, car.drive.gear_demand) == (9, 0)
    car.wired.gear_shift_status = 1
    car.run(20)
    assert (car.state, car.drive.gear_demand) == (9, gear)


@pytest.mark.parametrize("state", [2, 4, 5, 6, 7])
def test_no_gear_before_the_engine_idles(state: int) -> None:
    car = car_in(state)
    car.starter_ticks = 1000
    car.computer.gear = 1
    car.run(60)
    assert car.drive.gear_demand == 0


def test_under_emergency_the_steering_follows_a_sane_computer_while_the_car_moves() -> None:
    car = driving()
    car.computer.ct_state = 12
    car.run(10)
    stopped(car)
    car.computer.steer_deg = 20.0
    car.run(5)
    assert car.c.demand.steer == pytest.approx(20 * DEG, abs=1e-6)
    car.set_wheels(0.0)
    car.run(2)
    car.computer.steer_deg = -60.0
    car.run(5)
    assert car.c.demand.steer == pytest.approx(20 * DEG, abs=1e-6), "at rest nothing moves any more"


def test_under_emergency_a_steering_step_is_followed_no_more_than_before_it() -> None:
    car = driving()
    car.computer.steer_deg = 102.5  # 90.5 deg in a cycle
    car.run(20)
    stopped(car, FULL_BRAKE)
    assert car.c.demand.steer == pytest.approx(12 * DEG, abs=1e-6)
    car.computer.steer_deg = 20.0
    car.run(2)
    stopped(car)
    assert car.c.demand.steer == pytest.approx(20 * DEG, abs=1e-6), "who is back at it is followed again"


def test_a_shutdown_of_a_rolling_car_leaves_it_steered() -> None:
    car = driving(accelerator=0.0)
    car.computer.ct_state = 11
    car.run(10)
    assert car.state in (10, 11)
    car.computer.steer_deg = 20.0
    car.run(2)
    assert car.c.demand.steer == pytest.approx(20 * DEG, abs=1e-6)
    car.run_until(11, 50)
    car.computer.steer_deg = -20.0
    car.run(2)
    assert car.c.demand.steer == pytest.approx(-20 * DEG, abs=1e-6)
    assert car.drive.throttle_demand == 0.0


def test_under_emergency_without_a_computer_the_steering_is_kept() -> None:
    car = driving()
    car.computer.silent = {"brake_pressure_cmd", "accelerator_cmd", "steering_cmd", "ct_report", "gear_shift_cmd"}
    car.run(100)
    stopped(car, FULL_BRAKE)
    assert car.space_drive.drive.steer_motor_demand == pytest.approx(12 * DEG, abs=3e-4)
    assert car.space_drive.c.emergency == 0, "the Raptor itself is alive"


def test_the_gear_stays_in_while_the_car_rolls_and_comes_out_at_rest() -> None:
    car = driving()
    car.computer.gear = 2
    car.run(150)
    assert car.drive.gear_demand == 2
    car.computer.ct_state = 12
    car.run(100)
    assert (car.state, car.drive.gear_demand) == (EMERGENCY, 2)
    car.set_wheels(0.0)
    car.run(100)
    assert car.drive.gear_demand == 0


def test_a_zeroed_raptor_asks_for_full_brake() -> None:
    car = Car()
    ffi.buffer(car.c)[:] = bytes(ffi.sizeof("raptor"))
    car.wired.race_control.track_flag = YELLOW
    for _ in range(50):
        sent = car.tick()
        assert sent.value("req_brake_pos", "contrl_pos_brk") == FULL_BRAKE_COUNTS
        assert (car.drive.throttle_demand, car.drive.ignition) == (0.0, False)


def test_rejected_configuration_keeps_full_brake_through_the_whole_chain() -> None:
    """The onboard computer commands a full brake for ever: the actuators hold it, also inside the actuation test."""
    car = Car()
    car.computer = Computer(brake_kpa=FULL_BRAKE / 1000, ct_state=1)
    car.wired.safety_switch = 4
    for _ in range(600):
        car.tick()
        assert car.space_drive.drive.brake_pressure_demand == FULL_BRAKE
        assert (car.drive.throttle_demand, car.drive.starter) == (0.0, False)
    assert car.state == 4
