"""The safety properties, one class each.

A property sees a block of the run, every message and the plant's truth as `Series`, and gives the rows that break it.
Rows of one message are compared with what was in force of another one at their time; where a station needs a cycle to
follow, the property asks for no more than that.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from bridge.safety.active_faults import ActiveFaults
from bridge.safety.limits import (
    CYCLE_US,
    FULL_BRAKE_KPA,
    NEUTRAL_COUNTS,
    PASSING_US,
    PEDAL_BRAKE_KPA,
    PEDAL_THROTTLE_PERCENT,
    PEDAL_US,
    STEERED_BRAKE_KPA,
    STEERING_ASTRAY_US,
    STEERING_COUNTS,
    STEERING_LAG_US,
    WITHIN_TICK_US,
    SafetyLimits,
)
from bridge.safety.series import Column, Series, Times, lasting
from bridge.safety.statement import Statement
from bridge.safety.track import TrackEdges
from dbc.codec import MessageCodec
from dbc.states import CtState, SsmState, SysState

Rows = NDArray[np.bool_]

#: Half a bit of each signal, which encoding may add.
_KPA, _PERCENT, _DEG = 0.5, 0.005, 0.25
_SPEED, _ACCELERATION = 0.025 + 1e-9, 0.05 + 1e-9  # of what the SSM allows, m/s and m/s2
#: A count of a request on CAN3 and a bit of a command on CAN1, kPa.
_REQUEST_KPA = 1.0

_RELEASED = (SsmState.NOMINAL, SsmState.DEGRADED, SsmState.EMERGENCY)
_THROTTLED = (SsmState.NOMINAL, SsmState.DEGRADED)
_DRIVES = (CtState.CAUTION, CtState.NOM_RACE, CtState.COORD_STOP)

#: In these the Raptor asks for a full brake whatever it is told.
_BRAKED = (
    SysState.ACT_TEST_FAIL,
    SysState.CRANK_CHECKS_FAIL,
    SysState.EMERGENCY_SHUTDOWN,
    SysState.ENG_FAILED_TO_START,
    SysState.PWR_OFF,
)

SSM, FAULT, BRAKE, THROTTLE, STEERING = (
    "ssm_status",
    "fault_event",
    "brake_pressure_cmd",
    "accelerator_cmd",
    "steering_cmd",
)
GEAR, CT, SYS, PEDAL = "gear_shift_cmd", "ct_report", "misc_report", "accelerator_report"
BRAKE_REQUEST, STEERING_REQUEST, BRAKE_STATUS = "req_brake_pos", "req_steer_pos", "stat_brk_1"
STEERING_POSITIONS = ("calb_steer_pos_1", "calb_steer_pos_2", "calb_steer_pos_3")
STEERING_STATUS = ("stat_steer_1", "stat_steer_2", "stat_steer_3")

TRUTH = ("x", "y", "vx", "vy", "throttle_position", "brake_pressure_front", "brake_pressure_rear")
"""Outputs of the plant that properties look at."""


@dataclass(frozen=True)
class Breach:
    """Rows that break a property.

    Attributes
    ----------
    series : whose rows they are.
    rows : True where broken; shape of the series.
    seen : says what a row shows.
    allowed : says what it may.
    """

    series: Series
    rows: Rows
    seen: Callable[[int], str]
    allowed: str | Callable[[int], str]


@dataclass
class Scene:
    """What the properties see.

    Attributes
    ----------
    limits : of the run.
    messages, series : by name of the message.
    truth : of the plant.
    edges : of the track, if it is known.
    launched_us : when both computers first said that the car drives; None before.
    """

    limits: SafetyLimits
    messages: Mapping[str, MessageCodec]
    series: Mapping[str, Series]
    truth: Series
    edges: TrackEdges | None
    launched_us: int | None = None

    def look_for_launch(self) -> None:
        """Note the launch when it is among the new rows."""
        if self.launched_us is None and {SSM, SYS} <= self.series.keys():
            ssm = self.series[SSM]
            drives = among(ssm["ssm_state"], _RELEASED) & (
                self.series[SYS].held("sys_state", ssm.times) == SysState.DRIVING
            )
            drives[: ssm.fresh] = False
            if drives.any():
                self.launched_us = int(ssm.times[drives.argmax()])

    def before_launch(self, times: Times) -> Rows:
        """Which times lie before the launch."""
        if self.launched_us is None:
            return np.full(len(times), True)
        return times < self.launched_us

    def timeout_us(self, message: str) -> int:
        """Age at which a receiver gives a message up, and the two cycles within which it has to react."""
        return self.messages[message].timeout_us + PASSING_US


class Property(Statement):
    """What must be true of signals and of the plant.

    Attributes
    ----------
    messages : that it looks at.
    truth, track : whether it needs the plant, and the edges of the track.
    """

    messages: ClassVar[tuple[str, ...]] = ()
    truth: ClassVar[bool] = False
    track: ClassVar[bool] = False

    @abstractmethod
    def check(self, scene: Scene) -> Iterator[Breach]:
        """Give the rows that break it."""


class FullBrakeCommanded(Property):
    """The first layer: the onboard computer."""

    id = "SAFE-1"
    text = (
        "After the fault_event of a full-brake fault and its deadline, and while the SSM does not release the car, "
        "the commands are a full brake and no throttle; a stronger one while it lets no controller steer."
    )
    source = "deadline less debounce in faults.yaml; steered_brake_pressure, full_brake_pressure of the operation file"
    messages = (SSM, FAULT, BRAKE, THROTTLE)

    def __init__(self) -> None:
        self._latched_us: int | None = None

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        ssm, brake, throttle = (scene.series[name] for name in (SSM, BRAKE, THROTTLE))
        steered, full = scene.limits.steered_brake_kpa, scene.limits.full_brake_kpa
        pressure, open_ = brake[_brake_signal(scene)], throttle["acc_pedal_cmd"] > _PERCENT
        weak = pressure < steered - _KPA
        # Restarted, the computer is in BOOT again; its faults are forgotten, and the state itself demands the brake.
        restarts = _started_again(ssm["ssm_state"], (SsmState.BOOT,))
        restarts[: ssm.fresh] = False
        if restarts.any():
            self._latched_us = None
        since = self._since(scene, int(ssm.times[restarts][-1]) if restarts.any() else -1)
        if since is not None:
            allowed = _stopped(steered)
            for series, bad, signal in ((brake, weak, _brake_signal(scene)), (throttle, open_, "acc_pedal_cmd")):
                yield Breach(series, bad & (series.times >= since), _value(series, signal), allowed)
        # In two states running: what was commanded in between, the newest included, belongs to them.
        held = _twice(~among(ssm["ssm_state"], _RELEASED))
        unsteered = held & _twice(ssm["ssm_controller"] == 0)
        for series, bad, signal, rows, least in (
            (brake, weak, _brake_signal(scene), held, steered),
            (brake, pressure < full - _KPA, _brake_signal(scene), unsteered, full),
            (throttle, open_, "acc_pedal_cmd", held, steered),
        ):
            places = series.places(ssm.times)
            broken = rows & _in_force(series, ssm.times) & _picked(bad, places)
            seen = _with_state(ssm, "ssm_state", SsmState, _held_value(series, signal, places))
            yield Breach(ssm, broken, seen, _stopped(least))

    def _since(self, scene: Scene, restarted_us: int) -> int | None:
        faults = scene.series[FAULT]
        for row in range(faults.fresh, len(faults.times)):
            within_us = scene.limits.full_brake_faults.get(int(faults["fault_id"][row]))
            if within_us is not None and faults["fault_active"][row] and self._latched_us is None:
                time_us = int(faults.times[row])
                if time_us > restarted_us:
                    self._latched_us = time_us + within_us
        return self._latched_us


class FullBrakeRequested(Property):
    """The second layer: the Raptor."""

    id = "SAFE-2"
    text = (
        "The Raptor asks the Space Drive for no less brake than was commanded, and for a full brake when commands or "
        "ct_report are silent for their time-out, and in EMERGENCY_SHUTDOWN and the failure states; for the stronger "
        "one when it is the steering that is silent."
    )
    source = (
        "FULL_BRAKE_KPA and STEERED_BRAKE_KPA in bridge/safety/limits.py; GenMsgTimeout in the DBC file; two cycles "
        "from CAN1 to CAN3"
    )
    messages = (BRAKE, THROTTLE, STEERING, CT, SYS, BRAKE_REQUEST)

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        request, full = scene.series[BRAKE_REQUEST], scene.limits.brakes.full_kpa
        times, asked = request.times, _request_kpa(request["contrl_pos_brk"], full)
        required, own = np.zeros(len(times)), np.zeros(len(times))
        # Each bus has its own clock within a tick: the request may end before the command that it follows.
        told = times + WITHIN_TICK_US
        commanded = scene.series[BRAKE].lowest(_brake_signal(scene), told, PASSING_US + CYCLE_US + WITHIN_TICK_US)
        # What cannot be commanded is not followed; the Raptor stops the car for it.
        commanded = np.where(commanded > full, 0.0, commanded)
        required = np.fmax(required, commanded)
        for name in (BRAKE, THROTTLE, STEERING, CT):
            own[scene.series[name].age(told) > scene.timeout_us(name) + WITHIN_TICK_US] = STEERED_BRAKE_KPA
        own[scene.series[STEERING].age(told) > scene.timeout_us(STEERING) + WITHIN_TICK_US] = FULL_BRAKE_KPA
        sys = scene.series[SYS]
        now, before = sys.held("sys_state", times), sys.held("sys_state", times - PASSING_US)
        braked = among(now, _BRAKED) & (now == before)
        own[braked] = np.fmax(own[braked], STEERED_BRAKE_KPA)
        required = np.fmax(required, own)
        yield Breach(
            request,
            asked < required - _REQUEST_KPA,
            lambda row: f"contrl_pos_brk asks for {asked[row]:.0f} kPa",
            lambda row: f"at least {required[row]:.0f} kPa",
        )


class BrakesFollow(Property):
    """The third layer: Space Drive and hydraulics."""

    id = "SAFE-3"
    text = (
        "Both brake lines have what is asked for on CAN3 within the actuator's rise time; a full brake when requests "
        "are silent for their time-out, the stronger one when those of the steering are, and while the Space Drive "
        "reports its emergency brake."
    )
    source = (
        "FULL_BRAKE_KPA and STEERED_BRAKE_KPA in bridge/safety/limits.py; brake_delay, brake_bandwidth, "
        "brake_pressure_rate_limit of the vehicle file; GenMsgTimeout of CAN3"
    )
    messages = (BRAKE_REQUEST, STEERING_REQUEST, BRAKE_STATUS)
    truth = True

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        truth, brakes = scene.truth, scene.limits.brakes
        times, request = truth.times, scene.series[BRAKE_REQUEST]
        asked = _request_kpa(request.held("contrl_pos_brk", times), brakes.full_kpa)
        unheard_of = {
            name: scene.series[name].age(times) > scene.timeout_us(name) for name in (BRAKE_REQUEST, STEERING_REQUEST)
        }
        silent = unheard_of[BRAKE_REQUEST] | unheard_of[STEERING_REQUEST]
        emergency = scene.series[BRAKE_STATUS].held("emr_brk", times) > 0
        asked[silent | emergency] = STEERED_BRAKE_KPA
        asked[unheard_of[STEERING_REQUEST]] = FULL_BRAKE_KPA
        rows = brakes.settled_us // CYCLE_US + 1
        unheard = scene.series[BRAKE_STATUS].age(times) > scene.timeout_us(BRAKE_STATUS)
        alone = (silent | emergency | unheard).astype(np.float64)
        low = _over_last(np.minimum, asked, rows)
        high = np.where(_over_last(np.maximum, alone, rows) > 0.0, np.inf, _over_last(np.maximum, asked, rows))
        tolerance = brakes.tolerance_kpa + _REQUEST_KPA
        for signal, share in (("brake_pressure_front", brakes.front_share), ("brake_pressure_rear", brakes.rear_share)):
            pressure = truth[signal] / 1000.0
            # Not a number, before the first request, compares as false.
            broken = (pressure < low * share - tolerance) | (pressure > high * share + tolerance)
            broken[: rows - 1] = False  # too little is known of what was asked for before
            yield Breach(
                truth,
                broken,
                _number_of(signal, pressure, "kPa"),
                _range_of(low * share - tolerance, high * share + tolerance, "kPa"),
            )


class PedalsOnBus(Property):
    """Accelerator and brake commanded together."""

    id = "SAFE-4"
    text = "On CAN1 accelerator and brake are not commanded together beyond the overlap limit."
    source = "PEDAL_THROTTLE_PERCENT, PEDAL_BRAKE_KPA and PEDAL_US in bridge/safety/limits.py"
    messages = (BRAKE, THROTTLE)

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        throttle, brake = scene.series[THROTTLE], scene.series[BRAKE]
        pressure = brake.held(_brake_signal(scene), throttle.times)
        yield _overlap(throttle, throttle["acc_pedal_cmd"], pressure, PEDAL_US)


class PedalsAtRaptor(Property):
    """The Raptor lets no throttle pass beside a brake."""

    id = "SAFE-5"
    text = "The Raptor passes no accelerator beyond the overlap limit beside the brake that it asks for on CAN3."
    source = "PEDAL_THROTTLE_PERCENT and PEDAL_BRAKE_KPA in bridge/safety/limits.py; two cycles between the buses"
    messages = (PEDAL, BRAKE_REQUEST)

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        pedal, request = scene.series[PEDAL], scene.series[BRAKE_REQUEST]
        asked = _request_kpa(request.held("contrl_pos_brk", pedal.times), scene.limits.brakes.full_kpa)
        yield _overlap(pedal, pedal["acc_pedal_fdbk"], asked, PASSING_US)


class PedalsAtPlant(Property):
    """Throttle and brake pressure together."""

    id = "SAFE-6"
    text = "At the car the throttle is not open beside brake pressure beyond the overlap limit."
    source = "PEDAL_THROTTLE_PERCENT, PEDAL_BRAKE_KPA and PEDAL_US in bridge/safety/limits.py"
    truth = True

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        truth = scene.truth
        throttle, pressure = 100.0 * truth["throttle_position"], truth["brake_pressure_front"] / 1000.0
        yield _overlap(truth, throttle, pressure, PEDAL_US)


class CommandLimits(Property):
    """Commands inside their limits."""

    id = "SAFE-7"
    text = "Commands for brake, accelerator, steering and gear are inside their limits."
    source = (
        "brake_pressure_max and the gears of the vehicle file; throttle_limit, steering_limit and steering_ratio of "
        "the operation file"
    )
    messages = (BRAKE, THROTTLE, STEERING, GEAR)

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        limits = scene.limits
        for message, signal, low, high, slack, unit in (
            (BRAKE, _brake_signal(scene), 0.0, limits.brakes.full_kpa, _KPA, "kPa"),
            (THROTTLE, "acc_pedal_cmd", 0.0, limits.throttle_percent, _PERCENT, "%"),
            (STEERING, "steering_motor_ang_cmd", -limits.steering_deg, limits.steering_deg, _DEG, "deg"),
            (GEAR, "desired_gear", 0.0, float(limits.gears), 0.0, ""),
        ):
            series = scene.series[message]
            values = series[signal]
            broken = (values < low - slack) | (values > high + slack)
            yield Breach(series, broken, _value(series, signal), f"{low:.10g} to {high:.10g} {unit}".rstrip())


class SteeringSlew(Property):
    """Steering moves no faster than configured."""

    id = "SAFE-8"
    text = "From the launch on the steering command changes no faster than its slew limit, cycle by cycle."
    source = "steering_slew and steering_ratio of the operation file; GenMsgCycleTime in the DBC file"
    messages = (STEERING, SSM, SYS)

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        series, codec = scene.series[STEERING], scene.messages[STEERING]
        angle = series["steering_motor_ang_cmd"]
        gaps = np.diff(series.times, prepend=series.times[:1])
        steps = np.abs(np.diff(angle, prepend=angle[:1]))
        cycles = np.maximum(np.rint(gaps / codec.cycle_us), 1.0)
        # Both commands are rounded to a bit.
        most = cycles * scene.limits.steering_slew_deg + 2.0 * _DEG
        # Before, nobody follows it, and a computer that starts takes over the wheels where it finds them.
        broken = (steps > most) & (gaps <= codec.timeout_us) & ~scene.before_launch(series.times)
        yield Breach(
            series,
            broken,
            lambda row: f"steering_motor_ang_cmd changes by {steps[row]:.10g} deg",
            lambda row: f"{most[row]:.3g} deg",
        )


class SsmLimits(Property):
    """The SSM allows no more than the configuration."""

    id = "SAFE-9"
    text = (
        "The speed and accelerations that the SSM allows are at most those configured for its state, else none; two "
        "cycles after the fault_event of a fault, until that of its end, at most what it leaves of those of DEGRADED."
    )
    source = "max_* and degraded_max_* of the operation file; speed_percent and acceleration_percent in faults.yaml"
    messages = (SSM, FAULT)

    def __init__(self) -> None:
        self._faults: ActiveFaults | None = None

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        limits, ssm = scene.limits, scene.series[SSM]
        state = ssm["ssm_state"]
        nominal, degraded = state == SsmState.NOMINAL, state == SsmState.DEGRADED
        for signal, normal, lower, slack, braking in (
            ("ssm_max_speed", limits.max_speed, limits.degraded_max_speed, _SPEED, False),
            ("ssm_max_acceleration", limits.max_acceleration, limits.degraded_max_acceleration, _ACCELERATION, False),
            ("ssm_max_deceleration", limits.max_deceleration, limits.max_deceleration, _ACCELERATION, True),
        ):
            most = np.where(nominal, normal, np.where(degraded, lower, 0.0))
            if braking:
                most[state == SsmState.EMERGENCY] = normal
            seen = _with_state(ssm, "ssm_state", SsmState, _value(ssm, signal))
            yield Breach(ssm, ssm[signal] > most + slack, seen, _at_most(most))
        yield from self._by_fault(scene)

    def _by_fault(self, scene: Scene) -> Iterator[Breach]:
        limits, ssm = scene.limits, scene.series[SSM]
        if self._faults is None:
            self._faults = ActiveFaults(limits.degraded_shares)
        self._faults.update(scene.series[FAULT], ssm)
        if not len(ssm.times):
            return
        shares = self._faults.least(ssm.times)
        for signal, lower, slack, share in (
            ("ssm_max_speed", limits.degraded_max_speed, _SPEED, shares[:, 0]),
            ("ssm_max_acceleration", limits.degraded_max_acceleration, _ACCELERATION, shares[:, 1]),
        ):
            most = lower * share
            # The event that a fault has gone comes behind the first status without it.
            held = lasting(ssm[signal] > most + slack, ssm.times)
            seen = _with_state(ssm, "ssm_state", SsmState, _value(ssm, signal))
            yield Breach(ssm, held > PASSING_US, seen, _at_most(most, " with the faults that are active"))


class NoMotionBeforeLaunch(Property):
    """The car stands until it is launched."""

    id = "SAFE-10"
    text = "The car stands until the SSM has released it and the Raptor is in DRIVING."
    source = "standstill_speed of the operation file"
    messages = (SSM, SYS)
    truth = True

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        truth, most = scene.truth, scene.limits.standstill_speed
        speed = np.hypot(truth["vx"], truth["vy"])
        broken = (speed > most) & scene.before_launch(truth.times)
        yield Breach(truth, broken, _number_of("true speed", speed, "m/s"), f"{most:g} m/s before the launch")


class NoDriveBeforeLaunch(Property):
    """No throttle and no gear until the launch, no throttle outside of driving."""

    id = "SAFE-11"
    text = (
        "No gear is asked for before the launch; throttle is commanded in the SSM's NOMINAL and DEGRADED and in the "
        "ct_states 8 to 10 only, and passed by the Raptor in DRIVING only."
    )
    source = "the state tables of docs/ssm.md"
    messages = (SSM, SYS, CT, THROTTLE, GEAR, PEDAL)

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        gear = scene.series[GEAR]
        broken = (gear["desired_gear"] > 0) & scene.before_launch(gear.times)
        yield Breach(gear, broken, _value(gear, "desired_gear"), "0 before the launch")
        for message, state, names, allowed, demand, signal in (
            (SSM, "ssm_state", SsmState, _THROTTLED, THROTTLE, "acc_pedal_cmd"),
            (CT, "ct_state", CtState, _DRIVES, THROTTLE, "acc_pedal_cmd"),
            (SYS, "sys_state", SysState, (SysState.DRIVING,), PEDAL, "acc_pedal_fdbk"),
        ):
            series, demands = scene.series[message], scene.series[demand]
            places = demands.places(series.times)
            broken = _twice(~among(series[state], allowed)) & _in_force(demands, series.times)
            broken &= _picked(demands[signal] > _PERCENT, places)
            yield Breach(
                series,
                broken,
                _with_state(series, state, names, _held_value(demands, signal, places)),
                f"0 % outside of {', '.join(name.name for name in allowed)}",
            )


class _Terminal(Property):
    """A state that is left by a restart only."""

    message: ClassVar[str]
    state: ClassVar[str]
    names: ClassVar[type[SsmState] | type[SysState] | type[CtState]]
    terminal: ClassVar[Mapping[int, Collection[int]]]
    """Terminal states, and what may yet follow each."""
    starts: ClassVar[Collection[int]]
    """States of a computer that has just started."""

    def __init__(self) -> None:
        self._first_count: float | None = None

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        series = scene.series[self.message]
        states = series[self.state].astype(np.int64)
        if not len(states):
            return
        counter = scene.messages[self.message].facts.counter
        counts = np.zeros(len(states)) if counter is None else series[counter.name]
        if self._first_count is None:
            self._first_count = float(counts[0])
        before = np.concatenate((states[:1], states[:-1]))
        broken = np.zeros(len(states), np.bool_)
        for row in np.flatnonzero(states != before):
            left, entered = int(before[row]), int(states[row])
            # A computer that starts again counts from where it did at power-on.
            restarted = entered in self.starts and counts[row] == self._first_count
            broken[row] = left in self.terminal and entered not in self.terminal[left] and not restarted
        yield Breach(
            series,
            broken,
            lambda row: f"{_name(self.names, before[row])} is followed by {_name(self.names, states[row])}",
            "a restart only",
        )


class FullBrakeLatched(_Terminal):
    """The SSM's full brake stays."""

    id = "SAFE-12"
    text = "The SSM leaves FULL_BRAKE by a restart of the onboard computer only."
    source = "the state table of docs/ssm.md"
    messages = (SSM,)
    message, state, names = SSM, "ssm_state", SsmState
    terminal: ClassVar[Mapping[int, Collection[int]]] = {SsmState.FULL_BRAKE: ()}
    starts = (SsmState.BOOT,)


