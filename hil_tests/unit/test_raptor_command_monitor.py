"""Raptor: the command monitor alone, frame by frame and at the edges of what it allows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from actuator_ecus import message_frame

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import Bus, Flag, iterate

DRIVING = 9
LATE_US = 10**12

#: Receiver of each message, and a command in it.
MESSAGES: dict[str, tuple[str, dict[str, float]]] = {
    "brake_pressure_cmd": ("brake_rx", {"brake_pressure_cmd": 1000.0}),
    "accelerator_cmd": ("throttle_rx", {"acc_pedal_cmd": 30.0}),
    "steering_cmd": ("steering_rx", {"steering_motor_ang_cmd": 10.0}),
    "gear_shift_cmd": ("gear_rx", {"desired_gear": 3}),
    "ct_report": ("ct_report_rx", {"ct_state": 9}),
    "dash_switches_cmd": ("switches_rx", {"driver_traction_aim_switch": 3, "driver_traction_range_switch": 7}),
}
RECEIVERS = [receiver for receiver, _ in MESSAGES.values()]
TIMED = {
    "brake_pressure_cmd": lib.RAPTOR_COMMAND_BRAKE_TIMEOUT,
    "accelerator_cmd": lib.RAPTOR_COMMAND_THROTTLE_TIMEOUT,
    "steering_cmd": lib.RAPTOR_COMMAND_STEERING_TIMEOUT,
    "ct_report": lib.RAPTOR_COMMAND_CT_REPORT_TIMEOUT,
}
IMPLAUSIBLE: list[tuple[str, str, dict[str, float]]] = [
    ("brake_implausible", "brake_pressure_cmd", {"brake_pressure_cmd": 6001.0}),
    ("throttle_implausible", "accelerator_cmd", {"acc_pedal_cmd": -0.01}),
    ("steering_implausible", "steering_cmd", {"steering_motor_ang_cmd": 240.5}),
    ("gear_implausible", "gear_shift_cmd", {"desired_gear": 7}),
]


class Monitor:
    """A command monitor with a configuration of its own."""

    def __init__(self, **config: float) -> None:
        self.c = ffi.new("raptor_command_monitor *")
        lib.raptor_command_monitor_init(self.c)
        self.config = ffi.new("raptor_config *", lib.raptor_config_default)
        for name, value in config.items():
            setattr(self.config, name, value)
        self.counter = 0

    def receive(self, frame: bytes, now_us: int = 0, sys_state: int = DRIVING) -> None:
        pointer = ffi.new("can_frame *")
        ffi.buffer(pointer)[:] = frame
        lib.raptor_command_monitor_receive(self.c, self.config, pointer, sys_state, now_us)

    def send(self, name: str, values: dict[str, float], now_us: int = 0, sys_state: int = DRIVING) -> None:
        self.counter += 1
        self.receive(message_frame(name, self.counter, **values), now_us, sys_state)

    def step(self, now_us: int, sys_state: int = DRIVING) -> int:
        lib.raptor_command_monitor_step(self.c, self.config, sys_state, now_us)
        return int(self.c.faults)

    def received(self) -> dict[str, tuple[int, int, int]]:
        """Valid and rejected frames and the last status of each receiver."""
        rows = {name: getattr(self.c, name) for name in RECEIVERS}
        return {name: (rx.valid, rx.rejected, rx.last_status) for name, rx in rows.items()}

    def command(self) -> bytes:
        return bytes(ffi.buffer(ffi.addressof(self.c.command)))


def changed(frame: bytes, **fields: Any) -> bytes:
    return next(iterate(frame))._replace(**fields).pack()


@pytest.mark.parametrize("name", MESSAGES)
def test_a_command_is_taken_by_its_own_receiver_and_by_no_other(name: str) -> None:
    monitor = Monitor()
    receiver, values = MESSAGES[name]
    monitor.send(name, values)
    expected = dict.fromkeys(RECEIVERS, (0, 0, 0)) | {receiver: (1, 0, 0)}
    assert monitor.received() == expected
    command = monitor.c.command
    taken = {
        "brake_pressure_cmd": command.brake_pressure / 1000.0,
        "acc_pedal_cmd": round(100.0 * command.throttle, 3),
        "steering_motor_ang_cmd": round(float(np.degrees(command.steer_motor_angle)), 3),
        "desired_gear": command.gear,
        "ct_state": command.ct_state,
        "driver_traction_aim_switch": command.traction_aim,
        "driver_traction_range_switch": command.traction_range,
    }
    untouched = dict.fromkeys(taken, 0.0) | {"driver_traction_aim_switch": -1, "driver_traction_range_switch": -1}
    assert taken == untouched | values


@pytest.mark.parametrize("sys_state", range(lib.RAPTOR_SYS_COUNT))
def test_a_steering_step_is_judged_where_the_command_moves_the_wheels(sys_state: int) -> None:
    monitor = Monitor()
    monitor.send("steering_cmd", {"steering_motor_ang_cmd": 10.0}, 0, sys_state)
    monitor.send("steering_cmd", {"steering_motor_ang_cmd": 200.0}, 10_000, sys_state)
    moved = {
        lib.RAPTOR_SYS_DRIVING,
        lib.RAPTOR_SYS_SHUT_ENG,
        lib.RAPTOR_SYS_PWR_OFF,
        lib.RAPTOR_SYS_EMERGENCY_SHUTDOWN,
    }
    expected = (1, 10.0) if sys_state in moved else (0, 200.0)
    angle = float(np.degrees(monitor.c.command.steer_motor_angle))
    assert (monitor.c.steering_implausible, round(angle, 3)) == expected


DISGUISES: dict[str, Callable[[bytes], bytes]] = {
    "other bus": lambda frame: changed(frame, bus=Bus.CAN3),
    "extended": lambda frame: changed(frame, flags=Flag.EXTENDED),
    "error": lambda frame: changed(frame, flags=Flag.ERROR),
    "both": lambda frame: changed(frame, flags=Flag.ERROR | Flag.EXTENDED),
    "other bus, extended": lambda frame: changed(frame, bus=Bus.CAN3, flags=Flag.EXTENDED),
    "next id": lambda frame: changed(frame, id=0x7FF),
}


@pytest.mark.parametrize("name", MESSAGES)
@pytest.mark.parametrize("disguise", DISGUISES)
def test_what_is_no_command_is_not_even_counted(name: str, disguise: str) -> None:
    monitor = Monitor()
    before = bytes(ffi.buffer(monitor.c))
    monitor.receive(DISGUISES[disguise](message_frame(name, 1, **MESSAGES[name][1])))
    assert bytes(ffi.buffer(monitor.c)) == before


@pytest.mark.parametrize("name", MESSAGES)
@pytest.mark.parametrize("how", ["short", "remote"])
def test_a_command_that_the_codec_rejects_is_counted_and_not_used(name: str, how: str) -> None:
    monitor = Monitor()
    receiver, values = MESSAGES[name]
    frame, before = message_frame(name, 1, **values), monitor.command()
    bad = changed(frame, dlc=database.message(name).length - 1) if how == "short" else changed(frame, flags=Flag.REMOTE)
    monitor.receive(bad)
    status = lib.CODEC_SHORT_FRAME if how == "short" else lib.CODEC_REMOTE_FRAME
    assert monitor.received() == dict.fromkeys(RECEIVERS, (0, 0, 0)) | {receiver: (0, 1, status)}
    assert monitor.command() == before


def test_a_start_forgets_what_was_before() -> None:
    monitor = Monitor()
    fresh = bytes(ffi.buffer(monitor.c))
    ffi.buffer(monitor.c)[:] = b"\xff" * len(fresh)
    lib.raptor_command_monitor_init(monitor.c)
    assert bytes(ffi.buffer(monitor.c)) == fresh
    assert (monitor.c.command.traction_aim, monitor.c.command.traction_range) == (-1, -1)


@pytest.mark.parametrize(("field", "name", "values"), IMPLAUSIBLE)
def test_any_number_of_implausible_frames_is_too_many(field: str, name: str, values: dict[str, float]) -> None:
    monitor = Monitor(implausible_limit=0xFFFF)
    setattr(monitor.c, field, 0xFFFD)
    for number in (0xFFFE, 0xFFFF, 0xFFFF, 0xFFFF):
        monitor.send(name, values)
        assert getattr(monitor.c, field) == number
        assert bool(monitor.step(0) & lib.RAPTOR_COMMAND_IMPLAUSIBLE) is (number == 0xFFFF)
    monitor.send(name, MESSAGES[name][1])
    assert getattr(monitor.c, field) == 0
    assert not monitor.step(0) & lib.RAPTOR_COMMAND_IMPLAUSIBLE


def test_the_largest_steering_step_is_none_too_many() -> None:
    step = np.float32(40) * np.float32(0.5) * np.float32(0.017453293)
    for allowed, taken in ((float(step), True), (float(np.nextafter(step, np.float32(0))), False)):
        for sign in (1.0, -1.0):
            monitor = Monitor(steer_jump=allowed)
            monitor.send("steering_cmd", {"steering_motor_ang_cmd": 0.0})
            monitor.send("steering_cmd", {"steering_motor_ang_cmd": 20.0 * sign})
            assert monitor.c.command.steer_motor_angle == (sign * float(step) if taken else 0.0)
            assert monitor.c.steering_implausible == (0 if taken else 1)


def test_the_first_steering_command_is_no_step_and_neither_is_one_before_driving() -> None:
    for before, sys_state in (([], DRIVING), ([0.0], DRIVING - 1)):
        monitor = Monitor()
        for angle in (*before, 200.0):
            monitor.send("steering_cmd", {"steering_motor_ang_cmd": angle}, sys_state=sys_state)
        assert monitor.c.command.steer_motor_angle == pytest.approx(np.radians(200.0))
        assert monitor.c.steering_implausible == 0


@pytest.mark.parametrize("name", TIMED)
def test_time_outs_run_from_the_first_step_and_then_from_the_last_command(name: str) -> None:
    others = [other for other in TIMED if other != name]
    monitor = Monitor(command_timeout_ms=100, ct_report_timeout_ms=100)
    assert monitor.step(LATE_US) == 0
    for other in others:
        monitor.send(other, MESSAGES[other][1], LATE_US + 50_000)
    assert monitor.step(LATE_US + 100_000) == 0
    assert monitor.step(LATE_US + 100_001) == TIMED[name]
    monitor.send(name, MESSAGES[name][1], LATE_US + 100_001)
    assert monitor.step(LATE_US + 150_000) == 0
    assert lib.raptor_command_monitor_alive(monitor.c)
    assert monitor.step(LATE_US + 150_001) == sum(TIMED[other] for other in others)
    assert not lib.raptor_command_monitor_alive(monitor.c)


def test_a_ct_state_that_nobody_told_contradicts_nothing() -> None:
    monitor = Monitor(ct_report_timeout_ms=0, command_timeout_ms=0, ct_inconsistent_us=200_000)
    for now_us in range(0, 1_000_000, 10_000):
        assert monitor.step(now_us) == 0
    monitor.send("ct_report", {"ct_state": 1})
    assert [monitor.step(10**6 + late_us) for late_us in (0, 199_999, 200_000)] == [0, 0, lib.RAPTOR_COMMAND_CT_STATE]
    monitor.send("ct_report", {"ct_state": 9})
    assert monitor.step(2 * 10**6) == 0


@pytest.mark.parametrize(
    ("throttle", "brake_kpa", "conflict"), [(25.0, 1001.0, True), (25.01, 1000.0, False), (25.0, 1000.0, False),
                                            (24.0, 2000.0, False), (25.01, 1001.0, True)],
)  # fmt: skip
def test_both_pedals_must_be_pressed_for_a_conflict(throttle: float, brake_kpa: float, conflict: bool) -> None:
    limit = float(np.nextafter(np.float32(2500) * np.float32(1.0e-4), np.float32(0)))
    monitor = Monitor(
        pedal_conflict_throttle=limit, pedal_conflict_brake=1.0e6, pedal_conflict_us=500_000,
        command_timeout_ms=0, ct_report_timeout_ms=0,
    )  # fmt: skip
    monitor.send("accelerator_cmd", {"acc_pedal_cmd": throttle})
    monitor.send("brake_pressure_cmd", {"brake_pressure_cmd": brake_kpa})
    assert [monitor.step(now_us) for now_us in (0, 499_999)] == [0, 0]
    assert monitor.step(500_000) == (lib.RAPTOR_COMMAND_PEDAL_CONFLICT if conflict else 0)


def test_a_throttle_at_the_limit_is_no_conflict() -> None:
    limit = float(np.float32(2500) * np.float32(1.0e-4))
    monitor = Monitor(
        pedal_conflict_throttle=limit, pedal_conflict_brake=1.0e6, pedal_conflict_us=0,
        command_timeout_ms=0, ct_report_timeout_ms=0,
    )  # fmt: skip
    monitor.send("brake_pressure_cmd", {"brake_pressure_cmd": 3000.0})
    for throttle, fault in ((25.0, 0), (25.01, lib.RAPTOR_COMMAND_PEDAL_CONFLICT)):
        monitor.send("accelerator_cmd", {"acc_pedal_cmd": throttle})
        assert monitor.step(0) == fault


#: ct_states that fit a sys_state, written down independently of the firmware's table. 11 and 12 always fit.
CONSISTENT = {
    1: {0, 255, 1, 2}, 2: {0, 255, 1, 2}, 3: {0, 255, 1, 2}, 4: {0, 255, 1, 2, 3}, 5: {3, 4}, 13: {4}, 6: {4, 5},
    7: {5}, 8: {5, 6, 7}, 9: {7, 8, 9, 10}, 10: set(),
}  # fmt: skip
ENDS = (0, 11, 14, 15, 16, 17)


@pytest.mark.parametrize("sys_state", [*CONSISTENT, *ENDS, 12, 18, 255])
def test_ct_state_consistency_for_every_value(sys_state: int) -> None:
    known = {*range(13), 255}
    for ct_state in [*range(256), 256, 259, 0x0107, 0xFFFF]:
        if sys_state in {12, 18, 255}:
            expected = sys_state == 12 and ct_state in {11, 12}
        elif sys_state in ENDS:
            expected = ct_state in known
        else:
            expected = ct_state in CONSISTENT[sys_state] | {11, 12}
        assert bool(lib.raptor_ct_state_consistent(sys_state, ct_state)) is expected, ct_state


@pytest.mark.parametrize(
    ("name", "signal", "good", "bad"),
    [
        ("brake_pressure_cmd", "brake_pressure_cmd", 6000.0, 6001.0),
        ("accelerator_cmd", "acc_pedal_cmd", 0.0, -0.01),
        ("accelerator_cmd", "acc_pedal_cmd", 100.0, 100.01),
        ("steering_cmd", "steering_motor_ang_cmd", 240.0, 240.5),
        ("steering_cmd", "steering_motor_ang_cmd", -240.0, -240.5),
        ("gear_shift_cmd", "desired_gear", 6.0, 7.0),
    ],
)
def test_the_ends_of_the_ranges_are_taken_and_nothing_beyond(name: str, signal: str, good: float, bad: float) -> None:
    monitor = Monitor(implausible_limit=1, command_timeout_ms=0, ct_report_timeout_ms=0)
    monitor.send(name, {signal: good})
    assert monitor.step(0) == 0
    taken = monitor.command()
    monitor.send(name, {signal: bad})
    assert monitor.step(0) == lib.RAPTOR_COMMAND_IMPLAUSIBLE
    assert monitor.command() == taken


@pytest.mark.parametrize(("angle", "plausible"), [(102.0, True), (102.5, False), (-78.0, True), (-78.5, False)])
def test_a_steering_step_counts_from_the_last_angle_to_either_side(angle: float, plausible: bool) -> None:
    monitor = Monitor()
    for asked in (12.0, angle):
        monitor.send("steering_cmd", {"steering_motor_ang_cmd": asked})
    assert (monitor.c.steering_implausible == 0) is plausible


def test_a_time_out_says_when_frames_come_whose_counter_stands() -> None:
    monitor = Monitor(command_timeout_ms=100, ct_report_timeout_ms=0)
    for name in TIMED:
        monitor.send(name, MESSAGES[name][1])
    silent = lib.RAPTOR_COMMAND_THROTTLE_TIMEOUT | lib.RAPTOR_COMMAND_STEERING_TIMEOUT
    monitor.receive(message_frame("brake_pressure_cmd", 1, brake_pressure_cmd=1000.0), 50_000)
    stuck = lib.RAPTOR_COMMAND_BRAKE_TIMEOUT | lib.RAPTOR_COMMAND_COUNTER_STUCK
    assert monitor.step(100_001) == silent | stuck
    monitor.send("brake_pressure_cmd", {"brake_pressure_cmd": 1000.0}, 100_001)
    assert monitor.step(100_001) == silent
