"""The stations of a real-time run, stepped by slots in one process: car and frames are those of lock step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from station_chain import ByHand, ByNetwork, Chain

from bridge._native import lib
from bridge.monitor import RunMonitor
from bridge.operator import Verdict
from bridge.realtime.plant_station import CATCH_UP_US, FALL_OFF_US, PlantExit
from bridge.realtime.truth_file import TruthFile
from bridge.scenario import Scenario, load_scenario
from bridge.surroundings import REJECTED_RUN_US, TICK_US, Ending
from dbc.codec import database
from dbc.frames import Bus, Frame, Station, iterate
from dbc.states import CtState, SysState
from tools.run import build_bench, find_scenario

SLOTS_PER_S = 100


@dataclass
class Reference:
    """A lock-step run: frames, and the plant's outputs at the start of each tick."""

    frames: NDArray[np.void]
    truth: NDArray[np.float64]
    column: dict[str, int]


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(find_scenario("short_drive"))


@pytest.fixture(scope="module")
def reference(scenario: Scenario) -> Reference:
    frames, truth = [], []
    with build_bench(scenario) as bench:
        finish = scenario.finish
        while not finish.holds(bench.situation):
            truth.append(bench.plant.outputs.copy())
            bench.tick()
            frames.append(bench.network.drain_log())
        truth.append(bench.plant.outputs.copy())
        column = {name: place for place, name in enumerate(bench.plant.output_names)}
    return Reference(np.concatenate(frames), np.array(truth), column)


@pytest.fixture
def chain(scenario: Scenario, tmp_path: Path) -> Iterator[Chain]:
    """At 10 m/s, frames in the order of sending: that is what an interface does with a burst."""
    with Chain(scenario, tmp_path, ByHand()) as chain:
        drive(chain)
        yield chain


def drive(chain: Chain) -> None:
    while chain.surroundings.truth.vx < 10.0:
        assert chain.slot < 20 * SLOTS_PER_S
        chain.step()


def truth_of(chain: Chain) -> NDArray[np.float64]:
    with TruthFile(chain.truth_path) as file:
        assert file.names == chain.surroundings.plant.output_names
        assert file.units == chain.surroundings.plant.output_units
        return file.take()


def watched(chain: Chain) -> RunMonitor:
    """What the frames so far tell."""
    monitor = RunMonitor()
    monitor.update(chain.carrier.frames())
    return monitor


def run_to_the_end(chain: Chain) -> None:
    while not chain.plant.over:
        chain.step()


def test_on_the_buses_of_lock_step_every_frame_is_the_same(scenario: Scenario, reference: Reference, tmp_path: Path):
    carrier = ByNetwork()
    with Chain(scenario, tmp_path, carrier) as chain:
        run_to_the_end(chain)
        assert chain.plant.ending is Ending.FINISHED
        assert chain.plant.exit_status is PlantExit.FINISHED
        assert (chain.plant.caught_up, chain.plant.lost_us, chain.said) == (0, 0, [])
        rows = truth_of(chain)
    assert np.array_equal(rows[:, 1:], reference.truth)
    assert np.array_equal(rows[:, 0], TICK_US * np.arange(len(reference.truth)))
    # The plant ends the run at the start of a slot in which the others still speak.
    frames = carrier.frames()
    end_us = TICK_US * (len(reference.truth) - 1)
    assert frames[frames["time_us"] < end_us].tobytes() == reference.frames.tobytes()
    monitor = RunMonitor()
    monitor.update(frames)
    assert monitor.faults == []
    visited = [change.after for change in monitor.transitions]
    for state in (SysState.CRANKING, SysState.DRIVING, CtState.CAUTION, SysState.PWR_OFF):
        assert state.name in visited


def test_on_v26_the_stations_drive_the_same(scenario: Scenario, reference: Reference, tmp_path: Path):
    """The plant station reads the states from frames of another length."""
    with Chain(replace(scenario, profile="V26"), tmp_path, ByNetwork()) as chain:
        run_to_the_end(chain)
        assert chain.plant.ending is Ending.FINISHED
        rows = truth_of(chain)
        lengths = {int(frame["id"]): int(frame["dlc"]) for frame in chain.carrier.frames()[-200:]}
    assert lengths[database.message("misc_report").frame_id] == 6
    assert np.array_equal(rows[:, 1:], reference.truth)


