"""System Status Manager: states, reactions, limits and the choice of the controller."""

from __future__ import annotations

from typing import Any

import pytest

from bridge._native import ffi, lib
from firmware.tables import own_faults

NOMINAL_LIMITS = (63.0, 8.0, 10.0)
DEGRADED_LIMITS = (30.0, 3.0, 10.0)

WARN = lib.FAULT_GNSS_A_WRONG_SIZE
DEGRADE = lib.FAULT_GNSS_A_TIMEOUT
SAFE_STOP = lib.FAULT_WHEEL_SPEED_MISSING
EMERGENCY_STOP = lib.FAULT_ESTIMATE_LOST
FULL_BRAKE = lib.FAULT_MISC_REPORT_MISSING


SHARES = {
    fault.id: (fault.speed_percent, fault.acceleration_percent)
    for fault in own_faults()
    if fault.speed_percent is not None and fault.acceleration_percent is not None
}


class Ssm:
    """An SSM with a healthy input that a test changes."""

    def __init__(self) -> None:
        self.c = ffi.new("ssm *")
        self.conditions = ffi.new("fault_conditions *")
        self.input = ffi.new("ssm_input *")
        self.input.conditions = self.conditions
        self.input.nominal = NOMINAL_LIMITS
        self.input.degraded = DEGRADED_LIMITS
        self.input.verdict = lib.PARAMETER_VERDICT_ACCEPTED
        self.input.degraded_allowed = True
        self.input.launch_wanted = True
        self.input.standing_still = True
        self.out = ffi.new("ssm_output *")

    def step(self, *present: int, count: int = 1) -> int:
        for index in range(lib.FAULT_COUNT):
            self.conditions.present[index] = index in present
        for _ in range(count):
            lib.ssm_step(self.c, self.input, self.out)
            self.input.now_us += 10_000
        return int(self.out.state)

    def stays(self, state: int, *present: int, count: int) -> bool:
        """Whether every one of so many steps ends in this state."""
        return all(self.step(*present) == state for _ in range(count))

    def nominal(self) -> Ssm:
        self.step(count=4)
        assert self.out.state == lib.SSM_NOMINAL
        return self

    def driving(self) -> Ssm:
        self.nominal()
        self.input.driving = True
        self.input.standing_still = False
        return self

    @property
    def limits(self) -> tuple[float, float, float]:
        limits = self.out.limits
        return (limits.max_speed, limits.max_acceleration, limits.max_deceleration)


def shared_limits(*faults: int) -> Any:
    """What these faults leave of the degraded limits, by the table's source."""
    speed = min(SHARES[fault][0] for fault in faults) / 100.0
    acceleration = min(SHARES[fault][1] for fault in faults) / 100.0
    return pytest.approx((DEGRADED_LIMITS[0] * speed, DEGRADED_LIMITS[1] * acceleration, DEGRADED_LIMITS[2]), rel=1e-6)


def nothing_allowed(out: Any) -> bool:
    return not out.drive_allowed and out.limits.max_speed == 0 and out.limits.max_acceleration == 0


def test_way_to_nominal() -> None:
    ssm = Ssm()
    seen = [ssm.step() for _ in range(4)]
    assert seen == [lib.SSM_CONFIG_CHECK, lib.SSM_LAUNCHING, lib.SSM_NOMINAL, lib.SSM_NOMINAL]
    assert ssm.out.drive_allowed
    assert ssm.out.controller == lib.CONTROL_LQR
    assert ssm.limits == NOMINAL_LIMITS
    assert (ssm.out.reaction, ssm.out.worst_fault, ssm.out.active_faults) == (0, 0, 0)


def test_waits_for_the_configuration() -> None:
    ssm = Ssm()
    ssm.input.verdict = lib.PARAMETER_VERDICT_PENDING
    assert ssm.stays(lib.SSM_CONFIG_CHECK, count=1000)
    assert nothing_allowed(ssm.out)
    ssm.input.verdict = lib.PARAMETER_VERDICT_ACCEPTED
    assert ssm.step() == lib.SSM_LAUNCHING
    assert nothing_allowed(ssm.out)


