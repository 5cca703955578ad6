"""Fuzz of the three ECUs: disturbed frames, odd wired signals and jumps of time; what must hold, holds in every tick.

Each test prints how to run one seed again. RACELOOP_FUZZ_SEEDS=N runs N seeds instead of the few of the suite.
"""

from __future__ import annotations

import copy
import math
import random
from typing import Any

import pytest
from actuator_ecus import BRAKE_STOP, FULL_BRAKE, STEERED_BRAKE, Car, Requests, SpaceDrive, car_in, frames_buffer
from frame_fuzz import EPISODE_TICKS, EPISODES, RATES, Disturber, Judge, Snapshot, announce, disturb_wires, seeds
from obc_harness import TICK_US, ObcHarness, cast_frames

from bridge._native import ffi, lib
from dbc.buses import Station
from dbc.frames import Bus, iterate

STEERING_LIMIT_DEG = math.degrees(0.26) * 15.0  # of scenarios/operations/solo.yaml, at the motor
STEERING_STEP_DEG = math.degrees(0.6 * 0.01) * 15.0
STEERING_STOP_RAD = math.radians(240.0)
SENSOR_END_RAD = math.radians(250.0)


def next_tick(generator: random.Random, now_us: int, rate: float) -> int:
    """Return the next tick's start: 10 ms later, or with `rate` a late, an early or a wildly wrong clock."""
    if generator.random() >= rate:
        return now_us + TICK_US
    return max(
        0, now_us + generator.choice((TICK_US + 4_000, 35_000, 2_000_000, 3_600_000_000, 0, -5_000, -7_200_000_000))
    )


# --- onboard computer ---


