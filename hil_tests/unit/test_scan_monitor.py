"""Scan monitor: age, rate, size and progress of the scans that autonomy gives notice of."""

from __future__ import annotations

from typing import Any

import pytest
from obc_harness import cast_frames

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import Flag, iterate

LIMITS: dict[str, Any] = {"timeout_ms": 150, "min_rate": 15.0, "min_size": 60, "max_size": 64}
SENSORS = [lib.SCAN_LIDAR, lib.SCAN_RADAR]
PERIOD_US = 50_000
HEALTHY = {"timed_out": False, "low_rate": False, "wrong_size": False, "frozen": False}


class Scans:
    """A scan monitor, a clock and sequences that move."""

    def __init__(self) -> None:
        self.c = ffi.new("scan_monitor *")
        self.now_us = 0
        self.sequence = 0

    def push_frame(self, frame: bytes) -> None:
        array, _ = cast_frames(frame)
        lib.scan_monitor_push(self.c, array, self.now_us)

    def push(self, sensor: int, size: int = 64, age_ms: int = 0, new: bool = True) -> None:
        self.sequence = (self.sequence + new) & 0xFFFF
        number = lib.SCAN_FIRST_ID + sensor
        self.push_frame(database.message("sensor_notice").frame(number, self.sequence, size, age_ms))

    def run(self, sensor: int, ticks: int, every: int = 1, new: bool = True) -> None:
        """Give notice of every n-th scan for so many 10 ms ticks."""
        for _ in range(ticks):
            if self.now_us % (PERIOD_US * every) == 0:
                self.push(sensor, new=new)
            self.now_us += 10_000

    def health(self, sensor: int, **limits: Any) -> Any:
        return lib.scan_monitor_check(self.c, sensor, ffi.new("scan_limits *", LIMITS | limits), self.now_us)

    def check(self, sensor: int, **limits: Any) -> dict[str, bool]:
        health = self.health(sensor, **limits)
        return {name: bool(getattr(health, name)) for name in HEALTHY}


@pytest.mark.parametrize("sensor", SENSORS)
def test_unhealthy_until_seen_for_a_second(sensor: int) -> None:
    scans = Scans()
    assert scans.check(sensor) == {"timed_out": True, "low_rate": True, "wrong_size": True, "frozen": False}
    assert (scans.health(sensor).age_ms, scans.health(sensor).still_ms) == (65535, 65535)
    scans.run(sensor, 50)
    assert scans.check(sensor) == HEALTHY | {"low_rate": True}
    scans.run(sensor, 55)
    assert scans.check(sensor) == HEALTHY


@pytest.mark.parametrize("age_ms", [0, 1, 80, 150])
def test_age_is_that_of_the_data(age_ms: int) -> None:
    scans = Scans()
    scans.run(lib.SCAN_LIDAR, 120)
    scans.push(lib.SCAN_LIDAR, age_ms=age_ms)
    since_us = scans.now_us
    scans.now_us = since_us + (150 - age_ms) * 1000 + 999
    assert scans.health(lib.SCAN_LIDAR).age_ms == 150
    assert not scans.check(lib.SCAN_LIDAR)["timed_out"]
    scans.now_us += 1
    assert scans.health(lib.SCAN_LIDAR).age_ms == 151
    assert scans.check(lib.SCAN_LIDAR)["timed_out"]


def test_ages_saturate() -> None:
    scans = Scans()
    scans.push(lib.SCAN_RADAR, age_ms=65535)
    scans.now_us += 1_000_000
    assert scans.health(lib.SCAN_RADAR).age_ms == 65535
    scans.now_us += 100_000_000
    assert scans.health(lib.SCAN_RADAR).still_ms == 65535


@pytest.mark.parametrize(("size", "wrong"), [(0, True), (59, True), (60, False), (64, False), (65, True)])
def test_size_has_two_limits(size: int, wrong: bool) -> None:
    scans = Scans()
    scans.run(lib.SCAN_RADAR, 120)
    scans.push(lib.SCAN_RADAR, size=size)
    assert scans.check(lib.SCAN_RADAR) == HEALTHY | {"wrong_size": wrong}
    assert scans.health(lib.SCAN_RADAR).size == size


def test_size_is_carried_whole() -> None:
    scans = Scans()
    scans.push(lib.SCAN_LIDAR, size=(1 << 24) - 1)
    assert scans.health(lib.SCAN_LIDAR).size == (1 << 24) - 1
    assert not scans.health(lib.SCAN_LIDAR, max_size=0xFFFFFFFF).wrong_size


def test_rate_counts_notices_of_the_last_second() -> None:
    scans = Scans()
    scans.run(lib.SCAN_LIDAR, 300)
    assert scans.health(lib.SCAN_LIDAR).rate == 20
    scans.run(lib.SCAN_LIDAR, 200, every=2)
    assert scans.health(lib.SCAN_LIDAR).rate == 10
    assert scans.check(lib.SCAN_LIDAR) == HEALTHY | {"low_rate": True}
    assert not scans.check(lib.SCAN_LIDAR, min_rate=10.0)["low_rate"], "the limit itself is enough"


def test_frozen_is_repeated_and_not_silent() -> None:
    scans = Scans()
    scans.run(lib.SCAN_LIDAR, 121)  # the last notice 10 ms ago
    since_us = scans.now_us - 10_000
    while scans.now_us < since_us + 500_000:
        scans.run(lib.SCAN_LIDAR, 1, new=False)
        expected = scans.now_us - since_us > 150_000
        assert scans.check(lib.SCAN_LIDAR) == HEALTHY | {"frozen": expected}
    scans.now_us += 1_000_000
    assert scans.check(lib.SCAN_LIDAR) == HEALTHY | {"timed_out": True, "low_rate": True}
    scans.push(lib.SCAN_LIDAR)
    assert not scans.check(lib.SCAN_LIDAR)["frozen"]


def test_any_other_sequence_is_a_new_scan() -> None:
    scans = Scans()
    scans.sequence = 65_534
    scans.run(lib.SCAN_RADAR, 130)
    assert scans.sequence < 65_534
    assert scans.check(lib.SCAN_RADAR) == HEALTHY
    assert scans.health(lib.SCAN_RADAR).still_ms == 50


def test_sensors_are_told_apart() -> None:
    for sensor in SENSORS:
        scans = Scans()
        scans.run(sensor, 120)
        (other,) = set(SENSORS) - {sensor}
        assert scans.check(sensor) == HEALTHY
        assert scans.check(other)["timed_out"]


def test_frames_that_are_not_to_be_used_are_counted() -> None:
    scans = Scans()
    notice = database.message("sensor_notice")
    good = next(iterate(notice.frame(lib.SCAN_FIRST_ID, 1, 64, 0)))
    bad = [good._replace(dlc=7), good._replace(flags=int(Flag.REMOTE)), good._replace(flags=int(Flag.ERROR))]
    for frame in bad:
        scans.push_frame(frame.pack())
    for number in (0, lib.SCAN_FIRST_ID - 1, lib.SCAN_FIRST_ID + lib.SCAN_COUNT, 255):
        scans.push_frame(notice.frame(number, 1, 64, 0))
    assert scans.c.rejected == 7
    assert all(scans.check(sensor)["timed_out"] for sensor in SENSORS)
    scans.push_frame(good.pack())
    assert scans.c.rejected == 7
    assert not scans.check(lib.SCAN_LIDAR)["timed_out"]