def test_frames_that_take_no_time_drive_the_car_alike(scenario: Scenario, reference: Reference, tmp_path: Path):
    with Chain(scenario, tmp_path, ByHand()) as chain:
        run_to_the_end(chain)
        rows = truth_of(chain)
        report = chain.plant.report()
    assert len(rows) == len(reference.truth)
    for name in ("x", "y"):
        place = reference.column[name]
        assert rows[:, 1 + place] == pytest.approx(reference.truth[:, place], abs=1e-3), name
    assert report == {
        "finished": True,
        "reason": "finished",
        "simulated_s": pytest.approx((len(rows) - 1) * TICK_US * 1e-6),
        "laps_s": [],
        "verdict": "ACCEPTED",
        "offences": [],
        "caught_up_slots": 0,
        "lost_ms": 0,
        "scans_lost": 0,
    }


@pytest.mark.parametrize("late", [1, 3])
def test_a_late_plant_catches_up_and_no_fault_comes_of_it(chain: Chain, reference: Reference, late: int):
    before = chain.slot
    chain.held = {Station.OPERATOR}  # the plant's process
    chain.steps(late)
    chain.held = set()
    chain.step()
    assert chain.plant.caught_up == late
    assert chain.plant.simulated_us == chain.now_us - TICK_US
    rows = truth_of(chain)
    assert np.array_equal(rows[:, 0], TICK_US * np.arange(chain.slot))
    assert np.array_equal(rows[:before, 1:], reference.truth[:before])
    chain.steps(SLOTS_PER_S)
    assert chain.plant.caught_up == late
    assert (chain.plant.lost_us, chain.said) == (0, [])
    assert chain.surroundings.truth.vx > 10.0
    assert watched(chain).faults == []


def test_sensors_of_all_late_slots_go_out_in_order(chain: Chain):
    chain.step()
    late = 5
    frames = list(iterate(chain.plant.step(chain.now_us + late * TICK_US, b"")))
    rates = [frame for frame in frames if frame.id == database.message("imu_rates").frame_id]
    counters = [database.message("imu_rates").decode(frame.data)[-1] for frame in rates]
    assert len(rates) == late + 1
    assert np.array_equal(np.diff(counters) % 256, np.ones(late))


def test_too_far_behind_the_car_stands_still_meanwhile(chain: Chain):
    last_us = chain.now_us - TICK_US
    before = chain.surroundings.truth.distance
    behind_us = CATCH_UP_US + TICK_US
    chain.plant.step(last_us + TICK_US + behind_us, b"")
    assert chain.plant.lost_us == behind_us
    assert chain.plant.caught_up == 0
    assert chain.said == ["lost 210 ms of simulated time"]
    assert chain.plant.simulated_us == last_us + TICK_US
    assert chain.surroundings.truth.distance - before == pytest.approx(10.0 * TICK_US * 1e-6, rel=0.1)
    assert chain.surroundings.situation.time_us == last_us + TICK_US + behind_us
    chain.plant.step(last_us + 2 * TICK_US + behind_us, b"")
    assert chain.plant.simulated_us == last_us + 2 * TICK_US
    assert len(chain.said) == 1


def test_as_far_behind_as_allowed_nothing_is_lost(chain: Chain):
    chain.plant.step(chain.now_us + CATCH_UP_US, b"")
    assert chain.plant.caught_up * TICK_US == CATCH_UP_US
    assert (chain.plant.lost_us, chain.said) == (0, [])