class SysStateLatched(_Terminal):
    """The Raptor's emergency stays."""

    id = "SAFE-13"
    text = (
        "sys_state leaves EMERGENCY_SHUTDOWN and PWR_OFF by a restart of the Raptor only, and a failure state for "
        "EMERGENCY_SHUTDOWN besides."
    )
    source = "the state table of docs/ssm.md"
    messages = (SYS,)
    message, state, names = SYS, "sys_state", SysState
    terminal: ClassVar[Mapping[int, Collection[int]]] = {
        SysState.EMERGENCY_SHUTDOWN: (),
        SysState.PWR_OFF: (),
        SysState.ACT_TEST_FAIL: (SysState.EMERGENCY_SHUTDOWN,),
        SysState.CRANK_CHECKS_FAIL: (SysState.EMERGENCY_SHUTDOWN,),
        SysState.ENG_FAILED_TO_START: (SysState.EMERGENCY_SHUTDOWN,),
    }
    starts = (SysState.NONE, SysState.PWR_ON)


class CtStateLatched(_Terminal):
    """The onboard computer's shutdown stays."""

    id = "SAFE-14"
    text = "ct_state leaves CNTRL_SHUTDOWN and EMRG_SHUTDOWN by a restart of the onboard computer only."
    source = "the state table of docs/ssm.md"
    messages = (CT,)
    message, state, names = CT, "ct_state", CtState
    terminal: ClassVar[Mapping[int, Collection[int]]] = {CtState.CNTRL_SHUTDOWN: (), CtState.EMRG_SHUTDOWN: ()}
    starts = (CtState.DEFAULT, CtState.UNINITIALISED, CtState.PWR_ON)


