"""Space Drive: one axis alone, at the edges of its sensors, its votes and its times."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from actuator_ecus import message_frame

from bridge._native import ffi, lib

FRESH, LOST, WAITING = lib.SPACE_DRIVE_REQUEST_FRESH, lib.SPACE_DRIVE_REQUEST_LOST, lib.SPACE_DRIVE_REQUEST_WAITING
NAN = math.nan


class Axis:
    """An axis whose count is its position, with sensors at zero and requests that a test sets."""

    def __init__(self, **config: float) -> None:
        self.c = ffi.new("space_drive_axis *")
        values: dict[str, float] = {
            "position_at_zero": 0.0, "position_at_max": 1024.0, "counts_max": 1024, "sensor_minimum": -64.0,
            "sensor_maximum": 1088.0, "deviation": 8.0, "lead": 4096.0, "bad_limit": 3, "timeout_us": 50_000,
            "deviation_us": 50_000,
        }  # fmt: skip
        self.config = ffi.new("space_drive_axis_config *", values | config)
        self.sensors = [0.0, 0.0, 0.0]
        self.now_us = 0

    def ask(self, *counts: int | None, state: int = FRESH) -> None:
        """Give each channel its own last good request; None: it never had one."""
        for channel, asked in zip(self.c[0].channels, counts, strict=True):
            channel.request.state = WAITING if asked is None else state
            channel.request.counts = 0 if asked is None else asked
            channel.request.last_valid_us = self.now_us

    def step(self, now_us: int | None = None) -> None:
        self.now_us = self.now_us if now_us is None else now_us
        lib.space_drive_axis_step(self.c, self.config, ffi.new("float[3]", self.sensors), self.now_us)

    def flags(self, name: str) -> list[bool]:
        return [bool(getattr(channel, name)) for channel in self.c.channels]


def neighbour(value: float, towards: float) -> float:
    return float(np.nextafter(np.float32(value), np.float32(towards)))


@pytest.mark.parametrize("channel", range(3))
@pytest.mark.parametrize(
    ("value", "valid"),
    [
        (-64.0, True),
        (neighbour(-64.0, -math.inf), False),
        (1088.0, True),
        (neighbour(1088.0, math.inf), False),
        (NAN, False),
        (math.inf, False),
        (-math.inf, False),
    ],
)
def test_the_ends_of_the_sensor_are_valid_and_keep_the_last_reading_beyond(
    channel: int, value: float, valid: bool
) -> None:
    axis = Axis()
    axis.sensors = [5.0, 5.0, 5.0]
    axis.step()
    axis.sensors[channel] = value
    axis.step()
    assert axis.flags("sensor_valid") == [valid or other != channel for other in range(3)]
    assert axis.c.channels[channel].position == (value if valid else 5.0)
    assert axis.c.position == 5.0


@pytest.mark.parametrize("channel", range(3))
@pytest.mark.parametrize(("wrong", "reason"), [(NAN, "sensor_failed"), (100.0, "implausible")])
def test_a_sensor_that_is_wrong_for_exactly_its_time_is_excluded_until_restart(
    channel: int, wrong: float, reason: str
) -> None:
    axis = Axis()
    axis.sensors[channel] = wrong
    expected = [other == channel for other in range(3)]
    for now_us, excluded in ((10**12, False), (10**12 + 49_999, False), (10**12 + 50_000, True)):
        axis.step(now_us)
        assert axis.flags("excluded") == (expected if excluded else [False] * 3)
    assert axis.flags(reason) == expected
    assert not any(axis.flags("implausible" if reason == "sensor_failed" else "sensor_failed"))
    assert not axis.c.failed
    axis.sensors[channel] = 0.0
    axis.step(2 * 10**12)
    assert axis.flags("excluded") == expected


@pytest.mark.parametrize(("first", "second"), list(itertools.combinations(range(3), 2)))
def test_two_excluded_channels_are_a_failed_axis(first: int, second: int) -> None:
    axis = Axis(deviation_us=0)
    axis.ask(0, 0, 0)
    axis.sensors[first] = NAN
    axis.step()
    assert not axis.c.failed
    assert not axis.c.requests_lost
    axis.sensors[second] = NAN
    axis.step()
    assert axis.c.failed
    assert not axis.c.requests_lost, "the requests are all there; it is the sensors that failed"
    axis.sensors = [0.0, 0.0, 0.0]
    axis.step()
    assert axis.c.failed


@pytest.mark.parametrize("known", list(itertools.product([True, False], repeat=3)))
def test_two_channels_with_a_good_request_make_the_axis_ready(known: tuple[bool, ...]) -> None:
    axis = Axis()
    axis.ask(*(100 if one else None for one in known))
    axis.step()
    assert bool(axis.c.ready) is (sum(known) >= 2)
    assert not axis.c.requests_lost


@pytest.mark.parametrize("fresh", list(itertools.product([True, False], repeat=3)))
def test_fewer_than_two_fresh_requests_are_lost_requests(fresh: tuple[bool, ...]) -> None:
    axis = Axis()
    axis.ask(100, 100, 100)
    for channel, one in zip(axis.c.channels, fresh, strict=True):
        channel.request.last_valid_us = 50_000 if one else 49_999
    axis.step(100_000)
    assert axis.c.ready
    assert bool(axis.c.requests_lost) is (sum(fresh) < 2)
    assert [channel.request.state for channel in axis.c.channels] == [FRESH if one else LOST for one in fresh]
    assert axis.c.demand == 100.0, "the last good target stands"


@pytest.mark.parametrize("excluded", range(3))
def test_a_fresh_request_of_an_excluded_channel_does_not_count(excluded: int) -> None:
    axis = Axis(deviation_us=0)
    axis.sensors[excluded] = NAN
    axis.ask(100, 100, 100)
    axis.step()
    assert not axis.c.requests_lost
    axis.c.channels[(excluded + 1) % 3].request.state = LOST
    axis.step()
    assert axis.c.requests_lost


@pytest.mark.parametrize("out", range(3))
def test_of_two_voters_that_differ_the_last_agreed_demand_stands(out: int) -> None:
    axis = Axis()
    axis.ask(100, 100, 100)
    axis.step()
    assert (axis.c.demand_valid, axis.c.demand) == (True, 100.0)
    axis.sensors[out] = NAN
    one, other = ((out + 1) % 3, (out + 2) % 3)
    for apart, demand in ((8, 504.0), (9, 504.0), (6, 503.0)):
        axis.c.channels[one].request.counts = 500
        axis.c.channels[other].request.counts = 500 + apart
        axis.step()
        assert axis.c.demand == demand


@pytest.mark.parametrize("off", range(3))
def test_of_three_voters_one_that_differs_is_outvoted(off: int) -> None:
    axis = Axis()
    axis.ask(*(900 if channel == off else 100 + channel for channel in range(3)))
    axis.step()
    assert axis.c.demand_valid
    assert axis.c.demand == sorted(900 if channel == off else 100 + channel for channel in range(3))[1]


def test_without_two_voters_there_is_no_demand() -> None:
    axis = Axis()
    axis.ask(100, 100, 100)
    axis.sensors = [NAN, 0.0, NAN]
    axis.step()
    assert (axis.c.demand_valid, axis.c.demand) == (False, 0.0)


def test_demand_and_position_stay_when_the_vote_fails() -> None:
    axis = Axis()
    axis.ask(100, 100, 100)
    axis.sensors = [50.0, 50.0, 50.0]
    axis.step()
    axis.ask(200, 200, 200)
    axis.sensors = [NAN, 60.0, NAN]
    axis.step()
    assert (axis.c.demand_valid, axis.c.demand, axis.c.position) == (True, 100.0, 50.0)


def test_what_lies_behind_the_three_channels_has_no_say() -> None:
    axes = ffi.new("space_drive_axis[2]")
    axis = Axis()
    axis.c = axes
    behind = ffi.addressof(axes[0].channels, 0) + 3
    axis.ask(100, None, None)
    behind.request.state, behind.request.counts, behind.sensor_valid = FRESH, 100, True
    behind.position = 5.0
    before = bytes(ffi.buffer(ffi.addressof(axes, 1)))
    axis.sensors = [0.0, 0.0, NAN]
    axis.step()
    assert bytes(ffi.buffer(ffi.addressof(axes, 1))) == before
    assert not axes[0].ready
    axes[0].demand_valid = False
    axis.ask(100, 900, 900)
    behind.request.state, behind.request.counts, behind.sensor_valid = FRESH, 100, True
    axis.step()
    assert axes[0].ready
    assert not axes[0].demand_valid, "two voters that differ"


@pytest.mark.parametrize(("given", "demand"), [(True, 300.0), (False, 20.0)])
def test_before_the_first_request_the_safe_demand_or_the_own_position(given: bool, demand: float) -> None:
    axis = Axis(safe_demand=300.0, safe_demand_valid=given)
    axis.sensors = [20.0, 20.0, 20.0]
    axis.step()
    assert axis.c.demand == demand
    assert not axis.c.ready


@pytest.mark.parametrize(("asked", "demand"), [(1000, 60.0), (0, 40.0), (55, 55.0), (60, 60.0), (40, 40.0)])
def test_the_demand_leads_the_own_sensor_by_a_bounded_step(asked: int, demand: float) -> None:
    axis = Axis(lead=10.0)
    axis.sensors = [50.0, 50.0, 50.0]
    axis.ask(asked, asked, asked)
    axis.step()
    assert axis.c.demand == demand


def request(counts: int, counter: int) -> Any:
    pointer = ffi.new("can_frame *")
    ffi.buffer(pointer)[:] = message_frame("req_steer_pos", counter, cntrl_pos=counts)
    return pointer


def test_every_channel_takes_a_request_with_the_limits_of_the_axis() -> None:
    axis = Axis()
    for counter, (counts, taken) in enumerate([(1024, 1024), (1025, 1024), (7, 7)]):
        lib.space_drive_axis_receive(axis.c, axis.config, request(counts, counter), 5)
        assert [channel.request.counts for channel in axis.c.channels] == [taken] * 3
        assert [channel.request.bad_in_row for channel in axis.c.channels] == [int(counts > 1024)] * 3
        assert [channel.request.state for channel in axis.c.channels] == [FRESH] * 3


def test_an_axis_without_a_configuration_takes_no_request() -> None:
    axis = Axis(counts_max=0)
    before = bytes(ffi.buffer(axis.c))
    lib.space_drive_axis_receive(axis.c, axis.config, request(0, 1), 5)
    assert bytes(ffi.buffer(axis.c)) == before


@pytest.mark.parametrize(("position", "counts"), [(-1.0, 0), (0.0, 0), (0.4, 0), (0.6, 1), (1024.0, 1024), (1e6, 1024)])
def test_counts_saturate_and_round(position: float, counts: int) -> None:
    assert lib.space_drive_axis_counts(Axis().config, position) == counts
