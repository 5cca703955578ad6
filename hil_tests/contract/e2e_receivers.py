"""The three ECUs as receivers: each in a healthy state, with a stretch of the traffic that keeps it there.

The traffic was recorded from the harnesses, once. A run begins anew from the recorded state and hears the traffic as
it was, or with a fault in it; nothing answers, so that what an ECU makes of a fault is all its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

from actuator_ecus import car_in
from e2e_faults import Traffic, is_of, unpack
from obc_harness import OPERATION, TICK_US, ObcHarness, Outbox, cast_frames

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import FRAME_SIZE, Frame, Station, iterate
from dbc.network import MessageFacts, own_network
from firmware.parameters import load_operation
from firmware.tables import own_faults

#: Recorded ticks: the longest time-out, one second, with room before and after.
TICKS = 170

#: First tick with a fault; all periods begin anew in it.
BEGIN = 20

NETWORK = {facts.message.name: facts for facts in own_network()}

_RX = ffi.typeof("codec_rx")


class Reception(NamedTuple):
    """A codec_rx."""

    valid: int
    rejected: int
    last_status: int
    counter: int


@dataclass(frozen=True)
class Run:
    """States of an ECU after each tick of a run, and the frames that it sent.

    Attributes
    ----------
    receiver : whose run it is.
    states : content of the ECU's struct.
    sent : by tick.
    """

    receiver: Receiver
    states: list[bytes]
    sent: list[list[Frame]]

    def ecu(self, tick: int) -> Any:
        """The ECU's struct after a tick; valid as long as this run lives."""
        return ffi.from_buffer(f"{self.receiver.kind} *", self.states[tick])

    def reception(self, tick: int, offset: int) -> Reception:
        return self.receiver.reception(self.states[tick], offset)

    def missed(self, tick: int) -> frozenset[str]:
        """What the ECU says it misses after a tick, by names of its own."""
        return self.receiver.missed(self.ecu(tick))

    def noticed(self, control: Run) -> list[int]:
        """Ticks in which something is missed that was not without the fault."""
        return [tick for tick in range(len(self.states)) if self.missed(tick) - control.missed(tick)]


@dataclass(frozen=True)
class Receiver:
    """One ECU.

    Attributes
    ----------
    station, kind : number, and name of its C struct.
    state : content of the struct before the first tick.
    start_us : time of the first tick.
    traffic : what it hears, tick by tick.
    tick : run one tick on the struct.
    missed : what the ECU says it misses.
    """

    station: Station
    kind: str
    state: bytes
    start_us: int
    traffic: Traffic
    tick: Callable[[Any, int, Any, int, Any], None]
    missed: Callable[[Any], frozenset[str]]

    def run(self, traffic: Traffic) -> Run:
        ecu = ffi.new(f"{self.kind} *")
        buffer = ffi.buffer(ecu)
        buffer[:] = self.state
        outbox = Outbox()
        states, sent = [], []
        for number, frames in enumerate(traffic):
            array, count = cast_frames(b"".join(frames))
            self.tick(ecu, self.start_us + number * TICK_US, array, count, outbox.c)
            states.append(bytes(buffer))
            sent.append(list(iterate(outbox.take())))
        return Run(self, states, sent)

    def reception(self, state: bytes, offset: int) -> Reception:
        """A codec_rx in the content of the struct."""
        rx = ffi.cast("codec_rx *", ffi.from_buffer(state) + offset)
        return Reception(rx.valid, rx.rejected, rx.last_status, rx.counter)

    def receptions(self) -> dict[str, int]:
        """Place in the struct of every codec_rx, by path."""
        return dict(_receptions(ffi.typeof(self.kind), "", 0))

    def receptions_of(self, facts: MessageFacts) -> dict[str, int]:
        """Those that count the frames of a message, found by letting the ECU hear nothing else."""
        alone = self.run([[f for f in frames if is_of(facts, f)] for frames in self.traffic[:11]])
        silence = self.run([[] for _ in self.traffic[:11]])
        return {
            path: offset
            for path, offset in self.receptions().items()
            if alone.reception(10, offset) != silence.reception(10, offset)
        }


def _receptions(kind: Any, path: str, offset: int) -> Iterator[tuple[str, int]]:
    if kind == _RX:
        yield path, offset
    elif kind.kind == "struct":
        for name, field in kind.fields:
            yield from _receptions(field.type, f"{path}.{name}", offset + field.offset)
    elif kind.kind == "array":
        for index in range(kind.length):
            yield from _receptions(kind.item, f"{path}[{index}]", offset + index * ffi.sizeof(kind.item))