def test_outputs_of_a_raptor_that_is_gone_fall_off(chain: Chain):
    wired = chain.surroundings.wiring.raptor_out
    chain.held = {Station.RAPTOR}
    for _ in range(FALL_OFF_US // TICK_US):
        chain.step()
        assert wired.throttle_demand > 0.1
        assert wired.ignition
    chain.step()
    assert (wired.throttle_demand, wired.gear_demand, wired.ignition, wired.starter) == (0.0, 0, False, False)
    chain.step()
    assert wired.gear_demand == 0
    chain.held = set()
    chain.steps(2)
    assert wired.gear_demand > 0  # its words count again


def test_a_plant_that_was_late_does_not_blame_the_raptor(chain: Chain):
    chain.held = {Station.OPERATOR}
    chain.steps(2 * FALL_OFF_US // TICK_US)
    chain.held = set()
    chain.step()
    assert chain.surroundings.wiring.raptor_out.ignition


def test_motors_of_a_space_drive_that_is_gone_stay(chain: Chain):
    wired = chain.surroundings.wiring.space_drive_out
    chain.held = {Station.SPACE_DRIVE}
    chain.step()  # what it last put on the wires
    before = wired.steer_motor_demand, wired.brake_pressure_demand
    assert before[0] != 0.0
    chain.steps(50)
    assert (wired.steer_motor_demand, wired.brake_pressure_demand) == before


def test_an_orderly_stop_of_autonomy_is_read_by_the_ssm(chain: Chain):
    """INACTIVE comes first: the SSM degrades at once, and stops the car when silence follows: beside the wall while the
    last look at it holds, then by full brake."""
    conditions, ssm = chain.obc.conditions, chain.obc.ssm
    not_ok = (lib.FAULT_ESTIMATION_NOT_OK, lib.FAULT_PLANNING_NOT_OK, lib.FAULT_WALL_NOT_OK)
    assert not any(conditions.present[fault] for fault in not_ok)
    chain.carrier.send(Station.AUTONOMY, chain.autonomy.end(), Bus.CAN_A)
    chain.held = {Station.AUTONOMY}
    chain.step()
    for fault in not_ok:
        assert conditions.present[fault]
        assert conditions.detail[fault] == lib.NODE_INACTIVE
    assert not conditions.present[lib.FAULT_ESTIMATION_FAILED]
    assert ssm.state == lib.SSM_DEGRADED
    chain.steps(20)
    assert conditions.present[lib.FAULT_ESTIMATION_FAILED]
    assert (ssm.state, chain.obc.ssm_output.controller) == (lib.SSM_EMERGENCY, lib.CONTROL_EMERGENCY)
    chain.steps(40)
    assert ssm.state == lib.SSM_FULL_BRAKE


def test_the_plant_starts_wherever_the_grid_is(scenario: Scenario, tmp_path: Path):
    """Started again in the middle of a run, it does not catch up with what was before it."""
    with Chain(scenario, tmp_path, ByHand()) as chain:
        assert chain.plant.step(7_000_000, b"") != b""
        assert (chain.plant.simulated_us, chain.plant.caught_up, chain.plant.lost_us) == (0, 0, 0)
        chain.plant.step(7_010_000, b"")
        assert chain.plant.simulated_us == TICK_US
        assert truth_of(chain)[:, 0].tolist() == [7_000_000, 7_010_000]


def test_time_limit_ends_the_run_with_its_own_status(scenario: Scenario, tmp_path: Path):
    with Chain(replace(scenario, time_limit_us=500_000), tmp_path, ByHand()) as chain:
        assert chain.plant.exit_status is PlantExit.STOPPED
        assert chain.plant.report()["reason"] == "stopped"
        run_to_the_end(chain)
        assert chain.plant.exit_status is PlantExit.TIME_UP
        assert chain.slot == 51
        assert chain.plant.report()["reason"] == "time limit"
        assert not chain.plant.report()["finished"]
        assert len(truth_of(chain)) == 51
        assert chain.truth.lost == 0


def test_a_rejected_configuration_ends_the_run_with_its_own_status(scenario: Scenario, tmp_path: Path):
    operation = tmp_path / "operation.yaml"
    operation.write_text(scenario.operation.read_text().replace("max_speed: 63.1", "max_speed: -63.1"))
    with Chain(replace(scenario, operation=operation), tmp_path, ByHand()) as chain:
        run_to_the_end(chain)
        assert chain.plant.exit_status is PlantExit.REJECTED
        report = chain.plant.report()
        assert (report["verdict"], report["reason"]) == (Verdict.REJECTED.name, "configuration rejected")
        assert len(report["offences"]) == 1
        assert REJECTED_RUN_US <= chain.now_us < REJECTED_RUN_US + 1_000_000


def test_every_exit_has_a_status_of_its_own():
    assert len({int(status) for status in PlantExit}) == len(PlantExit)


def test_what_is_no_report_does_not_move_the_states(chain: Chain):
    misc, result = database.message("misc_report"), database.message("parameter_summary")
    before = chain.surroundings.situation.sys_state
    assert before == SysState.DRIVING
    foreign = [
        Frame(0, misc.frame_id, Bus.CAN1, 0, 0, 0, bytes(8)),  # cut off
        Frame(0, misc.frame_id, Bus.CAN1, 8, 1, 0, bytes(8)),  # another identifier of 29 bits
        Frame(0, misc.frame_id, Bus.CAN1, 8, 2, 0, bytes(8)),  # remote
        Frame(0, misc.frame_id, Bus.CAN_A, 8, 0, 0, bytes(8)),  # another bus
        Frame(0, 0x80, Bus.CAN1, 8, 4, 0, bytes(8)),  # an error
    ]
    chain.plant.step(chain.now_us, b"".join(frame.pack() for frame in foreign))
    assert chain.surroundings.situation.sys_state == before
    chain.surroundings.operator.verdict = Verdict.PENDING
    for dlc, code in ((8, 77), (3, Verdict.REJECTED)):
        data = result.encode(0, 0, 0, code, 0)
        chain.plant.step(chain.now_us, Frame(0, result.frame_id, Bus.CAN_A, dlc, 0, 0, data).pack())
    assert chain.surroundings.operator.verdict is Verdict.PENDING
