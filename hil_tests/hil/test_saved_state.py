"""A run that goes on from a saved state is, byte by byte, the run that went straight on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import can
import pytest
from bench_walk import walk

from bridge.bench import Bench
from bridge.condition import Condition
from bridge.faults import (
    ActuatorStuck,
    Babble,
    BusError,
    Corrupt,
    Delay,
    Drop,
    FaultPlan,
    Freeze,
    GripLoss,
    Hang,
    Noise,
    Onset,
    ParameterAltered,
    PowerLoss,
    Reorder,
    Reset,
    SensorFrozen,
    Slow,
)
from bridge.saved_state import SavedState
from dbc.errors import BusError as TapError
from dbc.errors import PlantError, RaceloopError
from dbc.frames import Bus, Station
from dbc.states import SsmState, SysState
from tools.run import build_bench, chosen_scenario

COMPARED_TICKS = 200

#: Places of the drive at which its state is saved, in the order in which it gets there.
PLACES: dict[str, Callable[[Bench], bool]] = {
    "power-on": lambda bench: bench.now_us == 0,
    "parameters half handed over": lambda bench: bench.now_us >= 100_000,
    "standstill": lambda bench: bench.now_us >= 2_000_000,
    "cranking": lambda bench: bench.situation.sys_state == SysState.CRANKING,
    "launch": lambda bench: bench.truth.vx > 2.0,
    "way on to the race line": lambda bench: bench.truth.distance > 120.0,
    "amid random faults": lambda bench: any(one.active for one in bench.injections),
    "at speed in a turn": lambda bench: bench.truth.vx > 40.0 and abs(bench.truth.yaw_rate) > 0.1,
    "stopping": lambda bench: bench.truth.vx < 15.0,
}

#: Random, with frames under way: begun when the car has gone for a while, and over before the turn.
RANDOM_FAULTS = tuple(
    FaultPlan(fault=fault, onset=Onset(Condition(distance_m=300.0)), for_us=2_500_000)
    for fault in (
        Noise(message="imu_rates", signal="imu_yaw_rate", sigma=0.01),
        Corrupt(message="wheel_speed_report", random_bits=1),
        Drop(message="gnss_a_position", probability=0.3),
        Delay(message="ct_report", ticks=2),
        Reorder(message="pt_report_1"),
        Freeze(message="gnss_b_quality", signal="gnss_b_satellites"),
    )
)


class Run:
    """A bench, and what came of it."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench

    def go(self, ticks: int) -> list[bytes]:
        """Frames and truth of each of the next ticks."""
        return [self._tick() for _ in range(ticks)]

    def _tick(self) -> bytes:
        network = self.bench.network
        first = 0 if network.log_half_full else network.logged()  # the tick drains a log that is half full
        self.bench.tick()
        return network.log_view(first).tobytes() + self.bench.plant.outputs.tobytes()

    def go_wild(self) -> None:
        """Drive somewhere else altogether, every part of the bench with it."""
        bench = self.bench
        bench.operator.launch_wanted = not bench.operator.launch_wanted
        for fault in (
            Noise(message="gnss_a_position", signal="gnss_a_latitude", sigma=1e-5),
            SensorFrozen(sensor="gnss_b"),
            Slow(station=Station.AUTONOMY, every=3),
            GripLoss(factor=0.3),
            ActuatorStuck(actuator="steering", value=0.4),
            ParameterAltered(name="max_speed", value=20.0),
            BusError(message="brake_pressure_cmd", errors=40),
            Babble(station=Station.RAPTOR, bus=Bus.CAN1),
        ):
            bench.inject(fault, for_us=300_000)
        bench.inject(Reset(station=Station.RAPTOR), onset=Onset(Condition(time_us=bench.now_us + 200_000)))
        bench.inject(PowerLoss(station=Station.SPACE_DRIVE), onset=Onset(Condition(time_us=bench.now_us + 400_000)))
        bench.inject(Hang(station=Station.OBC), onset=Onset(Condition(time_us=bench.now_us + 500_000)))
        for _ in range(90):
            bench.tick()
        bench.drain()
        bench.safety.finish()


@contextmanager
def run_of(profile: str, fmi_version: int) -> Iterator[Run]:
    scenario = chosen_scenario("solo_lap", profile)
    # Out to the first turns at speed, and back to standstill; SAFE-10 and the like are looked at as ever.
    race_control = (*scenario.race_control[:-1], replace(scenario.race_control[-1], when=Condition(distance_m=1200.0)))
    scenario = replace(scenario, fmi_version=fmi_version, race_control=race_control, faults=RANDOM_FAULTS)
    with build_bench(scenario) as bench:
        yield Run(bench)


