"""Every safety property finds what is planted into a real recording, in its frame, and not the nearest thing to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from bridge.plant import REQUIRED_OUTPUTS
from bridge.safety import monitor as monitor_module
from bridge.safety.limits import SafetyLimits
from bridge.safety.monitor import OCCASIONS_MAX, SafetyMonitor, properties
from bridge.scenario import load_scenario
from dbc.codec import database
from dbc.frames import FRAME_DTYPE, Station
from dbc.states import CtState, SsmState, SysState
from firmware.tables import FAULTS_FILE, REACTIONS, own_faults
from tools.run import build_bench, find_scenario, load_road

SCENARIO = load_scenario(find_scenario("short_drive"))
LIMITS = SafetyLimits.of_scenario(SCENARIO)
ROAD = load_road(SCENARIO, SCENARIO.track)
MS = 1000
S = 1_000_000

#: In the recording the car stands with the brake held, is launched, and drives.
STANDS_US, DRIVES_US, END_US = 3 * S, 10 * S, 11_500 * MS


@dataclass
class Recording:
    """Frames and truth of a run."""

    frames: NDArray[np.void]
    truth: NDArray[np.float64]

    def copy(self) -> Recording:
        return Recording(self.frames.copy(), self.truth.copy())

    def places(self, message: str, begin_us: int = 0, end_us: int = 1 << 60) -> NDArray[np.intp]:
        """Frames of a message from a time on, up to another one."""
        codec, frames = database.message(message), self.frames
        mine = (frames["bus"] == codec.bus) & (frames["id"] == codec.frame_id)
        return np.flatnonzero(mine & (frames["time_us"] >= begin_us) & (frames["time_us"] < end_us))

    def values(self, message: str, signal: str, places: NDArray[np.intp]) -> NDArray[np.float64]:
        codec = database.message(message)
        return codec.columns(self.frames[places])[codec.signals.index(signal)]

    def put(
        self, message: str, signal: str, value: float | NDArray[np.float64], places: NDArray[np.intp]
    ) -> NDArray[np.intp]:
        """Write a signal into frames, the others stay; returns the places."""
        codec = database.message(message)
        values = codec.columns(self.frames[places])
        values[codec.signals.index(signal)] = value
        data = np.frombuffer(codec.frames(values.T), FRAME_DTYPE)["data"]
        self.frames["data"][places] = data
        return places

    def put_truth(self, name: str, value: float, begin_us: int, end_us: int) -> None:
        times = self.truth[:, 0]
        self.truth[(times >= begin_us) & (times < end_us), 1 + REQUIRED_OUTPUTS.index(name)] = value

    def insert(self, frame: bytes, time_us: int) -> int:
        """Put a frame where it belongs; returns its place."""
        place = int(np.searchsorted(self.frames["time_us"], time_us))
        new = np.frombuffer(frame, FRAME_DTYPE).copy()
        new["time_us"] = time_us
        self.frames = np.concatenate((self.frames[:place], new, self.frames[place:]))
        return place

    def drop(self, places: NDArray[np.intp]) -> None:
        self.frames = np.delete(self.frames, places)


def judged(recording: Recording, chunk: int = 4096, senders_known: bool = True, plant: bool = True) -> SafetyMonitor:
    """What the monitor says about a recording that comes in chunks."""
    safety = SafetyMonitor(
        LIMITS, database, REQUIRED_OUTPUTS if plant else (), ROAD.boundaries(), senders_known=senders_known
    )
    frames, truth = recording.frames, recording.truth if plant else recording.truth[:0]
    row = 0
    for begin in range(0, len(frames), chunk):
        piece = frames[begin : begin + chunk]
        while row < len(truth) and truth[row, 0] <= int(piece["time_us"][-1]):
            safety.add_truth(int(truth[row, 0]), truth[row, 1:])
            row += 1
        safety.update(piece)
    for left in truth[row:]:
        safety.add_truth(int(left[0]), left[1:])
    safety.finish()
    return safety


@pytest.fixture(scope="module")
def drive() -> Recording:
    frames, rows = [], []
    with build_bench(SCENARIO) as bench:
        update, add_truth = bench.safety.update, bench.safety.add_truth

        def keep_frames(piece: NDArray[np.void]) -> None:
            frames.append(piece.copy())
            update(piece)

        def keep_truth(time_us: int, outputs: NDArray[np.float64]) -> None:
            rows.append(np.concatenate(([time_us], outputs[: len(REQUIRED_OUTPUTS)])))
            add_truth(time_us, outputs)

        bench.safety.update, bench.safety.add_truth = keep_frames, keep_truth  # type: ignore[method-assign]
        assert not bench.run(time_limit_us=END_US)  # it goes on driving
        bench.finish()
        assert bench.safety.violations == []
        assert bench.safety.frames == sum(map(len, frames))
        assert bench.safety.checked == tuple(properties())
    return Recording(np.concatenate(frames), np.array(rows))


@pytest.fixture
def log(drive: Recording) -> Recording:
    return drive.copy()


def found(log: Recording, property_id: str) -> tuple[int, int] | None:
    """Time and frame of the first violation of a property."""
    safety = judged(log)
    for one in safety.violations:
        if one.property_id == property_id:
            assert safety.broken[property_id] > 0
            return one.time_us, one.frame
    assert property_id not in safety.broken
    return None


def frame_of(log: Recording, place: int) -> tuple[int, int]:
    return int(log.frames["time_us"][place]), int(place)


# --- SAFE-1: full brake commanded -----------------------------------------------------------------------------------


def fault_event(name: str, active: bool = True) -> bytes:
    (fault,) = (fault for fault in own_faults() if fault.name == name)
    return database.message("fault_event").frame(fault.id, int(active), 0, REACTIONS.index(fault.reaction), 0, 0)


def test_full_brake_fault_without_full_brake(log: Recording) -> None:
    log.insert(fault_event("est6_sd_emergency_brake"), DRIVES_US)  # 40 ms, less 20 ms of debounce
    due = DRIVES_US + 20 * MS
    first = min(log.places("brake_pressure_cmd", due)[0], *throttled(log, due)[:1])
    assert found(log, "SAFE-1") == frame_of(log, int(first))


def throttled(log: Recording, begin_us: int) -> NDArray[np.intp]:
    places = log.places("accelerator_cmd", begin_us)
    return places[log.values("accelerator_cmd", "acc_pedal_cmd", places) > 0]


def test_full_brake_fault_with_full_brake_in_time(log: Recording) -> None:
    log.insert(fault_event("est6_sd_emergency_brake"), DRIVES_US)
    due = DRIVES_US + 20 * MS
    log.put("brake_pressure_cmd", "brake_pressure_cmd", 3500.0, log.places("brake_pressure_cmd", due))
    log.put("accelerator_cmd", "acc_pedal_cmd", 0.0, log.places("accelerator_cmd", due))
    assert found(log, "SAFE-1") is None
    late = log.places("brake_pressure_cmd", DRIVES_US + S)[:1]
    log.put("brake_pressure_cmd", "brake_pressure_cmd", 3499.0, late)
    assert found(log, "SAFE-1") == frame_of(log, int(late[0]))


def test_full_brake_of_a_computer_that_lets_no_controller_steer(log: Recording) -> None:
    places = log.places("ssm_status", DRIVES_US)
    log.put("ssm_status", "ssm_state", SsmState.FULL_BRAKE, places)
    log.put("brake_pressure_cmd", "brake_pressure_cmd", 3500.0, log.places("brake_pressure_cmd", DRIVES_US - 20 * MS))
    log.put("accelerator_cmd", "acc_pedal_cmd", 0.0, log.places("accelerator_cmd", DRIVES_US - 20 * MS))
    assert found(log, "SAFE-1") is None
    log.put("ssm_status", "ssm_controller", 0, places[:2])
    assert found(log, "SAFE-1") == frame_of(log, int(places[1]))


@pytest.mark.parametrize("name", ["gnss_a_timeout", "wheel_speed_missing", "estimate_lost"])
def test_fault_of_another_reaction(log: Recording, name: str) -> None:
    log.insert(fault_event(name), DRIVES_US)
    assert found(log, "SAFE-1") is None


@pytest.mark.parametrize("state", [SsmState.BOOT, SsmState.CONFIG_CHECK, SsmState.LAUNCHING, SsmState.FULL_BRAKE])
def test_state_of_full_brake_without_full_brake(log: Recording, state: SsmState) -> None:
    places = log.places("ssm_status", DRIVES_US)
    log.put("ssm_status", "ssm_state", state, places[:1])
    assert found(log, "SAFE-1") is None  # what is commanded may yet belong to the state before
    log.put("ssm_status", "ssm_state", state, places[:2])
    assert found(log, "SAFE-1") == frame_of(log, int(places[1]))


def test_full_brake_reduced_while_not_released(log: Recording) -> None:
    place = log.places("brake_pressure_cmd", 300 * MS)[:1]
    assert log.values("brake_pressure_cmd", "brake_pressure_cmd", place) == [4500.0]
    log.put("brake_pressure_cmd", "brake_pressure_cmd", 4499.0, place)
    status = log.places("ssm_status", int(log.frames["time_us"][place[0]]))[0]
    assert found(log, "SAFE-1") == frame_of(log, int(status))


# --- SAFE-2: full brake requested -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("counts", "breaks"), [(2, False), (4, True)])
def test_request_below_the_command(log: Recording, counts: int, breaks: bool) -> None:
    """A count is 0.37 kPa; 1 kPa is allowed for rounding."""
    place = log.places("req_brake_pos", 300 * MS)[:1]
    (now,) = log.values("req_brake_pos", "contrl_pos_brk", place)
    log.put("req_brake_pos", "contrl_pos_brk", now + counts, place)
    assert found(log, "SAFE-2") == (frame_of(log, int(place[0])) if breaks else None)


@pytest.mark.parametrize(
    ("message", "frames"),
    [("brake_pressure_cmd", 12), ("accelerator_cmd", 13), ("steering_cmd", 13), ("ct_report", 4)],
)
def test_silent_command(log: Recording, message: str, frames: int) -> None:
    """100 ms, 200 ms of ct_report, and two cycles; what ends in the tick of the request may have been heard."""
    gone = log.places(message, DRIVES_US)
    near = log.copy()
    near.drop(gone[: frames - 1])
    assert found(near, "SAFE-2") is None
    last_us = int(log.frames["time_us"][log.places(message, 0, DRIVES_US)[-1]])
    log.drop(gone[:frames])
    due = log.places("req_brake_pos", last_us + database.message(message).timeout_us + 20 * MS + 1)[0]
    assert found(log, "SAFE-2") == frame_of(log, int(due))


@pytest.mark.parametrize("message", ["brake_pressure_cmd", "accelerator_cmd", "steering_cmd", "ct_report"])
def test_request_while_the_steering_is_silent(log: Recording, message: str) -> None:
    """3500 kPa of 6000 are enough while somebody steers."""
    log.put("req_brake_pos", "contrl_pos_brk", round(0x4000 * 2500 / 6000), log.places("req_brake_pos", DRIVES_US))
    log.drop(log.places(message, DRIVES_US))
    assert (found(log, "SAFE-2") is None) == (message != "steering_cmd")


def test_emergency_without_full_request(log: Recording) -> None:
    places = log.places("misc_report", DRIVES_US)
    near = log.copy()
    near.put("misc_report", "sys_state", SysState.EMERGENCY_SHUTDOWN, places[:2])
    assert found(near, "SAFE-2") is None
    log.put("misc_report", "sys_state", SysState.EMERGENCY_SHUTDOWN, places[:4])
    time_us, frame = found(log, "SAFE-2") or (0, 0)
    assert frame in log.places("req_brake_pos")
    assert 20 * MS <= time_us - int(log.frames["time_us"][places[0]]) <= 30 * MS


# --- SAFE-3: brakes follow ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("off_kpa", "breaks"), [(-112.5, True), (-110.0, False), (110.0, False), (112.5, True)])
@pytest.mark.parametrize(("line", "share"), [("brake_pressure_front", 1.0), ("brake_pressure_rear", 0.46 / 0.54)])
def test_line_pressure(log: Recording, off_kpa: float, breaks: bool, line: str, share: float) -> None:
    """After four time constants 1.83 % of the largest step are left, 109.9 kPa, and 1 kPa for rounding."""
    (asked,) = log.values("req_brake_pos", "contrl_pos_brk", log.places("req_brake_pos", STANDS_US)[:1])
    pressure = (0x4000 - asked) / 0x4000 * 6000.0 * share + off_kpa
    log.put_truth(line, pressure * 1000.0, STANDS_US, STANDS_US + 10 * MS)
    assert (found(log, "SAFE-3") or (None,))[0] == (STANDS_US if breaks else None)


@pytest.mark.parametrize("message", ["req_steer_pos", "req_brake_pos"])
def test_silent_requests_must_brake(log: Recording, message: str) -> None:
    gone = log.places(message, DRIVES_US)
    near = log.copy()
    near.drop(gone[:6])
    assert found(near, "SAFE-3") is None
    log.drop(gone[:40])
    time_us, _ = found(log, "SAFE-3") or (0, 0)
    # 50 ms and two cycles until it must be noticed, then 40 ms, 4 / (2 pi 5 Hz), 33 ms and two cycles again.
    assert 60 * MS + 220 * MS <= time_us - DRIVES_US <= 80 * MS + 240 * MS


@pytest.mark.parametrize("message", ["req_steer_pos", "req_brake_pos"])
def test_brake_while_the_steering_is_silent(log: Recording, message: str) -> None:
    log.drop(log.places(message, DRIVES_US))
    for line, share in (("front", 1.0), ("rear", 0.46 / 0.54)):
        log.put_truth(f"brake_pressure_{line}", 3500.0e3 * share, DRIVES_US + 100 * MS, DRIVES_US + 10 * S)
    time_us, _ = found(log, "SAFE-3") or (0, 0)
    assert (time_us > DRIVES_US + 100 * MS) == (message == "req_steer_pos")


def test_reported_emergency_brake_must_brake(log: Recording) -> None:
    near = log.copy()
    places = log.places("stat_brk_1", DRIVES_US)
    cycle_us = int(np.diff(log.frames["time_us"][places[:2]].astype(np.int64))[0])
    near.put("stat_brk_1", "emr_brk", 1.0, places[: 200 * MS // cycle_us])
    assert found(near, "SAFE-3") is None
    log.put("stat_brk_1", "emr_brk", 1.0, places[: 300 * MS // cycle_us])
    time_us, _ = found(log, "SAFE-3") or (0, 0)
    assert 220 * MS <= time_us - DRIVES_US <= 240 * MS + cycle_us


# --- SAFE-4 to SAFE-6: accelerator and brake ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("throttle", "brake", "for_us", "breaks"),
    [(20.0, 600.0, 520 * MS, True), (20.0, 600.0, 495 * MS, False), (10.0, 600.0, S, False), (20.0, 500.0, S, False)],
)
def test_pedals_on_can1(log: Recording, throttle: float, brake: float, for_us: int, breaks: bool) -> None:
    end_us = DRIVES_US + for_us
    places = log.places("accelerator_cmd", DRIVES_US, end_us)
    log.put("accelerator_cmd", "acc_pedal_cmd", throttle, places)
    log.put("brake_pressure_cmd", "brake_pressure_cmd", brake, log.places("brake_pressure_cmd", DRIVES_US, end_us))
    late = places[log.frames["time_us"][places] > log.frames["time_us"][places[0]] + 500 * MS]
    assert found(log, "SAFE-4") == (frame_of(log, int(late[0])) if breaks else None)


@pytest.mark.parametrize(("frames", "breaks"), [(3, False), (4, True)])
def test_pedals_at_the_raptor(log: Recording, frames: int, breaks: bool) -> None:
    requests = log.places("req_brake_pos", DRIVES_US)
    log.put("req_brake_pos", "contrl_pos_brk", 0x4000 * 0.9, requests[:20])
    places = log.places("accelerator_report", int(log.frames["time_us"][requests[1]]))[:frames]
    others = log.places("accelerator_report", DRIVES_US - 100 * MS, DRIVES_US + S)
    log.put("accelerator_report", "acc_pedal_fdbk", 0.0, others)
    log.put("accelerator_report", "acc_pedal_fdbk", 20.0, places)
    assert found(log, "SAFE-5") == (frame_of(log, int(places[3])) if breaks else None)


@pytest.mark.parametrize(("for_us", "breaks"), [(510 * MS, False), (520 * MS, True)])
def test_pedals_at_the_plant(log: Recording, for_us: int, breaks: bool) -> None:
    log.put_truth("throttle_position", 0.2, STANDS_US, STANDS_US + for_us)
    log.put_truth("brake_pressure_front", 2.0e6, STANDS_US, STANDS_US + for_us)
    assert (found(log, "SAFE-6") or (None,))[0] == (STANDS_US + 510 * MS if breaks else None)


# --- SAFE-7 to SAFE-9: limits ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "signal", "inside", "outside"),
    [
        ("brake_pressure_cmd", "brake_pressure_cmd", 6000.0, 6001.0),
        ("accelerator_cmd", "acc_pedal_cmd", 100.0, 100.01),
        ("accelerator_cmd", "acc_pedal_cmd", 0.0, -0.01),
        ("steering_cmd", "steering_motor_ang_cmd", 223.5, 224.0),  # 0.26 rad at the wheels, times 15: 223.45 deg
        ("steering_cmd", "steering_motor_ang_cmd", -223.5, -224.0),
        ("gear_shift_cmd", "desired_gear", 6.0, 7.0),
    ],
)
def test_command_limits(log: Recording, message: str, signal: str, inside: float, outside: float) -> None:
    place = log.places(message, DRIVES_US)[:1]
    log.put(message, signal, inside, place)
    assert found(log, "SAFE-7") is None
    log.put(message, signal, outside, place)
    assert found(log, "SAFE-7") == frame_of(log, int(place[0]))


@pytest.mark.parametrize(("step", "breaks"), [(5.5, False), (-5.5, False), (6.0, True), (-6.0, True)])
def test_steering_slew(log: Recording, step: float, breaks: bool) -> None:
    """0.6 rad/s at the wheels, times 15: 5.16 deg in a cycle, and half a degree for rounding."""
    places = log.places("steering_cmd", DRIVES_US)[:2]
    (before, _) = log.values("steering_cmd", "steering_motor_ang_cmd", places)
    log.put("steering_cmd", "steering_motor_ang_cmd", before + step, places[1:])
    log.put("steering_cmd", "steering_motor_ang_cmd", before, log.places("steering_cmd", DRIVES_US)[2:4])
    assert found(log, "SAFE-8") == (frame_of(log, int(places[1])) if breaks else None)


@pytest.mark.parametrize(
    ("state", "signal", "inside", "outside"),
    [
        (SsmState.NOMINAL, "ssm_max_speed", 63.1, 63.15),
        (SsmState.DEGRADED, "ssm_max_speed", 30.0, 30.05),
        (SsmState.EMERGENCY, "ssm_max_speed", 0.0, 0.05),
        (SsmState.NOMINAL, "ssm_max_acceleration", 8.0, 8.1),
        (SsmState.DEGRADED, "ssm_max_acceleration", 3.0, 3.1),
        (SsmState.EMERGENCY, "ssm_max_deceleration", 10.0, 10.1),
        (SsmState.FULL_BRAKE, "ssm_max_deceleration", 0.0, 0.1),
    ],
)
def test_ssm_limits(log: Recording, state: SsmState, signal: str, inside: float, outside: float) -> None:
    place = log.places("ssm_status", DRIVES_US)[:1]
    for limit in ("ssm_max_speed", "ssm_max_acceleration", "ssm_max_deceleration"):
        log.put("ssm_status", limit, 0.0, place)
    log.put("ssm_status", "ssm_state", state, place)
    log.put("ssm_status", signal, inside, place)
    assert found(log, "SAFE-9") is None
    log.put("ssm_status", signal, outside, place)
    assert found(log, "SAFE-9") == frame_of(log, int(place[0]))


#: Time of a fault_event, just behind an ssm_status.
EVENT_US = DRIVES_US + 5 * MS


@dataclass
class Degraded:
    """A recording in which the car is degraded from `EVENT_US` on, with the largest degraded limits."""

    log: Recording

    def __post_init__(self) -> None:
        self.log.put("ssm_status", "ssm_active_faults", 1.0, self.log.places("ssm_status", EVENT_US))
        self.log.put("ssm_status", "ssm_state", SsmState.DEGRADED, self.log.places("ssm_status", EVENT_US))
        self.allow(30.0, 3.0)

    def allow(self, speed: float, acceleration: float, begin_us: int = EVENT_US, end_us: int = 1 << 60) -> None:
        self.log.put("ssm_status", "ssm_max_speed", speed, self.log.places("ssm_status", begin_us, end_us))
        self.log.put(
            "ssm_status", "ssm_max_acceleration", acceleration, self.log.places("ssm_status", begin_us, end_us)
        )

    def broken_at(self, begin_us: int) -> bool:
        """Whether the first violation is in a status more than two cycles, for which it may lag, behind the first."""
        places = self.log.places("ssm_status", begin_us)
        times = self.log.frames["time_us"][places]
        place = places[np.argmax(times > times[0] + 20 * MS)]
        at = found(self.log, "SAFE-9")
        assert at is None or at == frame_of(self.log, int(place))
        return at is not None


def test_ssm_limits_by_fault_of_the_table() -> None:
    """Read apart from the firmware's table, whose build the same file goes into."""
    source = yaml.safe_load(FAULTS_FILE.read_text())["faults"]
    assert LIMITS.degraded_shares == {
        number: (row["speed_percent"] / 100.0, row["acceleration_percent"] / 100.0)
        for number, row in enumerate(source, 1)
        if row["reaction"] in ("degrade", "switch_controller")
    }


