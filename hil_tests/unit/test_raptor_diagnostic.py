"""Raptor: the diagnostic step alone, at the edges of what it allows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bridge._native import ffi, lib

TICK_US = 10_000
DRIVING, EMERGENCY = 9, 16
EST1, EST2, EST3 = (
    lib.RAPTOR_DIAG_EST1_FRONT_BRAKE, lib.RAPTOR_DIAG_EST2_REAR_BRAKE, lib.RAPTOR_DIAG_EST3_LOW_ENGINE,
)  # fmt: skip


def above(value: float) -> float:
    return float(np.nextafter(np.float32(value), np.float32(math.inf)))


def below(value: float) -> float:
    return float(np.nextafter(np.float32(value), np.float32(-math.inf)))


class Diagnostic:
    """A diagnostic of a healthy driving car whose lines have the pressure that is asked for."""

    def __init__(self) -> None:
        self.c = ffi.new("raptor_diagnostic *")
        self.config = ffi.new("raptor_config *", lib.raptor_config_default)
        self.config.brake_axle_share = [1.0, 0.5]
        self.config.brake_out_of_spec, self.config.brake_out_of_spec_share = 4.0e5, 0.25
        self.gateway = ffi.new("raptor_gateway *")
        self.input = ffi.new("raptor_diagnostic_input *")
        self.input.gateway = self.gateway
        self.input.sys_state = DRIVING
        self.input.race_control_linked = self.input.engine_running = True
        self.input.engine_speed = 400.0
        self.now_us = 0

    def brake(self, request: float) -> None:
        self.input.brake_request = request
        self.input.brake_lines = [request, 0.5 * request]

    def step(self, ticks: int = 1) -> int:
        for _ in range(ticks):
            lib.raptor_diagnostic_step(self.c, self.config, self.input, self.now_us)
            self.now_us += TICK_US
        return int(self.c.bits)


@pytest.mark.parametrize("axis", ["steer", "brake"])
@pytest.mark.parametrize("channel", range(3))
def test_a_critical_error_of_a_channel_is_a_failure_as_long_as_it_is_told(axis: str, channel: int) -> None:
    diagnostic = Diagnostic()
    told = getattr(diagnostic.gateway, axis).channels[channel]
    told.critical = True
    assert diagnostic.step() == lib.RAPTOR_DIAG_SD_FAILURE
    told.error = True
    first = lib.RAPTOR_DIAG_SD_STEER_WARNING_1 if axis == "steer" else lib.RAPTOR_DIAG_SD_BRAKE_WARNING_1
    assert diagnostic.step() == lib.RAPTOR_DIAG_SD_FAILURE | lib.RAPTOR_DIAG_SD_WARNING | first << channel
    told.critical = told.error = False
    assert diagnostic.step() == 0


CAUSES = {
    "lost": lib.RAPTOR_DIAG_EST4_SD_LOST | lib.RAPTOR_DIAG_SD_FAILURE,
    "emergency_brake": lib.RAPTOR_DIAG_EST6_SD_EBRAKE | lib.RAPTOR_DIAG_SD_FAILURE,
    "obc_lost": lib.RAPTOR_DIAG_OBC_LOST,
    "race_control_lost": lib.RAPTOR_DIAG_RC_LOST,
}
"""What is told, and its bits."""


def tell(diagnostic: Diagnostic, cause: str, present: bool) -> None:
    if cause == "race_control_lost":
        diagnostic.input.race_control_linked = not present
    else:
        setattr(diagnostic.input if cause == "obc_lost" else diagnostic.gateway, cause, present)


@pytest.mark.parametrize("cause", CAUSES)
def test_what_is_told_sets_its_bits_as_long_as_it_lasts(cause: str) -> None:
    diagnostic = Diagnostic()
    for present in (False, True, False):
        tell(diagnostic, cause, present)
        assert diagnostic.step() == (CAUSES[cause] if present else 0)


@pytest.mark.parametrize("cause", CAUSES)
def test_the_cause_of_an_emergency_shutdown_stays_readable_and_later_ones_do_not(cause: str) -> None:
    diagnostic = Diagnostic()
    tell(diagnostic, cause, True)
    diagnostic.step()
    tell(diagnostic, cause, False)
    diagnostic.input.sys_state = EMERGENCY
    triggers = CAUSES[cause] & ~(lib.RAPTOR_DIAG_SD_FAILURE | lib.RAPTOR_DIAG_RC_LOST)
    assert diagnostic.step(2) == triggers
    diagnostic.input.race_control_linked = False
    assert diagnostic.step() == triggers | lib.RAPTOR_DIAG_RC_LOST
    diagnostic.input.obc_lost = True
    assert diagnostic.step() == triggers | lib.RAPTOR_DIAG_RC_LOST | lib.RAPTOR_DIAG_OBC_LOST
    diagnostic.input.obc_lost, diagnostic.input.race_control_linked = False, True
    assert diagnostic.step() == triggers


def test_a_request_that_creeps_counts_as_constant_around_where_it_settled() -> None:
    """Inside its band it may go where it likes; the band does not go with it."""
    diagnostic = Diagnostic()
    diagnostic.config.brake_settled_band = 1.0e5
    diagnostic.input.brake_lines = [2.0e6, 0.0]
    for tick in range(49):
        diagnostic.input.brake_request = 1.0e4 * tick
        assert diagnostic.step() == 0
    assert diagnostic.c.settled_request == 4.4e5


@pytest.mark.parametrize(
    ("front", "rear", "bits"),
    [
        (2.9e6, 1.65e6, 0),  # 400 kPa and a quarter of the expected 2 MPa, or 1 MPa
        (1.1e6, 0.35e6, 0),
        (2.9e6 + 1, 1.0e6, EST1),
        (2.9e6, 1.65e6 + 1, EST2),
        (1.1e6 - 1, 1.0e6, EST1),
        (2.0e6, 0.35e6 - 1, EST2),
    ],
)
def test_a_line_may_miss_the_request_by_its_tolerance(front: float, rear: float, bits: int) -> None:
    diagnostic = Diagnostic()
    diagnostic.brake(2.0e6)
    diagnostic.step(100)
    diagnostic.input.brake_lines = [front, rear]
    assert diagnostic.step(100) == bits


@pytest.mark.parametrize(("step", "judged"), [(1.0e5, True), (above(1.0e5), False)])
def test_a_request_inside_its_band_counts_as_constant(step: float, judged: bool) -> None:
    """It goes to and fro every 100 ms, which is less than it must stand to be judged."""
    diagnostic = Diagnostic()
    diagnostic.config.brake_settled_band = 1.0e5
    diagnostic.input.brake_lines = [2.0e6, 0.0]
    for tick in range(100):
        diagnostic.input.brake_request = step if tick // 10 % 2 else 0.0
        diagnostic.step()
    assert bool(diagnostic.c.bits & EST1) is judged


@pytest.mark.parametrize(("share", "stalls"), [(above(1.0), False), (1.0, False), (below(1.0), True)])
def test_the_lowest_engine_speed_is_no_stall(share: float, stalls: bool) -> None:
    diagnostic = Diagnostic()
    diagnostic.config.engine_low_speed = 32.0
    diagnostic.input.engine_speed = 32.0 * share
    assert diagnostic.step(100) == (EST3 if stalls else 0)