class OnTrack(Property):
    """The car stays on the road, as long as somebody can steer it.

    Attributes
    ----------
    excursion_m : how far the car was beyond an edge while nobody could; 0 when never.
    """

    id = "SAFE-15"
    text = (
        "The car's centre of gravity stays between the edges of the track, as long as it is steered: the onboard "
        "computer has a controller, its commands and the requests of the Raptor go on, and the steering follows them."
    )
    source = (
        "the widths of the track file; GenMsgTimeout in the DBC files; STEERING_LAG_US, STEERING_COUNTS and "
        "STEERING_ASTRAY_US in bridge/safety/limits.py"
    )
    messages = (SSM, STEERING, STEERING_REQUEST, *STEERING_POSITIONS, *STEERING_STATUS)
    truth = True
    track = True

    def __init__(self) -> None:
        self.excursion_m = 0.0
        self._unsteered = False

    def check(self, scene: Scene) -> Iterator[Breach]:
        """See `Property`."""
        assert scene.edges is not None
        truth, fresh = scene.truth, scene.truth.fresh
        # The row before the new ones tells whether the car was outside already.
        begin = max(fresh - 1, 0)
        beyond = np.full(len(truth.times), -np.inf)
        beyond[begin:] = scene.edges.beyond(truth["x"][begin:], truth["y"][begin:])
        outside = beyond > 0.0
        unsteered = self._without_steering(scene, outside)
        lost = outside & unsteered
        if lost.any():
            self.excursion_m = max(self.excursion_m, float(beyond[lost].max()))
        yield Breach(
            truth,
            outside & ~unsteered,
            lambda row: f"{beyond[row]:.2f} m beyond the edge of the track",
            "between its edges",
        )

    def _without_steering(self, scene: Scene, outside: Rows) -> Rows:
        """Rows of the truth at which nobody steers, or has been able to since the car last stood on the track."""
        truth = scene.truth
        safe = ~outside & (np.hypot(truth["vx"], truth["vy"]) < scene.limits.standstill_speed)
        steered = (
            (scene.series[SSM].held("ssm_controller", truth.times) != 0)
            & _counts(scene, STEERING, truth.times)
            & _counts(scene, STEERING_REQUEST, truth.times)
            & _follows(scene, truth.times)
        )
        result = np.zeros(len(truth.times), np.bool_)
        for row in range(truth.fresh, len(truth.times)):
            self._unsteered = not safe[row] and (self._unsteered or not steered[row])
            result[row] = self._unsteered
        return result