@pytest.mark.parametrize(
    ("fault", "speed", "acceleration"),
    [("lqr_invalid", 21.0, 2.1), ("lateral_acceleration_high", 21.0, 1.5), ("estimate_bad", 15.0, 1.5)],
)
def test_ssm_limits_by_fault(log: Recording, fault: str, speed: float, acceleration: float) -> None:
    log.insert(fault_event(fault), EVENT_US)
    degraded = Degraded(log)
    degraded.allow(speed, acceleration)
    assert not degraded.broken_at(EVENT_US)
    for one, other in ((0.05, 0.0), (0.0, 0.1)):
        degraded.allow(speed + one, acceleration + other)
        assert degraded.broken_at(EVENT_US)


def test_ssm_limits_of_nominal_with_a_fault(log: Recording) -> None:
    """A state that does not fit the fault is no way round its limits."""
    log.insert(fault_event("lqr_invalid"), EVENT_US)
    degraded = Degraded(log)
    log.put("ssm_status", "ssm_state", SsmState.NOMINAL, log.places("ssm_status", EVENT_US))
    assert degraded.broken_at(EVENT_US)


def test_ssm_limits_of_two_faults_of_which_one_goes(log: Recording) -> None:
    middle_us = EVENT_US + 500 * MS
    log.insert(fault_event("lqr_invalid"), EVENT_US)
    log.insert(fault_event("estimate_bad"), EVENT_US)
    log.insert(fault_event("estimate_bad", active=False), middle_us)
    degraded = Degraded(log)
    degraded.allow(15.0, 1.5)
    degraded.allow(21.0, 2.1, middle_us - 10 * MS)  # the event comes behind the first status without the fault
    assert not degraded.broken_at(middle_us)
    degraded.allow(21.0, 2.1, middle_us - 40 * MS)
    assert degraded.broken_at(middle_us - 40 * MS)
    degraded.allow(15.0, 1.5)
    degraded.allow(21.05, 2.1, middle_us)
    assert degraded.broken_at(middle_us)


