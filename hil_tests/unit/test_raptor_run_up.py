"""Raptor and Space Drive together: the run-up, its failures, the emergency triggers, and the way back to off."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from actuator_ecus import (
    BRAKE_STOP,
    DEG,
    FULL_BRAKE,
    GREEN,
    ORANGE,
    RED,
    RUN_UP,
    STEERED_BRAKE,
    YELLOW,
    Car,
    car_in,
    message_frame,
)

from bridge._native import lib
from dbc.codec import database
from dbc.frames import FRAME_STRUCT

EMERGENCY = 16
EST1, EST2 = lib.RAPTOR_DIAG_EST1_FRONT_BRAKE, lib.RAPTOR_DIAG_EST2_REAR_BRAKE
EST3, EST4, EST6 = lib.RAPTOR_DIAG_EST3_LOW_ENGINE, lib.RAPTOR_DIAG_EST4_SD_LOST, lib.RAPTOR_DIAG_EST6_SD_EBRAKE


def fully_braked(car: Car, brake: float = STEERED_BRAKE, by_itself: float | None = None) -> bool:
    """Pressure of the Raptor's full brake, and of the Space Drive's if it brakes by itself."""
    return bool(
        car.c.demand.brake == brake
        and abs(car.space_drive.drive.brake_pressure_demand - (by_itself or brake)) < 200
        and car.drive.throttle_demand == 0.0
        and not car.drive.ignition
        and not car.drive.starter
    )


def test_the_run_up_passes_every_state_in_order() -> None:
    car = Car()
    seen = [car.state]
    for reached, ct_state, flag, switch in RUN_UP:
        car.computer.ct_state = 6 if reached == 9 else ct_state
        car.wired.race_control.track_flag, car.wired.safety_switch = flag, switch
        for tick in range(600):
            if tick == 10:
                car.computer.ct_state = ct_state
            car.tick()
            if car.state != seen[-1]:
                seen.append(car.state)
            if car.state != 9:
                assert car.drive.throttle_demand == 0.0
            if car.state in {1, 2, 3, 4, 5, 13, 6}:
                assert not car.drive.starter
                assert not car.drive.ignition
            if car.state == reached:
                break
        assert car.diagnostic_bits == 0
        assert car.c.commands.faults == 0
    assert seen == [1, 2, 3, 4, 5, 13, 6, 7, 8, 9]
    assert car.space_drive.c.emergency == 0


def test_nothing_moves_without_a_safety_switch() -> None:
    car = Car()
    car.computer.steer_deg, car.computer.accelerator, car.computer.brake_kpa = 100.0, 50.0, 0.0
    for _ in range(500):
        car.tick()
        assert car.space_drive.drive.steer_motor_demand == pytest.approx(0.0, abs=3e-4)
        assert car.c.demand.brake >= lib.raptor_config_default.brake_hold
    assert car.state == 2


def test_wheels_found_turned_are_held_until_the_test() -> None:
    car = Car()
    car.space_drive.sense(0.9, 0.0)
    for _ in range(100):
        car.tick()
        assert car.space_drive.drive.steer_motor_demand == pytest.approx(0.9, abs=3e-4)


@pytest.mark.parametrize("speed", [1.0, 60.0, -1.0, math.nan])
def test_a_rolling_car_is_not_tested(speed: float) -> None:
    """After a loss of power at speed nobody sweeps the wheels or lets the brake go."""
    car = car_in(2)
    car.computer.ct_state, car.wired.safety_switch = 2, 4
    car.set_wheels(speed)
    for _ in range(300):
        car.tick()
        assert car.state == 2
        assert car.c.demand.brake >= lib.raptor_config_default.brake_hold
    car.set_wheels(0.0)
    car.run_until(4)


def test_the_actuation_test_sweeps_both_ways_and_pulses_the_brake() -> None:
    car = car_in(3)
    steer, brake = [], []
    while car.state == 3:
        car.tick()
        steer.append(car.space_drive.drive.steer_motor_demand / DEG)
        brake.append(car.space_drive.drive.brake_pressure_demand)
    assert car.state == 4
    assert max(steer) == pytest.approx(30.0, abs=0.05)
    assert min(steer) == pytest.approx(-30.0, abs=0.05)
    assert steer[-1] == pytest.approx(0.0, abs=0.05)
    assert max(brake) >= 2.0e6
    assert min(brake[:-1]) >= 0.49e6, "the car is held throughout"
    assert brake[-1] == pytest.approx(2.0e6, abs=1e3)


def stuck_steering(car: Car) -> None:
    car.space_drive.follow = False


def blocked_right(car: Car) -> None:
    car.space_drive.follow = False
    demand = car.space_drive.drive.steer_motor_demand
    car.space_drive.sense(max(demand, -10 * DEG), car.space_drive.drive.brake_pressure_demand)


def weak_front(car: Car) -> None:
    car.lines_follow = False
    demand = car.space_drive.drive.brake_pressure_demand
    car.wired.brake_pressure_front, car.wired.brake_pressure_rear = 0.7 * demand, demand * 0.46 / 0.54


def weak_rear(car: Car) -> None:
    car.lines_follow = False
    demand = car.space_drive.drive.brake_pressure_demand
    car.wired.brake_pressure_front, car.wired.brake_pressure_rear = demand, 0.5 * demand


def rear_short_of_the_pulse(car: Car) -> None:
    """Within the tolerance of the request, but below the pressure that the pulse has to show."""
    car.lines_follow = False
    demand = car.space_drive.drive.brake_pressure_demand
    car.wired.brake_pressure_front, car.wired.brake_pressure_rear = demand, 0.78 * demand


def blind_line(car: Car) -> None:
    car.lines_follow = False
    car.wired.brake_pressure_front = math.nan


def one_dead_channel(car: Car) -> None:
    car.space_drive.wired.steer_motor_angle[1] = math.nan


@pytest.mark.parametrize(
    "disturb",
    [stuck_steering, blocked_right, weak_front, weak_rear, rear_short_of_the_pulse, blind_line, one_dead_channel],
)
def test_the_actuation_test_fails(disturb: Callable[[Car], None]) -> None:
    car = car_in(3)
    car.wired.safety_switch = 4
    for _ in range(1500):
        disturb(car)
        car.tick()
        if car.state != 3:
            break
    assert car.state == 14
    assert fully_braked(car)
    car.space_drive.follow = car.lines_follow = True
    car.computer.ct_state = 3
    car.run(300)
    assert car.state == 14, "only a power cycle clears it"


def test_the_test_starts_anew_when_the_switch_was_opened() -> None:
    car = car_in(3)
    car.run(30)
    car.wired.safety_switch = 2
    car.run(2)
    assert car.state == 2
    car.wired.safety_switch = 3
    car.run_until(4)


@pytest.mark.parametrize(
    ("name", "value"),
    [("gear", 1), ("battery_voltage", 10.0), ("battery_voltage", 17.0), ("battery_voltage", math.nan)],
)
def test_crank_checks_fail(name: str, value: float) -> None:
    car = car_in(5)
    setattr(car.wired, name, value)
    car.computer.ct_state = 4
    car.shift_ticks = 10_000
    car.run_until(15, 300)
    assert fully_braked(car)


def test_crank_checks_fail_when_the_brake_is_not_held() -> None:
    car = car_in(5)
    car.computer.ct_state = 4
    car.tick()
    car.lines_follow = False
    car.wired.brake_pressure_front, car.wired.brake_pressure_rear = 1.5e6, 1.3e6
    for _ in range(300):
        car.tick()
        assert car.state not in {6, 7}
    assert car.state in {15, EMERGENCY}


def test_an_engine_that_does_not_fire() -> None:
    car = car_in(6)
    car.starter_ticks = 10_000
    car.computer.ct_state, car.wired.race_control.track_flag = 5, ORANGE
    car.run_until(7)
    for _ in range(499):
        car.tick()
        assert (car.state, car.drive.starter) == (7, True)
    car.tick()
    assert car.state == 17
    assert fully_braked(car)


def test_the_starter_stops_as_soon_as_the_engine_runs() -> None:
    car = car_in(7)
    while not car.wired.engine_running:
        car.tick()
    car.tick()
    assert not car.drive.starter
    assert car.drive.ignition


def driving() -> Car:
    car = car_in(9)
    car.computer.brake_kpa, car.computer.accelerator = 0.0, 30.0
    car.set_wheels(30.0)
    car.run(100)
    assert car.state == 9
    assert car.diagnostic_bits == 0
    return car


def run_to_emergency(car: Car, limit: int = 300, by_itself: float | None = None) -> None:
    for _ in range(limit):
        if car.state == EMERGENCY:
            break
        car.tick()
    assert car.state == EMERGENCY
    car.run(5)
    assert fully_braked(car, by_itself=by_itself)


@pytest.mark.parametrize(
    ("front", "rear", "bits"),
    [
        (0.0, 1.0, EST1),
        (1.0, 0.0, EST2),
        (0.0, 0.0, EST1 | EST2),
        (math.nan, 1.0, EST1),
        (1.8, 1.0, EST1),
    ],
)
def test_brake_lines_out_of_spec(front: float, rear: float, bits: int) -> None:
    car = driving()
    car.computer.accelerator, car.computer.brake_kpa = 0.0, 3000.0
    car.lines_follow = False
    car.wired.brake_pressure_front, car.wired.brake_pressure_rear = 3.0e6 * front, 3.0e6 * rear * 0.46 / 0.54
    run_to_emergency(car)
    assert car.diagnostic_bits & (EST1 | EST2) == bits
    car.lines_follow = True
    car.run(300)
    assert car.diagnostic_bits & (EST1 | EST2) == bits, "the trigger stays readable"


def test_a_brake_that_drags_is_out_of_spec() -> None:
    car = driving()
    car.lines_follow = False
    car.wired.brake_pressure_front = 8.0e5
    run_to_emergency(car)
    assert car.diagnostic_bits & EST1


def test_moving_brake_commands_are_not_judged() -> None:
    """A line that is 300 ms behind a ramp is far off the command all the time, and no fault: nothing settled."""
    car = driving()
    car.computer.accelerator = 0.0
    car.lines_follow = False
    demands = [0.0] * 30
    worst = 0.0
    for tick in range(140):
        car.computer.brake_kpa = 40.0 * tick
        demands.append(car.space_drive.drive.brake_pressure_demand)
        car.wired.brake_pressure_front, car.wired.brake_pressure_rear = demands[-31], demands[-31] * 0.46 / 0.54
        car.tick()
        worst = max(worst, demands[-1] - demands[-31])
    assert worst > 1.1e6
    assert car.state == 9
    assert car.diagnostic_bits == 0


@pytest.mark.parametrize("speed", [0.0, 41.0, math.nan])
def test_a_stalling_engine(speed: float, monkeypatch: pytest.MonkeyPatch) -> None:
    car = driving()
    stimulate = car._stimulate

    def stall() -> None:
        stimulate()
        car.wired.engine_speed = speed

    monkeypatch.setattr(car, "_stimulate", stall)
    run_to_emergency(car)
    assert car.diagnostic_bits & EST3


def test_losing_the_space_drive() -> None:
    car = driving()
    car.space_drive_connected = False
    lost_after = 0
    while car.state == 9:
        sent = car.tick()
        lost_after += 1
    assert car.state == EMERGENCY
    assert lost_after <= 13, "50 ms time-out and 50 ms debounce"
    assert car.diagnostic_bits & EST4
    assert sent.value("req_brake_pos", "contrl_pos_brk") == round(0x4000 * (1.0 - STEERED_BRAKE / BRAKE_STOP))
    assert sent.value("diagnostic_report", "est4_sd_comms_loss") == 1


def test_losing_one_channel_is_a_warning_only() -> None:
    car = driving()
    car.space_drive.wired.brake_pressure[2] = math.nan

    def blind() -> None:
        car.space_drive.wired.brake_pressure[2] = math.nan

    for _ in range(100):
        blind()
        sent = car.tick()
    assert car.state == 9
    row = sent.of("diagnostic_report")[-1]
    assert {name for name, value in row.items() if value} == {"sd_system_warning", "sd_brake_warning3"}


@pytest.mark.parametrize(("family", "message"), [(0x60, "act_err_steer_1"), (0x80, "stat_steer_1")])
def test_error_or_status_frames_that_stop_are_a_warning(family: int, message: str) -> None:
    """Who no longer says whether it brakes by itself is not healthy; one that is late is."""
    car = driving()
    codec = database.message(message)
    rows = []
    for _ in range((codec.timeout_us + codec.cycle_us) // 10_000 + 2):
        car._to_raptor = [f for f in car._to_raptor if FRAME_STRUCT.unpack(f)[1] & ~7 != family]
        rows.append(car.tick().of("diagnostic_report")[-1])
    assert car.state == 9
    for row in rows[: (codec.timeout_us - codec.cycle_us) // 10_000 - 1]:
        assert not any(row.values())
    row = rows[-1]
    assert {name for name, value in row.items() if value} == {
        "sd_system_warning", *(f"sd_{axis}_warning{n}" for axis in ("brake", "steer") for n in (1, 2, 3)),
    }  # fmt: skip


def test_a_space_drive_that_never_speaks_is_reported_once_it_is_overdue() -> None:
    car = Car()
    car.space_drive_connected = False
    car.wired.safety_switch = 4
    sent = [car.tick() for _ in range(100)]
    assert sent[4].of("diagnostic_report")[-1] == dict.fromkeys(sent[4].of("diagnostic_report")[-1], 0.0)
    row = sent[-1].of("diagnostic_report")[-1]
    assert {name for name, value in row.items() if value} == {
        "sd_system_warning", "sd_system_failure", "est4_sd_comms_loss",
        *(f"sd_{axis}_warning{n}" for axis in ("brake", "steer") for n in (1, 2, 3)),
    }  # fmt: skip
    assert car.state == 2
    assert not any(m.of("req_steer_pos") for m in sent), "nobody knows where to hold the wheels"
    assert all(m.value("req_brake_pos", "contrl_pos_brk") < 0x4000 for m in sent)


def test_the_space_drives_own_emergency_brake() -> None:
    car = driving()
    car.space_drive.c.emergency = lib.SPACE_DRIVE_EMERGENCY_STEER_SENSORS
    run_to_emergency(car, by_itself=FULL_BRAKE)
    assert car.diagnostic_bits & EST6
    assert car.diagnostic_bits & lib.RAPTOR_DIAG_SD_FAILURE


def test_one_status_frame_alone_does_not_stop_the_car() -> None:
    car = driving()
    for counter in range(100):
        car.tick([message_frame("stat_brk_1", counter, emr_brk=1)] if counter % 2 else [])
    assert car.state == 9


def test_losing_race_control_is_reported_and_stops_the_relay() -> None:
    car = driving()
    car.wired.race_control.linked = False
    sent = [car.tick() for _ in range(100)]
    assert car.state == 9
    assert car.diagnostic_bits == lib.RAPTOR_DIAG_RC_LOST
    assert sum(len(m.of("base_to_car_summary")) for m in sent) == 0
    assert sum(len(m.of("marelli_report_1")) for m in sent) == 10
    marelli = next(m for m in reversed(sent) if m.of("marelli_report_1"))
    assert marelli.value("marelli_report_1", "marelli_rc_base_sync_check") == 0


@pytest.mark.parametrize("state", [2, 3, 4, 5, 6, 7, 8, 9])
def test_an_emergency_request_of_the_computer_works_in_every_state(state: int) -> None:
    car = car_in(state)
    car.computer.ct_state = 12
    run_to_emergency(car, 10)
    car.computer.ct_state = 8
    car.wired.race_control.track_flag = GREEN
    car.run(300)
    assert car.state == EMERGENCY
    assert fully_braked(car)


@pytest.mark.parametrize("state", [5, 6, 7, 8, 9])
def test_opening_the_safety_switch_stops_the_car(state: int) -> None:
    car = car_in(state)
    car.wired.safety_switch = 3
    run_to_emergency(car, 3)


def test_shutdown_at_the_end_of_a_race() -> None:
    car = driving()
    car.computer.accelerator, car.computer.brake_kpa = 0.0, 2000.0
    car.set_wheels(0.0)
    car.computer.ct_state = 11
    car.run_until(10, 10)
    assert not car.drive.ignition
    car.run_until(11, 10)
    car.run(20)
    assert car.space_drive.c.shutdown
    car.computer.silent = {"brake_pressure_cmd", "accelerator_cmd", "steering_cmd", "ct_report"}
    car.run(100)
    assert car.state == 11, "a computer that is switched off then is no emergency"
    assert fully_braked(car, FULL_BRAKE)
    assert car.space_drive.c.emergency == 0


def test_race_control_flags_alone_start_nothing() -> None:
    car = car_in(8)
    car.computer.ct_state = 6
    for flag in (RED, ORANGE, YELLOW, GREEN, 8, 15):
        car.wired.race_control.track_flag = flag
        car.run(20)
        assert car.state == 8


def test_a_run_is_reproducible_to_the_bit() -> None:
    logs = [driving().log for _ in range(2)]
    assert logs[0] == logs[1]
    assert len(logs[0]) > 3000
