"""What the tests of control share: paths with closed forms, plans cut from them, the car in closed loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge._native import ffi, lib
from plant_fmu.driver import Plant, Value

PERIOD = 0.01
LQR, STANLEY, PURE_PURSUIT = 1, 2, 3
STEER_RATIO = 15.0

Array = NDArray[np.float64]


def wrap(angle: Any) -> Any:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@dataclass
class Course:
    """A path by arc length, integrated from its curvature on a fine grid.

    Attributes
    ----------
    s, x, y, yaw, curvature, bank : on the grid.
    """

    s: Array
    curvature: Array
    bank: Array
    x: Array = field(init=False)
    y: Array = field(init=False)
    yaw: Array = field(init=False)

    def __post_init__(self) -> None:
        step = np.diff(self.s)
        self.yaw = np.concatenate([[0.0], np.cumsum(0.5 * (self.curvature[1:] + self.curvature[:-1]) * step)])
        middle = 0.5 * (self.yaw[1:] + self.yaw[:-1])
        self.x = np.concatenate([[0.0], np.cumsum(np.cos(middle) * step)])
        self.y = np.concatenate([[0.0], np.cumsum(np.sin(middle) * step)])

    @classmethod
    def of(cls, pieces: list[tuple[float, float, float, float, float]]) -> Course:
        """From pieces (length, curvature from, to, bank from, to), 5 cm apart."""
        ends = np.cumsum([0.0] + [piece[0] for piece in pieces])
        s = np.arange(0.0, ends[-1], 0.05)
        curvature, bank = np.zeros_like(s), np.zeros_like(s)
        for start, end, piece in zip(ends[:-1], ends[1:], pieces, strict=True):
            inside = (s >= start) & (s < end)
            part = (s[inside] - start) / piece[0]
            curvature[inside] = piece[1] + part * (piece[2] - piece[1])
            bank[inside] = piece[3] + part * (piece[4] - piece[3])
        return cls(s, curvature, bank)

    def at(self, name: str, s: Any) -> Any:
        return np.interp(s, self.s, getattr(self, name))

    def project(self, x: float, y: float, near: float) -> tuple[float, float, float]:
        """Arc length, lateral offset and yaw of the foot of (x, y), searched within 20 m of `near`."""
        low = int(np.searchsorted(self.s, near - 20.0))
        high = int(np.searchsorted(self.s, near + 20.0))
        nearest = low + int(np.argmin((self.x[low:high] - x) ** 2 + (self.y[low:high] - y) ** 2))
        yaw = float(self.yaw[nearest])
        dx, dy = x - float(self.x[nearest]), y - float(self.y[nearest])
        s = float(self.s[nearest]) + dx * math.cos(yaw) + dy * math.sin(yaw)
        return s, dy * math.cos(yaw) - dx * math.sin(yaw), float(self.at("yaw", s))


def oval_half() -> Course:
    """Half of the Las Vegas oval with straights of equal bank, then its mirror image: an abrupt way into the turn and a
    long one out, then a long one in and an abrupt one out."""
    flat, low, entry, high, leave = (math.radians(bank) for bank in (6.0, 9.0, 15.1, 20.0, 14.7))
    turn = 1.0 / 233.1
    half = [
        (134.0, 0.0, 0.0, low, entry - 0.012),
        (15.0, 0.0, turn, entry - 0.012, entry),
        (111.0, turn, turn, entry, high),
        (308.0, turn, turn, high, high),
        (100.0, turn, turn, high, leave),
        (182.0, turn, 0.0, leave, flat),
        (150.0, 0.0, 0.0, flat, flat),
    ]
    mirrored = [(length, after, before, bank_after, bank) for length, before, after, bank, bank_after in half[::-1]]
    return Course.of([(300.0, 0.0, 0.0, low, low), *half, *mirrored, (500.0, 0.0, 0.0, low, low)])


def make_plan(
    course: Course,
    start: float,
    speed: Callable[[float], float],
    spacing: float = 6.0,
    count: int = 40,
    ends_in_stop: bool = False,
) -> Any:
    """Plan of `count` points from arc length `start`, rounded as the wire rounds it."""
    plan = ffi.new("trajectory *")
    stations = start + spacing * np.arange(count)
    stations = stations[stations <= course.s[-1]]
    columns = [course.at(name, stations) for name in ("x", "y", "yaw", "curvature", "bank")]
    plan.count, plan.ends_in_stop = len(stations), ends_in_stop
    length = 0.0
    for i, s in enumerate(stations):
        point = plan.points[i]
        point.x, point.y = round(columns[0][i], 3), round(columns[1][i], 3)
        point.yaw = round(wrap(columns[2][i]), 4)
        point.curvature, point.bank = round(columns[3][i], 5), round(columns[4][i], 3)
        point.speed = round(speed(float(s)) / 0.02) * 0.02
        if i > 0:
            before = plan.points[i - 1]
            turn = wrap(point.yaw - before.yaw)
            length += math.hypot(point.x - before.x, point.y - before.y) * (1.0 + turn * turn / 24.0)
        point.s = length
    return plan


@dataclass(frozen=True)
class Noise:
    """Errors of the estimate: slow and white position (m), yaw (rad), velocity (m/s), yaw rate (rad/s)."""

    slow: float = 0.07
    position: float = 0.02
    yaw: float = 0.002
    velocity: float = 0.03
    yaw_rate: float = 0.002


QUIET = Noise(0.0, 0.0, 0.0, 0.0, 0.0)


class Loop:
    """Control and plant in closed loop at 100 Hz; reports reach control one period late, a new plan comes at 20 Hz."""

    def __init__(
        self,
        course: Course,
        speed: Callable[[float], float],
        start: float = 5.0,
        offset: float = 0.0,
        controller: int = LQR,
        noise: Noise = QUIET,
        seed: int = 1,
        parameters: Mapping[str, Value] | None = None,
    ) -> None:
        self.course, self.speed, self.noise = course, speed, noise
        print(f"seed {seed}")
        self._random = np.random.default_rng(seed)
        self._slow = np.zeros(2)
        yaw = float(course.at("yaw", start))
        begin: dict[str, Value] = {
            "x0": float(course.at("x", start)) - offset * math.sin(yaw),
            "y0": float(course.at("y", start)) + offset * math.cos(yaw),
            "yaw0": float(wrap(yaw)),
            "ignition": True,
            "engine_running0": True,
        }
        self.plant = Plant({**begin, **(parameters or {})})
        self.control = ffi.new("control *")
        lib.control_init(self.control)
        self.input = ffi.new("control_input *")
        self.output = ffi.new("control_output *")
        self.input.lateral = controller
        self.input.max_speed, self.input.max_acceleration, self.input.max_deceleration = 63.2, 6.0, 8.0
        self.input.drive_enabled = True
        self._ticks, self._station, self._feedback = 0, start, self._report()
        self._plan: Any = None
        self.log: list[dict[str, float]] = []

    def __enter__(self) -> Loop:
        return self

    def __exit__(self, *_: object) -> None:
        self.plant.close()

    def _value(self, name: str) -> float:
        return float(self.plant[name])

    def _report(self) -> tuple[float, float, float, float, int, int, bool]:
        wheel = 0.5 * (self._value("wheel_speed_fl") + self._value("wheel_speed_fr"))
        motor = round(math.degrees(self._value("steer_motor_angle")) / 0.5) * 0.5
        return (
            wheel * self._value("tyre_radius_front"),
            self._value("engine_speed"),
            math.radians(motor) / STEER_RATIO,
            self._value("brake_pressure_front"),
            int(self.plant["gear"]),
            int(self.plant["gear_shift_status"]),
            bool(self.plant["engine_running"]),
        )

    def _estimate(self, x: float, y: float, yaw: float) -> None:
        noise, random = self.noise, self._random
        keep = math.exp(-PERIOD / 0.5)
        self._slow = keep * self._slow + math.sqrt(1.0 - keep * keep) * noise.slow * random.normal(size=2)
        estimate = self.input.estimate
        estimate.x = x + self._slow[0] + noise.position * random.normal()
        estimate.y = y + self._slow[1] + noise.position * random.normal()
        estimate.yaw = wrap(yaw + noise.yaw * random.normal())
        estimate.vx = self._value("vx") + noise.velocity * random.normal()
        estimate.vy = self._value("vy") + noise.velocity * random.normal()
        estimate.yaw_rate = self._value("yaw_rate") + noise.yaw_rate * random.normal()
        estimate.ax, estimate.ay, estimate.valid = self._value("ax"), self._value("ay"), True

    def tick(self) -> dict[str, float]:
        x, y, yaw = self._value("x"), self._value("y"), self._value("yaw")
        self._station, lateral, path_yaw = self.course.project(x, y, self._station)
        if self._ticks % 5 == 0:
            start = max(6.0 * math.floor(self._station / 6.0 - 1.0), 0.0)  # every plan has the same points
            self._plan = make_plan(self.course, start, self.speed, ends_in_stop=self.speed(start + 240.0) <= 0.0)
            self.input.plan = self._plan
        self._estimate(x, y, yaw)
        feedback = self.input.feedback
        (
            feedback.wheel_speed,
            feedback.engine_speed,
            feedback.road_wheel_angle,
            feedback.brake_pressure,
            feedback.gear,
            feedback.gear_shift_status,
            feedback.engine_running,
        ) = self._feedback
        self._feedback = self._report()
        lib.control_step(self.control, self.input, self.output)
        self.plant.step(
            steer_motor_demand=self.output.road_wheel_command * STEER_RATIO,
            throttle_demand=self.output.throttle,
            brake_pressure_demand=self.output.brake_pressure,
            gear_demand=self.output.gear,
            road_bank=float(self.course.at("bank", self._station)),
        )
        self._ticks += 1
        row = {
            "t": self._ticks * PERIOD,
            "s": self._station,
            "v": self._value("vx"),
            "lateral": lateral,
            "heading": float(wrap(yaw - path_yaw)),
            "throttle": self.output.throttle,
            "brake": self.output.brake_pressure,
            "gear": float(self.plant["gear"]),
            "ax": self._value("ax"),
            "wheel_rear": 0.5 * (self._value("wheel_speed_rl") + self._value("wheel_speed_rr")),
            "command": self.output.road_wheel_command,
            "speed_error": self.output.speed_error,
            "integral": self.control.lqr.integral,
        }
        self.log.append(row)
        return row

    def run(self, seconds: float, until: Callable[[dict[str, float]], bool] | None = None) -> dict[str, Array]:
        """Columns of this run's rows."""
        first = len(self.log)
        for _ in range(round(seconds / PERIOD)):
            row = self.tick()
            if until is not None and until(row):
                break
        rows = self.log[first:]
        return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def rolling(speed: float, gear: int) -> dict[str, Value]:
    """Start values of a car that rolls at `speed` in `gear`."""
    return {"v0": speed, "gear0": gear}