def test_ssm_limits_when_no_fault_is_active_any_more(log: Recording) -> None:
    """What was started again tells no end of its faults."""
    log.insert(fault_event("estimate_bad"), EVENT_US)
    degraded = Degraded(log)
    degraded.allow(15.0, 1.5)
    middle_us = EVENT_US + 500 * MS
    degraded.allow(30.0, 3.0, middle_us)
    assert degraded.broken_at(middle_us)
    log.put("ssm_status", "ssm_active_faults", 0.0, log.places("ssm_status", middle_us)[:1])
    assert not degraded.broken_at(middle_us)


# --- SAFE-10, SAFE-11: launch ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed", "breaks"), [(0.19, False), (-0.19, False), (0.21, True), (-0.21, True)])
def test_motion_before_launch(log: Recording, speed: float, breaks: bool) -> None:
    log.put_truth("vx", speed, STANDS_US, STANDS_US + 10 * MS)
    assert (found(log, "SAFE-10") or (None,))[0] == (STANDS_US if breaks else None)


def test_gear_before_launch(log: Recording) -> None:
    (launch,) = (place for place in log.places("misc_report")[:-1] if first_driving(log) == place)
    before, after = log.places("gear_shift_cmd", 0, int(log.frames["time_us"][launch]))[-1:], launch
    assert after > before[0]
    log.put("gear_shift_cmd", "desired_gear", 1.0, before)
    assert found(log, "SAFE-11") == frame_of(log, int(before[0]))


