"""Faults end to end: from the injection to what bus, brakes and car do, with times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bridge._native import lib
from bridge.bench import Bench
from bridge.condition import Condition
from bridge.faults import (
    ActuatorStuck,
    BrakeFade,
    BusError,
    ClockDrift,
    Drop,
    EngineStall,
    ExecutionTime,
    FaultPlan,
    Freeze,
    GripLoss,
    Hang,
    Masquerade,
    MemoryAltered,
    Offset,
    Onset,
    ParameterAltered,
    Partition,
    PowerLoss,
    Reset,
    SensorOutage,
    Slow,
    WireAltered,
)
from bridge.observed_bench import MissedError, ObservedBench
from bridge.operator import Verdict
from bridge.plant import REQUIRED_INPUTS
from bridge.wiring import NOMINAL_FRICTION, PLACE_OF_FRICTION
from dbc.errors import CodecError, ConfigurationError
from dbc.frames import Bus, Station
from dbc.states import SsmState, SysState
from firmware.tables import own_faults
from tools.run import build_bench, chosen_scenario

FULL_BRAKE_PA = 4.5e6
FULL_BRAKE_KPA = 4500.0
FAULT = {fault.name: fault.id for fault in own_faults()}


def driving(bench: ObservedBench, speed: float = 10.0) -> None:
    bench.run_to(lambda: bench.truth.vx > speed)


def full_brake(bench: ObservedBench) -> Callable[[], bool]:
    return lambda: bool(bench.wiring.space_drive_out.brake_pressure_demand > 0.999 * FULL_BRAKE_PA)


def test_a_run_with_faults_that_wait_or_change_nothing_is_the_run_without() -> None:
    scenario = chosen_scenario("short_drive", None)
    logs = []
    for faults in (False, True):
        with build_bench(scenario) as bench:
            if faults:
                bench.inject(Drop(message="steering_cmd"), onset=Onset(station_m=1e6, ssm_state=SsmState.NOMINAL))
                for message, signal in (("steering_cmd", "steering_motor_ang_cmd"), ("imu_rates", "imu_yaw_rate")):
                    bench.inject(Offset(message=message, signal=signal, value=0.0))
                bench.inject(GripLoss(factor=0.5), onset=Onset(Condition(time_us=10**9)))
            for _ in range(150):
                bench.tick()
            logs.append((bench.network.drain_log().tobytes(), bench.plant.outputs.tobytes()))
            assert [injection.count for injection in bench.injections] == [0, 0, 0, 0][: len(bench.injections)]
            assert bench.losses == 0
    assert logs[0] == logs[1]


def test_without_faults_nothing_is_diverted_and_nobody_is_asked() -> None:
    with build_bench(chosen_scenario("short_drive", None)) as bench:
        bench.tick()
        assert bench.injections == []
        assert not bench.network.handle.diverting
        assert bench.network.handle.watch_count == 2


@pytest.mark.expects_faults
def test_raptor_brakes_when_the_obc_hangs(bench: ObservedBench) -> None:
    driving(bench)
    hang = bench.inject(Hang(station=Station.OBC))
    took_us = bench.run_to(full_brake(bench), within_s=0.2)
    assert 90_000 <= took_us <= 130_000
    assert bench.wiring.raptor_out.throttle_demand == 0.0
    assert bench.wait_for("diagnostic_report", 0.05).signals["adlink_hb_lost"] == 1.0
    bench.run_to(lambda: bench.situation.standstill, within_s=5.0)
    hang.cancel()
    bench.run_for(1.0)
    assert full_brake(bench)()
    assert bench.situation.sys_state == SysState.EMERGENCY_SHUTDOWN
    assert hang.count * 10_000 == hang.ended_us - hang.first_us  # type: ignore[operator]


@pytest.mark.expects_faults
def test_raptor_brakes_when_the_steering_counter_stands_still(bench: ObservedBench) -> None:
    driving(bench)
    stuck = bench.inject(Freeze(message="steering_cmd", signal="steering_motor_cmd_counter"))
    first = bench.wait_for("steering_cmd", 0.02)
    assert (
        bench.wait_for("steering_cmd", 0.02).signals["steering_motor_cmd_counter"]
        == (first.signals["steering_motor_cmd_counter"])
    )
    took_us = bench.run_to(full_brake(bench), within_s=0.3)
    assert stuck.active
    assert 90_000 <= took_us + 20_000 <= 130_000


@pytest.mark.expects_faults(
    "gnss_a_timeout",
    "gnss_b_timeout",
    "gnss_a_low_rate",
    "gnss_b_low_rate",
    "estimation_not_ok",
    "estimation_failed",
    "estimation_low_reliability",
    "planning_low_reliability",
    "estimate_bad",
    "estimate_lost",
)
def test_ssm_degrades_and_stops_the_car_when_both_gnss_are_lost(bench: ObservedBench) -> None:
    """A receiver is missed 150 ms after its last sample; the estimator bears two seconds, the SSM no more: then
    the wall is what is left."""
    driving(bench)
    for sensor in ("gnss_a", "gnss_b"):
        bench.inject(SensorOutage(sensor=sensor))
    begin_us = bench.now_us
    degraded = bench.wait_for("ssm_status", 0.17, lambda s: s["ssm_state"] == SsmState.DEGRADED)
    assert degraded.time_us - begin_us >= 100_000
    stopping = bench.wait_for("ssm_status", 2.1, lambda s: s["ssm_state"] == SsmState.EMERGENCY)
    assert stopping.time_us - begin_us >= 2_000_000
    assert stopping.signals["ssm_controller"] == lib.CONTROL_EMERGENCY
    bench.run_to(lambda: bench.situation.standstill, within_s=4.0)


@pytest.mark.expects_faults
def test_brakes_that_fade_stop_the_car_later(bench: ObservedBench) -> None:
    """A tenth of the pressure; the grip of the tyres would give eight times what is left of the brakes."""
    driving(bench)
    fade = bench.inject(BrakeFade(factor=0.1))
    bench.inject(PowerLoss(station=Station.OBC))
    begin, begin_us = bench.truth.distance, bench.now_us
    front = bench.plant.output_names.index("brake_pressure_front")
    pressure = 0.0
    while not bench.situation.standstill:
        bench.tick()
        pressure = max(pressure, float(bench.plant.outputs[front]))
    assert bench.wiring.space_drive_out.brake_pressure_demand == pytest.approx(FULL_BRAKE_PA)  # they are asked for all
    assert pressure == pytest.approx(0.1 * FULL_BRAKE_PA, rel=1e-3)
    distance = bench.truth.distance - begin
    assert 10.0**2 / (2 * 6.0) < distance < 30.0  # test_full_brake asks for 6 m/s2 of sound brakes
    assert fade.count == (bench.now_us - begin_us) // 10_000


def test_power_loss_of_the_raptor_lets_its_outputs_fall_off_and_a_reset_starts_it_anew(bench: ObservedBench) -> None:
    bench.run_to(Condition(sys_state=SysState.SUBSYS_CON))
    lost = bench.inject(PowerLoss(station=Station.RAPTOR), for_us=50_000)
    bench.run_for(0.05)
    assert (lost.active, lost.count) == (True, 5)
    assert Station.RAPTOR in bench.silent
    bench.run_for(0.02)
    assert Station.RAPTOR not in bench.silent
    assert bench.situation.sys_state == SysState.PWR_ON
    bench.run_to(Condition(sys_state=SysState.SUBSYS_CON), within_s=2.0)
    reset = bench.inject(Reset(station=Station.RAPTOR))
    bench.run_to(Condition(sys_state=SysState.PWR_ON), within_s=0.02)
    bench.run_to(Condition(sys_state=SysState.SUBSYS_CON), within_s=2.0)
    assert (reset.count, reset.done, reset.ended_us) == (1, True, reset.first_us)


def test_a_hung_raptor_keeps_its_outputs_and_a_dead_one_does_not(bench: ObservedBench) -> None:
    bench.run_for(0.1)
    bench.wiring.raptor_out.ignition = True
    hang = bench.inject(Hang(station=Station.RAPTOR))
    bench.run_for(0.02)
    assert bench.wiring.raptor_out.ignition
    hang.cancel()
    bench.inject(PowerLoss(station=Station.RAPTOR))
    bench.run_for(0.01)
    assert not bench.wiring.raptor_out.ignition


def test_a_slow_obc_sends_every_third_tick(bench: ObservedBench) -> None:
    bench.run_for(0.1)
    slow = bench.inject(Slow(station=Station.OBC, every=3), for_us=90_000)
    first = bench.network.logged()
    bench.run_for(0.12)
    log = bench.network.log_view(first)
    ticks = np.unique(log["time_us"][(log["sender"] == Station.OBC) & (log["bus"] == Bus.CAN1)] // 10_000)
    assert ticks.tolist() == [12, 15, 18, 19, 20, 21]
    assert slow.count == 6
    assert bench.losses == 0


def test_an_obc_that_resets_under_way_brakes_and_stays(bench: ObservedBench) -> None:
    """Its configuration is gone, and nobody sends it again: full brake from its first frame on."""
    driving(bench)
    reset = bench.inject(Reset(station=Station.OBC))
    first = bench.wait_for("brake_pressure_cmd", 0.01)
    assert first.signals["brake_pressure_cmd"] == FULL_BRAKE_KPA
    bench.run_to(full_brake(bench), within_s=0.02)
    bench.run_to(lambda: bench.situation.standstill, within_s=3.0)
    bench.run_for(1.0)
    assert full_brake(bench)()
    assert reset.count == 1
    assert bench.complaints() == []
    assert bench.monitor.state("ssm") == "CONFIG_CHECK"


@pytest.mark.expects_faults
def test_actuator_stuck_engine_stall_and_grip(bench: ObservedBench) -> None:
    driving(bench)
    stuck = bench.inject(ActuatorStuck(actuator="steering", value=0.2), for_us=50_000)
    grip = bench.inject(GripLoss(factor=0.4), for_us=50_000)
    bench.inject(GripLoss(factor=0.3, wheel="fr"), for_us=50_000)
    grips = slice(len(REQUIRED_INPUTS), None)
    bench.tick()
    assert bench.plant.inputs[0] == 0.2
    assert bench.plant.inputs[PLACE_OF_FRICTION] == pytest.approx(0.4)
    assert bench.plant.inputs[grips].tolist() == [1.0, 0.3, 1.0, 1.0]
    bench.run_for(0.05)
    assert (stuck.count, grip.count) == (5, 5)
    assert bench.plant.inputs[0] == pytest.approx(bench.wiring.space_drive_out.steer_motor_demand)
    assert bench.plant.inputs[PLACE_OF_FRICTION] == NOMINAL_FRICTION
    assert bench.plant.inputs[grips].tolist() == [1.0] * 4
    running = bench.plant.output_names.index("engine_running")
    assert bench.plant.outputs[running] == 1.0
    bench.inject(EngineStall())
    bench.run_to(lambda: bench.plant.outputs[running] == 0.0, within_s=0.05)


def test_memory_is_altered_at_the_start_of_a_tick_or_behind_a_task(bench: ObservedBench) -> None:
    bench.run_for(0.1)
    road_wheel = bench.obc.control_output.road_wheel_angle
    last = bench.inject(MemoryAltered(station=Station.OBC, field="control_output.road_wheel_angle[1]", value="nan"))
    bench.tick()
    assert np.isfinite(road_wheel[1])  # control has written it anew
    last.cancel()
    behind = {"station": Station.OBC, "after": "control"}
    lqr = MemoryAltered(field="control_output.road_wheel_angle[CONTROL_LQR]", value="nan", **behind)
    stanley = MemoryAltered(field="control_output.road_wheel_angle[CONTROL_STANLEY]", value=0.5, **behind)
    bench.inject(lqr, for_us=20_000)
    longer = bench.inject(stanley, for_us=40_000)
    bench.run_for(0.02)
    assert np.isnan(road_wheel[1])
    assert road_wheel[2] == 0.5
    bench.tick()
    assert np.isfinite(road_wheel[1])
    assert road_wheel[2] == 0.5
    bench.run_for(0.02)
    assert road_wheel[2] != 0.5
    assert longer.count == 4
    assert not bench.obc.executive.clock
    kept = bench.inject(MemoryAltered(station=Station.RAPTOR, field="demand.steer_held", value=0), for_us=10_000)
    bench.tick()
    assert kept.count == 1


@pytest.mark.expects_faults
def test_execution_time_counts_as_an_overrun_and_wires_read_something_else(bench: ObservedBench) -> None:
    bench.run_for(0.1)
    record = bench.obc.executive.records[1]
    bench.inject(ExecutionTime(task="control", extra_us=11_000), for_us=30_000)
    bench.run_for(0.05)
    assert (record.overruns, record.last_us, bench.obc.executive.overruns) == (3, 0, 3)
    wired = bench.wiring.raptor_in
    front = bench.inject(WireAltered(station=Station.RAPTOR, input="brake_pressure_front", offset=1e6), for_us=30_000)
    bench.inject(WireAltered(station=Station.RAPTOR, input="safety_switch", value=7), for_us=30_000)
    column = bench.plant.output_names.index("brake_pressure_front")
    switch = wired.safety_switch
    assert switch != 7
    for _ in range(3):
        true = float(bench.plant.outputs[column])
        bench.tick()
        assert wired.brake_pressure_front == pytest.approx(true + 1e6, abs=1.0)
        assert wired.safety_switch == 7
    bench.tick()
    assert wired.brake_pressure_front == pytest.approx(float(bench.plant.outputs[column]), abs=1e5)
    assert wired.safety_switch == switch
    assert front.count == 3


def test_grip_of_a_wheel_is_refused_where_the_plant_does_not_know_it(bench: ObservedBench) -> None:
    bench.plant.input_names = REQUIRED_INPUTS
    with pytest.raises(CodecError, match=r"^grip_loss: the plant has no input 'wheel_grip_fl'$"):
        bench.inject(GripLoss(factor=0.3, wheel="fl"))
    plans = (FaultPlan(fault=GripLoss(factor=0.3)), FaultPlan(fault=GripLoss(factor=0.3, wheel="rr")))
    with pytest.raises(ConfigurationError) as caught:
        Bench(bench.surroundings, bench._autonomy, replace(bench.scenario, faults=plans))
    assert (caught.value.file, caught.value.key) == (str(bench.scenario.path), "faults[1]")


def test_altered_parameter_is_noticed_by_the_operator(bench: ObservedBench) -> None:
    bench.inject(ParameterAltered(name="max_speed", value=70.0))
    bench.run_for(2.0)
    assert bench.operator.verdict is Verdict.REJECTED
    assert not bench.operator.launch_wanted


@pytest.mark.expects_faults("gnss_a_timeout", "gnss_a_low_rate")
@pytest.mark.expects_bus_errors
def test_what_is_not_in_order_is_told(bench: ObservedBench) -> None:
    bench.run_for(1.0)
    assert bench.complaints() == []
    assert bench.complaints(faults=["gnss_b_timeout"]) == ["fault gnss_b_timeout did not happen"]
    bench.inject(SensorOutage(sensor="gnss_a"))
    bench.inject(BusError(message="steering_cmd", errors=2))
    bench.run_for(0.6)
    complaints = bench.complaints(faults=["gnss_a_low_rate"])
    assert [line.split(" at ")[0] for line in complaints] == [
        "unexpected fault gnss_a_timeout",
        "2 error frames on CAN1",
    ]
    assert bench.complaints(faults=None) == complaints[1:]
    assert bench.complaints(faults=None, bus_errors=True) == []


def test_what_comes_too_late_is_missed(bench: ObservedBench) -> None:
    with pytest.raises(MissedError, match=r"did not hold within 0\.1 s, from 0\.00 s on"):
        bench.run_to(Condition(sys_state=SysState.DRIVING), within_s=0.1)
    assert bench.now_us == 100_000
    with pytest.raises(MissedError, match=r"no such misc_report within 0\.05 s, from 0\.10 s on; the last one held"):
        bench.wait_for("misc_report", 0.05, lambda signals: signals["sys_state"] == SysState.DRIVING)
    first = bench.wait_for("misc_report", 0.05)
    assert 150_000 < first.time_us < 160_000
    assert first.signals["sys_state"] == SysState.PWR_ON


# --- a bus that is cut, a clock that drifts, another one in the place of the owner


@pytest.mark.expects_faults
def test_each_layer_stops_the_car_when_its_bus_is_cut(bench: ObservedBench) -> None:
    """CAN3: the Space Drive by itself, then the computers, which are told of it."""
    driving(bench)
    cut = bench.inject(Partition(bus=Bus.CAN3))
    assert bench.run_to(full_brake(bench), within_s=0.1) <= 70_000
    assert bench.wait_for("diagnostic_report", 0.1, lambda s: s["est4_sd_comms_loss"] == 1.0)
    bench.wait_for("ssm_status", 0.1, lambda s: s["ssm_state"] == SsmState.FULL_BRAKE)
    bench.run_to(lambda: bench.situation.standstill, within_s=5.0)
    assert cut.count > 0


@pytest.mark.expects_faults
def test_a_raptor_that_is_off_can1_brakes_over_can3(bench: ObservedBench) -> None:
    driving(bench)
    begin_us = bench.now_us
    bench.inject(Partition(bus=Bus.CAN1, station=Station.RAPTOR))
    full = bench.wait_for("req_brake_pos", 0.2, lambda s: s["contrl_pos_brk"] == 4096.0)
    assert full.time_us - begin_us <= 120_000
    missed = bench.wait_for("ssm_status", 0.3, lambda s: s["ssm_state"] == SsmState.FULL_BRAKE)
    assert full.time_us < missed.time_us
    bench.run_to(full_brake(bench), within_s=0.02)


def test_clocks_that_drift_apart_are_borne(bench: ObservedBench) -> None:
    """A hundred times what crystals do; nobody misses anything, and the executive sees nothing of it."""
    drifts = [
        bench.inject(ClockDrift(station=station, ppm=ppm))
        for station, ppm in ((Station.OBC, 10_000), (Station.RAPTOR, -10_000), (Station.SPACE_DRIVE, 5000))
    ]
    bench.run_to(lambda: bench.truth.vx > 10.0)
    ticks = bench.now_us // 10_000
    extra = ticks // 100
    assert extra > 5
    assert [drift.count for drift in drifts] == [extra, extra, ticks // 200]
    for drift in drifts:
        drift.cancel()
    offsets = [clock.offset_us // 10_000 for clock in bench.clocks.values()]
    assert offsets == [extra, -extra, ticks // 200]
    executive = bench.obc.executive
    assert (executive.frame, executive.missed_frames, executive.late_frames) == (ticks + extra, 0, 0)


@pytest.mark.expects_faults("gnss_a_low_rate", "gnss_b_low_rate", "imu_low_rate")
def test_an_onboard_computer_that_runs_fast_sees_slow_sensors(bench: ObservedBench) -> None:
    """20 and 100 samples a second are 14.3 and 71.4 by its clock; it wants 15 and 80."""
    driving(bench)
    drift = bench.inject(ClockDrift(station=Station.OBC, ppm=400_000))
    begin, frames = bench.now_us, bench.obc.executive.frame
    degraded = bench.wait_for("ssm_status", 2.0, lambda s: s["ssm_state"] == SsmState.DEGRADED)
    assert degraded.time_us - begin > 500_000
    bench.run_to(lambda: bench.now_us - begin >= 1_000_000)
    assert bench.obc.executive.frame - frames == 140
    assert drift.count == 40
    own_us = bench.clocks[Station.OBC].offset_us
    drift.cancel()
    bench.run_for(0.1)
    assert bench.clocks[Station.OBC].offset_us - own_us <= 10_000, "what was gained stays, and no more is"
    assert bench.obc.executive.missed_frames == bench.obc.executive.late_frames == 0


@pytest.mark.expects_faults
def test_the_onboard_computer_hears_who_takes_its_place(bench: ObservedBench) -> None:
    driving(bench)
    begin_us = bench.now_us
    angle = {"message": "steering_cmd", "signal": "steering_motor_ang_cmd", "value": 1.0}
    bench.inject(Masquerade(station=Station.SENSORS, **angle))
    stopped = bench.wait_for("ssm_status", 0.05, lambda s: s["ssm_state"] == SsmState.FULL_BRAKE)
    assert stopped.time_us - begin_us < 30_000
    assert stopped.signals["ssm_worst_fault"] == FAULT["second_computer"]


@pytest.mark.expects_faults
def test_who_knows_the_crc_is_believed(bench: ObservedBench) -> None:
    """The Space Drive cannot tell; the Raptor sees brakes that do not follow it, and is heard by nobody."""
    driving(bench)
    begin_us = bench.now_us
    third = {"message": "req_brake_pos", "signal": "contrl_pos_brk", "value": float(round(0x4000 * 2 / 3))}
    bench.inject(Masquerade(station=Station.SENSORS, **third))
    told = bench.wait_for("diagnostic_report", 0.5, lambda s: s["est1_oos_front_brk"] == 1.0)
    assert told.time_us - begin_us >= 200_000
    bench.wait_for("ssm_status", 0.05, lambda s: s["ssm_state"] == SsmState.FULL_BRAKE)
    bench.run_for(0.5)
    assert bench.wiring.space_drive_out.brake_pressure_demand == pytest.approx(6.0e6 / 3, rel=0.01)