class FuzzedObc:
    """The onboard computer among healthy frames, disturbed on their way to it, and what it must never do."""

    def __init__(self, generator: random.Random) -> None:
        self.generator = generator
        self.disturber = Disturber(generator, (Bus.CAN1, Bus.CAN_A, Bus.CAN_S))
        self.judge = Judge(Station.OBC, most=40)
        self.harness = ObcHarness()
        self.starts = [self._start()]
        self.harness.plan_speed = 40.0
        self.harness.launch()
        self.starts.append(self._start())
        self.harness = ObcHarness()
        self.harness.plan_speed = 40.0
        self.harness.drive()
        self.harness.set_speed(20.0)
        self.harness.signals["pt_report_1"] |= {"current_gear": 2, "engine_speed_rpm": 5000}
        self.harness.run(30)
        assert self.harness.throttle > 0
        self.starts.append(self._start())
        self.states: set[int] = set()

    def _start(self) -> tuple[ObcHarness, Snapshot, int, dict[str, dict[str, float]]]:
        harness = self.harness
        return harness, Snapshot(harness.obc), harness.now_us, copy.deepcopy(harness.signals)

    def episode(self, ticks: int) -> None:
        self.harness, snapshot, now_us, signals = self.generator.choice(self.starts)
        snapshot.restore()
        self.harness.now_us = now_us
        self.harness.signals = copy.deepcopy(signals)
        self.harness.extra.clear()
        self.disturber.forget()
        self.judge.forget()
        self.steering: float | None = None
        self.full_brake = self.terminal = 0
        rate = self.generator.choice(RATES)
        clock_rate = self.generator.choice((0.0, 0.0, 0.0, 0.01))
        if self.generator.random() < 0.3:
            self.harness.configure()
        for tick in range(ticks):
            self.disturber.rate = rate if tick < ticks * 3 // 4 else 0.0
            self._wander()
            self._tick()
            self.harness.now_us = next_tick(self.generator, self.harness.now_us - TICK_US, clock_rate)

    def _wander(self) -> None:
        """What others say now and then changes, within what they may say."""
        generator, signals = self.generator, self.harness.signals
        if generator.random() < 0.03:
            signals["misc_report"]["sys_state"] = generator.choice((1, 2, 4, 5, 6, 8, 9, 9, 9, 16))
        if generator.random() < 0.03:
            signals["base_to_car_summary"] |= {
                "track_flag": generator.randint(1, 4), "veh_flag": generator.choice((0, 0, 1, 2, 4, 8)),
            }  # fmt: skip
        if generator.random() < 0.03:
            self.harness.set_speed(generator.choice((0.0, 0.1, 20.0, 63.0, 90.0)))
        if generator.random() < 0.03:
            signals["estimate_motion"]["estimate_yaw"] = generator.uniform(-3.1, 3.1)
        if generator.random() < 0.03:
            signals["launch_request"]["launch_wanted"] = generator.randint(0, 1)

    def _tick(self) -> None:
        harness = self.harness
        frames = [*harness.extra, *harness.due()]
        harness.extra.clear()
        array, count = cast_frames(b"".join(self.disturber(frames)))
        lib.obc_tick(harness.obc, harness.now_us, array, count, harness.outbox.c)
        sent = list(iterate(harness.outbox.take()))
        harness.now_us += TICK_US
        assert all(frame.sender == Station.OBC for frame in sent)
        self._check(self.judge.check(sent, harness.outbox.c), [frame.id for frame in sent])

    def _check(self, found: dict[str, tuple[float, ...]], ids: list[int]) -> None:
        assert [number for number in ids if 1400 <= number <= 1402] == [1400, 1401, 1402], "once each, the brake first"
        brake, throttle = found["brake_pressure_cmd"][0], found["accelerator_cmd"][0]
        steering = found["steering_cmd"][0]
        state, ct_state = self.harness.obc.ssm.state, self.harness.obc.ct_state
        self.states.add(state)

        # A disturbed parameter_write may carry another pressure that is allowed, and has no CRC.
        full_kpa, steered_kpa = (
            round(lib.parameters_real(ffi.addressof(self.harness.obc.parameters), index) / 1000.0)
            for index in (lib.PARAMETER_FULL_BRAKE_PRESSURE, lib.PARAMETER_STEERED_BRAKE_PRESSURE)
        )
        assert 0 <= brake <= full_kpa
        assert 0 <= throttle <= 100
        assert brake == 0 or throttle == 0
        assert abs(steering) <= STEERING_LIMIT_DEG + 0.25
        assert self.steering is None or abs(steering - self.steering) <= STEERING_STEP_DEG + 0.5
        self.steering = steering
        assert found.get("gear_shift_cmd", (0.0,))[0] <= 6
        if state not in (lib.SSM_NOMINAL, lib.SSM_DEGRADED, lib.SSM_EMERGENCY):
            steered = state == lib.SSM_FULL_BRAKE and self.harness.obc.ssm_output.controller != lib.CONTROL_NONE
            assert (brake, throttle) in {(full_kpa, 0), (steered_kpa if steered else full_kpa, 0)}
        if throttle > 0:
            assert state in (lib.SSM_NOMINAL, lib.SSM_DEGRADED)
            assert ct_state in (lib.CT_CAUTION, lib.CT_NOM_RACE, lib.CT_COORD_STOP)
        if state > lib.SSM_LAUNCHING and state != lib.SSM_FULL_BRAKE:
            assert self.harness.obc.parameters.verdict == lib.PARAMETER_VERDICT_ACCEPTED
        assert not self.full_brake or state == lib.SSM_FULL_BRAKE, "until restart"
        self.full_brake = state == lib.SSM_FULL_BRAKE
        assert not self.terminal or ct_state == self.terminal
        self.terminal = ct_state if ct_state in (lib.CT_CNTRL_SHUTDOWN, lib.CT_EMRG_SHUTDOWN) else 0
        if ct_state == lib.CT_EMRG_SHUTDOWN:
            # By the purple flag the SSM may be in any running state, and its controller steers the full brake.
            steered = self.harness.obc.ssm_output.controller != lib.CONTROL_NONE
            assert (brake, throttle) in {(full_kpa, 0), (steered_kpa if steered else full_kpa, 0)}


@pytest.mark.parametrize("seed", seeds(2))
def test_obc(seed: int) -> None:
    generator = announce("test_obc", seed)
    fuzzed = FuzzedObc(generator)
    for _ in range(EPISODES):
        fuzzed.episode(EPISODE_TICKS)
    assert {lib.SSM_NOMINAL, lib.SSM_EMERGENCY, lib.SSM_FULL_BRAKE} <= fuzzed.states, "the fuzz reaches what it is for"


# --- Raptor ---


