"""Full brake in each of its three layers, each with everything above it dead.

The plant, all ECUs and autonomy are the real ones; what is taken away is taken away as a power cut would.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bridge._native import lib
from bridge.bench import Bench
from bridge.safety.track import TrackEdges
from bridge.scenario import Condition, Scenario, load_scenario
from bridge.surroundings import TICK_US
from dbc.codec import database
from dbc.frames import Bus, Station
from dbc.states import CtState, SysState
from tools.run import DEFAULT_SCENARIO, build_bench

FULL_BRAKE_KPA = 4500.0
FULL_BRAKE_PA = 4.5e6
TICK_S = TICK_US * 1e-6


@pytest.fixture
def scenario() -> Scenario:
    return load_scenario(DEFAULT_SCENARIO)


@contextmanager
def safe_bench(scenario: Scenario, *excused: str) -> Iterator[Bench]:
    """A bench on which, when the test is over, every safety property has held but those that are excused."""
    with build_bench(scenario) as bench:
        yield bench
        bench.finish()
        assert {one.property_id for one in bench.safety.violations} <= set(excused)
        assert bench.safety.frames > 0


def drive_to(bench: Bench, speed: float) -> None:
    """Run the scenario until the car is faster than `speed`, m/s."""
    while bench.truth.vx < speed:
        assert bench.now_us < 60_000_000, f"still at {bench.truth.vx:.1f} m/s"
        bench.tick()


def ticks_until(bench: Bench, what: object, limit: int) -> int:
    """Ticks until `what()` is true; fails after `limit`."""
    for tick in range(1, limit + 1):
        bench.tick()
        if what():  # type: ignore[operator]
            return tick
    pytest.fail(f"did not happen within {limit} ticks")


def stop_distance(bench: Bench) -> float:
    """Metres to standstill from here; fails when the car does not stop."""
    start = bench.truth.distance
    for _ in range(1500):
        bench.tick()
        if abs(bench.truth.vx) < 0.05:
            return bench.truth.distance - start
    pytest.fail(f"still at {bench.truth.vx:.1f} m/s after 15 s")


def newest(bench: Bench, message: str) -> dict[str, float]:
    """Signals of the newest frame of a message on its bus."""
    codec = database.message(message)
    log = bench.network.log_view()
    frames = log[(log["bus"] == codec.bus) & (log["id"] == codec.frame_id)]
    assert frames.size, f"no {message} in the log"
    return dict(zip(codec.signals, codec.decode(frames[-1]["data"].tobytes()), strict=True))


@pytest.mark.parametrize(
    "change",
    [
        ("max_speed", "-63.0"),
        ("max_speed", ".nan"),
        ("max_speed", "fast"),
        ("max_speed", None),
        ("max_sped", "63.0"),
    ],
    ids=["sign", "nan", "type", "missing", "unknown"],
)
def test_rejected_configuration_never_moves(scenario: Scenario, tmp_path: Path, change: tuple[str, str | None]) -> None:
    """SSM-2: full brake on CAN1 from the first frame, applied by the Space Drive, and it stays."""
    key, value = change
    lines = scenario.operation.read_text().splitlines()
    kept = [line for line in lines if not (line.startswith("max_speed:") and key == "max_speed")]
    bad = tmp_path / "bad.yaml"
    bad.write_text("\n".join(kept + ([f"{key}: {value}"] if value is not None else [])) + "\n")
    command, ssm = database.message("brake_pressure_cmd"), database.message("ssm_status")
    with safe_bench(replace(scenario, operation=bad)) as bench:
        pressures, states = [], []
        demand = []
        settled = 0.0
        for tick in range(1500):
            bench.tick()
            if tick == 300:
                settled = bench.truth.distance
            frames = bench.network.log_view()[-120:]
            sent = frames[(frames["bus"] == Bus.CAN1) & (frames["id"] == command.frame_id)]
            pressures.append(command.decode(sent[-1]["data"].tobytes())[0])
            status = frames[(frames["bus"] == Bus.CAN_A) & (frames["id"] == ssm.frame_id)]
            states.append(int(ssm.decode(status[-1]["data"].tobytes())[ssm.signals.index("ssm_state")]))
            demand.append(bench.wiring.space_drive_out.brake_pressure_demand)
        assert set(pressures) == {FULL_BRAKE_KPA}
        assert states[-1] == lib.SSM_FULL_BRAKE
        assert lib.SSM_LAUNCHING not in states
        assert min(demand[2:]) == pytest.approx(FULL_BRAKE_PA, rel=1e-3)
        assert bench.truth.distance < 5e-3  # the tyres take up the banking's side load: millimetres, once
        assert bench.truth.distance == pytest.approx(settled, abs=1e-6)
        assert bench.situation.sys_state not in (SysState.CRANKING, SysState.ENG_IDLE, SysState.DRIVING)


def test_raptor_brakes_when_the_obc_dies(scenario: Scenario) -> None:
    """Layer two: 100 ms without commands, then full brake, throttle closed, engine off, latched."""
    with safe_bench(scenario) as bench:
        drive_to(bench, 40.0)
        assert bench.situation.sys_state == SysState.DRIVING
        bench.silent.add(Station.OBC)
        braking = lambda: bench.wiring.space_drive_out.brake_pressure_demand > 0.999 * FULL_BRAKE_PA  # noqa: E731
        ticks = ticks_until(bench, braking, 20)
        assert 9 <= ticks <= 13, f"{ticks * 10} ms from the last command to full brake"
        assert bench.wiring.raptor_out.throttle_demand == 0.0
        assert not bench.wiring.raptor_out.ignition
        bench.tick()
        assert newest(bench, "diagnostic_report")["adlink_hb_lost"] == 1.0
        assert newest(bench, "misc_report")["sys_state"] == SysState.EMERGENCY_SHUTDOWN
        assert stop_distance(bench) < 40.0**2 / (2 * 6.0)
        bench.silent.clear()  # power comes back: nothing may move again
        for _ in range(300):
            bench.tick()
        assert bench.wiring.space_drive_out.brake_pressure_demand > 0.999 * FULL_BRAKE_PA
        assert abs(bench.truth.vx) < 0.05


@pytest.mark.parametrize("dead", [{Station.RAPTOR}, {Station.RAPTOR, Station.OBC}], ids=["raptor", "raptor and obc"])
def test_space_drive_brakes_when_the_raptor_dies(scenario: Scenario, dead: set[Station]) -> None:
    """Layer three: requests stop, and the Space Drive brakes by itself."""
    with safe_bench(scenario) as bench:
        drive_to(bench, 40.0)
        bench.silent.update(dead)
        braking = lambda: bench.wiring.space_drive_out.brake_pressure_demand > 0.999 * FULL_BRAKE_PA  # noqa: E731
        ticks = ticks_until(bench, braking, 12)
        assert 4 <= ticks <= 8, f"{ticks * 10} ms from the last request to full brake"
        bench.tick()
        for _ in range(10):
            bench.tick()
        assert newest(bench, "stat_brk_1")["emr_brk"] == 1.0
        assert stop_distance(bench) < 40.0**2 / (2 * 6.0) + 40.0
        assert bench.wiring.space_drive_out.brake_pressure_demand > 0.999 * FULL_BRAKE_PA


def test_ssm_stops_the_car_when_autonomy_dies(scenario: Scenario) -> None:
    """Layer one: no estimate, no plan and no wall; the SSM brings the car to a stop by itself, as blind as it is."""
    with safe_bench(scenario) as bench:
        drive_to(bench, 40.0)
        bench.silent.add(Station.AUTONOMY)
        ticks = ticks_until(bench, lambda: newest(bench, "ssm_status")["ssm_state"] > lib.SSM_DEGRADED, 60)
        assert ticks <= 30, f"{ticks * 10} ms until the SSM reacted"
        assert stop_distance(bench) < 40.0**2 / (2 * 3.0)
        assert bench.wiring.raptor_out.throttle_demand == 0.0
        edges = TrackEdges(*bench.surroundings.road.boundaries())
        assert edges.beyond(np.array([bench.truth.x]), np.array([bench.truth.y]))[0] < 1.3  # known, docs/safety.md


def test_launch_moves_only_after_every_state_allowed_it(scenario: Scenario) -> None:
    """Up to DRIVING the throttle is closed and the car stands; then it launches without stalling."""
    with safe_bench(scenario) as bench:
        while bench.situation.sys_state != SysState.DRIVING:
            assert bench.now_us < 30_000_000
            assert bench.wiring.raptor_out.throttle_demand == 0.0
            assert abs(bench.truth.distance) < 0.01
            bench.tick()
        assert bench.run(until=Condition(ct_state=CtState.CAUTION))
        drive_to(bench, 12.0)
        assert newest(bench, "pt_report_1")["engine_state"] == 1.0
        assert newest(bench, "ssm_status")["ssm_state"] == lib.SSM_NOMINAL
        assert np.isfinite(bench.truth.vx)
        assert bench.losses == 0