def first_driving(log: Recording) -> int:
    places = log.places("misc_report")
    return int(places[np.argmax(log.values("misc_report", "sys_state", places) == SysState.DRIVING)])


@pytest.mark.parametrize(
    ("message", "demand", "signal"),
    [("ct_report", "accelerator_cmd", "acc_pedal_cmd"), ("misc_report", "accelerator_report", "acc_pedal_fdbk")],
)
def test_throttle_while_the_state_forbids_it(log: Recording, message: str, demand: str, signal: str) -> None:
    """The SSM is NOMINAL long before the car may drive."""
    log.put(demand, signal, 0.1, place := log.places(demand, STANDS_US)[:1])
    begin_us = int(log.frames["time_us"][place[0]])
    log.put(demand, signal, 0.1, log.places(demand, begin_us, begin_us + 100 * MS))
    state = log.places(message, begin_us)[0]
    assert found(log, "SAFE-11") == frame_of(log, int(state))


def test_throttle_in_the_ssm_s_emergency(log: Recording) -> None:
    places = log.places("ssm_status", DRIVES_US)
    assert throttled(log, DRIVES_US - 10 * MS).size
    log.put("accelerator_cmd", "acc_pedal_cmd", 5.0, log.places("accelerator_cmd", DRIVES_US, DRIVES_US + S))
    log.put("ssm_status", "ssm_state", SsmState.EMERGENCY, places[:1])
    assert found(log, "SAFE-11") is None
    log.put("ssm_status", "ssm_state", SsmState.EMERGENCY, places[:2])
    assert found(log, "SAFE-11") == frame_of(log, int(places[1]))


