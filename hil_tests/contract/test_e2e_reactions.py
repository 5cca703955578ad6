"""What the ECUs do about a communication fault, and what above the protocol notices one that the protocol cannot."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
from actuator_ecus import BRAKE_STOP, FULL_BRAKE, STEERED_BRAKE, Requests, SpaceDrive, message_frame
from e2e_faults import (
    Stream,
    Traffic,
    all_frames_lost,
    bus_silent,
    changed,
    content_bits,
    forged_frames_between,
    forged_frames_instead,
    is_of,
    one_bit_flipped,
    unpack,
    with_bit_flipped,
    with_data,
)
from e2e_receivers import BEGIN, FAULTS, NETWORK, TICKS, Receiver, Run, actuator_ecus, onboard_computer, timeout_ms
from e2e_verdicts import MISSED, OUTCOMES, PLAUSIBILITY, ROWS, Row, protection

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import Bus, Station

#: What the Raptor makes of each command, by message.
COMMANDS = {
    "brake_pressure_cmd": ("brake_pressure",),
    "accelerator_cmd": ("throttle",),
    "steering_cmd": ("steer_motor_angle",),
    "gear_shift_cmd": ("gear",),
    "ct_report": ("ct_state",),
    "dash_switches_cmd": ("traction_aim", "traction_range"),
}

#: Without these the car is stopped.
VITAL = ("brake_pressure_cmd", "accelerator_cmd", "steering_cmd", "ct_report")

REQUESTS = {"req_steer_pos": "steer", "req_brake_pos": "brake"}

ALL_ROWS = [pytest.param(row, id=f"{row.fault}, {row.shape}") for row in ROWS]


@cache
def raptor() -> Receiver:
    return actuator_ecus()[0]


@cache
def space_drive() -> Receiver:
    return actuator_ecus()[1]


def stream_of(receiver: Receiver, name: str, donor: str) -> Stream:
    limit = timeout_ms(receiver.station, NETWORK[name])
    return Stream(NETWORK[name], BEGIN, None if limit is None else limit // 10, NETWORK[donor])


@cache
def control(receiver_of: Any) -> Run:
    receiver: Receiver = receiver_of()
    return receiver.run(receiver.traffic)


def command_of(run: Run, name: str, tick: int = -1) -> tuple[float, ...]:
    command = run.ecu(tick).commands.command
    return tuple(getattr(command, field) for field in COMMANDS[name])


# --- Raptor: commands of the onboard computer


@pytest.mark.parametrize("row", ALL_ROWS)
@pytest.mark.parametrize("name", VITAL)
def test_a_command_that_is_missed_stops_the_car(name: str, row: Row) -> None:
    receiver = raptor()
    donor = "brake_pressure_cmd" if name != "brake_pressure_cmd" else "steering_cmd"
    traffic = row.inject(receiver.traffic, stream_of(receiver, name, donor))
    run = receiver.run(traffic)
    if MISSED in row.verdicts[protection(NETWORK[name])]:
        assert run.ecu(-1).sys.state == lib.RAPTOR_SYS_EMERGENCY_SHUTDOWN
        silent = run.ecu(-1).commands.faults & lib.RAPTOR_COMMAND_STEERING_TIMEOUT
        full = FULL_BRAKE if silent else STEERED_BRAKE
        assert (run.ecu(-1).demand.brake, run.ecu(-1).demand.throttle) == (full, 0.0)
    else:
        assert not run.ecu(-1).commands.faults & lib.RAPTOR_COMMAND_ANY_TIMEOUT


@pytest.mark.parametrize("inject", [forged_frames_between, forged_frames_instead, one_bit_flipped])
@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "ct_report"])
def test_plausible_content_of_another_sender_is_followed(name: str, inject: Any) -> None:
    """CAN1 has no checksum and no key: what fits its layout and its range is a command."""
    receiver = raptor()
    traffic = inject(receiver.traffic, stream_of(receiver, name, "steering_cmd"))
    run = receiver.run(traffic)
    followed = any(
        command_of(run, name, tick) != command_of(control(raptor), name, tick) for tick in range(BEGIN, TICKS)
    )
    assert followed
    assert run.ecu(-1).sys.state == lib.RAPTOR_SYS_DRIVING


@pytest.mark.parametrize("name", COMMANDS)
def test_what_plausibility_makes_of_one_corrupt_bit(name: str) -> None:
    """Every bit of the content alone, flipped in every frame, at 30 % throttle, 12 degrees and 100 kPa."""
    outcomes = [outcome_of_bit(name, bit) for bit in content_bits(NETWORK[name])]
    counts = {outcome: outcomes.count(outcome) for outcome in OUTCOMES}
    assert tuple(counts.values()) == PLAUSIBILITY[name]


def outcome_of_bit(name: str, bit: int) -> str:
    receiver = raptor()
    stream = stream_of(receiver, name, name)
    run = receiver.run(changed(receiver.traffic, stream, lambda _, frame: [with_bit_flipped(frame, bit)]))
    if run.ecu(-1).sys.state == lib.RAPTOR_SYS_EMERGENCY_SHUTDOWN:
        return "stops the car"
    return "no effect" if command_of(run, name) == command_of(control(raptor), name) else "followed"


@pytest.mark.parametrize("bus", [Bus.CAN1, Bus.CAN3])
def test_a_blocked_bus_stops_the_car(bus: Bus) -> None:
    receiver = raptor()
    name = {Bus.CAN1: "steering_cmd", Bus.CAN3: "calb_steer_pos_1"}[bus]
    run = receiver.run(bus_silent(receiver.traffic, stream_of(receiver, name, name)))
    ecu = run.ecu(-1)
    assert ecu.sys.state == lib.RAPTOR_SYS_EMERGENCY_SHUTDOWN
    full = {Bus.CAN1: FULL_BRAKE, Bus.CAN3: STEERED_BRAKE}[bus]
    assert (ecu.demand.brake, ecu.demand.throttle) == (full, 0.0)
    cause = {Bus.CAN1: lib.RAPTOR_DIAG_OBC_LOST, Bus.CAN3: lib.RAPTOR_DIAG_EST4_SD_LOST}[bus]
    assert ecu.diagnostic.bits & (lib.RAPTOR_DIAG_OBC_LOST | lib.RAPTOR_DIAG_EST4_SD_LOST) == cause


# --- Space Drive: requests of the Raptor


@pytest.mark.parametrize("row", ALL_ROWS)
@pytest.mark.parametrize("name", REQUESTS)
def test_a_request_that_is_missed_is_an_emergency(name: str, row: Row) -> None:
    receiver = space_drive()
    donor = next(other for other in REQUESTS if other != name)
    run = receiver.run(row.inject(receiver.traffic, stream_of(receiver, name, donor)))
    missed = MISSED in row.verdicts[protection(NETWORK[name])]
    assert (run.ecu(-1).emergency != 0) == missed
    steers = not run.ecu(-1).emergency & lib.SPACE_DRIVE_EMERGENCY_STEER_REQUESTS
    assert not steers or name == "req_brake_pos" or not missed
    full = STEERED_BRAKE if steers else FULL_BRAKE
    assert (run.ecu(-1).brake_demand == full) == missed


@pytest.mark.parametrize("bit", range(64))
def test_a_shutdown_with_a_wrong_bit_is_none(bit: int) -> None:
    """Bits beside its two bytes belong to no signal."""
    drive, requests = SpaceDrive(), Requests(0.2, 1.0e6)
    for _ in range(5):
        drive.tick(requests.frames())
    order = message_frame("Shutdown_seq", 0, shutdown=1, shutdown_2=1)
    drive.tick([*requests.frames(), with_bit_flipped(order, bit)])
    message = database.message("Shutdown_seq")
    values = message.decode(unpack(with_bit_flipped(order, bit)).data)
    assert bool(drive.c.shutdown) == (values == message.decode(unpack(order).data))
    assert drive.c.emergency == 0


def test_a_shutdown_that_is_inserted_while_the_car_drives_is_none() -> None:
    receiver = space_drive()
    order = message_frame("Shutdown_seq", 0, shutdown=1, shutdown_2=1)
    run = receiver.run([[*frames, order] for frames in receiver.traffic])
    assert not run.ecu(-1).shutdown
    assert run.states[-1] == control(space_drive).states[-1]


# --- Onboard computer: reports, estimate, sensors


def obc_streams() -> list[str]:
    receiver = onboard_computer()
    heard = {(f.bus, f.id) for frames in receiver.traffic for f in map(unpack, frames)}
    return [
        name
        for name, facts in NETWORK.items()
        if (facts.bus, facts.message.frame_id) in heard and timeout_ms(Station.OBC, facts) is not None
    ]


def active_faults(run: Run, tick: int) -> set[str]:
    faults = run.ecu(tick).ssm.faults.faults
    return {FAULTS[i].name for i in FAULTS if faults[i].active}


@pytest.mark.parametrize("name", obc_streams())
def test_a_report_that_is_missed_has_the_reaction_of_its_fault(name: str) -> None:
    receiver = onboard_computer()
    run = receiver.run(all_frames_lost(receiver.traffic, stream_of(receiver, name, name)))
    missed = run.missed(-1)
    assert missed
    # Judged as the last of them becomes active: later the SSM sees a car that does not answer its commands.
    active = [tick for tick in range(TICKS - 1) if missed <= active_faults(run, tick)]
    assert active, "every debounce is over"
    tick = active[0] + 1
    ecu = run.ecu(tick)
    reactions = {FAULTS[i].reaction for i in FAULTS if FAULTS[i].name in missed}
    state = ecu.ssm_output.state
    sent = {f.id: database.find(f.bus, f.id).decode(f.data) for f in run.sent[tick] if f.bus == Bus.CAN1}  # type: ignore[union-attr]
    brake, throttle = (sent[NETWORK[m].message.frame_id][0] for m in ("brake_pressure_cmd", "accelerator_cmd"))
    if "full_brake" in reactions:
        assert (state, brake, throttle) == (lib.SSM_FULL_BRAKE, 3500, 0)
    elif reactions & {"safe_stop", "emergency_stop"}:
        assert (state, throttle) == (lib.SSM_EMERGENCY, 0)
        assert brake > 0
    else:
        assert (reactions, state) == ({"degrade"}, lib.SSM_DEGRADED)


OBC_SENDS = [message.name for message in database if message.sender == Station.OBC and message.bus != Bus.CAN3]


@pytest.mark.parametrize("name", OBC_SENDS)
def test_the_onboard_computer_hears_whoever_sends_in_its_name(name: str) -> None:
    """Insertion and masquerade among its own messages: the one sender that can know is the true one."""
    receiver, message = onboard_computer(), database.message(name)
    intruder = message.frame(*(max(0.0, message.limits(signal)[0]) for signal in message.signals))
    traffic = [frames + [intruder] * (tick == BEGIN) for tick, frames in enumerate(receiver.traffic[: BEGIN + 3])]
    run = receiver.run(traffic)
    assert not run.ecu(BEGIN - 1).conditions.present[lib.FAULT_SECOND_COMPUTER]
    assert run.ecu(BEGIN).conditions.present[lib.FAULT_SECOND_COMPUTER]
    assert run.ecu(-1).ssm_output.state == lib.SSM_FULL_BRAKE


# --- what the onboard computer reads without counting it

#: Whether losing a row's frames for good is noticed; rows that are not named are about counters and CRCs.
OTHERWISE = {
    ("repetition", "each frame comes twice"): False,
    ("repetition", "one old frame again and again"): True,
    ("loss", "of one frame"): False,
    ("loss", "of all frames"): True,
    ("wrong addressing", "on another bus"): True,
    ("wrong addressing", "id in the other format"): True,
    ("corruption", "one byte too short"): True,
    ("corruption", "remote frame instead of data"): True,
    ("blocked channel", "nothing comes on this bus"): True,
}


@pytest.mark.parametrize("row", [row for row in ALL_ROWS if (row.values[0].fault, row.values[0].shape) in OTHERWISE])  # type: ignore[attr-defined]
@pytest.mark.parametrize(
    "name",
    ["node_status", "trajectory_header", "trajectory_pose", "trajectory_motion", "wall_line", "wall_bend"],
)
def test_plans_walls_and_node_states_have_their_own_counters(name: str, row: Row) -> None:
    receiver = onboard_computer()
    run = receiver.run(row.inject(receiver.traffic, stream_of(receiver, name, name)))
    noticed = run.noticed(control(onboard_computer))
    assert bool(noticed) == OTHERWISE[row.fault, row.shape]
    expected = {"node": {"planning_stalled"}, "trajectory": {"plan_stale"}, "wall": {"wall_missing"}}
    assert not noticed or expected[name.partition("_")[0]] <= run.missed(-1)


# --- asymmetric information and partial reception: three receivers of one request


def heard_differently(axis: str, changes: dict[int, Any], ticks: int = TICKS) -> Any:
    """A Space Drive whose three receivers of one axis hear each its own frames.

    `changes` has, by channel, what becomes of a request there: other frames, or none.
    """
    receiver = space_drive()
    name = next(message for message, which in REQUESTS.items() if which == axis)
    ecu = ffi.new("space_drive *")
    ffi.buffer(ecu)[:] = receiver.state
    storage = ffi.new("can_frame[]", 64)
    out = ffi.new("can_outbox *", {"frames": storage, "capacity": 64})
    config = getattr(ecu.config, axis)
    for tick, frames in enumerate(receiver.traffic[:ticks]):
        now_us = receiver.start_us + 10_000 * tick
        (request,) = (frame for frame in frames if is_of(NETWORK[name], frame))
        for channel in range(3):
            change = changes.get(channel, lambda frame: [frame]) if tick >= BEGIN else lambda frame: [frame]
            for frame in change(request):
                one = ffi.new("can_frame *")
                ffi.memmove(one, frame, len(frame))
                state = getattr(ecu, axis).channels[channel].request
                lib.space_drive_request_receive(ffi.addressof(state), one, config.counts_max, config.bad_limit, now_us)
        rest = b"".join(frame for frame in frames if frame is not request)
        array = ffi.new("can_frame[]", max(len(rest) // 24, 1))
        ffi.memmove(array, rest, len(rest))
        receiver.tick(ecu, now_us, array, len(rest) // 24, out)
        out.count = 0
    return ecu


def other_position(frame: bytes) -> list[bytes]:
    """The same request with another position, by a sender that makes no mistake."""
    head = unpack(frame)
    message = database.find(head.bus, head.id)
    assert message is not None
    moved = with_data(frame, (0x2000).to_bytes(2, "little") + head.data[2:])
    return [message.finish(moved, head.data[5])]


def nothing(_frame: bytes) -> list[bytes]:
    return []


def broken(frame: bytes) -> list[bytes]:
    return [with_bit_flipped(frame, 3)]


@pytest.mark.parametrize("channel", [0, 1, 2])
@pytest.mark.parametrize("change", [other_position, nothing, broken])
@pytest.mark.parametrize("axis", ["steer", "brake"])
def test_one_receiver_of_three_that_hears_something_else_is_outvoted(axis: str, change: Any, channel: int) -> None:
    alike = heard_differently(axis, {})
    ecu = heard_differently(axis, {channel: change})
    assert ecu.emergency == 0
    assert getattr(ecu, axis).demand == getattr(alike, axis).demand
    states = [getattr(ecu, axis).channels[i].request.state for i in range(3)]
    lost = lib.SPACE_DRIVE_REQUEST_FRESH if change is other_position else lib.SPACE_DRIVE_REQUEST_LOST
    assert states == [lost if i == channel else lib.SPACE_DRIVE_REQUEST_FRESH for i in range(3)]


@pytest.mark.parametrize("change", [nothing, broken])
@pytest.mark.parametrize("axis", ["steer", "brake"])
def test_two_receivers_of_three_that_hear_nothing_good_are_an_emergency(axis: str, change: Any) -> None:
    ecu = heard_differently(axis, {0: change, 2: change})
    assert ecu.emergency != 0
    assert ecu.brake_demand == (FULL_BRAKE if axis == "steer" else STEERED_BRAKE)


def test_two_receivers_of_three_that_hear_the_same_wrong_request_are_followed() -> None:
    """The limit of a vote."""
    ecu = heard_differently("brake", {0: other_position, 2: other_position})
    assert ecu.emergency == 0
    assert ecu.brake_demand == pytest.approx(BRAKE_STOP / 2)


# --- asymmetric information and partial reception: three senders of one position


def one_of_three(names: list[str], change: Any) -> Run:
    receiver = raptor()
    traffic: Traffic = receiver.traffic
    for name in names:
        traffic = changed(traffic, stream_of(receiver, name, name), lambda _, frame: change(frame))
    return receiver.run(traffic)


def other_report(frame: bytes) -> list[bytes]:
    """A channel's position far from that of the others, by a sender that makes no mistake."""
    head = unpack(frame)
    message = database.find(head.bus, head.id)
    assert message is not None
    values = dict(zip(message.signals, message.decode(head.data), strict=True))
    position = next(signal for signal in message.signals if "pos" in signal.lower() and values[signal] > 0x1000)
    values[position] = float(0x1000)
    (counter,) = (values[signal] for signal in message.signals if "Counter" in signal)
    return [message.finish(with_data(frame, message.encode(*values.values())), int(counter))]


