"""Runs one cell of the reaction matrix: bring the fault about, follow what comes of it, hold it to the fault table."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bridge.faults.injector import Injection
from bridge.faults.provocations import Duration
from bridge.observed_bench import ObservedBench
from bridge.surroundings import STANDSTILL_SPEED, TICK_US
from dbc.states import SysState, TrackFlag
from firmware.parameters import load_operation
from firmware.tables import CONTROLLERS, REACTIONS, Fault
from tools.reactions.cells import Cell, Matrix
from tools.reactions.trace import Trace

#: What a value takes from one station to the next one's frame, twice.
_TWO_FRAMES_MS = 20
#: Pressure at the wheels has risen when it is so much above what it was, Pa.
_RISE_PA = 5.0e5
#: A car that has just stopped rocks on its tyres no faster, m/s.
_ROCKING_SPEED = 0.3
#: Longest time to standstill from anywhere, and to what the injection befalls first.
_STOP_US, _ONSET_US = 20_000_000, 1_500_000
#: How long the operator's request stays withdrawn in a reset; then how long there is to answer it.
_WITHDRAWN_US, _ANSWER_US = 300_000, 300_000
#: How long what must not happen is waited for.
_NOTHING_US = 300_000


@dataclass
class Measurement:
    """What one cell has shown; simulated times in microseconds.

    Attributes
    ----------
    cell : which.
    speed : of the car at the injection, m/s.
    injected_us : when something was befallen first.
    condition_us : earliest begin of the condition, computed.
    event_us : end of the frame that tells of the fault; None when nobody did.
    reaction_us : end of the frame that shows the reaction: on CAN1, or on CAN-A where CAN1 has none.
    brake_us : when the pressure at the wheels had risen.
    stop_distance_m : from the begin of the condition to standstill.
    beyond_edge_m : how far the centre of gravity was beyond the edge of the track; 0 on it.
    complaints : what is not as it should be, one line each.
    """

    cell: Cell
    speed: float = 0.0
    injected_us: int = 0
    condition_us: int = 0
    event_us: int | None = None
    reaction_us: int | None = None
    brake_us: int | None = None
    stop_distance_m: float | None = None
    beyond_edge_m: float = 0.0
    complaints: list[str] = field(default_factory=list)


class _Run:
    """One cell on a bench that is in the cell's operating state."""

    def __init__(self, matrix: Matrix, bench: ObservedBench, cell: Cell) -> None:
        self.matrix = matrix
        self.bench = bench
        self.cell = cell
        self.provocation = matrix.provocation(cell)
        self.duration = Duration(cell.duration)
        self.trace = Trace(bench)
        self.result = Measurement(cell, speed=bench.truth.vx)
        self.reacts = self.duration is not Duration.BELOW and matrix.supervised(cell)
        self.operation = dict(load_operation(bench.scenario.operation))
        self.full_pa = float(self.operation["steered_brake_pressure"])  # type: ignore[arg-type]

    @property
    def brakes_fully(self) -> bool:
        """The reaction is a full brake, whoever applies it."""
        raise NotImplementedError

    # --- the steps of a cell

    def provoke(self) -> list[Injection]:
        """Inject, and wait until something is befallen; sets the window in which the condition begins."""
        plans = self.matrix.provoker.plans(self.provocation, self.duration, self.matrix.debounce_cycles(self.cell))
        assert plans is not None
        injections = [self.bench.inject(plan) for plan in plans]
        self.trace.run_to(lambda: injections[0].first_us is not None, self.bench.now_us + _ONSET_US)
        first_us = injections[0].first_us
        assert first_us is not None, f"{injections[0].fault} has befallen nothing"
        self.result.injected_us = first_us
        self.begin_us, self.latest_us = self.matrix.provoker.condition_us(self.provocation, first_us)
        self.result.condition_us = self.begin_us
        return injections

    def await_end(self, injections: list[Injection]) -> tuple[int, int]:
        """Run until the injection is over; the window in which the condition is gone."""
        self.trace.run_to(lambda: all(injection.done for injection in injections), self.bench.now_us + _ONSET_US)
        last_us = injections[0].last_us
        assert last_us is not None
        assert all(injection.done for injection in injections)
        return self.matrix.provoker.end_us(self.provocation, last_us)

    def stand(self, why: str, measure: bool = True) -> None:
        """Run until the car stands, sliding counted, and a little longer: it has to stay."""
        if not self.trace.run_to(lambda: self.speed() < STANDSTILL_SPEED, self.bench.now_us + _STOP_US):
            self.complain(f"{why}: the car still moves at {self.speed():.1f} m/s")
            return
        if measure:
            self.measure_brakes()
        self.trace.run_until(self.bench.now_us + _NOTHING_US)
        if self.speed() > _ROCKING_SPEED:
            self.complain(f"{why}: the car moves again at {self.speed():.1f} m/s")

    def speed(self) -> float:
        """True speed, whichever way the car points, m/s."""
        return math.hypot(self.bench.truth.vx, self.bench.truth.vy)

    def complain(self, text: str) -> None:
        """Note what is not as it should be."""
        self.result.complaints.append(text)

    # --- what was seen

    def events(self) -> list[tuple[int, str, bool]]:
        """fault_event frames: time, name, active."""
        times, numbers = self.trace.signal("fault_event", "fault_id")
        _, active = self.trace.signal("fault_event", "fault_active")
        names = {fault.id: name for name, fault in self.matrix.faults.items()}
        rows = zip(times.tolist(), numbers.tolist(), active.tolist(), strict=True)
        return [(time_us, names[int(number)], bool(on)) for time_us, number, on in rows]

    def happened(self, name: str, active: bool = True) -> int | None:
        """When a fault was told, first."""
        found = (time_us for time_us, one, on in self.events() if (one, on) == (name, active))
        return next(found, None)

    def first_after(
        self, after_us: int, message: str, signal: str, holds: Callable[[NDArray[np.float64]], NDArray[np.bool_]]
    ) -> int | None:
        """Time of the first frame from a time on whose value is as wanted."""
        times, values = self.trace.signal(message, signal)
        found = times[(times >= after_us) & holds(values)]
        return int(found[0]) if found.size else None

    def measure_brakes(self) -> None:
        """When the pressure rose, and how far the car went."""
        times, pressure = self.trace.truth("brake_pressure_front")
        before = float(pressure[np.searchsorted(times, self.result.injected_us)])
        risen = times[(times > self.begin_us) & (pressure > before + _RISE_PA)]
        # A car that brakes already has nothing to show but for a full brake.
        tells = risen.size and (self.brakes_fully or before < _RISE_PA)
        self.result.brake_us = int(risen[0]) if tells else None
        times, distance = self.trace.truth("distance")
        if self.result.speed > 1.0:
            place = int(np.searchsorted(times, self.begin_us))
            self.result.stop_distance_m = float(distance[-1] - distance[place])

    def judge_window(self, what: str, seen_us: int | None, earliest_us: int, latest_us: int) -> None:
        """Something happened in its window."""
        if seen_us is None:
            self.complain(f"{what}: not seen, allowed until {latest_us / 1e6:.3f} s")
        elif not earliest_us <= seen_us <= latest_us:
            window = f"{earliest_us / 1e6:.3f} to {latest_us / 1e6:.3f} s"
            self.complain(f"{what}: at {seen_us / 1e6:.4f} s, allowed is {window}")

    def complain_of_others(self, allowed: set[str]) -> None:
        """Every fault that was told and does not belong here."""
        found: dict[str, int] = {}
        for time_us, name, active in self.events():
            if active and name not in allowed:
                found.setdefault(name, time_us)
        for name, time_us in found.items():
            after_ms = (time_us - self.result.injected_us) / 1000
            self.complain(f"unexpected fault {name}, {after_ms:.0f} ms after the injection")

    def judge_safety(self) -> None:
        """The safety properties have held but for those that the injection itself breaks."""
        self.bench.finish()
        for violation in self.bench.safety.violations:
            if violation.property_id not in self.provocation.excused:
                self.complain(str(violation))
        self.result.beyond_edge_m = self.trace.beyond_edge(self.matrix.edges)
        if self.bench.losses:
            self.complain(f"{self.bench.losses} frames lost")