PROPERTIES: tuple[type[Property], ...] = (
    FullBrakeCommanded,
    FullBrakeRequested,
    BrakesFollow,
    PedalsOnBus,
    PedalsAtRaptor,
    PedalsAtPlant,
    CommandLimits,
    SteeringSlew,
    SsmLimits,
    NoMotionBeforeLaunch,
    NoDriveBeforeLaunch,
    FullBrakeLatched,
    SysStateLatched,
    CtStateLatched,
    OnTrack,
)
"""Those that compare signals; those of whole frames are in `bridge.safety.frame_rules`."""


def among(column: Column, states: Collection[int]) -> Rows:
    """Rows that have one of some states."""
    return np.isin(column, [float(state) for state in states])


def _counts(scene: Scene, message: str, at: Times) -> Rows:
    """Times at which a message comes, and its counter moves."""
    series, counter = scene.series[message], scene.messages[message].facts.counter
    assert counter is not None
    moves = np.concatenate(([True], np.diff(series[counter.name]) != 0.0))[: len(series.times)]
    moved = np.searchsorted(series.times[moves], at, side="right") - 1
    newest = series.times[moves][np.maximum(moved, 0)] if moves.any() else np.zeros(len(at), np.int64)
    return (moved >= 0) & (at - newest <= scene.timeout_us(message))


