"""Sensor monitor: age, rate, data size and plausibility of each sensor."""

from __future__ import annotations

import math
import random
from typing import Any

import pytest
from obc_harness import cast_frames

from bridge._native import ffi, lib
from dbc.codec import database

MESSAGES = {
    lib.SENSOR_GNSS_A: ("gnss_a_position", "gnss_a_velocity", "gnss_a_attitude", "gnss_a_quality"),
    lib.SENSOR_GNSS_B: ("gnss_b_position", "gnss_b_velocity", "gnss_b_attitude", "gnss_b_quality"),
    lib.SENSOR_IMU: ("imu_rates", "imu_specific_force"),
}
GNSS_LIMITS = {
    "timeout_ms": 150, "min_rate": 15.0, "data_size": 4, "frozen_timeout_ms": 300, "max_step": [2.0, 0.0],
}  # fmt: skip
LIMITS: dict[int, dict[str, Any]] = {
    lib.SENSOR_GNSS_A: GNSS_LIMITS,
    lib.SENSOR_GNSS_B: GNSS_LIMITS,
    lib.SENSOR_IMU: {
        "timeout_ms": 50, "min_rate": 80.0, "data_size": 2, "frozen_timeout_ms": 60, "max_step": [0.5, 10.0],
    },
}  # fmt: skip
PERIOD_US = {lib.SENSOR_GNSS_A: 50_000, lib.SENSOR_GNSS_B: 50_000, lib.SENSOR_IMU: 10_000}
SENSORS = list(MESSAGES)
LAST_BIT = {
    "position": 1e-7, "velocity": 0.005, "attitude": 1e-4, "quality": 0.001, "rates": 2e-4, "specific_force": 0.002,
}  # fmt: skip


class Sensors:
    """A sensor monitor, a clock, and counters that move.

    `values` holds the first signals of a message, by name. With `noise` the last bit of the first one moves, except in
    the message `still`.
    """

    def __init__(self) -> None:
        self.c = ffi.new("sensor_monitor *")
        self.now_us = 0
        self.counter = 0
        self.values: dict[str, tuple[float, ...]] = {}
        self.noise = False
        self.still: str | None = None

    def push(self, name: str, frozen: bool = False) -> None:
        message = database.message(name)
        self.counter += 0 if frozen else 1
        values = [float(self.counter % 256) if signal.endswith("counter") else 0.0 for signal in message.signals]
        first = self.values.get(name, ())
        values[: len(first)] = first
        if self.noise and name != self.still:
            values[0] += LAST_BIT[name.split("_", 2 if name.startswith("gnss") else 1)[-1]] * (
                self.now_us // 10_000 % 2
            )
        array, _ = cast_frames(message.frame(*values))
        lib.sensor_monitor_push(self.c, array, self.now_us)

    def sample(self, sensor: int, frames: int | None = None) -> None:
        for name in MESSAGES[sensor][:frames]:
            self.push(name)

    def run(self, sensor: int, ticks: int, every: int = 1) -> None:
        """Send every n-th due sample for so many 10 ms ticks."""
        for _ in range(ticks):
            if self.now_us % (PERIOD_US[sensor] * every) == 0:
                self.sample(sensor)
            self.now_us += 10_000

    def check(self, sensor: int) -> tuple[bool, bool, bool]:
        health = self.health(sensor)
        return (bool(health.timed_out), bool(health.low_rate), bool(health.wrong_size))

    def health(self, sensor: int) -> Any:
        return lib.sensor_monitor_check(self.c, sensor, ffi.new("sensor_limits *", LIMITS[sensor]), self.now_us)


HEALTHY = (False, False, False)


@pytest.mark.parametrize("sensor", SENSORS)
def test_unhealthy_until_seen_for_a_second(sensor: int) -> None:
    sensors = Sensors()
    assert sensors.check(sensor) == (True, True, True)
    assert sensors.health(sensor).age_ms == 65535
    sensors.run(sensor, 50)
    assert sensors.check(sensor) == (False, True, False)
    sensors.run(sensor, 55)
    assert sensors.check(sensor) == HEALTHY


@pytest.mark.parametrize("sensor", SENSORS)
def test_rate_counts_samples_of_the_last_second(sensor: int) -> None:
    sensors = Sensors()
    sensors.run(sensor, 300)
    assert sensors.health(sensor).rate == 1_000_000 // PERIOD_US[sensor]
    sensors.run(sensor, 200, every=2)
    assert sensors.health(sensor).rate == 500_000 // PERIOD_US[sensor]
    assert sensors.check(sensor) == (False, True, False), "slow, but neither silent nor short"
    sensors.run(sensor, 150)
    assert sensors.check(sensor) == HEALTHY


