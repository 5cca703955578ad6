"""CTL-4 and SSM-8: a car that loses its localisation at 227 km/h stops beside the wall, wherever on the lap that is.

The way to racing speed is driven once per seed. From there on, at each place, the car's state is saved, something is
taken away, and afterwards the state is put back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace

import numpy as np
import pytest
from obc_harness import OPERATION

from autonomy.track import Track
from autonomy.track_files import load_track
from autonomy.wall_fit import fit_wall
from bridge._native import lib
from bridge.bench import Bench
from bridge.faults import Drop, SensorOutage
from bridge.saved_state import SavedState
from bridge.scenario import load_scenario
from bridge.surroundings import TICK_US
from dbc.frames import Station
from firmware.parameters import load_operation
from tools.run import DEFAULT_SCENARIO, build_bench

#: Stations of the lap, m: both straights, the dogleg, and entry, middle and exit of the four turns.
PLACES = {
    "dogleg": 100.0, "front straight": 300.0, "into turn 1": 420.0, "turn 1": 560.0, "turn 2": 760.0,
    "out of turn 2": 960.0, "back straight": 1235.0, "into turn 3": 1420.0, "turn 3": 1560.0, "turn 4": 1800.0,
    "out of turn 4": 2060.0, "before the dogleg": 2230.0,
}  # fmt: skip
FAST = 58.0  # m/s, everywhere on the flying lap
HALF_WIDTH = 7.45
FULL_BRAKE_PA = dict(load_operation(OPERATION))["full_brake_pressure"]
LOST = (Station.SENSORS,)  # GNSS A and B and the IMU


@dataclass
class Lap:
    """A bench on the flying lap, with what was seen of a stop."""

    bench: Bench
    track: Track

    def drive_to(self, station: float) -> None:
        """Until the car passes a station, at speed."""
        bench = self.bench
        while not (bench.truth.vx > FAST and 0.0 <= bench.station - station < 2.0):
            assert bench.now_us < 120_000_000
            bench.tick()

    def offset(self) -> float:
        return self.track.project(self.bench.truth.x, self.bench.truth.y)[1]

    def stop(self, watch: Callable[[], object] = lambda: None) -> list[float]:
        """Lateral offsets until the car stands; fails when it does not."""
        offsets = []
        for _ in range(1500):
            self.bench.tick()
            watch()
            offsets.append(self.offset())
            if np.hypot(self.bench.truth.vx, self.bench.truth.vy) < 0.05:
                return offsets
        pytest.fail(f"still at {self.bench.truth.vx:.1f} m/s after 15 s")

    @property
    def ssm(self) -> tuple[int, int]:
        out = self.bench.obc.ssm_output
        return int(out.state), int(out.controller)


EMERGENCY = (lib.SSM_EMERGENCY, lib.CONTROL_EMERGENCY)


Laps = Callable[[int], AbstractContextManager[Lap]]


@pytest.fixture(scope="module")
def lap() -> Iterator[Laps]:
    """Laps by seed, from the moment on at which the car is fast: the same bench each time."""
    with ExitStack() as benches:
        fast: dict[int, tuple[Lap, SavedState]] = {}

        @contextmanager
        def begin(seed: int) -> Iterator[Lap]:
            if seed not in fast:
                scenario = replace(load_scenario(DEFAULT_SCENARIO), seed=seed)
                run = Lap(benches.enter_context(build_bench(scenario)), load_track(scenario.track))
                while not run.bench.truth.vx > FAST:
                    assert run.bench.now_us < 120_000_000
                    run.bench.tick()
                fast[seed] = run, run.bench.save()
            run, state = fast[seed]
            run.bench.restore(state)
            yield run

        yield begin


@pytest.mark.parametrize("seed", [20221015, 1, 2])
def test_everything_but_the_lidars_is_lost(lap: Laps, seed: int) -> None:
    """On the straights and in each turn: to a standstill between the edges, on wheels that roll, by the wall alone."""
    with lap(seed) as run:
        bench = run.bench
        for place, station in sorted(PLACES.items(), key=lambda item: item[1]):
            run.drive_to(station)
            assert run.ssm == (lib.SSM_NOMINAL, lib.CONTROL_LQR)
            saved, begin, speed = bench.save(), bench.truth.distance, bench.truth.vx
            bench.silent.update(LOST)
            pressures, seen = [], set()

            def watch(pressures: list[float] = pressures, seen: set[tuple[int, int]] = seen) -> None:
                pressures.append(bench.obc.dbw.brake_pressure)
                seen.add(run.ssm)

            offsets = run.stop(watch)
            assert seen == {(lib.SSM_NOMINAL, lib.CONTROL_LQR), EMERGENCY}, place
            assert max(map(abs, offsets)) < HALF_WIDTH, (place, min(offsets), max(offsets))
            assert max(pressures) < 3.0e6, "the wheels do not lock"
            distance = bench.truth.distance - begin
            assert distance < 0.1 * speed + speed**2 / (2.0 * 0.9 * lib.EMERGENCY_DECELERATION), place
            bench.finish()
            assert bench.safety.violations == [], place
            saved.restore()


def test_the_wall_is_lost_too(lap: Laps) -> None:
    """Its curvature is held for a moment, then the brake is full; a full brake at once when there was no wall."""
    with lap(1) as run:
        bench = run.bench
        run.drive_to(PLACES["back straight"])
        saved = bench.save()
        bench.silent.update(LOST)
        while run.ssm != EMERGENCY:
            bench.tick()
        before = bench.obc.dbw.road_wheel_angle
        lost_us = bench.now_us
        bench.silent.add(Station.AUTONOMY)
        while run.ssm == EMERGENCY:
            assert abs(bench.obc.dbw.road_wheel_angle - before) < 0.03
            bench.tick()
        held_ms = (bench.now_us - lost_us) / 1000
        hold_ms = lib.wall_receiver_timeout_ms() + lib.EMERGENCY_HOLD_MS
        assert hold_ms - 50 <= held_ms <= hold_ms + 20
        assert run.ssm == (lib.SSM_FULL_BRAKE, lib.CONTROL_NONE)
        assert bench.obc.dbw.brake_pressure == FULL_BRAKE_PA
        run.stop()
        saved.restore()
        bench.inject(Drop(message="wall_line"))
        for _ in range(30):
            bench.tick()
        assert run.ssm == (lib.SSM_NOMINAL, lib.CONTROL_LQR), "by itself the loss of the wall stops nobody"
        bench.silent.update(LOST)
        while run.ssm[0] == lib.SSM_NOMINAL:
            bench.tick()
        assert run.ssm == (lib.SSM_FULL_BRAKE, lib.CONTROL_NONE)
        run.stop()


@pytest.mark.parametrize("fault", [SensorOutage(sensor="gnss_a"), SensorOutage(sensor="gnss_b")], ids=["a", "b"])
def test_a_receiver_less_is_no_emergency(lap: Laps, fault: SensorOutage) -> None:
    with lap(1) as run:
        run.drive_to(PLACES["turn 1"])
        run.bench.inject(fault)
        for _ in range(500):
            run.bench.tick()
            assert run.ssm[0] in (lib.SSM_NOMINAL, lib.SSM_DEGRADED)
            assert run.ssm[1] == lib.CONTROL_LQR
        assert run.bench.truth.vx > 10.0


@pytest.mark.parametrize("sensor", ["imu"])
def test_the_imu_alone_is_an_emergency(lap: Laps, sensor: str) -> None:
    with lap(2) as run:
        for place in ("into turn 1", "turn 2", "before the dogleg"):
            run.drive_to(PLACES[place])
            saved = run.bench.save()
            run.bench.inject(SensorOutage(sensor=sensor))
            assert max(map(abs, run.stop())) < HALF_WIDTH
            assert run.ssm == EMERGENCY
            saved.restore()


def test_both_receivers_are_lost_and_the_imu_carries_on_for_a_while(lap: Laps) -> None:
    """The estimate lives on the IMU until its quality is LOST; only then the wall takes over."""
    with lap(1) as run:
        run.drive_to(PLACES["into turn 3"])
        for sensor in ("gnss_a", "gnss_b"):
            run.bench.inject(SensorOutage(sensor=sensor))
        offsets = run.stop()
        assert run.ssm == EMERGENCY
        assert max(map(abs, offsets)) < HALF_WIDTH


def test_the_fit_is_the_wall_all_around_the_lap(lap: Laps) -> None:
    """Against the track's own wall, in the car's frame: beside the car, and as far ahead as is looked at 227 km/h."""
    with lap(1) as run:
        bench, track = run.bench, run.track
        (wall,) = track.walls()
        lidar = bench.surroundings._sensors.lidar
        run.drive_to(PLACES["dogleg"])
        worst = {0.0: 0.0, 28.0: 0.0}
        orders = set()
        for _ in range(40 * 1_000_000 // TICK_US // 10):
            for _ in range(10):
                bench.tick()
            truth = bench.truth
            fit = fit_wall(lidar.scan(truth), -1)
            assert fit is not None
            orders.add(fit.order)
            dx, dy = wall[:, 0] - truth.x, wall[:, 1] - truth.y
            c, s = np.cos(truth.yaw), np.sin(truth.yaw)
            ahead, left = c * dx + s * dy, c * dy - s * dx
            near = np.flatnonzero((np.abs(ahead) < 60.0) & (np.abs(left) < 40.0))
            near = near[np.argsort(ahead[near])]
            for x, so_far in worst.items():
                off = abs(fit.at(x) - float(np.interp(x, ahead[near], left[near])))
                worst[x] = max(so_far, off)
        assert worst[0.0] < 0.05
        assert worst[28.0] < 0.15
        assert orders == {1, 3}