class FuzzedRaptor:
    """Raptor between a healthy onboard computer and a healthy Space Drive, both heard badly, its wires loose."""

    def __init__(self, generator: random.Random) -> None:
        self.generator = generator
        self.disturber = Disturber(generator, (Bus.CAN1, Bus.CAN3))
        self.judge = Judge(Station.RAPTOR, most=35)
        self.starts = [self._start(car_in(state)) for state in (1, 3, 6, 8, 9)]
        self.states: set[int] = set()

    def _start(self, car: Car) -> tuple[Car, Snapshot, int, dict[str, Any]]:
        computer = car.computer
        if car.state == 9:
            computer.brake_kpa, computer.accelerator = 0.0, 40.0
            car.set_wheels(20.0)
            car.run(5)
        snapshot = Snapshot(
            car.c, car.wired, car.drive, car.space_drive.c, car.space_drive.wired, car.space_drive.drive
        )
        return car, snapshot, car.now_us, copy.deepcopy(vars(computer))

    def episode(self, ticks: int) -> None:
        self.car, snapshot, now_us, computer = self.generator.choice(self.starts)
        snapshot.restore()
        vars(self.car.computer).update(copy.deepcopy(computer))
        self.car.now_us = self.car.space_drive.now_us = now_us
        self.car.wired.safety_switch = 4
        self.disturber.forget()
        self.judge.forget()
        self.latched = 0
        self.gear = self.car.c.demand.gear
        rate, wire_rate = self.generator.choice(RATES), self.generator.choice((0.0, 0.0, 0.002, 0.05))
        clock_rate = self.generator.choice((0.0, 0.0, 0.0, 0.01))
        heard: list[bytes] = []
        for tick in range(ticks):
            self.disturber.rate = rate if tick < ticks * 3 // 4 else 0.0
            self._wander()
            disturb_wires(self.generator, self.car.wired, wire_rate)
            heard = self._tick(heard)
            self.car.now_us = next_tick(self.generator, self.car.now_us, clock_rate)

    def _wander(self) -> None:
        generator, computer = self.generator, self.car.computer
        if generator.random() < 0.03:
            computer.ct_state = generator.choice((3, 4, 5, 6, 7, 8, 9, 10, 11, 12))
        if generator.random() < 0.05:
            computer.accelerator, computer.brake_kpa = generator.choice(((60, 0), (0, 3000), (50, 400), (70, 6000)))
        if generator.random() < 0.05:
            computer.gear = generator.randint(0, 8)
        if generator.random() < 0.05:
            computer.steer_deg = generator.choice((0.0, 20.0, -240.0, 240.0, 300.0))
        if generator.random() < 0.02:
            self.car.wired.race_control.track_flag = generator.randint(1, 4)

    def _tick(self, heard: list[bytes]) -> list[bytes]:
        car = self.car
        array, count = frames_buffer(self.disturber([*heard, *car.computer.frames()]))
        lib.raptor_tick(car.c, car.now_us, car.wired, array, count, car.drive, car.outbox.c)
        sent = car.outbox.take()
        self._check(self.judge.check(sent, car.outbox.c))
        answers = car.space_drive.tick(frame.pack() for frame in sent if frame.bus == Bus.CAN3).frames
        car._stimulate()
        return [frame.pack() for frame in answers]

    def _check(self, found: dict[str, tuple[float, ...]]) -> None:
        car, state = self.car, self.car.state
        demand, drive, config = car.c.demand, car.drive, car.c.config
        self.states.add(state)
        braked = BRAKE_STOP * (1.0 - found["req_brake_pos"][0] / 0x4000)

        assert 0.0 <= demand.brake <= BRAKE_STOP
        assert braked == pytest.approx(demand.brake, abs=200.0), "the Space Drive is asked for just that"
        assert abs(demand.steer) <= STEERING_STOP_RAD * 1.0001
        assert 0.0 <= drive.throttle_demand <= 1.0
        assert drive.throttle_demand == 0.0 or (state == 9 and demand.brake <= config.pedal_conflict_brake)
        assert drive.gear_demand <= 6
        assert abs(drive.gear_demand - self.gear) <= 1
        self.gear = drive.gear_demand
        assert not drive.ignition or state in (7, 8, 9)
        assert not drive.starter or state == 7
        if car.c.commands.faults or not car.c.commands.brake_known or state in (11, 14, 15, 16, 17):
            commands = car.c.commands
            silent = commands.faults & lib.RAPTOR_COMMAND_STEERING_TIMEOUT or not commands.steering_known
            unsteered = silent or commands.steering_implausible >= config.implausible_limit
            assert demand.brake >= (FULL_BRAKE if unsteered else STEERED_BRAKE)
            assert drive.throttle_demand == 0.0
        elif state not in (3, 9):
            assert demand.brake >= config.brake_hold
        assert not self.latched or state == self.latched, "until restart"
        self.latched = state if state in (11, 16) else 0
        assert found["misc_report"][1] == state


