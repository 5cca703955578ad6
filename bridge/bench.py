"""The bench: ECUs, buses, sensors and plant in one lock-step loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import can

from bridge._native import ffi, lib
from bridge.bus import Network
from bridge.collector import collector_paused
from bridge.deferred_recorder import DeferredRecorder
from bridge.faults.fault import Fault
from bridge.faults.injector import Injection, Injector
from bridge.faults.plan import FaultPlan
from bridge.interfaces import Autonomy, Road
from bridge.monitor import RunMonitor
from bridge.pace import WallClockPace
from bridge.recorder import Recorder, Recording
from bridge.safety.limits import SafetyLimits
from bridge.safety.monitor import SafetyMonitor
from bridge.saved_state import SavedState
from bridge.scenario import Condition, Scenario, Situation, load_scenario
from bridge.sensors.truth import Truth
from bridge.surroundings import TICK_US, Ending, EndWatch, ReportedStates, Surroundings
from bridge.tap import Taps
from dbc.codec import profile
from dbc.errors import CodecError, ConfigurationError
from dbc.frames import Bus, Station

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


@dataclass
class EcuClock:
    """An ECU's own clock: it says when a tick is due, and what time it is then.

    Attributes
    ----------
    offset_us : own time less simulated time.
    ticks : in this minor frame; another number than one when the clock runs fast or slow.
    """

    offset_us: int = 0
    ticks: int = 1

    def times(self, now_us: int) -> range:
        """Own times of the ticks of the minor frame that begins now."""
        first_us = now_us + self.offset_us
        return range(first_us, first_us + self.ticks * TICK_US, TICK_US)

    def catch_up(self) -> None:
        """Go on from the last minor frame, in which there was not one tick, to one with one."""
        self.offset_us += (self.ticks - 1) * TICK_US
        self.ticks = 1


class Bench:
    """One car on one road, from power-on, advanced tick by tick.

    Parameters
    ----------
    surroundings : of the ECUs; closed with the bench.
    autonomy : from outside, see `bridge.interfaces`.
    scenario : that the surroundings were made from; how the run ends.
    taps : open python-can buses by channel name (CAN1, CAN3, CANA, CANS, CANR).

    Attributes
    ----------
    network, monitor, safety, plant, wiring, operator, race_control, laps : the parts, for inspection.
    obc, raptor, space_drive : the ECUs' C structs.
    silent : stations without power: they neither hear nor send, an ECU does not tick. A silent Raptor's outputs fall
        off; a silent Space Drive's motors stay where they are.
    stalled : stations that do not tick: what they receive waits, their outputs stay as they are.
    clocks : by ECU.
    now_us : start of the next tick.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        autonomy: Autonomy,
        scenario: Scenario,
        taps: Mapping[str, can.BusABC] | None = None,
    ) -> None:
        self.surroundings = surroundings
        self.plant = surroundings.plant
        self.wiring = surroundings.wiring
        self.operator = surroundings.operator
        self.race_control = surroundings.race_control
        self.laps = surroundings.laps
        self.scenario = scenario
        self.network = Network()
        database = profile(scenario.profile)
        self.monitor = RunMonitor(database)
        self.safety = SafetyMonitor(
            SafetyLimits.of_scenario(scenario),
            database,
            self.plant.output_names,
            surroundings.road.boundaries(),
            senders_known=True,
        )
        self.obc: Any = ffi.new("obc *")
        self.raptor: Any = ffi.new("raptor *")
        self.space_drive: Any = ffi.new("space_drive *")
        for station in (Station.OBC, Station.RAPTOR, Station.SPACE_DRIVE):
            self.power_on(station)
        self.clocks = {station: EcuClock() for station in (Station.OBC, Station.RAPTOR, Station.SPACE_DRIVE)}
        self.silent: set[Station] = set()
        self.stalled: set[Station] = set()
        self.now_us = 0
        self.lost_in_outboxes = 0
        self._autonomy = autonomy
        self._taps = Taps(taps) if taps else None
        self._recorder: Recorder | DeferredRecorder | None = None
        self._injector: Injector | None = None
        self.task_hooks: Any = None  # of `bridge.faults.memory`: they belong to the state
        self._states = ReportedStates(database)
        misc, report = self._states.misc_report, self._states.ct_report
        self._misc_data = ffi.buffer(self.network.watch(misc.bus, misc.frame_id).frame.data)
        self._ct_data = ffi.buffer(self.network.watch(report.bus, report.frame_id).frame.data)
        for place, plan in enumerate(scenario.faults):
            try:
                self.inject(plan)
            except CodecError as error:
                raise ConfigurationError(scenario.path, f"faults[{place}]", str(error)) from error

    @classmethod
    def from_scenario(
        cls,
        scenario: Scenario | Path,
        road_factory: Callable[[Path], Road],
        autonomy_factory: Callable[[Scenario, Road], Autonomy],
        folder: Path | None = None,
        taps: Mapping[str, can.BusABC] | None = None,
    ) -> Self:
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
        if isinstance(scenario, Path):
            scenario = load_scenario(scenario)
        profile(scenario.profile).check_sources()  # now rather than when the recording is done
        road = road_factory(scenario.track)
        surroundings = Surroundings.from_scenario(scenario, road)
        try:
            bench = cls(surroundings, autonomy_factory(scenario, road), scenario, taps)
            if folder is not None:
                bench.record_to(folder)
        except BaseException:
            surroundings.close()
            raise
        return bench

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def record_to(self, folder: Path) -> None:
        """Record from here on; `finish` puts the recording into place."""
        self._recorder = Recorder(folder, self.plant.output_names, self.plant.output_units, self.scenario.profile)

    def power_on(self, station: Station) -> None:
        """Put an ECU into its power-on state: onboard computer, Raptor or Space Drive."""
        number = profile(self.scenario.profile).number
        if station is Station.OBC:
            lib.obc_init(self.obc)
            lib.obc_select_profile(self.obc, number)
        elif station is Station.RAPTOR:
            lib.raptor_init(self.raptor, ffi.NULL)
            lib.raptor_select_profile(self.raptor, number)
        elif station is Station.SPACE_DRIVE:
            lib.space_drive_init(self.space_drive, ffi.NULL)
        else:
            raise ValueError(f"{station.name} is no ECU")

    def inject(self, fault: Fault | FaultPlan, **times: Any) -> Injection:
        """Inject a fault from the next tick on.

        Parameters
        ----------
        fault : one of `bridge.faults`; or a plan of one, which has its times.
        times : what `FaultPlan` has besides the fault: `onset`, `for_us`, `for_frames`, `times`, `every_us`, `seed`.

        Raises
        ------
        CodecError
            When the fault does not fit the messages of the scenario's profile, or the plant.
        """
        plan = fault if isinstance(fault, FaultPlan) else FaultPlan(fault=fault, **times)
        injector = self._injector or Injector(self)
        injection = injector.add(plan)
        self._injector = injector
        return injection

    @property
    def injections(self) -> list[Injection]:
        """All faults that were handed in, in their order."""
        return [] if self._injector is None else self._injector.injections

    def tick(self) -> None:
        """One minor frame, in the order that never changes."""
        now_us, network, surroundings, wiring = self.now_us, self.network, self.surroundings, self.wiring
        if network.log_half_full:
            self.drain()
        logged = network.logged()
        network.begin_tick(now_us, now_us + TICK_US)

        # Faults begin and end.
        if self._injector is not None:
            self._injector.begin_tick(now_us)

        # People act, and frames come in from outside.
        surroundings.act()
        if self._taps is not None:
            network.submit(Station.NONE, self._taps.receive())

        # The plant is sampled; sensors emit.
        sensed = surroundings.sense(now_us)
        if self._injector is not None:
            self._injector.sense()
        if self._speaks(Station.SENSORS):
            network.submit(Station.SENSORS, sensed)
        network.transmit(Bus.CAN_S, Bus.CAN_R)

        # Operator and autonomy.
        if self._speaks(Station.OPERATOR):
            network.submit(Station.OPERATOR, self.operator.tick(now_us, network.take(Station.OPERATOR)))
        if self._speaks(Station.AUTONOMY):
            heard, cloud = network.take(Station.AUTONOMY), surroundings.scan(now_us)
            if self._injector is not None:
                cloud = self._injector.scan(cloud)
            network.submit(Station.AUTONOMY, self._autonomy.tick(now_us, heard, cloud))
        network.transmit(Bus.CAN_A)

        # ECUs.
        if self._speaks(Station.OBC):
            for own_us in self.clocks[Station.OBC].times(now_us):
                self.lost_in_outboxes += lib.bench_obc_tick(network.handle, self.obc, own_us)
        network.transmit(Bus.CAN1, Bus.CAN_A)
        if self._speaks(Station.RAPTOR):
            for own_us in self.clocks[Station.RAPTOR].times(now_us):
                self.lost_in_outboxes += lib.bench_raptor_tick(
                    network.handle, self.raptor, own_us, wiring.raptor_in, wiring.raptor_out
                )
        elif Station.RAPTOR in self.silent:
            wiring.release_raptor()
        network.transmit(Bus.CAN1, Bus.CAN3)
        if self._speaks(Station.SPACE_DRIVE):
            for own_us in self.clocks[Station.SPACE_DRIVE].times(now_us):
                self.lost_in_outboxes += lib.bench_space_drive_tick(
                    network.handle, self.space_drive, own_us, wiring.space_drive_in, wiring.space_drive_out
                )
        network.transmit(Bus.CAN3)
        network.end_tick()
        if self._taps is not None:
            self._taps.mirror(network.log_view(logged))

        # The plant moves on.
        self.safety.add_truth(now_us, self.plant.outputs)
        if self._recorder is not None:
            self._recorder.add_truth(now_us, self.plant.outputs)
        surroundings.advance(now_us * 1e-6, None if self._injector is None else self._injector.drive)
        self.now_us = now_us + TICK_US
        surroundings.observe(self.now_us, *self._states.decode(self._misc_data, self._ct_data))

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
        limit_us = self.scenario.time_limit_us if time_limit_us is None else time_limit_us
        watch = EndWatch(until or self.scenario.finish, limit_us)
        pace = WallClockPace(rt_ratio) if rt_ratio is not None else None
        with collector_paused():
            while (ending := watch.update(self.surroundings)) is None:
                if pace is not None:
                    pace.wait(self.now_us)
                self.tick()
                if on_progress is not None and self.now_us // TICK_US % _PROGRESS_TICKS == 0:
                    on_progress(Progress(self.situation, self.truth.vx, self.station))
        return ending is Ending.FINISHED

    def drain(self) -> None:
        """Give the frames of the network's log to the monitors and to whoever records."""
        frames = self.network.drain_log()
        self.monitor.update(frames)
        self.safety.update(frames)
        if self._recorder is not None:
            self._recorder.add_frames(frames)

    def save(self) -> SavedState:
        """The state of everything between two ticks, for `restore`.

        Raises
        ------
        RaceloopError
            When it cannot be saved: the FMU does not give its state, the run is being recorded, or there are taps.
        """
        self.drain()
        self.safety.look()
        return SavedState(self, "bench")

    def restore(self, state: SavedState) -> None:
        """Go on from a state that `save` gave for this bench; any number of times, in any order.

        What belongs to the bench stays the same object. Faults that were handed in since then are gone; their handles
        tell what was.
        """
        state.restore()

    def finish(self) -> Recording | None:
        """Complete the run: the monitors know the last frame, the recording is in place."""
        self.drain()
        self.safety.finish()
        if self._recorder is None:
            return None
        recorder, self._recorder = self._recorder, None
        return recorder.finish()

    def close(self) -> None:
        """Release the plant; a recording that was not finished is removed."""
        if self._recorder is not None:
            self._recorder.abort()
            self._recorder = None
        self.surroundings.close()

    @property
    def truth(self) -> Truth:
        """True motion at `now_us`."""
        return self.surroundings.truth

    @property
    def station(self) -> float:
        """True place along the lap at `now_us`, m."""
        return self.surroundings.station

    @property
    def situation(self) -> Situation:
        """What the scenario's steps look at, at `now_us`."""
        return self.surroundings.situation

    @property
    def losses(self) -> int:
        """Frames lost anywhere for want of room: zero in a sound run."""
        return self.network.losses() + self.lost_in_outboxes

    def _speaks(self, station: Station) -> bool:
        """True unless the station is silent, when what it would have heard is gone, or stalled."""
        if station not in self.silent:
            return station not in self.stalled
        self.network.take(station)
        return False
