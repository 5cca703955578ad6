"""Raptor and Space Drive on a table: their ticks, the frames that they see, and stimuli for their wired signals.

Nothing here is a plant. Stimulus gives the wired signals that a test needs to get an ECU into a state: actuators that
follow at once or with one lag, an engine that starts when it is told. The real plant drives the tests in hil_tests/hil.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import FRAME_SIZE, Bus, Frame, iterate

TICK_US = 10_000
FULL_BRAKE = 4.5e6  # while nobody steers
STEERED_BRAKE = 3.5e6
BRAKE_STOP = 6.0e6  # at count 0 on CAN3
FULL_BRAKE_COUNTS = round(0x4000 * (1.0 - FULL_BRAKE / BRAKE_STOP))
DEG = 0.017453292519943295
OUTBOX = 96

RED, ORANGE, YELLOW, GREEN = 1, 2, 3, 4


def frames_buffer(frames: Iterable[bytes]) -> tuple[Any, int]:
    """C array of frames, and how many."""
    joined = b"".join(frames)
    count = len(joined) // FRAME_SIZE
    array = ffi.new("can_frame[]", max(count, 1))
    ffi.buffer(array)[: len(joined)] = joined
    return array, count


class Outbox:
    """Storage for what a tick sends."""

    def __init__(self, capacity: int = OUTBOX) -> None:
        self._storage = ffi.new("can_frame[]", capacity)
        self.c = ffi.new("can_outbox *", {"frames": self._storage, "capacity": capacity})

    def take(self) -> list[Frame]:
        frames = list(iterate(bytes(ffi.buffer(self._storage, self.c.count * FRAME_SIZE))))
        self.c.count = 0
        return frames


class Messages:
    """Frames by name, with the value of a signal."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self.frames = list(frames)

    def of(self, name: str) -> list[dict[str, float]]:
        message = database.message(name)
        return [
            dict(zip(message.signals, message.decode(frame.data), strict=True))
            for frame in self.frames
            if (frame.bus, frame.id) == (message.bus, message.frame_id)
        ]

    def value(self, name: str, signal: str) -> float:
        """Value in the newest frame of that name."""
        return self.of(name)[-1][signal]


def message_frame(name: str, counter: int, **values: float) -> bytes:
    """One frame with counter and CRC in place; signals that are not named are 0."""
    message = database.message(name)
    unknown = set(values) - set(message.signals)
    assert not unknown, unknown
    return message.finish(message.frame(*(values.get(signal, 0.0) for signal in message.signals)), counter)


@dataclass
class Computer:
    """The onboard computer's side of CAN1: what it commands, and which frames it leaves out or holds."""

    brake_kpa: float = 2000.0
    accelerator: float = 0.0
    steer_deg: float = 0.0
    gear: int = 0
    ct_state: int = 1
    silent: set[str] = field(default_factory=set)
    stuck: set[str] = field(default_factory=set)
    counters: dict[str, int] = field(default_factory=dict)
    tick: int = 0

    def frames(self) -> list[bytes]:
        rows: list[tuple[str, dict[str, float]]] = [
            ("brake_pressure_cmd", {"brake_pressure_cmd": self.brake_kpa}),
            ("accelerator_cmd", {"acc_pedal_cmd": self.accelerator}),
            ("steering_cmd", {"steering_motor_ang_cmd": self.steer_deg}),
        ]
        if self.tick % 10 == 0:
            rows.append(("gear_shift_cmd", {"desired_gear": self.gear}))
        if self.tick % 5 == 0:
            rows.append(("ct_report", {"ct_state": self.ct_state}))
        self.tick += 1
        return [self._frame(name, values) for name, values in rows if name not in self.silent]

    def _frame(self, name: str, values: dict[str, float]) -> bytes:
        counter = self.counters.get(name, 0)
        if name not in self.stuck:
            self.counters[name] = counter + 1
        return message_frame(name, counter, **values)


class SpaceDrive:
    """One Space Drive with healthy sensors that follow its demands."""

    def __init__(self, config: Any = ffi.NULL) -> None:
        self.c = ffi.new("space_drive *")
        lib.space_drive_init(self.c, config)
        self.wired = ffi.new("space_drive_wired_in *", {"main_battery": 13.2, "backup_battery": 12.8})
        self.drive = ffi.new("space_drive_wired_out *")
        self.outbox = Outbox()
        self.now_us = 0
        self.follow = True

    def tick(self, frames: Iterable[bytes] = ()) -> Messages:
        array, count = frames_buffer(frames)
        lib.space_drive_tick(self.c, self.now_us, self.wired, array, count, self.drive, self.outbox.c)
        self.now_us += TICK_US
        if self.follow:
            self.sense(self.drive.steer_motor_demand, self.drive.brake_pressure_demand)
        return Messages(self.outbox.take())

    def sense(self, steer: float, brake: float) -> None:
        for channel in range(3):
            self.wired.steer_motor_angle[channel] = steer
            self.wired.brake_pressure[channel] = brake


