"""What surrounds the ECUs: car, road, sensors, and the people who act on the car.

The lock-step bench and the plant station of a real-time run both take these steps, in this order; they differ in who
says when, and in how frames and wires reach the ECUs.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bridge._native import lib
from bridge.interfaces import Road
from bridge.laps import LapTimer
from bridge.operator import OperatorStation, Verdict
from bridge.opponents import ScriptedCar
from bridge.plant import Plant
from bridge.race_control import RaceControl, SafetySwitch
from bridge.scenario import Condition, PerceptionMode, Scenario, Situation, Trigger, load_vehicle
from bridge.sensors.lidar import Cloud, due
from bridge.sensors.suite import SensorSuite
from bridge.sensors.surfaces import RoadSurface
from bridge.sensors.truth import Truth, TruthReader
from bridge.wiring import Wiring
from dbc.codec import Codec
from dbc.errors import ConfigurationError, PlantError, StartValueError
from dbc.frames import Buffer
from firmware.parameters import parameter_frames
from plant_fmu import fmu_path

#: One minor frame.
TICK_US: int = lib.EXECUTIVE_FRAME_US

#: Slower than this, the car stands, m/s.
STANDSTILL_SPEED = 0.1

#: How long a run with a rejected configuration goes on: long enough to see that the car is held.
REJECTED_RUN_US = 3_000_000


class Surroundings:
    """One car on one road with its sensors, its operator, race control and the person at the safety switch.

    Parameters
    ----------
    plant : initialised FMU; closed with the surroundings.
    road : see `bridge.interfaces`; ConfigurationError when it has no origin.
    scenario : what race control and people do, seed.
    parameters : frames of the operation parameters, closed by their commit.

    Attributes
    ----------
    plant, road, wiring, operator, race_control, laps : the parts, for inspection.
    opponents : the other cars.
    truth, station, situation : as last observed; station in m along the lap.
    """

    def __init__(self, plant: Plant, road: Road, scenario: Scenario, parameters: bytes) -> None:
        if road.origin is None:
            raise ConfigurationError(scenario.track, "origin", "is missing; GNSS needs the track's place on the Earth")
        self.plant = plant
        self.road = road
        self.wiring = Wiring(plant)
        self.operator = OperatorStation(parameters)
        self.race_control = RaceControl(scenario.race_control)
        self.laps = LapTimer(road.length)
        self._safety_switch = SafetySwitch(scenario.safety_switch)
        spatial = road if scenario.perception is PerceptionMode.FULL else None
        axle = load_vehicle(scenario.vehicle).get("cg_to_rear_axle", 0.0)
        self._sensors = SensorSuite(
            road.origin, scenario.seed, road.walls(), axle, radar=scenario.radar, spatial=spatial
        )
        surface = RoadSurface(road)
        self.opponents = [ScriptedCar(opponent, road, surface) for opponent in scenario.opponents]
        self._truth_reader = TruthReader(plant.output_names)
        self.truth: Truth
        self.station: float
        self.situation: Situation
        self.observe(0, 0, 0)

    @classmethod
    def from_scenario(cls, scenario: Scenario, road: Road) -> Surroundings:
        """Build what a scenario describes; the car stands where it starts.

        Raises
        ------
        RaceloopError
            When any of the files is wrong.
        """
        parameters = parameter_frames(scenario.operation)
        plant = _plant_of(scenario, road)
        try:
            return cls(plant, road, scenario, parameters)
        except BaseException:
            plant.close()
            raise

    def act(self) -> None:
        """The person at the switch, race control and other cars do what the situation asks for."""
        for car in self.opponents:
            car.act(self.situation)
        self._safety_switch.tick(self.situation, self.wiring.raptor_in)
        laps_s = self.laps.laps_s
        self.race_control.tick(
            self.situation, self.station, laps_s[-1] if laps_s else 0.0, self.wiring.raptor_in.race_control
        )

    def sense(self, now_us: int) -> bytes:
        """Sample the car for the ECUs' wires; returns the frames that sensors have for CAN-S and CAN-R."""
        self.wiring.sense()
        return self._sensors.emit(now_us, self.truth, [car.outline for car in self.opponents])

    def scan(self, now_us: int) -> Cloud | None:
        """Points that the LiDARs see in this tick, see `bridge.interfaces.Autonomy`; None when no scan is due."""
        return self._sensors.scan(now_us, self.truth, [car.body for car in self.opponents] if due(now_us) else ())

    def advance(self, time_s: float, change: Callable[[NDArray[np.float64]], None] | None = None) -> None:
        """Drive the car by the ECUs' wires for one tick, from `time_s` of the plant's own time.

        Parameters
        ----------
        change : is given the plant's inputs before the plant gets them.
        """
        self.wiring.drive()
        self.wiring.lay_road(*self.road.road_at_station(self.station))
        if change is not None:
            change(self.plant.inputs)
        self.plant.step(time_s, TICK_US * 1e-6)
        for car in self.opponents:
            car.advance(TICK_US * 1e-6)

    def observe(self, now_us: int, sys_state: int, ct_state: int) -> None:
        """Look at the car: what the people, the sensors and the road of this tick depend on.

        Parameters
        ----------
        now_us : start of the tick.
        sys_state, ct_state : as last sent on CAN1, 0 before.
        """
        self.truth = self._truth_reader.read(self.plant.outputs)
        self.station, _ = self.road.project(self.truth.x, self.truth.y)
        self.laps.update(now_us, self.station)
        self.situation = Situation(
            time_us=now_us,
            sys_state=sys_state,
            ct_state=ct_state,
            distance_m=self.truth.distance,
            laps=self.laps.count,
            standstill=abs(self.truth.vx) < STANDSTILL_SPEED,
        )

    def close(self) -> None:
        """Release the plant; safe to call twice."""
        self.plant.close()