# --- SAFE-12 to SAFE-14: states that stay ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("property_id", "message", "signal", "state"),
    [
        ("SAFE-12", "ssm_status", "ssm_state", SsmState.FULL_BRAKE),
        ("SAFE-13", "misc_report", "sys_state", SysState.EMERGENCY_SHUTDOWN),
        ("SAFE-13", "misc_report", "sys_state", SysState.PWR_OFF),
        ("SAFE-13", "misc_report", "sys_state", SysState.ACT_TEST_FAIL),
        ("SAFE-14", "ct_report", "ct_state", CtState.EMRG_SHUTDOWN),
        ("SAFE-14", "ct_report", "ct_state", CtState.CNTRL_SHUTDOWN),
    ],
)
def test_terminal_state(log: Recording, property_id: str, message: str, signal: str, state: int) -> None:
    places = log.places(message, DRIVES_US)
    stays = log.copy()
    stays.put(message, signal, state, places)
    assert found(stays, property_id) is None
    log.put(message, signal, state, places[:1])
    assert found(log, property_id) == frame_of(log, int(places[1]))


@pytest.mark.parametrize(
    ("property_id", "message", "signal", "counter", "state", "start"),
    [
        ("SAFE-12", "ssm_status", "ssm_state", "ssm_status_counter", SsmState.FULL_BRAKE, SsmState.BOOT),
        (
            "SAFE-13",
            "misc_report",
            "sys_state",
            "raptor_rolling_counter",
            SysState.EMERGENCY_SHUTDOWN,
            SysState.PWR_ON,
        ),
        ("SAFE-14", "ct_report", "ct_state", "ct_state_rolling_counter", CtState.EMRG_SHUTDOWN, CtState.DEFAULT),
    ],
)
def test_a_restart_leaves_a_terminal_state(
    log: Recording, property_id: str, message: str, signal: str, counter: str, state: int, start: int
) -> None:
    """A computer that has started counts from where it did at power-on; one that has not is caught."""
    first = log.values(message, counter, log.places(message)[:1])[0]
    places = log.places(message, DRIVES_US)
    log.put(message, signal, state, places[:1])
    log.put(message, signal, start, places[1:])
    log.put(message, counter, first, places[1:2])
    assert found(log, property_id) is None
    log.put(message, counter, first + 1, places[1:2])
    assert found(log, property_id) == frame_of(log, int(places[1]))