@dataclass
class Requests:
    """The Raptor's side of CAN3."""

    steer: float = 0.0
    brake: float = 0.0
    speed_kmh: int = 0
    counter: int = 0

    def steer_frame(self, counts: int | None = None) -> bytes:
        position = round(0x4000 * (1.0 + self.steer / (240 * DEG))) if counts is None else counts
        return message_frame("req_steer_pos", self.counter, cntrl_pos=position, veh_speed=self.speed_kmh)

    def brake_frame(self, counts: int | None = None) -> bytes:
        position = round(0x4000 * (1.0 - self.brake / BRAKE_STOP)) if counts is None else counts
        return message_frame("req_brake_pos", self.counter, contrl_pos_brk=position)

    def frames(self) -> list[bytes]:
        self.counter += 1
        return [self.steer_frame(), self.brake_frame()]


class Car:
    """Raptor and Space Drive joined by CAN3, an onboard computer that a test steers, and stimuli for the rest.

    The lines follow the Space Drive's demand at once, the engine runs when the starter has turned for
    `starter_ticks`, the gearbox takes a gear in `shift_ticks`. `heard` and `requested` are the frames that the Raptor
    and the Space Drive received in the last tick.
    """

    def __init__(self, config: Any = ffi.NULL) -> None:
        self.c = ffi.new("raptor *")
        lib.raptor_init(self.c, config)
        self.wired = ffi.new("raptor_wired_in *")
        self.drive = ffi.new("raptor_wired_out *")
        self.outbox = Outbox()
        self.space_drive = SpaceDrive()
        self.computer = Computer()
        self.starter_ticks = 30
        self.shift_ticks = 10
        self.lines_follow = True
        self.space_drive_connected = True
        self.now_us = 0
        self.log: list[tuple[int, Frame]] = []
        self.heard: list[bytes] = []
        self.requested: list[bytes] = []
        self._to_raptor: list[bytes] = []
        self._cranked = 0
        self._shifting = 0
        self.wired.battery_voltage = 13.2
        self.wired.gear_shift_status = 1
        self.wired.race_control.linked = True
        self.wired.race_control.track_flag = RED

    @property
    def state(self) -> int:
        return int(self.c.sys.state)

    @property
    def diagnostic_bits(self) -> int:
        return int(self.c.diagnostic.bits)

    def set_wheels(self, speed: float) -> None:
        """Wheel speeds for a vehicle speed in m/s."""
        for wheel in range(4):
            self.wired.wheel_speed[wheel] = speed / (0.2958 if wheel < 2 else 0.3099)

    def tick(self, extra: Iterable[bytes] = ()) -> Messages:
        """One minor frame; extra: frames for the Raptor besides those of the computer and the Space Drive."""
        self.heard = [*self._to_raptor, *self.computer.frames(), *extra]
        array, count = frames_buffer(self.heard)
        lib.raptor_tick(self.c, self.now_us, self.wired, array, count, self.drive, self.outbox.c)
        sent = self.outbox.take()
        self.requested = [frame.pack() for frame in sent if frame.bus == Bus.CAN3]
        answers = self.space_drive.tick(self.requested).frames
        self._to_raptor = [frame.pack() for frame in answers] if self.space_drive_connected else []
        self.log += [(self.now_us, frame) for frame in sent]
        self._stimulate()
        self.now_us += TICK_US
        return Messages(sent)

    def run(self, ticks: int) -> Messages:
        messages = Messages([])
        for _ in range(ticks):
            messages = self.tick()
        return messages

    def run_until(self, state: int, limit: int = 2000) -> int:
        """Tick until sys_state is `state`; returns the ticks it took."""
        for ticks in range(limit):
            if self.state == state:
                return ticks
            self.tick()
        raise AssertionError(f"sys_state {state} not reached within {limit} ticks, it is {self.state}")

    def _stimulate(self) -> None:
        wired, drive = self.wired, self.drive
        if self.lines_follow:
            demand = self.space_drive.drive.brake_pressure_demand
            wired.brake_pressure_front = demand
            wired.brake_pressure_rear = demand * 0.46 / 0.54
        self._cranked = self._cranked + 1 if drive.starter and drive.ignition else self._cranked
        wired.engine_running = bool(drive.ignition) and self._cranked >= self.starter_ticks
        wired.engine_speed = 136.0 if wired.engine_running else (30.0 if drive.starter else 0.0)
        if drive.gear_demand != wired.gear:
            self._shifting += 1
            wired.gear_shift_status = 3 if drive.gear_demand > wired.gear else 4
            if self._shifting >= self.shift_ticks:
                wired.gear = drive.gear_demand
                wired.gear_shift_status = 1
                self._shifting = 0


#: What gets the car from one sys_state to the next: (state reached, ct_state, track flag, safety switch).
RUN_UP = (
    (2, 1, RED, 0),
    (3, 2, RED, 3),
    (4, 2, RED, 3),
    (5, 3, RED, 4),
    (13, 4, RED, 4),
    (6, 4, RED, 4),
    (7, 5, ORANGE, 4),
    (8, 5, ORANGE, 4),
    (9, 7, YELLOW, 4),
)


def car_in(state: int, config: Any = ffi.NULL) -> Car:
    """A car that went through the run-up to a sys_state."""
    car = Car(config)
    for reached, ct_state, flag, switch in RUN_UP:
        if car.state == state:
            return car
        car.computer.ct_state = ct_state
        car.wired.race_control.track_flag = flag
        car.wired.safety_switch = switch
        if reached == 9:
            car.computer.ct_state = 6
            car.run(10)
            car.computer.ct_state = ct_state
        car.run_until(reached)
    assert car.state == state
    if state == 9:
        car.computer.ct_state = 8
        car.run(10)
    return car