class ReportedStates:
    """Decodes the states that the scenario looks at, sys_state of misc_report and ct_state of ct_report.

    Parameters
    ----------
    database : messages of the profile that CAN1 has.
    """

    def __init__(self, database: Codec) -> None:
        self.misc_report = database.message("misc_report")
        self.ct_report = database.message("ct_report")
        self._decode_sys, self._sys_place = self.misc_report.decode, self.misc_report.signals.index("sys_state")
        self._decode_ct, self._ct_place = self.ct_report.decode, self.ct_report.signals.index("ct_state")

    def decode(self, misc_data: Buffer, ct_data: Buffer) -> tuple[int, int]:
        """sys_state and ct_state from the data of the two messages, 8 bytes each, zeros before the first."""
        return int(self._decode_sys(misc_data)[self._sys_place]), int(self._decode_ct(ct_data)[self._ct_place])


class Ending(Enum):
    """Why a run ended by itself."""

    FINISHED = "finished"
    TIME_UP = "time limit"
    REJECTED = "configuration rejected"
    """The onboard computer holds the car until the next power-on."""


class EndWatch:
    """Tells when a run is over; to be asked once per tick, after the car was observed.

    Parameters
    ----------
    finish : condition of a run that has reached its aim.
    time_limit_us : when to give up.
    """

    def __init__(self, finish: Condition, time_limit_us: int) -> None:
        self._finish = Trigger(finish)
        self._time_limit_us = time_limit_us

    def update(self, surroundings: Surroundings) -> Ending | None:
        """The ending, or None while the run goes on."""
        now, operator = surroundings.situation, surroundings.operator
        if self._finish.update(now):
            return Ending.FINISHED
        rejected_us = operator.verdict_us if operator.verdict is Verdict.REJECTED else None
        if rejected_us is not None and now.time_us >= rejected_us + REJECTED_RUN_US:
            return Ending.REJECTED
        return Ending.TIME_UP if now.time_us >= self._time_limit_us else None


def _plant_of(scenario: Scenario, road: Road) -> Plant:
    """The car of a scenario where it starts."""
    x, y, yaw = road.pose_at(scenario.start_s_m, scenario.start_d_m)
    bank, grade = road.road_at_station(scenario.start_s_m)
    pose = {"x0": x, "y0": y, "yaw0": yaw, "v0": 0.0, "road_bank": bank, "road_grade": grade}
    try:
        return Plant(_fmu_of(scenario), load_vehicle(scenario.vehicle) | pose)
    except StartValueError as error:
        raise ConfigurationError(scenario.vehicle, "", str(error)) from error


def _fmu_of(scenario: Scenario) -> Path:
    if scenario.fmu is not None:
        return scenario.fmu
    try:
        return fmu_path(scenario.fmi_version)
    except FileNotFoundError as error:
        raise PlantError(str(error)) from error