# --- SAFE-15: track -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("station", [60.0, 700.0, 1500.0])
@pytest.mark.parametrize(("beyond", "breaks"), [(0.05, True), (-0.05, False)])
@pytest.mark.parametrize("side", ["left", "right"])
def test_off_the_track(log: Recording, station: float, beyond: float, breaks: bool, side: str) -> None:
    """On the straight and in the turn; where the edges are, the track's own widths say."""
    node = round(station / ROAD.centre.spacing)
    width = float((ROAD.width_left if side == "left" else ROAD.width_right)[node])
    lateral = (width + beyond) * (1.0 if side == "left" else -1.0)
    x, y, _ = ROAD.pose_at(node * ROAD.centre.spacing, lateral)
    log.put_truth("x", x, STANDS_US, STANDS_US + 10 * MS)
    log.put_truth("y", y, STANDS_US, STANDS_US + 10 * MS)
    assert (found(log, "SAFE-15") or (None,))[0] == (STANDS_US if breaks else None)


def off_the_track(log: Recording, begin_us: int) -> float:
    """Put the car half a metre off the road for 50 ms while it drives; returns how far it is."""
    node = round(700.0 / ROAD.centre.spacing)
    x, y, _ = ROAD.pose_at(node * ROAD.centre.spacing, float(ROAD.width_left[node]) + 0.5)
    log.put_truth("x", x, begin_us, begin_us + 50 * MS)
    log.put_truth("y", y, begin_us, begin_us + 50 * MS)
    return 0.5


CHANNELS = (1, 2, 3)


def no_controller(log: Recording, begin_us: int, end_us: int) -> None:
    log.put("ssm_status", "ssm_controller", 0, log.places("ssm_status", begin_us, end_us))


def nobody_commands(log: Recording, begin_us: int, end_us: int) -> None:
    log.drop(log.places("steering_cmd", begin_us, end_us))


def commands_stand_still(log: Recording, begin_us: int, end_us: int) -> None:
    log.put("steering_cmd", "steering_motor_cmd_counter", 7.0, log.places("steering_cmd", begin_us, end_us))


def nobody_requests(log: Recording, begin_us: int, end_us: int) -> None:
    log.drop(log.places("req_steer_pos", begin_us, end_us))