@pytest.mark.parametrize(("profile", "fmi_version"), [("V14", 3), ("V26", 2)])
def test_a_run_from_a_saved_state_is_the_run_that_went_straight_on(profile: str, fmi_version: int) -> None:
    with run_of(profile, fmi_version) as run:
        bench, saved, states, ticks = run.bench, {}, {}, []
        begins: dict[str, int] = {}
        for place, reached in PLACES.items():
            while not reached(bench):
                ticks += run.go(1)
                assert bench.now_us < 120_000_000, place
            saved[place] = bench.save()
            states[place], begins[place] = walk(bench), len(ticks)
        ticks += run.go(COMPARED_TICKS)
        straight = {place: ticks[begin : begin + COMPARED_TICKS] for place, begin in begins.items()}
        assert len(set(begins.values())) == len(PLACES)

        order = [*list(PLACES)[::-2], *list(PLACES)[1::2], "launch"]  # forth and back in time, one of them again
        for place in order:
            run.go_wild()
            assert walk(bench) != states[place]
            bench.restore(saved[place])
            assert walk(bench) == states[place], place
            assert run.go(COMPARED_TICKS) == straight[place], place
            bench.restore(saved[place])  # and again, at once
            assert run.go(COMPARED_TICKS) == straight[place], place


def test_saving_changes_nothing() -> None:
    logs = []
    for every in (None, 7):
        with build_bench(chosen_scenario("short_drive", None)) as bench:
            run, parts = Run(bench), []
            for tick in range(700):
                if every and tick % every == 0:
                    bench.save()
                parts += run.go(1)
            bench.finish()
            transitions = sorted(bench.monitor.transitions, key=lambda one: one.time_us)
            logs.append((parts, bench.safety.frames, bench.safety.violations, transitions))
    assert logs[0] == logs[1]


def test_monitors_and_handles_go_back_too(short: Bench) -> None:
    while short.truth.vx < 10.0:
        short.tick()
    before = short.save()
    transitions = list(short.monitor.transitions)
    hang = short.inject(Hang(station=Station.OBC), for_us=500_000)
    for _ in range(20):
        short.tick()
    amid = short.save()
    assert hang.active
    count = hang.count
    for _ in range(100):
        short.tick()
    short.finish()
    assert not hang.active
    assert short.monitor.state("sys") == SysState.EMERGENCY_SHUTDOWN.name
    short.restore(amid)
    assert (hang.active, hang.count) == (True, count)
    assert short.injections == [hang]
    short.restore(before)
    assert short.injections == []
    assert short.stalled == set()
    assert short.monitor.transitions == transitions
    for _ in range(50):
        short.tick()
    short.finish()
    assert short.monitor.state("ssm") == SsmState.NOMINAL.name
    assert short.safety.violations == []


@pytest.fixture
def short() -> Iterator[Bench]:
    with build_bench(chosen_scenario("short_drive", None)) as bench:
        yield bench


def test_what_cannot_be_saved_is_one_line(short: Bench, tmp_path: Path) -> None:
    short._autonomy.mine = (number for number in range(3))  # type: ignore[attr-defined]
    with pytest.raises(
        RaceloopError, match=r"^bench\._autonomy\.mine: the state of builtins\.generator cannot be saved$"
    ):
        short.save()
    del short._autonomy.mine  # type: ignore[attr-defined]
    short.save()
    short.plant._gives_state = False
    with pytest.raises(PlantError, match=r"\.fmu: its state cannot be saved: it says no canGetAndSetFMUstate$"):
        short.save()
    short.plant._gives_state = True
    short.record_to(tmp_path / "out")
    with pytest.raises(RaceloopError, match="a run that is being recorded cannot be saved"):
        short.save()


def test_a_bench_with_taps_cannot_be_saved() -> None:
    scenario = chosen_scenario("short_drive", None)
    with can.Bus("saved state", interface="virtual") as outside, build_bench(scenario) as made:
        tapped = Bench(made.surroundings, made._autonomy, scenario, {"CAN1": outside})
        with pytest.raises(TapError, match="taps cannot be saved"):
            tapped.save()


def test_a_part_that_saves_itself_is_asked() -> None:
    class Counter:
        """Keeps its state where a walk does not look."""

        hidden = iter(range(100))

        def __init__(self) -> None:
            self.counts = iter(range(100))
            self.count = next(self.counts)

        def save_state(self) -> int:
            return self.count

        def restore_state(self, state: int) -> None:
            self.count = state

    counter = Counter()
    state = SavedState([counter], "list")
    counter.count = 7
    state.restore()
    assert counter.count == 0


def test_states_outlive_neither_plant_nor_memory(short: Bench) -> None:
    states = [short.save() for _ in range(3)]
    assert len(short.plant._states) == len(states)
    del states[0]
    assert len(short.plant._states) == 2
    short.close()
    with pytest.raises(PlantError, match="the plant is closed"):
        short.restore(states[0])