def _follows(scene: Scene, at: Times) -> Rows:
    """Times at which one of the Space Drive's channels takes the requests and the motor is where they want it."""
    request = scene.series[STEERING_REQUEST]
    result = np.zeros(len(at), np.bool_)
    for position, status in zip(STEERING_POSITIONS, STEERING_STATUS, strict=True):
        series, takes = scene.series[position], scene.series[status]
        if not len(series.times) or not len(request.times):
            continue
        low = request.lowest("cntrl_pos", series.times, STEERING_LAG_US)
        high = request.highest("cntrl_pos", series.times, STEERING_LAG_US)
        where = series[scene.messages[position].signals[0]]
        astray = (where < low - STEERING_COUNTS) | (where > high + STEERING_COUNTS)
        lost = lasting(astray, series.times) >= STEERING_ASTRAY_US
        places = series.places(at)
        result |= (
            (places >= 0)
            & ~_picked(lost, places)
            & (series.age(at) <= scene.timeout_us(position))
            & (takes.held("ip_sgnl_vald", at) > 0.0)
            & (takes.age(at) <= scene.timeout_us(status))
        )
    return result


def _twice(condition: Rows) -> Rows:
    """Rows at which it holds, and at the row before too."""
    return condition & np.concatenate(([False], condition[:-1])) if len(condition) else condition