def test_rejected_configuration_is_a_full_brake_for_good() -> None:
    ssm = Ssm()
    ssm.input.verdict = lib.PARAMETER_VERDICT_REJECTED
    assert ssm.step(lib.FAULT_PARAMETERS_REJECTED) == lib.SSM_FULL_BRAKE
    assert ssm.out.worst_fault == lib.FAULT_PARAMETERS_REJECTED
    ssm.input.verdict = lib.PARAMETER_VERDICT_ACCEPTED
    for wanted in (False, True, False, True):
        ssm.input.launch_wanted = wanted
        assert ssm.stays(lib.SSM_FULL_BRAKE, count=100)
    assert nothing_allowed(ssm.out)
    assert ssm.out.reaction == lib.FAULT_REACTION_FULL_BRAKE


def test_no_launch_without_the_operator() -> None:
    ssm = Ssm()
    ssm.input.launch_wanted = False
    ssm.step(count=2)
    assert ssm.stays(lib.SSM_LAUNCHING, count=500)
    assert nothing_allowed(ssm.out)
    assert ssm.out.controller == lib.CONTROL_NONE


@pytest.mark.parametrize("fault", [i for i in range(1, lib.FAULT_COUNT) if lib.fault_table[i].blocks_launch])
def test_condition_keeps_from_nominal_without_latching(fault: int) -> None:
    ssm = Ssm()
    ssm.step(fault, count=2)
    assert ssm.stays(lib.SSM_LAUNCHING, fault, count=500)
    assert ssm.out.active_faults == 0
    assert ssm.step() == lib.SSM_NOMINAL


def test_warning_changes_nothing() -> None:
    ssm = Ssm().nominal()
    assert ssm.step(WARN) == lib.SSM_NOMINAL
    assert ssm.out.reaction == lib.FAULT_REACTION_WARN
    assert ssm.limits == NOMINAL_LIMITS


def test_the_output_is_written_whole_whatever_it_held() -> None:
    clean, dirty = Ssm().nominal(), Ssm().nominal()
    ffi.buffer(dirty.out)[:] = b"\xff" * ffi.sizeof("ssm_output")
    assert clean.step(WARN, DEGRADE) == dirty.step(WARN, DEGRADE) == lib.SSM_DEGRADED
    expected = ffi.new("ssm_output *", {name: getattr(clean.out, name) for name, _ in ffi.typeof("ssm_output").fields})
    assert bytes(ffi.buffer(dirty.out)) == bytes(ffi.buffer(clean.out)) == bytes(ffi.buffer(expected))
    assert clean.out.active_faults == 2


def test_degrades_and_recovers() -> None:
    ssm = Ssm().nominal()
    assert ssm.step(DEGRADE) == lib.SSM_DEGRADED
    assert ssm.limits == DEGRADED_LIMITS
    assert ssm.out.drive_allowed
    assert not ssm.out.safe_stop
    assert ssm.step(count=lib.fault_table[DEGRADE].clear_cycles - 1) == lib.SSM_DEGRADED
    assert ssm.step() == lib.SSM_NOMINAL


@pytest.mark.parametrize("fault", sorted(SHARES), ids=lambda fault: own_faults()[fault - 1].name)
def test_every_fault_has_its_own_limits(fault: int) -> None:
    ssm = Ssm().driving()
    row = lib.fault_table[fault]
    assert ssm.step(fault, count=row.debounce_cycles) == lib.SSM_DEGRADED
    assert ssm.limits == shared_limits(fault)
    assert 0.0 < ssm.limits[0] < NOMINAL_LIMITS[0]
    assert 0.0 < ssm.limits[1] < NOMINAL_LIMITS[1]
    if row.latch == lib.FAULT_LATCH_WHILE_PRESENT:
        ssm.step(count=row.clear_cycles - 1)
        assert ssm.limits == shared_limits(fault), "the limits stay until the fault clears"
        ssm.step()
        assert ssm.limits == NOMINAL_LIMITS


