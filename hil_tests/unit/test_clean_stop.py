"""An ECU that is told to stop: full brake in the next tick, whatever it did before, and until it starts again."""

from __future__ import annotations

import pytest
from actuator_ecus import FULL_BRAKE, STEERED_BRAKE, Requests, SpaceDrive, car_in
from obc_harness import ObcHarness

from bridge._native import ffi, lib

FULL_BRAKE_KPA, STEERED_BRAKE_KPA = 4500, 3500
EMERGENCY, PWR_OFF = 16, 11


def power_on(_harness: ObcHarness) -> None:
    pass


def wait_for_a_configuration(harness: ObcHarness) -> None:
    harness.run(50)
    assert harness.state == lib.SSM_CONFIG_CHECK


def drive(harness: ObcHarness) -> None:
    harness.plan_speed = 30.0
    harness.drive()
    harness.set_speed(20.0)
    harness.run(30)
    assert harness.state == lib.SSM_NOMINAL
    assert harness.brake_kpa < STEERED_BRAKE_KPA


@pytest.mark.parametrize("prepare", [power_on, wait_for_a_configuration, ObcHarness.launch, drive])
def test_the_onboard_computer_brakes_and_says_why(prepare):
    harness = ObcHarness()
    prepare(harness)
    before = harness.ct_state if harness.received else lib.CT_PWR_ON
    lib.obc_stop(harness.obc)
    for _ in range(300):
        harness.tick()
        full = STEERED_BRAKE_KPA if prepare is drive else FULL_BRAKE_KPA
        assert (harness.brake_kpa, harness.throttle) == (full, 0)
        assert harness.state == lib.SSM_FULL_BRAKE
        assert harness.value("ssm_status", "ssm_worst_fault") == lib.FAULT_COMPUTER_STOPPING
    assert harness.ct_state == (lib.CT_EMRG_SHUTDOWN if prepare is drive else before)
    lib.obc_init(harness.obc)
    harness.launch()


@pytest.mark.parametrize("state", [1, 2, 3, 4, 5, 6, 7, 8, 9])
def test_the_raptor_shuts_down_and_brakes(state: int):
    car = car_in(state)
    car.computer.accelerator = 20.0
    car.tick()
    lib.raptor_stop(car.c)
    for _ in range(300):
        car.tick()
        assert car.state == EMERGENCY
        assert car.c.demand.brake == STEERED_BRAKE
        assert (car.drive.throttle_demand, car.drive.ignition, car.drive.starter) == (0.0, False, False)
    assert car.space_drive.drive.brake_pressure_demand == pytest.approx(STEERED_BRAKE, abs=200)
    lib.raptor_init(car.c, ffi.NULL)
    car.tick()
    assert car.state == 1


def test_a_raptor_that_is_off_stays_off():
    car = car_in(9)
    car.computer.brake_kpa = 2000.0
    car.set_wheels(0.0)
    car.computer.ct_state = 11
    car.run_until(PWR_OFF)
    car.run(20)
    assert car.space_drive.c.shutdown
    lib.raptor_stop(car.c)
    lib.space_drive_stop(car.space_drive.c)
    car.run(20)
    assert car.state == PWR_OFF
    assert (car.c.demand.brake, car.space_drive.c.brake_demand) == (FULL_BRAKE, FULL_BRAKE)
    assert car.space_drive.c.emergency == 0


def test_the_space_drive_brakes_steers_and_reports():
    drive, requests = SpaceDrive(), Requests(0.2, 1.0e6)
    for _ in range(20):
        drive.tick(requests.frames())
    assert drive.drive.brake_pressure_demand == pytest.approx(1.0e6, abs=200)
    lib.space_drive_stop(drive.c)
    requests.steer = -0.3
    reports = []
    for _ in range(300):
        sent = drive.tick(requests.frames())
        assert drive.drive.brake_pressure_demand == FULL_BRAKE
        reports += sent.of("stat_brk_1")
    assert {report["emr_brk"] for report in reports} == {1.0}
    assert drive.drive.steer_motor_demand == pytest.approx(-0.3, abs=2.6e-4)
    assert drive.c.emergency == lib.SPACE_DRIVE_EMERGENCY_STOPPING
    lib.space_drive_init(drive.c, ffi.NULL)
    for _ in range(20):
        drive.tick(requests.frames())
    assert drive.drive.brake_pressure_demand == pytest.approx(1.0e6, abs=200)


def test_a_space_drive_is_told_to_stop_before_its_first_tick():
    drive, requests = SpaceDrive(), Requests(0.0, 0.0)
    lib.space_drive_stop(drive.c)
    for _ in range(50):
        drive.tick(requests.frames())
        assert drive.drive.brake_pressure_demand == FULL_BRAKE