@pytest.mark.parametrize("channel", [1, 2, 3])
@pytest.mark.parametrize("change", [other_report, nothing, broken])
@pytest.mark.parametrize("axis", ["steer", "brake"])
def test_one_channel_of_three_that_says_something_else_is_outvoted(axis: str, change: Any, channel: int) -> None:
    run = one_of_three([f"calb_{axis}_pos_{channel}"], change)
    ecu = run.ecu(-1)
    assert ecu.sys.state == lib.RAPTOR_SYS_DRIVING
    assert getattr(ecu.gateway, axis).position == getattr(control(raptor).ecu(-1).gateway, axis).position
    warning = lib.RAPTOR_DIAG_SD_STEER_WARNING_1 if axis == "steer" else lib.RAPTOR_DIAG_SD_BRAKE_WARNING_1
    told = ecu.diagnostic.bits & (warning * 7)
    assert told == (0 if change is other_report else warning << (channel - 1))


@pytest.mark.parametrize("change", [nothing, broken])
@pytest.mark.parametrize("axis", ["steer", "brake"])
def test_two_channels_of_three_that_say_nothing_good_stop_the_car(axis: str, change: Any) -> None:
    run = one_of_three([f"calb_{axis}_pos_1", f"calb_{axis}_pos_3"], change)
    assert run.ecu(-1).sys.state == lib.RAPTOR_SYS_EMERGENCY_SHUTDOWN
    assert run.ecu(-1).diagnostic.bits & lib.RAPTOR_DIAG_EST4_SD_LOST