def test_of_two_faults_the_least_share_counts_and_one_that_clears_gives_its_own_back() -> None:
    mild, slow, weak = lib.FAULT_GNSS_A_TIMEOUT, lib.FAULT_BRAKE_REPORT_STUCK, lib.FAULT_ACCELERATOR_REPORT_MISSING
    assert SHARES[slow][0] < SHARES[weak][0], "each of the two has one of the least shares"
    assert SHARES[slow][1] > SHARES[weak][1]
    ssm = Ssm().driving()
    ssm.step(mild, slow, weak, count=lib.fault_table[slow].debounce_cycles)
    assert ssm.limits == shared_limits(slow, weak)
    assert ssm.step(mild, slow, WARN, count=lib.fault_table[weak].clear_cycles - 1) == lib.SSM_DEGRADED
    assert ssm.limits == shared_limits(slow, weak)
    ssm.step(mild, slow, WARN)
    assert ssm.limits == shared_limits(slow)
    ssm.step(mild, count=lib.fault_table[slow].clear_cycles)
    assert ssm.limits == shared_limits(mild)
    assert ssm.step(count=lib.fault_table[mild].clear_cycles) == lib.SSM_NOMINAL
    assert ssm.limits == NOMINAL_LIMITS


def test_degraded_driving_not_allowed_becomes_a_safe_stop() -> None:
    for fault in (DEGRADE, lib.FAULT_LQR_INVALID):
        ssm = Ssm().driving()
        ssm.input.degraded_allowed = False
        assert ssm.step(fault) == lib.SSM_EMERGENCY
        assert ssm.out.reaction == lib.FAULT_REACTION_SAFE_STOP
    ssm = Ssm().nominal()
    ssm.input.degraded_allowed = False
    assert ssm.step(WARN) == lib.SSM_NOMINAL


def test_safe_stop_holds_until_the_operator_resets_at_standstill() -> None:
    ssm = Ssm().driving()
    assert ssm.step(SAFE_STOP) == lib.SSM_EMERGENCY
    assert ssm.out.safe_stop
    assert ssm.out.drive_allowed
    assert ssm.limits == (0.0, 0.0, NOMINAL_LIMITS[2])
    assert ssm.stays(lib.SSM_EMERGENCY, count=1000), "the condition is gone, the latch is not"
    ssm.input.launch_wanted = False
    ssm.step()
    ssm.input.launch_wanted = True
    assert ssm.step() == lib.SSM_EMERGENCY, "no reset while the car moves"
    ssm.input.standing_still = True
    assert ssm.step(count=10) == lib.SSM_EMERGENCY, "standing still is no reset"
    ssm.input.launch_wanted = False
    assert ssm.step(count=10) == lib.SSM_EMERGENCY, "withdrawing is no reset"
    ssm.input.launch_wanted = True
    assert ssm.step() == lib.SSM_LAUNCHING, "a reset leads back through the launch checks"
    assert ssm.step() == lib.SSM_NOMINAL


def test_reset_with_the_condition_present_stays_in_emergency() -> None:
    ssm = Ssm().nominal()
    ssm.step(SAFE_STOP)
    ssm.input.launch_wanted = False
    ssm.step(SAFE_STOP)
    ssm.input.launch_wanted = True
    assert ssm.step(SAFE_STOP) == lib.SSM_EMERGENCY


@pytest.mark.parametrize("before", [None, WARN, DEGRADE, SAFE_STOP])
def test_full_brake_from_every_state_and_for_good(before: int | None) -> None:
    ssm = Ssm().driving()
    if before is not None:
        ssm.step(before)
    assert ssm.step(FULL_BRAKE) == lib.SSM_FULL_BRAKE
    assert nothing_allowed(ssm.out)
    assert ssm.limits == (0.0, 0.0, 0.0)
    assert ssm.out.controller == lib.CONTROL_LQR, "a full brake is steered"
    ssm.input.standing_still = True
    for wanted in (False, True, False, True):
        ssm.input.launch_wanted = wanted
        assert ssm.stays(lib.SSM_FULL_BRAKE, count=300)
    assert ssm.out.reaction == lib.FAULT_REACTION_FULL_BRAKE


def test_controllers_in_order_then_full_brake() -> None:
    ssm = Ssm().driving()
    for fault, controller in (
        (lib.FAULT_LQR_INVALID, lib.CONTROL_STANLEY),
        (lib.FAULT_STANLEY_INVALID, lib.CONTROL_PURE_PURSUIT),
    ):
        assert ssm.step(fault) == lib.SSM_DEGRADED
        assert ssm.out.controller == controller
        assert ssm.limits == shared_limits(fault)
    assert ssm.step(lib.FAULT_PURE_PURSUIT_INVALID) == lib.SSM_FULL_BRAKE
    assert ssm.out.controller == lib.CONTROL_NONE
    ssm.input.standing_still = True
    ssm.input.launch_wanted = False
    ssm.step()
    ssm.input.launch_wanted = True
    assert ssm.stays(lib.SSM_FULL_BRAKE, count=10), "a reset frees the controllers, not the brake"
    assert ssm.out.reaction == lib.FAULT_REACTION_FULL_BRAKE