def space_drive_is_silent(log: Recording, begin_us: int, end_us: int) -> None:
    for channel in CHANNELS:
        log.drop(log.places(f"calb_steer_pos_{channel}", begin_us, end_us))


def requests_are_refused(log: Recording, begin_us: int, end_us: int) -> None:
    for channel in CHANNELS:
        log.put(f"stat_steer_{channel}", "ip_sgnl_vald", 0.0, log.places(f"stat_steer_{channel}", begin_us, end_us))


def motor_is_elsewhere(log: Recording, begin_us: int, end_us: int) -> None:
    for channel in CHANNELS:
        signal = f"cur_steer_pos_steering_pos_{channel}"
        places = log.places(f"calb_steer_pos_{channel}", begin_us, end_us)
        values = log.values(f"calb_steer_pos_{channel}", signal, places)
        log.put(f"calb_steer_pos_{channel}", signal, values + 150.0, places)


def one_channel_is_silent(log: Recording, begin_us: int, end_us: int) -> None:
    log.drop(log.places("calb_steer_pos_1", begin_us, end_us))


@pytest.mark.parametrize(
    "loss",
    [
        no_controller,
        nobody_commands,
        commands_stand_still,
        nobody_requests,
        space_drive_is_silent,
        requests_are_refused,
        motor_is_elsewhere,
    ],
)
def test_off_the_track_while_nobody_can_steer(log: Recording, loss: Callable[[Recording, int, int], None]) -> None:
    """It comes to rest there, which is no excuse to find fault with it then."""
    loss(log, DRIVES_US, END_US)
    distance = off_the_track(log, DRIVES_US + 700 * MS)
    for name in ("vx", "vy"):
        log.put_truth(name, 0.0, DRIVES_US + 720 * MS, DRIVES_US + 750 * MS)
    safety = judged(log)
    assert "SAFE-15" not in safety.broken
    assert safety.excursion_m == pytest.approx(distance, abs=0.1)


@pytest.mark.parametrize(
    ("loss", "for_us"),
    [
        (one_channel_is_silent, END_US),
        (nobody_commands, 90 * MS),
        (commands_stand_still, 90 * MS),
        (nobody_requests, 40 * MS),
        (space_drive_is_silent, 40 * MS),
        (motor_is_elsewhere, 60 * MS),
    ],
)
def test_off_the_track_though_somebody_steers(
    log: Recording, loss: Callable[[Recording, int, int], None], for_us: int
) -> None:
    """What is shorter than the time-out takes the steering away from nobody."""
    loss(log, DRIVES_US, DRIVES_US + for_us)
    off_the_track(log, DRIVES_US + 700 * MS)
    safety = judged(log)
    assert safety.broken["SAFE-15"] > 0
    assert safety.excursion_m == 0.0


def test_a_car_that_could_not_be_steered_must_stay_on_the_track_once_it_stood(log: Recording) -> None:
    """Nor is it excused while it stands."""
    nobody_commands(log, DRIVES_US, DRIVES_US + 300 * MS)
    for name in ("vx", "vy"):
        log.put_truth(name, 0.0, DRIVES_US + 500 * MS, DRIVES_US + 520 * MS)
    off_the_track(log, DRIVES_US + 700 * MS)
    safety = judged(log)
    assert safety.broken["SAFE-15"] > 0
    assert safety.excursion_m == 0.0


# --- SAFE-16, SAFE-17: frames ---------------------------------------------------------------------------------------

COUNTED = [codec.name for codec in database if codec.facts.counter is not None]


def test_stuck_counters(drive: Recording) -> None:
    """Of every message with a counter that the run has; a jump is no standstill."""
    tried = 0
    stuck, jumps, expected = drive.copy(), drive.copy(), []
    for name in COUNTED:
        places = drive.places(name, DRIVES_US)[:2]
        if len(places) < 2:
            continue
        counter = database.message(name).facts.counter
        assert counter is not None
        before = drive.values(name, counter.name, places)[0]
        stuck.put(name, counter.name, before, places[1:])
        # The frame after it must not look stuck either.
        jumps.put(name, counter.name, (before + 5) % (1 << counter.length), places[1:])
        expected.append(frame_of(drive, int(places[1])))
        tried += 1
    assert tried > 25
    safety = judged(stuck)
    assert safety.broken["SAFE-16"] == tried
    seen = [(one.time_us, one.frame) for one in safety.violations if one.property_id == "SAFE-16"]
    assert len(seen) == min(tried, OCCASIONS_MAX)
    assert set(seen) <= set(expected)
    assert found(jumps, "SAFE-16") is None


def test_counter_of_a_message_that_was_away(log: Recording) -> None:
    places = log.places("ssm_status", DRIVES_US)
    (last,) = log.values("ssm_status", "ssm_status_counter", places[:1])
    log.put("ssm_status", "ssm_status_counter", last, places[15:16])
    near = log.copy()
    near.drop(places[1:15])  # 150 ms; the time-out is 100 ms
    assert found(near, "SAFE-16") is None
    log.put("ssm_status", "ssm_status_counter", last, places[5:6])
    log.drop(places[1:5])
    assert found(log, "SAFE-16") is not None


