"""The bench: ECUs, buses, sensors and plant in one lock-step loop."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import can

from bridge._native import ffi, lib
from bridge.bus import Network
from bridge.interfaces import Autonomy, Road
from bridge.laps import LapTimer
from bridge.monitor import RunMonitor
from bridge.operator import OperatorStation, Verdict
from bridge.pace import WallClockPace
from bridge.plant import Plant
from bridge.race_control import RaceControl, SafetySwitch
from bridge.recorder import Recorder, Recording
from bridge.scenario import Condition, Scenario, Situation, Trigger, load_scenario, load_vehicle
from bridge.sensors.suite import SensorSuite
from bridge.sensors.truth import TruthReader
from bridge.tap import Taps
from bridge.wiring import Wiring
from dbc.codec import database
from dbc.errors import ConfigurationError, PlantError, StartValueError
from dbc.frames import Bus, Station
from firmware.parameters import parameter_frames
from plant_fmu import fmu_path

#: One minor frame.
TICK_US: int = lib.EXECUTIVE_FRAME_US

#: Slower than this, the car stands, m/s.
STANDSTILL_SPEED = 0.1

#: How long a run with a rejected configuration goes on: long enough to see that the car is held.
REJECTED_RUN_US = 3_000_000

#: Ticks between calls of on_progress: ten per simulated second.
_PROGRESS_TICKS = 10


@dataclass(frozen=True)
class Progress:
    """Where a run is, for people.

    Attributes
    ----------
    situation : time, states, distance, laps.
    speed : true speed, m/s.
    station : along the lap, m.
    """

    situation: Situation
    speed: float
    station: float


class Bench:
    """One car on one road, from power-on, advanced tick by tick.

    Parameters
    ----------
    plant : initialised FMU; closed with the bench.
    road, autonomy : from outside, see `bridge.interfaces`.
    scenario : what race control and people do, seed, end.
    parameters : frames of the operation parameters, closed by their commit.
    taps : open python-can buses by channel name (CAN1, CAN3, CANA, CANS).

    Attributes
    ----------
    network, plant, operator, race_control, monitor, laps : the parts, for inspection.
    obc, raptor, space_drive : the ECUs' C structs.
    silent : stations without power: they neither hear nor send, an ECU does not tick. A silent Raptor's outputs fall
        off; a silent Space Drive's motors stay where they are.
    now_us : start of the next tick.
    """

    def __init__(
        self,
        plant: Plant,
        road: Road,
        autonomy: Autonomy,
        scenario: Scenario,
        parameters: bytes,
        taps: Mapping[str, can.BusABC] | None = None,
    ) -> None:
        if road.origin is None:
            raise ConfigurationError(scenario.track, "origin", "is missing; GNSS needs the track's place on the Earth")
        self.plant = plant
        self.scenario = scenario
        self.network = Network()
        self.operator = OperatorStation(parameters)
        self.race_control = RaceControl(scenario.race_control)
        self.monitor = RunMonitor()
        self.laps = LapTimer(road.length)
        self.wiring = Wiring(plant)
        self.obc: Any = ffi.new("obc *")
        self.raptor: Any = ffi.new("raptor *")
        self.space_drive: Any = ffi.new("space_drive *")
        lib.obc_init(self.obc)
        lib.raptor_init(self.raptor, ffi.NULL)
        lib.space_drive_init(self.space_drive, ffi.NULL)
        self.silent: set[Station] = set()
        self.now_us = 0
        self.lost_in_outboxes = 0
        self._road = road
        self._autonomy = autonomy
        self._safety_switch = SafetySwitch(scenario.safety_switch)
        self._sensors = SensorSuite(road.origin, scenario.seed)
        self._truth_reader = TruthReader(plant.output_names)
        self._taps = Taps(taps) if taps else None
        self._recorder: Recorder | None = None
        misc, report = database.message("misc_report"), database.message("ct_report")
        self._misc_data = ffi.buffer(self.network.watch(misc.bus, misc.frame_id).frame.data)
        self._report_data = ffi.buffer(self.network.watch(report.bus, report.frame_id).frame.data)
        self._decode_sys, self._sys_place = misc.decode, misc.signals.index("sys_state")
        self._decode_ct, self._ct_place = report.decode, report.signals.index("ct_state")
        self._observe()

    @classmethod
    def from_scenario(
        cls,
        scenario: Scenario | Path,
        road_factory: Callable[[Path], Road],
        autonomy_factory: Callable[[Scenario, Road], Autonomy],
        folder: Path | None = None,
        taps: Mapping[str, can.BusABC] | None = None,
    ) -> Bench:
        """Build the bench that a scenario describes.

        Parameters
        ----------
        scenario : loaded, or its file.
        road_factory : makes the road from the scenario's track file.
        autonomy_factory : makes the autonomy partition.
        folder : of the recording; None for no recording.
        taps : see `Bench`.

        Raises
        ------
        RaceloopError
            When any of the files is wrong.
        """
        database.check_sources()  # now rather than when the recording is done
        if isinstance(scenario, Path):
            scenario = load_scenario(scenario)
        road = road_factory(scenario.track)
        parameters = parameter_frames(scenario.operation)
        plant = _plant_of(scenario, road)
        try:
            bench = cls(plant, road, autonomy_factory(scenario, road), scenario, parameters, taps)
            if folder is not None:
                bench.record_to(folder)
        except BaseException:
            plant.close()
            raise
        return bench

    def __enter__(self) -> Bench:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def record_to(self, folder: Path) -> None:
        """Record from here on; `finish` puts the recording into place."""
        self._recorder = Recorder(folder, self.plant.output_names, self.plant.output_units)

    def tick(self) -> None:
        """One minor frame, in the order that never changes."""
        now_us, network, wiring = self.now_us, self.network, self.wiring
        if network.log_half_full:
            self._drain()
        logged = network.logged()
        network.begin_tick(now_us, now_us + TICK_US)

        # Scenario events, and what comes in from outside.
        self._safety_switch.tick(self.situation, wiring.raptor_in)
        self.race_control.tick(self.situation, self.station, self._last_lap_s, wiring.raptor_in.race_control)
        if self._taps is not None:
            network.submit(Station.NONE, self._taps.receive())

        # The plant is sampled; sensors emit.
        wiring.sense()
        sensed = self._sensors.emit(now_us, self.truth)
        if self._speaks(Station.SENSORS):
            network.submit(Station.SENSORS, sensed)
        network.transmit(Bus.CAN_S)

        # Operator and autonomy.
        if self._speaks(Station.OPERATOR):
            network.submit(Station.OPERATOR, self.operator.tick(now_us, network.take(Station.OPERATOR)))
        if self._speaks(Station.AUTONOMY):
            network.submit(Station.AUTONOMY, self._autonomy.tick(now_us, network.take(Station.AUTONOMY)))
        network.transmit(Bus.CAN_A)

        # ECUs.
        if self._speaks(Station.OBC):
            self.lost_in_outboxes += lib.bench_obc_tick(network.handle, self.obc, now_us)
        network.transmit(Bus.CAN1, Bus.CAN_A)
        if self._speaks(Station.RAPTOR):
            self.lost_in_outboxes += lib.bench_raptor_tick(
                network.handle, self.raptor, now_us, wiring.raptor_in, wiring.raptor_out
            )
        else:
            wiring.release_raptor()
        network.transmit(Bus.CAN1, Bus.CAN3)
        if self._speaks(Station.SPACE_DRIVE):
            self.lost_in_outboxes += lib.bench_space_drive_tick(
                network.handle, self.space_drive, now_us, wiring.space_drive_in, wiring.space_drive_out
            )
        network.transmit(Bus.CAN3)
        network.end_tick()
        if self._taps is not None:
            self._taps.mirror(network.log_view(logged))

        # The plant moves on.
        wiring.drive()
        wiring.lay_road(*self._road.road_at_station(self.station))
        if self._recorder is not None:
            self._recorder.add_truth(now_us, self.plant.outputs)
        self.plant.step(now_us * 1e-6, TICK_US * 1e-6)

        self.now_us = now_us + TICK_US
        self._observe()

    def run(
        self,
        until: Condition | None = None,
        on_progress: Callable[[Progress], None] | None = None,
        rt_ratio: float | None = None,
        time_limit_us: int | None = None,
    ) -> bool:
        """Tick until a condition holds.

        Parameters
        ----------
        until : the scenario's `finish` by default.
        on_progress : called ten times per simulated second.
        rt_ratio : simulated seconds per second of the wall clock; None for as fast as possible.
        time_limit_us : simulated time at which to give up; the scenario's by default.

        Returns
        -------
        bool
            True when the condition held, False when time was up, or the onboard computer has rejected the
            configuration: then the car is held until the next power-on, and the run ends soon.
        """
        finish = Trigger(until or self.scenario.finish)
        limit_us = self.scenario.time_limit_us if time_limit_us is None else time_limit_us
        pace = WallClockPace(rt_ratio) if rt_ratio is not None else None
        with _collector_paused():
            while not finish.update(self.situation):
                if self.now_us >= limit_us or self._held_for_good():
                    return False
                if pace is not None:
                    pace.wait(self.now_us)
                self.tick()
                if on_progress is not None and self.now_us // TICK_US % _PROGRESS_TICKS == 0:
                    on_progress(Progress(self.situation, self.truth.vx, self.station))
        return True

    def finish(self) -> Recording | None:
        """Complete the run: the monitor knows the last frame, the recording is in place."""
        self._drain()
        if self._recorder is None:
            return None
        recorder, self._recorder = self._recorder, None
        return recorder.finish()

    def close(self) -> None:
        """Release the plant; a recording that was not finished is removed."""
        if self._recorder is not None:
            self._recorder.abort()
            self._recorder = None
        self.plant.close()

    @property
    def losses(self) -> int:
        """Frames lost anywhere for want of room: zero in a sound run."""
        return self.network.losses() + self.lost_in_outboxes

    def _held_for_good(self) -> bool:
        rejected_us = self.operator.verdict_us if self.operator.verdict is Verdict.REJECTED else None
        return rejected_us is not None and self.now_us >= rejected_us + REJECTED_RUN_US

    def _observe(self) -> None:
        """Look at the car after a tick: what scenario steps, sensors and the road of the next tick depend on."""
        self.truth = self._truth_reader.read(self.plant.outputs)
        self.station, _ = self._road.project(self.truth.x, self.truth.y)
        self.laps.update(self.now_us, self.station)
        self.situation = Situation(
            time_us=self.now_us,
            sys_state=int(self._decode_sys(self._misc_data)[self._sys_place]),
            ct_state=int(self._decode_ct(self._report_data)[self._ct_place]),
            distance_m=self.truth.distance,
            laps=self.laps.count,
            standstill=abs(self.truth.vx) < STANDSTILL_SPEED,
        )

    @property
    def _last_lap_s(self) -> float:
        laps = self.laps.laps_s
        return laps[-1] if laps else 0.0

    def _speaks(self, station: Station) -> bool:
        """True unless the station is silent; then what it would have heard is gone."""
        if station not in self.silent:
            return True
        self.network.take(station)
        return False

    def _drain(self) -> None:
        if self._recorder is None:
            self.monitor.update(self.network.log_view())  # each message in order of time, which is all it needs
            self.network.clear_log()
        else:
            frames = self.network.drain_log()
            self.monitor.update(frames)
            self._recorder.add_frames(frames)


@contextmanager
def _collector_paused() -> Iterator[None]:
    """No search for reference cycles while the loop runs: it makes none, and each search would be a pause."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


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