class SsmRun(_Run):
    """A fault of the fault table."""

    def __init__(self, matrix: Matrix, bench: ObservedBench, cell: Cell) -> None:
        super().__init__(matrix, bench, cell)
        self.fault: Fault = matrix.faults[cell.name]
        self.debounced_us = (self.fault.debounce_cycles - 1) * TICK_US
        self.stops = REACTIONS.index(self.fault.reaction) >= REACTIONS.index("safe_stop")
        self.allowed = {self.fault.name, *self.provocation.companions}

    @property
    def brakes_fully(self) -> bool:
        """See `_Run`."""
        return self.fault.reaction == "full_brake"

    def run(self) -> Measurement:
        """Everything, in order."""
        injections = self.provoke()
        if not self.reacts:
            self.see_nothing(injections)
        else:
            self.trace.run_until(self.latest_us + self.debounced_us + _TWO_FRAMES_MS * 1000 + 2 * TICK_US)
            self.judge_reaction()
            if self.duration is Duration.PERMANENT:
                self.see_it_through()
            else:
                self.recover(injections)
        self.judge_others()
        self.judge_safety()
        return self.result

    def see_nothing(self, injections: list[Injection]) -> None:
        """The condition is too short, or nobody is to look: nothing happens."""
        if self.duration is Duration.BELOW:
            self.await_end(injections)
        self.trace.run_until(
            max(self.bench.now_us, self.latest_us + self.debounced_us) + _TWO_FRAMES_MS * 1000 + _NOTHING_US
        )
        if (seen_us := self.happened(self.fault.name)) is not None:
            self.complain(f"{self.fault.name} at {seen_us / 1e6:.4f} s, where nothing is allowed")

    def judge_reaction(self) -> None:
        """Neither late nor early, and the one that the table says."""
        fault, result = self.fault, self.result
        earliest_us = self.begin_us + self.debounced_us
        bound_ms = min(fault.debounce_ms + _TWO_FRAMES_MS, fault.deadline_ms)
        latest_us = self.latest_us + bound_ms * 1000
        result.event_us = self.happened(fault.name)
        self.judge_window("fault_event", result.event_us, earliest_us, latest_us + TICK_US)
        if result.event_us is None:
            return
        level = REACTIONS.index(fault.reaction)
        ssm_us = self.first_after(result.injected_us, "ssm_status", "ssm_reaction", lambda values: values >= level)
        first_us = self.companions_us(level, earliest_us)
        self.judge_window(f"reaction {fault.reaction} on CAN-A", ssm_us, first_us, latest_us)
        active_us = result.event_us // TICK_US * TICK_US
        result.reaction_us = self.first_after(active_us, "ssm_status", "ssm_reaction", lambda values: values >= level)
        if self.stops:
            result.reaction_us = self.judge_commands(active_us, first_us, latest_us)
        elif level > REACTIONS.index("warn"):
            self.judge_degradation(earliest_us, latest_us)

    def companions_us(self, level: int, earliest_us: int) -> int:
        """From when on a reaction of this level may be seen: a companion may have asked for it before."""
        levels = {name: REACTIONS.index(fault.reaction) for name, fault in self.matrix.faults.items()}
        others = self.allowed - {self.fault.name}
        before = [time_us for time_us, name, on in self.events() if on and name in others and levels[name] >= level]
        return min([earliest_us, *(time_us // TICK_US * TICK_US for time_us in before)])

    def judge_commands(self, active_us: int, earliest_us: int, latest_us: int) -> int | None:
        """The commands on CAN1 are those of a stop; returns the time by which they were.

        A throttle may be shut before for other reasons, a full brake may not.
        """
        shut = self.first_after(active_us, "accelerator_cmd", "acc_pedal_cmd", lambda values: values <= 0.0)
        self.judge_window("throttle shut on CAN1", shut, 0, latest_us)
        if not self.brakes_fully:
            return shut
        full_kpa = self.full_pa / 1000.0
        begin_us = self.result.injected_us
        braked = self.first_after(begin_us, "brake_pressure_cmd", "brake_pressure_cmd", lambda kpa: kpa >= full_kpa)
        # What is seen a tick later, by its own trace, may have been answered in the tick itself.
        told_later_us = self.provocation.detection.later_ms * 1000
        self.judge_window("full brake on CAN1", braked, earliest_us - told_later_us, latest_us)
        return None if shut is None or braked is None else max(shut, braked)

    def judge_degradation(self, after_us: int, latest_us: int) -> None:
        """Limits and controller are those of a degraded car, and the throttle is shut above the limit."""
        speed_percent, _ = self.fault.share
        limit = float(self.operation["degraded_max_speed"]) * speed_percent / 100.0  # type: ignore[arg-type]
        seen_us = self.first_after(after_us, "ssm_status", "ssm_max_speed", lambda values: values <= limit + 0.05)
        self.judge_window("degraded_max_speed on CAN-A", seen_us, after_us, latest_us)
        if self.fault.disables != "none":
            number = CONTROLLERS.index(self.fault.disables)
            switched = self.first_after(after_us, "ssm_status", "ssm_controller", lambda values: values != number)
            self.judge_window(f"{self.fault.disables} disabled", switched, after_us, latest_us)
        if self.result.speed > limit + 1.0:
            shut = self.first_after(after_us, "accelerator_cmd", "acc_pedal_cmd", lambda values: values <= 0.0)
            self.judge_window("throttle shut above the limit", shut, 0, latest_us + _TWO_FRAMES_MS * 1000)

    def see_it_through(self) -> None:
        """The condition stays: so does the reaction; the car stops when it is to."""
        if self.stops:
            self.stand("permanent")
        else:
            self.trace.run_until(self.bench.now_us + _NOTHING_US)
        if (cleared := self.happened(self.fault.name, active=False)) is not None:
            self.complain(f"{self.fault.name} cleared at {cleared / 1e6:.3f} s while its condition was there")
        times, values = self.trace.signal("ssm_status", "ssm_reaction")
        since = self.result.reaction_us or 0
        if np.any(values[times >= since] < REACTIONS.index(self.fault.reaction)):
            self.complain(f"the reaction was less than {self.fault.reaction} while the condition was there")

    def recover(self, injections: list[Injection]) -> None:
        """The condition goes away: clear time and latch are honoured."""
        gone_us, gone_latest_us = self.await_end(injections)
        cleared_us = gone_us + (self.fault.clear_cycles - 1) * TICK_US
        cleared_latest_us = gone_latest_us + (self.fault.clear_cycles - 1) * TICK_US + _TWO_FRAMES_MS * 1000
        if self.fault.latch == "while_present":
            self.trace.run_until(cleared_latest_us + TICK_US)
            seen_us = self.happened(self.fault.name, active=False)
            self.judge_window("cleared", seen_us, cleared_us, cleared_latest_us)
            self.judge_return()
            return
        self.trace.run_until(cleared_latest_us + _NOTHING_US)
        if not self.stops and not self.bench.situation.standstill:
            self.bench.race_control.track_flag = TrackFlag.RED
        self.stand("after the condition", measure=self.stops)
        early = self.happened(self.fault.name, active=False)
        if self.provocation.resets and self.cell.state == "standstill":
            self.judge_window("cleared by its own end", early, cleared_us, cleared_latest_us)
            return
        if early is not None:
            self.complain(f"{self.fault.name} cleared at {early / 1e6:.3f} s, before any reset")
        self.reset()

    def judge_return(self) -> None:
        """Without any fault left the SSM is what it was before."""
        active = {name: on for _, name, on in self.events()}
        _, reactions = self.trace.signal("ssm_status", "ssm_reaction")
        if not any(active.values()) and reactions[-1] != REACTIONS.index("none"):
            self.complain(f"reaction {REACTIONS[int(reactions[-1])]} with every fault cleared")

    def reset(self) -> None:
        """The operator withdraws the request and asks again, at standstill."""
        self.allowed.add("launch_withdrawn")
        self.bench.operator.launch_wanted = False
        self.trace.run_until(self.bench.now_us + _WITHDRAWN_US)
        self.bench.operator.launch_wanted = True
        asked_us = self.bench.now_us
        self.trace.run_until(asked_us + _ANSWER_US)
        cleared = self.happened(self.fault.name, active=False)
        if self.fault.latch == "until_reset":
            self.judge_window("cleared by the reset", cleared, asked_us, asked_us + 100_000 + _TWO_FRAMES_MS * 1000)
        elif cleared is not None:
            self.complain(f"{self.fault.name} cleared at {cleared / 1e6:.3f} s; it lasts until a restart")

    def judge_others(self) -> None:
        """No fault but those that belong to it."""
        self.complain_of_others(self.allowed)


class LowerRun(_Run):
    """What the Raptor or the Space Drive watches by itself."""

    @property
    def brakes_fully(self) -> bool:
        """See `_Run`."""
        return self.provocation.reaction != "warn"

    def run(self) -> Measurement:
        """Everything, in order."""
        injections = self.provoke()
        self.trace.run_until(self.latest_us + 12 * TICK_US)
        stops = self.provocation.reaction != "warn"
        if self.reacts:
            self.judge_reaction(stops)
            if stops:
                self.stand("full brake")
            if self.duration is Duration.AT:
                self.await_end(injections)
            self.trace.run_until(self.bench.now_us + _NOTHING_US)
            self.judge_latch(stops)
        else:
            self.await_end(injections)
            self.trace.run_until(self.bench.now_us + _NOTHING_US)
        if not (self.reacts and stops):
            self.judge_no_stop()
            self.judge_others()
        self.judge_safety()
        return self.result

    def judge_reaction(self, stops: bool) -> None:
        """Neither late nor early, and told by the bits that belong to it."""
        latest_us = self.latest_us + _TWO_FRAMES_MS * 1000
        if stops:
            reaction_us = self.braking_frame()
            self.result.reaction_us = reaction_us
            self.judge_window(self.provocation.reaction, reaction_us, self.begin_us, latest_us)
        bits = [
            self.first_after(self.result.injected_us, "diagnostic_report", bit, lambda values: values == 1.0)
            for bit in self.provocation.diagnostic
        ]
        for bit, seen_us in zip(self.provocation.diagnostic, bits, strict=True):
            # A Space Drive's status comes every 20 ms, and a tick later to the Raptor.
            self.judge_window(bit, seen_us, self.begin_us, latest_us + 3 * TICK_US)
        known = [seen_us for seen_us in bits if seen_us is not None]
        self.result.event_us = min(known) if known else None
        if not stops:
            self.result.reaction_us = self.result.event_us

    def braking_frame(self) -> int | None:
        """When the layer says that it stops the car: the Raptor on CAN1, the Space Drive on CAN3."""
        if self.cell.layer == "raptor":
            emergency = SysState.EMERGENCY_SHUTDOWN
            return self.first_after(0, "misc_report", "sys_state", lambda values: values == emergency)
        told = (
            self.first_after(0, message, "emr_brk", lambda values: values == 1.0)
            for message in ("stat_brk_1", "stat_steer_1")
        )
        return min((seen_us for seen_us in told if seen_us is not None), default=None)

    def judge_latch(self, stops: bool) -> None:
        """Who brakes goes on braking, with the condition or without."""
        if not stops:
            return
        demand = self.bench.wiring.space_drive_out.brake_pressure_demand
        if demand < 0.999 * self.full_pa:
            self.complain(f"the brake demand is {demand / 1e6:.2f} MPa at the end; it stays full until a restart")
        if self.bench.wiring.raptor_out.throttle_demand > 0.0:
            self.complain("the throttle is open at the end")

    def judge_no_stop(self) -> None:
        """Nobody brakes, and nobody says that he does."""
        _, states = self.trace.signal("misc_report", "sys_state")
        if np.any(states == SysState.EMERGENCY_SHUTDOWN):
            self.complain("the Raptor is in EMERGENCY_SHUTDOWN")
        for message in ("stat_brk_1", "stat_steer_1"):
            if self.first_after(0, message, "emr_brk", lambda values: values == 1.0) is not None:
                self.complain(f"{message}: the Space Drive brakes")
                break

    def judge_others(self) -> None:
        """No fault of the SSM but those that belong to it."""
        self.complain_of_others(set(self.provocation.companions))


def run_cell(matrix: Matrix, bench: ObservedBench, cell: Cell) -> Measurement:
    """Run a cell on a bench that is in its operating state, see `tools.reactions.states`."""
    return (SsmRun if cell.layer == "ssm" else LowerRun)(matrix, bench, cell).run()