def _started_again(column: Column, starts: Collection[int]) -> Rows:
    """Rows that have a state of a start, and the row before another one."""
    starting = among(column, starts)
    return starting & np.concatenate(([False], ~starting[:-1])) if len(column) else starting


def _in_force(series: Series, at: Times) -> Rows:
    """Times at which the newest row is of the last two cycles: one that does not come says nothing of its sender."""
    return series.age(at) <= PASSING_US


def _picked(rows: Rows, places: NDArray[np.intp]) -> Rows:
    return rows[places] if len(rows) else np.zeros(len(places), np.bool_)


def _overlap(series: Series, throttle: Column, brake: Column, most_us: int) -> Breach:
    both = (throttle > PEDAL_THROTTLE_PERCENT + _PERCENT) & (brake > PEDAL_BRAKE_KPA + _REQUEST_KPA)
    held = lasting(both, series.times) if len(series.times) else series.times
    return Breach(
        series,
        held > most_us,
        lambda row: f"accelerator {throttle[row]:.4g} % beside brake {brake[row]:.4g} kPa",
        f"{PEDAL_THROTTLE_PERCENT:g} % beside more than {PEDAL_BRAKE_KPA:g} kPa for at most {most_us // 1000} ms",
    )


def _over_last(function: np.ufunc, column: Column, rows: int) -> Column:
    """Of each row and those before it; of the first ones only of what there is."""
    result = column.copy()
    done = 1
    while done < rows:  # doubling: of 1, 2, 4 rows
        step = min(done, rows - done)
        result[step:] = function(result[step:], result[:-step].copy())
        done += step
    return result