@pytest.mark.parametrize("sensor", SENSORS)
def test_rate_at_its_limit_is_enough(sensor: int) -> None:
    sensors = Sensors()
    sensors.run(sensor, 130)
    nominal = 1_000_000 / PERIOD_US[sensor]
    for min_rate, low in ((nominal, False), (nominal + 0.5, True)):
        limits = ffi.new("sensor_limits *", LIMITS[sensor] | {"min_rate": min_rate})
        assert lib.sensor_monitor_check(sensors.c, sensor, limits, sensors.now_us).low_rate == low


@pytest.mark.parametrize("sensor", SENSORS)
def test_timeout_at_its_limit(sensor: int) -> None:
    sensors = Sensors()
    sensors.run(sensor, 120)
    sensors.sample(sensor)
    start_us = sensors.now_us
    sensors.now_us = start_us + LIMITS[sensor]["timeout_ms"] * 1000 + 999
    assert not sensors.check(sensor)[0]
    sensors.now_us += 1
    assert sensors.check(sensor)[0]
    sensors.now_us = start_us + 100_000_000
    assert sensors.check(sensor)[:2] == (True, True)
    assert sensors.health(sensor).age_ms == 65535
    assert sensors.health(sensor).rate == 0
    sensors.run(sensor, 130)
    assert sensors.check(sensor) == HEALTHY


@pytest.mark.parametrize("sensor", SENSORS)
def test_short_sample(sensor: int) -> None:
    sensors = Sensors()
    sensors.run(sensor, 120)
    sensors.sample(sensor, frames=len(MESSAGES[sensor]) - 1)
    assert not sensors.check(sensor)[2], "not finished yet"
    sensors.sample(sensor)
    assert sensors.check(sensor)[2]
    assert sensors.health(sensor).size == len(MESSAGES[sensor]) - 1
    sensors.sample(sensor)
    assert not sensors.check(sensor)[2]


@pytest.mark.parametrize("sensor", SENSORS)
def test_sample_without_its_first_frame_makes_the_one_before_too_long(sensor: int) -> None:
    sensors = Sensors()
    sensors.run(sensor, 120)
    for name in MESSAGES[sensor][1:]:
        sensors.push(name)
    sensors.sample(sensor)
    assert sensors.check(sensor)[2]


@pytest.mark.parametrize("sensor", SENSORS)
def test_stuck_counter_does_not_count(sensor: int) -> None:
    sensors = Sensors()
    sensors.run(sensor, 120)
    sensors.sample(sensor)
    sensors.push(MESSAGES[sensor][-1], frozen=True)
    sensors.sample(sensor)
    assert not sensors.check(sensor)[2], "the repeated frame was dropped"


def test_sensors_are_told_apart() -> None:
    sensors = Sensors()
    sensors.run(lib.SENSOR_GNSS_B, 120)
    assert sensors.check(lib.SENSOR_GNSS_B) == HEALTHY
    assert sensors.check(lib.SENSOR_GNSS_A) == (True, True, True)
    assert sensors.check(lib.SENSOR_IMU) == (True, True, True)


def test_frames_of_no_sensor_are_ignored() -> None:
    sensors = Sensors()
    before = bytes(ffi.buffer(sensors.c))
    for name in ("estimate_position", "brake_pressure_report"):
        sensors.push(name)
    assert bytes(ffi.buffer(sensors.c)) == before


def test_endless_sample_saturates() -> None:
    sensors = Sensors()
    sensors.sample(lib.SENSOR_IMU)
    for _ in range(66_000):
        sensors.push("imu_specific_force")
    sensors.sample(lib.SENSOR_IMU)
    assert sensors.health(lib.SENSOR_IMU).size == 65535


# --- values that stand still or jump