@pytest.mark.parametrize("seed", seeds(2))
def test_raptor(seed: int) -> None:
    generator = announce("test_raptor", seed)
    fuzzed = FuzzedRaptor(generator)
    for _ in range(EPISODES):
        fuzzed.episode(EPISODE_TICKS)
    assert {3, 9, 16} <= fuzzed.states, "the fuzz reaches what it is for"


# --- Space Drive ---


class FuzzedSpaceDrive:
    def __init__(self, generator: random.Random) -> None:
        self.generator = generator
        self.disturber = Disturber(generator, (Bus.CAN3,))
        self.judge = Judge(Station.SPACE_DRIVE, most=15)
        self.released = self.braked = 0

    def episode(self, ticks: int) -> None:
        generator = self.generator
        self.drive, requests = SpaceDrive(), Requests(brake=1.0e6)
        self.judge.forget()
        self.disturber.forget()
        self.emergency, self.shutdown = 0, False
        rate, wire_rate = generator.choice(RATES), generator.choice((0.0, 0.0, 0.002, 0.05))
        clock_rate = generator.choice((0.0, 0.0, 0.0, 0.01))
        healthy = generator.randrange(20)
        sensors = [(axis, channel) for axis in ("steer_motor_angle", "brake_pressure") for channel in range(3)]
        broken = generator.sample(sensors, generator.choice((0, 0, 1, 2, 3)))
        self.stuck = {place: generator.choice((math.nan, math.inf, -1.0, 0.0, 2.0, 3.0e6)) for place in broken}
        for tick in range(ticks):
            disturbed = tick >= healthy
            self.disturber.rate = rate if disturbed else 0.0
            if generator.random() < 0.1:
                requests.steer, requests.brake = generator.uniform(-4.0, 4.0), generator.uniform(0.0, BRAKE_STOP)
                requests.speed_kmh = generator.choice((0, 1, 200))
            self._tick(self.disturber(requests.frames()), wire_rate if disturbed else 0.0)
            self.drive.now_us = next_tick(generator, self.drive.now_us, clock_rate if disturbed else 0.0)

    def _tick(self, frames: list[bytes], wire_rate: float) -> None:
        drive = self.drive
        disturb_wires(self.generator, drive.wired, wire_rate)
        for (axis, channel), value in self.stuck.items():
            getattr(drive.wired, axis)[channel] = value
        array, count = frames_buffer(frames)
        lib.space_drive_tick(drive.c, drive.now_us, drive.wired, array, count, drive.drive, drive.outbox.c)
        self._check(self.judge.check(drive.outbox.take(), drive.outbox.c))
        drive.sense(drive.drive.steer_motor_demand, drive.drive.brake_pressure_demand)

    def _check(self, found: dict[str, tuple[float, ...]]) -> None:
        state, brake = self.drive.c, self.drive.drive.brake_pressure_demand
        assert sum(name.startswith("calb_") for name in found) == 6
        assert 0.0 <= brake <= BRAKE_STOP
        assert abs(self.drive.drive.steer_motor_demand) <= SENSOR_END_RAD, "NaN is not"
        assert state.emergency & self.emergency == self.emergency, "until restart"
        assert state.shutdown or not self.shutdown
        self.emergency, self.shutdown = state.emergency, state.shutdown
        if state.emergency or state.shutdown or not (state.steer.ready and state.brake.ready):
            causes = lib.SPACE_DRIVE_EMERGENCY_BRAKE_REQUESTS | lib.SPACE_DRIVE_EMERGENCY_BRAKE_SENSORS
            assert brake == (STEERED_BRAKE if state.emergency and not state.emergency & ~causes else FULL_BRAKE)
            self.braked += 1
        else:
            self.released += brake < STEERED_BRAKE


@pytest.mark.parametrize("seed", seeds(2))
def test_space_drive(seed: int) -> None:
    generator = announce("test_space_drive", seed)
    fuzzed = FuzzedSpaceDrive(generator)
    for _ in range(EPISODES):
        fuzzed.episode(EPISODE_TICKS)
    assert fuzzed.released > 100
    assert fuzzed.braked > 100