def test_foreign_sender(log: Recording) -> None:
    place = log.places("brake_pressure_cmd", DRIVES_US)[0]
    log.frames["sender"][place] = Station.RAPTOR
    assert found(log, "SAFE-17") == frame_of(log, int(place))
    log.frames["sender"][place] = Station.NONE
    assert found(log, "SAFE-17") == frame_of(log, int(place))
    # A log file does not say who has sent a frame.
    assert judged(log, senders_known=False).violations == []


def test_identifier_that_nobody_owns(log: Recording) -> None:
    frame = bytearray(database.message("steering_cmd").frame(0.0, 0, sender=Station.OBC))
    frame[8:12] = (0x7F1).to_bytes(4, "little")
    place = log.insert(bytes(frame), DRIVES_US)
    assert found(log, "SAFE-17") == frame_of(log, place)
    log.frames["sender"][place] = Station.NONE
    assert found(log, "SAFE-17") is None


# --- The monitor itself ---------------------------------------------------------------------------------------------


def planted(log: Recording) -> Recording:
    """A recording with something wrong for many properties."""
    log.put("brake_pressure_cmd", "brake_pressure_cmd", 4000.0, log.places("brake_pressure_cmd", 300 * MS, 400 * MS))
    log.put("steering_cmd", "steering_motor_ang_cmd", 240.0, log.places("steering_cmd", DRIVES_US)[:1])
    log.put("misc_report", "sys_state", SysState.EMERGENCY_SHUTDOWN, log.places("misc_report", 10_500 * MS, 11 * S))
    log.put_truth("vx", 1.0, STANDS_US, STANDS_US + 100 * MS)
    log.put_truth("brake_pressure_front", 0.0, STANDS_US, STANDS_US + 100 * MS)
    log.put_truth("y", 1.0e4, 11 * S, 11_100 * MS)
    log.drop(log.places("ct_report", 9 * S, 9 * S + 700 * MS))
    log.frames["sender"][log.places("ssm_status", 8 * S)[:3]] = Station.AUTONOMY
    return log


@pytest.mark.parametrize(("chunk", "block"), [(37, 200), (1000, 1500), (4096, 32768), (10**6, 32768)])
def test_pieces_do_not_matter(log: Recording, monkeypatch: pytest.MonkeyPatch, chunk: int, block: int) -> None:
    recording = planted(log)
    if block < 1000:  # many small blocks take their time: the first part only
        recording.frames = recording.frames[recording.frames["time_us"] < 4 * S]
        recording.truth = recording.truth[recording.truth[:, 0] < 4 * S]
    whole = judged(recording, chunk=10**6)
    assert len(whole.broken) >= (3 if block < 1000 else 8)
    monkeypatch.setattr(monitor_module, "BLOCK_FRAMES", block)
    pieces = judged(recording, chunk=chunk)
    assert pieces.violations == whole.violations
    assert pieces.broken == whole.broken
    assert pieces.frames == len(recording.frames)


def test_what_it_keeps_does_not_grow(log: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(monitor_module, "BLOCK_FRAMES", 2000)
    safety = judged(planted(log), chunk=500)
    for series in (safety._scene.truth, *safety._scene.series.values()):
        assert len(series.times) < 300
    assert len(safety.violations) <= OCCASIONS_MAX * len(safety.checked)


def test_without_a_plant_the_frames_are_checked(log: Recording) -> None:
    safety = judged(planted(log), plant=False)
    assert set(properties()) - set(safety.checked) == {"SAFE-3", "SAFE-6", "SAFE-10", "SAFE-15"}
    assert {"SAFE-1", "SAFE-2", "SAFE-7", "SAFE-13", "SAFE-17"} <= set(safety.broken)


def test_excused_properties_are_not_checked(log: Recording) -> None:
    recording = planted(log)
    safety = SafetyMonitor(LIMITS, database, senders_known=True, excused={"SAFE-1", "SAFE-17"})
    safety.update(recording.frames)
    safety.finish()
    assert not {"SAFE-1", "SAFE-17"} & {*safety.checked, *safety.broken}
    assert "SAFE-2" in safety.broken


def test_limits_are_those_of_the_files() -> None:
    """By hand from scenarios/operations/solo.yaml, scenarios/vehicles/av21.yaml and firmware/schema/faults.yaml."""
    assert pytest.approx(4500.0) == LIMITS.full_brake_kpa
    assert pytest.approx(3500.0) == LIMITS.steered_brake_kpa
    assert pytest.approx(223.4535, abs=1e-3) == LIMITS.steering_deg
    assert pytest.approx(5.15662, abs=1e-4) == LIMITS.steering_slew_deg
    assert (LIMITS.throttle_percent, LIMITS.gears, LIMITS.standstill_speed) == (100.0, 6, 0.2)
    assert LIMITS.brakes.settled_us == 20_000 + 40_000 + 127_324 + 33_333 + 1  # 4 / (2 pi 5 Hz), rounded up
    assert pytest.approx(6000.0 * np.exp(-4.0)) == LIMITS.brakes.tolerance_kpa
    full = [fault for fault in own_faults() if fault.reaction == "full_brake"]
    assert len(full) >= 10
    assert set(LIMITS.full_brake_faults) == {fault.id for fault in full}
    for fault in full:
        assert 10_000 <= LIMITS.full_brake_faults[fault.id] == 1000 * (fault.deadline_ms - fault.debounce_ms) <= 20_000
