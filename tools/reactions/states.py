"""Operating states of the car: each is driven to once on a real scenario, saved, and restored for every cell."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import scenarios
from bridge._native import lib
from bridge.condition import Condition
from bridge.observed_bench import ObservedBench
from bridge.saved_state import SavedState
from bridge.scenario import PerceptionMode, Scenario
from dbc.states import CtState, TrackFlag
from tools.run import chosen_scenario, load_road, make_autonomy

SCENARIO = chosen_scenario("solo_lap", None)
#: The same with a car that has perception and requires it.
SEEING = replace(
    SCENARIO,
    perception=PerceptionMode.FULL,
    radar=True,
    operation=scenarios.DIRECTORY / "operations" / "perception.yaml",
)

#: Steps of race control in the solo lap up to the start of the engine, and up to pit-out: the car goes no farther.
_ENGINE, _PIT_OUT = 2, 3

_PIT_SPEED = 13.0  # m/s, little below the 31 mph that race control asks for
_RACING_SPEED = 60.0  # m/s
_STRAIGHT_RATE, _TURN_RATE = 0.02, 0.2  # rad/s of yaw
_BRAKING_PRESSURE = 1.0e6  # Pa


@dataclass
class OperatingStates:
    """Benches in their operating states, see `bridge.faults.provocations.OPERATING_STATES`.

    Parameters
    ----------
    of : the whole run that the states are taken from.
    seed : in its place; None for its own.
    """

    of: Scenario = SCENARIO
    seed: int | None = None
    _benches: dict[int, ObservedBench] = field(default_factory=dict)
    _saved: dict[str, tuple[ObservedBench, SavedState]] = field(default_factory=dict)

    @property
    def scenario(self) -> Scenario:
        """The whole run, with the seed."""
        return self.of if self.seed is None else replace(self.of, seed=self.seed)

    def at(self, state: str) -> ObservedBench:
        """The bench in a state, as if it had just got there."""
        if state not in self._saved:
            bench = getattr(self, f"_drive_to_{state}")()
            self._saved[state] = bench, bench.save()
        bench, saved = self._saved[state]
        bench.restore(saved)
        return bench

    def close(self) -> None:
        """Release the plants."""
        for bench in self._benches.values():
            bench.close()

    def _bench(self, steps: int) -> ObservedBench:
        """The bench of the solo lap whose race control takes only so many steps."""
        if steps not in self._benches:
            scenario = self.scenario
            scenario = replace(scenario, race_control=scenario.race_control[:steps])
            road = partial(load_road, scenario)
            self._benches[steps] = ObservedBench.from_scenario(scenario, road, make_autonomy)
        return self._benches[steps]

    def _drive_to_standstill(self) -> ObservedBench:
        """Launched, the engine idles, nobody has released the car."""
        bench = self._bench(_ENGINE)
        bench.run_to(Condition(ct_state=CtState.RACEREADY, for_us=1_000_000))
        assert bench.obc.ssm_output.state == lib.SSM_NOMINAL
        return bench

    def _drive_to_launch(self) -> ObservedBench:
        """The clutch bites: first gear, the car has just begun to roll."""
        bench = self._bench(_PIT_OUT)
        bench.run_to(lambda: bench.truth.vx > 2.0)
        return bench

    def _drive_to_pit_lane(self) -> ObservedBench:
        self.at("launch")
        bench = self._bench(_PIT_OUT)
        bench.run_to(lambda: bench.truth.vx > _PIT_SPEED)
        bench.run_for(2.0)
        return bench

    def _drive_to_straight(self) -> ObservedBench:
        bench = self._bench(len(self.scenario.race_control))
        bench.run_to(lambda: bench.truth.vx > _RACING_SPEED and abs(bench.truth.yaw_rate) < _STRAIGHT_RATE)
        return bench

    def _drive_to_turn(self) -> ObservedBench:
        bench = self.at("straight")
        bench.run_to(lambda: abs(bench.truth.yaw_rate) > _TURN_RATE)
        return bench

    def _drive_to_braking(self) -> ObservedBench:
        """Race control shows red: the car stops along its path."""
        bench = self.at("straight")
        bench.race_control.track_flag = TrackFlag.RED
        pressure = bench.plant.output_names.index("brake_pressure_front")
        bench.run_to(lambda: bool(bench.plant.outputs[pressure] > _BRAKING_PRESSURE))
        bench.run_for(0.3)
        return bench