def addressed_to(station: Station) -> list[MessageFacts]:
    """Periodic messages that the DBC files send to a station."""
    return [facts for facts in NETWORK.values() if station in facts.receivers and facts.cycle_ms]


def completed(station: Station, traffic: Traffic) -> Traffic:
    """Traffic with those messages to the station in it that nobody sends, at their periods, all signals 0."""
    heard = {(f.bus, f.id) for frames in traffic for f in map(unpack, frames)}
    result = [list(frames) for frames in traffic]
    for facts in addressed_to(station):
        if (facts.bus, facts.message.frame_id) not in heard:
            codec = database.message(facts.message.name)
            zero = codec.frame(*(max(0.0, codec.limits(signal)[0]) for signal in codec.signals))
            for number, frames in enumerate(result[:: facts.cycle_ms // 10]):
                frames.append(codec.finish(zero, number & 0xFF))
    return result


# --- onboard computer

#: The onboard computer's time-outs are parameters of the operation, by message. The other messages that it counts have
#: none: the followers in a sensor's sample are counted with the sample, and old flags of Marelli are not acknowledged.
OBC_TIMEOUTS = {
    "accelerator_report": "accelerator_report_timeout",
    "base_to_car_summary": "race_control_timeout",
    "brake_pressure_report": "brake_report_timeout",
    "diagnostic_report": "diagnostic_report_timeout",
    "estimate_motion": "estimate_timeout",
    "estimate_position": "estimate_timeout",
    "estimate_quality": "estimate_timeout",
    "gnss_a_position": "gnss_a_timeout",
    "gnss_b_position": "gnss_b_timeout",
    "imu_rates": "imu_timeout",
    "launch_request": "launch_request_timeout",
    "misc_report": "misc_report_timeout",
    "pt_report_1": "powertrain_report_timeout",
    "steering_report": "steering_report_timeout",
    "wheel_speed_report": "wheel_speed_timeout",
}

#: Age at which the Raptor acts without telling: an old gear command is not followed.
RAPTOR_UNTOLD = frozenset({"gear_shift_cmd"})


@cache
def operation() -> dict[str, Any]:
    """Parameters that the onboard computer drives with."""
    return dict(load_operation(OPERATION))


def timeout_ms(station: Station, facts: MessageFacts) -> int | None:
    """Age from which on a station says that it misses a message; None when it never does.

    The actuator ECUs have the time-outs of the DBC files.
    """
    name = facts.message.name
    if station == Station.OBC:
        parameter = OBC_TIMEOUTS.get(name)
        return int(operation()[parameter]) if parameter else None
    return facts.timeout_ms or None if name not in RAPTOR_UNTOLD else None


#: Conditions that mean that something does not come any more. The fault table has more, about what does come.
OBC_MISSED = frozenset(
    {
        "gnss_a_timeout", "gnss_b_timeout", "imu_timeout", "estimate_lost", "launch_withdrawn", "wheel_speed_missing",
        "brake_report_missing", "steering_report_missing", "misc_report_missing", "powertrain_report_missing",
        "diagnostic_report_missing", "accelerator_report_missing", "race_control_lost", "plan_stale",
        "planning_stalled", "estimation_stalled", "wall_missing",
    }
)  # fmt: skip

#: The sensors' samples are counted by their frames too.
OBC_WRONG_SIZE = frozenset({"gnss_a_wrong_size", "gnss_b_wrong_size", "imu_wrong_size"})

FAULTS = {fault.id: fault for fault in own_faults()}


def obc_conditions(ecu: Any, names: frozenset[str]) -> frozenset[str]:
    """Those of the faults whose condition is present because something is old or absent."""
    present, detail = bytes(ffi.buffer(ecu.conditions.present)), ecu.conditions.detail
    found = {fault.name for number, fault in FAULTS.items() if present[number] and fault.name in names}
    # These two may also tell of content; their detail says so.
    if "launch_withdrawn" in found and detail[lib.FAULT_LAUNCH_WITHDRAWN] != 0:
        found.discard("launch_withdrawn")
    if "estimate_lost" in found and detail[lib.FAULT_ESTIMATE_LOST] == lib.ESTIMATE_LOST:
        found.discard("estimate_lost")
    return frozenset(found)


@cache
def onboard_computer() -> Receiver:
    """Racing at 30 m/s."""
    harness = ObcHarness()
    harness.plan_speed = 30.0
    harness.drive()
    harness.set_speed(30.0)
    # A whole number of all periods, so that the recording begins like the harness did.
    while harness.now_us % 100_000 or harness.now_us < 2_500_000:
        harness.tick()
    state, start_us = bytes(ffi.buffer(harness.obc)), harness.now_us
    traffic: Traffic = []

    def record(frames: bytes) -> bytes:
        traffic.append([frames[i : i + FRAME_SIZE] for i in range(0, len(frames), FRAME_SIZE)])
        return frames

    harness.filters.append(record)
    harness.run(TICKS)
    assert (harness.state, harness.ct_state) == (lib.SSM_NOMINAL, lib.CT_NOM_RACE)
    return Receiver(
        Station.OBC, "obc", state, start_us, completed(Station.OBC, traffic), lib.obc_tick,
        lambda ecu: obc_conditions(ecu, OBC_MISSED),
    )  # fmt: skip


# --- actuator ECUs

RAPTOR_TIMEOUTS = {
    "brake command": lib.RAPTOR_COMMAND_BRAKE_TIMEOUT,
    "accelerator command": lib.RAPTOR_COMMAND_THROTTLE_TIMEOUT,
    "steering command": lib.RAPTOR_COMMAND_STEERING_TIMEOUT,
    "ct_report": lib.RAPTOR_COMMAND_CT_REPORT_TIMEOUT,
}


def raptor_missed(ecu: Any) -> frozenset[str]:
    found = {name for name, bit in RAPTOR_TIMEOUTS.items() if ecu.commands.faults & bit}
    for axis in ("steer", "brake"):
        channels = getattr(ecu.gateway, axis).channels
        found |= {f"{axis} channel {index + 1}" for index in range(len(channels)) if channels[index].faulty}
    return frozenset(found)


def space_drive_missed(ecu: Any) -> frozenset[str]:
    return frozenset(
        f"{axis} channel {index + 1}"
        for axis in ("steer", "brake")
        for index in range(lib.SPACE_DRIVE_CHANNELS)
        if getattr(ecu, axis).channels[index].request.state == lib.SPACE_DRIVE_REQUEST_LOST
    )


@cache
def actuator_ecus() -> tuple[Receiver, Receiver]:
    """Raptor and Space Drive while driving, one in front of the other; wired signals stay as they are in the end."""
    car = car_in(lib.RAPTOR_SYS_DRIVING)
    car.computer.brake_kpa, car.computer.accelerator, car.computer.steer_deg = 100.0, 30.0, 12.0
    car.set_wheels(20.0)
    car.wired.engine_speed = 400.0
    while car.now_us % 100_000 or car.computer.tick % 10:
        car.tick()
    start_us = car.now_us
    states = bytes(ffi.buffer(car.c)), bytes(ffi.buffer(car.space_drive.c))
    heard, requested = [], []
    for _ in range(TICKS):
        car.tick()
        heard.append(car.heard)
        requested.append(car.requested)
    assert (car.state, car.space_drive.c.emergency) == (lib.RAPTOR_SYS_DRIVING, 0)

    def raptor_tick(ecu: Any, now_us: int, frames: Any, count: int, out: Any) -> None:
        lib.raptor_tick(ecu, now_us, car.wired, frames, count, ffi.new("raptor_wired_out *"), out)

    def space_drive_tick(ecu: Any, now_us: int, frames: Any, count: int, out: Any) -> None:
        drive = ffi.new("space_drive_wired_out *")
        lib.space_drive_tick(ecu, now_us, car.space_drive.wired, frames, count, drive, out)

    return (
        Receiver(
            Station.RAPTOR, "raptor", states[0], start_us, completed(Station.RAPTOR, heard), raptor_tick, raptor_missed
        ),
        Receiver(
            Station.SPACE_DRIVE, "space_drive", states[1], start_us, completed(Station.SPACE_DRIVE, requested),
            space_drive_tick, space_drive_missed,
        ),
    )  # fmt: skip


def receivers() -> tuple[Receiver, ...]:
    """All ECUs that receive."""
    return onboard_computer(), *actuator_ecus()