def test_switched_controller_returns_by_reset_only() -> None:
    ssm = Ssm().driving()
    ssm.step(lib.FAULT_LQR_INVALID)
    ssm.step(count=1000)
    assert ssm.out.controller == lib.CONTROL_STANLEY
    ssm.input.standing_still = True
    ssm.input.launch_wanted = False
    ssm.step()
    ssm.input.launch_wanted = True
    assert ssm.step() == lib.SSM_NOMINAL
    assert ssm.out.controller == lib.CONTROL_LQR


def test_driving_faults_only_while_driving() -> None:
    ssm = Ssm().nominal()
    assert ssm.step(lib.FAULT_LQR_INVALID, count=10) == lib.SSM_NOMINAL
    ssm.input.driving = True
    assert ssm.step(lib.FAULT_LQR_INVALID) == lib.SSM_DEGRADED


def test_state_that_does_not_exist_is_a_full_brake() -> None:
    ssm = Ssm().nominal()
    ssm.c.state = 7
    assert ssm.step() == lib.SSM_FULL_BRAKE
    assert nothing_allowed(ssm.out)


def test_an_emergency_stop_follows_the_wall_until_a_reset_at_standstill() -> None:
    ssm = Ssm().driving()
    ssm.input.wall_followed = True
    assert ssm.step() == lib.SSM_NOMINAL
    assert ssm.out.controller == lib.CONTROL_LQR, "a wall alone changes nothing"
    ssm.step(EMERGENCY_STOP, count=lib.fault_table[EMERGENCY_STOP].debounce_cycles)
    assert (ssm.out.state, ssm.out.controller) == (lib.SSM_EMERGENCY, lib.CONTROL_EMERGENCY)
    assert (ssm.out.reaction, ssm.out.worst_fault) == (lib.FAULT_REACTION_EMERGENCY_STOP, EMERGENCY_STOP)
    assert ssm.out.safe_stop
    assert ssm.limits == (0.0, 0.0, NOMINAL_LIMITS[2])
    assert ssm.stays(lib.SSM_EMERGENCY, count=200), "the condition has gone, the latch holds"
    assert ssm.out.controller == lib.CONTROL_EMERGENCY
    ssm.input.standing_still, ssm.input.driving = True, False
    ssm.input.launch_wanted = False
    ssm.step(count=5)
    ssm.input.launch_wanted = True
    assert ssm.step() == lib.SSM_LAUNCHING


def test_an_emergency_stop_without_a_wall_is_a_full_brake_for_good() -> None:
    ssm = Ssm().driving()
    ssm.step(EMERGENCY_STOP, count=lib.fault_table[EMERGENCY_STOP].debounce_cycles)
    assert (ssm.out.state, ssm.out.controller) == (lib.SSM_FULL_BRAKE, lib.CONTROL_NONE)
    assert nothing_allowed(ssm.out)
    ssm.input.wall_followed = True
    assert ssm.stays(lib.SSM_FULL_BRAKE, count=200)
    assert ssm.out.controller == lib.CONTROL_EMERGENCY, "a full brake is steered by what is there"


def test_a_wall_that_is_lost_during_the_stop_ends_it() -> None:
    ssm = Ssm().driving()
    ssm.input.wall_followed = True
    ssm.step(EMERGENCY_STOP, count=lib.fault_table[EMERGENCY_STOP].debounce_cycles)
    ssm.input.wall_followed = False
    assert ssm.step(EMERGENCY_STOP) == lib.SSM_FULL_BRAKE
    assert ssm.out.controller == lib.CONTROL_NONE


def test_a_car_that_knows_where_it_is_never_follows_the_wall() -> None:
    for fault in range(1, lib.FAULT_COUNT):
        if lib.fault_table[fault].reaction == lib.FAULT_REACTION_EMERGENCY_STOP:
            continue
        ssm = Ssm().driving()
        ssm.input.wall_followed = True
        ssm.step(fault, count=lib.fault_table[fault].debounce_cycles)
        assert ssm.out.controller != lib.CONTROL_EMERGENCY