def _request_kpa(counts: Column, full_kpa: float) -> Column:
    """What a position on CAN3 asks for: count 0 is full brake, the middle none."""
    return np.clip((NEUTRAL_COUNTS - counts) / NEUTRAL_COUNTS, 0.0, 1.0) * full_kpa


def _brake_signal(scene: Scene) -> str:
    """The command; in a profile with one for each axle, that of the front line, which has the full pressure."""
    signals = scene.messages[BRAKE].signals
    return "brake_pressure_cmd" if "brake_pressure_cmd" in signals else "F_brake_pressure_cmd"


def _name(names: type[SsmState] | type[SysState] | type[CtState], code: float) -> str:
    known = names._value2member_map_
    return names(int(code)).name if int(code) in known else f"{code:g}"


def _value(series: Series, signal: str) -> Callable[[int], str]:
    return lambda row: f"{signal} is {series[signal][row]:.10g}"


def _stopped(kpa: float) -> str:
    return f"brake_pressure_cmd at least {kpa:g} kPa, acc_pedal_cmd 0 %"


def _held_value(series: Series, signal: str, places: NDArray[np.intp]) -> Callable[[int], str]:
    return lambda row: f"{signal} is {series[signal][places[row]]:.10g}"


def _with_state(
    series: Series,
    state: str,
    names: type[SsmState] | type[SysState] | type[CtState],
    seen: Callable[[int], str],
) -> Callable[[int], str]:
    return lambda row: f"{seen(row)} in {state} {_name(names, series[state][row])}"


def _number_of(name: str, column: Column, unit: str) -> Callable[[int], str]:
    return lambda row: f"{name} is {column[row]:.5g} {unit}"


def _range_of(low: Column, high: Column, unit: str) -> Callable[[int], str]:
    return lambda row: f"{max(low[row], 0.0):.5g} to {high[row]:.5g} {unit}"


def _at_most(most: Column, when: str = "") -> Callable[[int], str]:
    return lambda row: f"at most {most[row]:.4g}{when}"
