"""Sensor monitor: age, rate and data size of each sensor."""

from __future__ import annotations

import pytest
from obc_harness import cast_frames

from bridge._native import ffi, lib
from dbc.codec import database

MESSAGES = {
    lib.SENSOR_GNSS_A: ("gnss_a_position", "gnss_a_velocity", "gnss_a_attitude", "gnss_a_quality"),
    lib.SENSOR_GNSS_B: ("gnss_b_position", "gnss_b_velocity", "gnss_b_attitude", "gnss_b_quality"),
    lib.SENSOR_IMU: ("imu_rates", "imu_specific_force"),
}
LIMITS = {
    lib.SENSOR_GNSS_A: {"timeout_ms": 150, "min_rate": 15.0, "data_size": 4},
    lib.SENSOR_GNSS_B: {"timeout_ms": 150, "min_rate": 15.0, "data_size": 4},
    lib.SENSOR_IMU: {"timeout_ms": 50, "min_rate": 80.0, "data_size": 2},
}
PERIOD_US = {lib.SENSOR_GNSS_A: 50_000, lib.SENSOR_GNSS_B: 50_000, lib.SENSOR_IMU: 10_000}
SENSORS = list(MESSAGES)


class Sensors:
    """A sensor monitor, a clock, and counters that move."""

    def __init__(self) -> None:
        self.c = ffi.new("sensor_monitor *")
        self.now_us = 0
        self.counter = 0

    def push(self, name: str, frozen: bool = False) -> None:
        message = database.message(name)
        self.counter += 0 if frozen else 1
        values = [float(self.counter % 256) if signal.endswith("counter") else 0.0 for signal in message.signals]
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

    def health(self, sensor: int) -> object:
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