@pytest.mark.parametrize(
    ("sensor", "name"),
    [(sensor, name) for sensor in SENSORS for name in MESSAGES[sensor] if not name.endswith("quality")],
)
def test_frozen_when_one_message_repeats_itself_for_its_time(sensor: int, name: str) -> None:
    sensors = Sensors()
    sensors.noise = True
    sensors.run(sensor, 120)
    assert not sensors.health(sensor).frozen
    sensors.still = name
    since_us = sensors.now_us  # of the last change: from a last bit of one to that of the values that stay
    limit_us = LIMITS[sensor]["frozen_timeout_ms"] * 1000
    while sensors.now_us <= since_us + 3 * limit_us:
        assert sensors.health(sensor).frozen == (sensors.now_us - since_us >= limit_us + 1000)
        sensors.run(sensor, 1)
    sensors.still = None
    sensors.run(sensor, PERIOD_US[sensor] // 10_000)
    assert not sensors.health(sensor).frozen


@pytest.mark.parametrize("sensor", SENSORS)
def test_silence_is_not_frozen(sensor: int) -> None:
    sensors = Sensors()
    assert not sensors.health(sensor).frozen
    sensors.noise = True
    sensors.run(sensor, 120)
    sensors.now_us += 10_000_000
    assert sensors.health(sensor).timed_out
    assert not sensors.health(sensor).frozen


@pytest.mark.parametrize("receiver", ["a", "b"])
@pytest.mark.parametrize("seed", range(5))
def test_position_step_is_the_distance_from_where_the_last_sample_leads(receiver: str, seed: int) -> None:
    print(f"seed {seed}; python -m pytest 'hil_tests/unit/test_sensor_monitor.py' -k 'position_step and {seed}'")
    source = random.Random(seed)
    sensors = Sensors()
    sensor = lib.SENSOR_GNSS_A if receiver == "a" else lib.SENSOR_GNSS_B
    latitude, longitude, velocity = 36.2723, -115.0102, (0.0, 0.0)
    for number in range(40):
        moved = tuple(source.uniform(-8.0, 8.0) for _ in range(2))
        # Local radii of the ellipsoid, the reference; the firmware takes a sphere, which is 0.5 % off.
        sine = math.sin(math.radians(latitude))
        narrow = 1.0 - 0.00669438 * sine**2
        meridian, prime = 6378137.0 * (1 - 0.00669438) / narrow**1.5, 6378137.0 / math.sqrt(narrow)
        latitude += math.degrees(moved[1] / meridian)
        longitude += math.degrees(moved[0] / (prime * math.cos(math.radians(latitude))))
        sensors.values[f"gnss_{receiver}_position"] = (latitude, longitude)
        seconds = source.choice((0.05, 0.06, 0.10))
        sensors.now_us += round(seconds * 1e6)
        sensors.sample(sensor)
        step = sensors.c.sensors[sensor].values.step[0]
        expected = math.hypot(moved[0] - velocity[0] * seconds, moved[1] - velocity[1] * seconds)
        assert step == pytest.approx(expected if number else 0.0, abs=0.1)
        velocity = (source.uniform(-60.0, 60.0), source.uniform(-60.0, 60.0))
        sensors.values[f"gnss_{receiver}_velocity"] = velocity
        sensors.push(f"gnss_{receiver}_velocity")
        assert lib.sensor_monitor_ground_speed(sensors.c, sensor) == pytest.approx(math.hypot(*velocity), abs=0.005)


@pytest.mark.parametrize(("message", "bit"), [("imu_rates", 0), ("imu_specific_force", 1)])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_jump_of_one_axis(message: str, bit: int, axis: int, direction: float) -> None:
    sensor = lib.SENSOR_IMU
    step = LIMITS[sensor]["max_step"][bit]
    for size, jumps in ((step * 0.99, 0), (step * 1.01, 1 << bit)):
        sensors = Sensors()
        sensors.run(sensor, 120)
        assert sensors.health(sensor).jumps == 0, "the first sample jumps from nowhere"
        sensors.values[message] = tuple(direction * size if index == axis else 0.0 for index in range(3))
        sensors.run(sensor, 1)
        assert sensors.health(sensor).jumps == jumps
        sensors.run(sensor, 1)
        assert sensors.health(sensor).jumps == 0, "it stays where it is"


@pytest.mark.parametrize("sensor", SENSORS)
def test_no_jump_after_a_gap_as_long_as_the_timeout(sensor: int) -> None:
    name = MESSAGES[sensor][0]
    for gap_ms, jumps in ((LIMITS[sensor]["timeout_ms"], 1), (LIMITS[sensor]["timeout_ms"] + 1, 0)):
        sensors = Sensors()
        sensors.run(sensor, 120)
        sensors.sample(sensor)
        sensors.values[name] = (1.0, 1.0, 1.0) if name == "imu_rates" else (0.01, 0.01)
        sensors.now_us += gap_ms * 1000
        sensors.sample(sensor)
        assert sensors.health(sensor).jumps == jumps
