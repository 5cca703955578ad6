"""Raptor: the gateway to the Space Drive alone, frame by frame and at the edges of its times."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
from actuator_ecus import BRAKE_STOP, DEG, Outbox, message_frame

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import Bus, Flag, iterate

LATE_US = 10**12
NAN, INF = math.nan, math.inf
AXES = ("steer", "brake")
CHANNELS = [(axis, channel) for axis in AXES for channel in range(3)]
POSITION, STATUS, ERRORS = "calb", "stat", "act_err"
RECEIVERS = {POSITION: "position_rx", STATUS: "status_rx", ERRORS: "error_rx"}


def name_of(kind: str, axis: str, channel: int) -> str:
    if kind == POSITION:
        return f"calb_{axis}_pos_{channel + 1}"
    return f"{kind}_{'brk' if (kind, axis) == (STATUS, 'brake') else axis}_{channel + 1}"


class Gateway:
    """A gateway with a configuration of its own."""

    def __init__(self, **config: float) -> None:
        self.c = ffi.new("raptor_gateway *")
        self.config = ffi.new("raptor_config *", lib.raptor_config_default)
        for name, value in config.items():
            setattr(self.config, name, value)
        self.counter = 0

    def receive(self, frame: bytes, now_us: int = 0) -> None:
        pointer = ffi.new("can_frame *")
        ffi.buffer(pointer)[:] = frame
        lib.raptor_gateway_receive(self.c, pointer, now_us)

    def send(self, kind: str, axis: str, channel: int, now_us: int = 0, **values: float) -> None:
        self.counter += 1
        self.receive(message_frame(name_of(kind, axis, channel), self.counter, **values), now_us)

    def send_position(self, axis: str, channel: int, counts: int, now_us: int = 0, plausibility: int = 0) -> None:
        signal = database.message(name_of(POSITION, axis, channel)).signals[0]
        self.send(POSITION, axis, channel, now_us, **{signal: counts, "plausibity": plausibility})

    def send_all(self, now_us: int, kinds: tuple[str, ...] = (POSITION, STATUS, ERRORS)) -> None:
        for axis, channel in CHANNELS:
            for kind in kinds:
                if kind == POSITION:
                    self.send_position(axis, channel, 0x2000, now_us)
                else:
                    self.send(kind, axis, channel, now_us)

    def step(self, now_us: int) -> None:
        lib.raptor_gateway_step(self.c, self.config, now_us)

    def channel(self, axis: str, channel: int) -> Any:
        return getattr(self.c, axis).channels[channel]

    def faulty(self) -> list[tuple[str, int]]:
        return [place for place in CHANNELS if self.channel(*place).faulty]


def changed(frame: bytes, **fields: Any) -> bytes:
    return next(iterate(frame))._replace(**fields).pack()


@pytest.mark.parametrize(("axis", "channel"), CHANNELS)
@pytest.mark.parametrize("kind", RECEIVERS)
def test_a_frame_is_taken_by_its_own_receiver_and_by_no_other(kind: str, axis: str, channel: int) -> None:
    gateway = Gateway()
    gateway.send(kind, axis, channel, 7)
    for place, (other, receiver) in itertools.product(CHANNELS, RECEIVERS.items()):
        rx = getattr(gateway.channel(*place), receiver)
        own = (kind, axis, channel) == (other, *place)
        assert (rx.valid, rx.rejected, rx.last_valid_us) == ((1, 0, 7) if own else (0, 0, 0))
    other = bytes(ffi.buffer(ffi.addressof(gateway.c, "brake" if axis == "steer" else "steer")))
    assert other == bytes(len(other))


DISGUISES: dict[str, Callable[[bytes], bytes]] = {
    "other bus": lambda frame: changed(frame, bus=Bus.CAN1),
    "extended": lambda frame: changed(frame, flags=Flag.EXTENDED),
    "error": lambda frame: changed(frame, flags=Flag.ERROR),
    "both": lambda frame: changed(frame, flags=Flag.ERROR | Flag.EXTENDED),
    "other bus, extended": lambda frame: changed(frame, bus=Bus.CAN1, flags=Flag.EXTENDED),
}


@pytest.mark.parametrize("kind", RECEIVERS)
@pytest.mark.parametrize("disguise", DISGUISES)
def test_foreign_frames_are_not_even_counted(kind: str, disguise: str) -> None:
    gateway = Gateway()
    gateway.receive(DISGUISES[disguise](message_frame(name_of(kind, "brake", 1), 1)))
    assert bytes(ffi.buffer(gateway.c)) == bytes(ffi.sizeof("raptor_gateway"))


@pytest.mark.parametrize("first", [0x60, 0x80, 0x120])
@pytest.mark.parametrize("offset", [-1, 6, 7])
def test_the_neighbours_of_a_family_are_no_channels(first: int, offset: int) -> None:
    gateway = Gateway()
    gateway.receive(changed(message_frame("stat_steer_1", 1), id=first + offset))
    assert bytes(ffi.buffer(gateway.c)) == bytes(ffi.sizeof("raptor_gateway"))


@pytest.mark.parametrize("kind", RECEIVERS)
def test_a_frame_that_the_codec_rejects_tells_nothing(kind: str) -> None:
    gateway = Gateway()
    channel = gateway.channel("steer", 0)
    frame = message_frame(name_of(kind, "steer", 0), 1)
    gateway.receive(changed(frame, dlc=7, data=b"\xff" * 8))
    told = (channel.plausible, channel.position, channel.emergency_brake, channel.error, channel.critical)
    assert told == (False, 0.0, False, False, False)
    assert getattr(channel, RECEIVERS[kind]).rejected == 1


@pytest.mark.parametrize(
    ("axis", "counts", "plausibility", "position"),
    [
        ("steer", 0, 0, -240 * DEG),
        ("steer", 0x1000, 0, -180 * DEG),
        ("steer", 0x8000, 0, 240 * DEG),
        ("steer", 0x8001, 0, None),
        ("steer", 0x1000, 2, None),
        ("steer", 0x1000, 1, None),
        ("brake", 0, 0, BRAKE_STOP),
        ("brake", 0x1000, 0, 0.75 * BRAKE_STOP),
        ("brake", 0x4000, 0, 0.0),
        ("brake", 0x4001, 0, None),
        ("brake", 0xFFFF, 2, None),
    ],
)
def test_positions(axis: str, counts: int, plausibility: int, position: float | None) -> None:
    gateway = Gateway()
    channel = gateway.channel(axis, 1)
    channel.position = 0.125
    gateway.send_position(axis, 1, counts, plausibility=plausibility)
    gateway.step(0)
    assert bool(channel.plausible) is bool(channel.valid) is (position is not None)
    assert bool(channel.faulty) is (position is None)
    assert channel.position == pytest.approx(0.125 if position is None else position, rel=1e-6)


@pytest.mark.parametrize(("axis", "channel"), CHANNELS)
def test_emergency_brake_of_a_channel(axis: str, channel: int) -> None:
    gateway = Gateway()
    told = gateway.channel(axis, channel)
    for braking in (1, 0, 1):
        gateway.send(STATUS, axis, channel, emr_brk=braking)
        assert told.emergency_brake == bool(braking)
    gateway.step(200_000)
    assert told.emergency_brake
    gateway.step(200_001)
    assert not told.emergency_brake, "nobody knows it any more"


@pytest.mark.parametrize("bit", range(64))
def test_every_bit_of_the_errors_is_one_and_the_critical_one_is_known(bit: int) -> None:
    gateway = Gateway()
    channel = gateway.channel("brake", 2)
    frame = message_frame(name_of(ERRORS, "brake", 2), 1)
    gateway.receive(changed(frame, data=(1 << bit).to_bytes(8, "little")))
    assert (channel.error, channel.critical) == (True, bit == 62)
    gateway.receive(frame)
    assert (channel.error, channel.critical) == (False, False)


@pytest.mark.parametrize(("kind", "timeout_us"), [(POSITION, 50_000), (STATUS, 200_000), (ERRORS, 500_000)])
def test_frames_are_overdue_after_their_time_from_the_first_step_or_the_last_frame(kind: str, timeout_us: int) -> None:
    others = tuple(other for other in RECEIVERS if other != kind)
    gateway = Gateway(position_timeout_ms=50, status_timeout_ms=200, error_timeout_ms=500)
    gateway.step(LATE_US)
    assert gateway.faulty() == []
    for start_us in (LATE_US, LATE_US + timeout_us + 1):
        gateway.send_all(start_us + timeout_us, others)
        gateway.step(start_us + timeout_us)
        assert gateway.faulty() == []
        gateway.step(start_us + timeout_us + 1)
        assert gateway.faulty() == CHANNELS
        gateway.send_all(start_us + timeout_us + 1)
        gateway.step(start_us + timeout_us + 1)
        assert gateway.faulty() == []


@pytest.mark.parametrize("axis", AXES)
def test_an_axis_is_lost_when_it_has_had_one_valid_channel_for_too_long(axis: str) -> None:
    gateway = Gateway(space_drive_lost_us=50_000, position_timeout_ms=0)
    gateway.send_all(0)
    gateway.step(0)
    assert lib.raptor_gateway_ready(gateway.c)
    gateway.send_position(axis, 0, 0x2000, plausibility=2)
    for now_us in (10_000, 1_000_000):
        gateway.step(now_us)
        assert not gateway.c.lost
        assert not lib.raptor_gateway_ready(gateway.c)
        assert getattr(gateway.c, axis).valid_count == 2
    gateway.send_position(axis, 2, 0x2000, plausibility=2)
    lost = []
    for now_us in (2_000_000, 2_049_999, 2_050_000):
        gateway.step(now_us)
        lost.append(bool(gateway.c.lost))
    assert lost == [False, False, True]
    gateway.send_all(2_060_000)
    gateway.step(2_060_000)
    assert not gateway.c.lost
    assert lib.raptor_gateway_ready(gateway.c)


def test_a_channel_that_was_never_heard_is_not_valid() -> None:
    gateway = Gateway()
    gateway.step(0)
    assert [gateway.channel(*place).valid for place in CHANNELS] == [False] * 6
    assert (gateway.c.steer.valid_count, gateway.c.brake.valid_count) == (0, 0)
    assert gateway.faulty() == []
    assert not lib.raptor_gateway_ready(gateway.c)


@pytest.mark.parametrize("axis", AXES)
def test_the_position_is_the_median_and_stays_when_two_channels_are_gone(axis: str) -> None:
    gateway = Gateway(position_timeout_ms=0)
    told = getattr(gateway.c, axis)
    full = 480 * DEG / 0x8000 if axis == "steer" else -BRAKE_STOP / 0x4000
    zero = -240 * DEG if axis == "steer" else BRAKE_STOP
    gateway.send_position(axis, 0, 0x1000)
    gateway.step(0)
    assert (told.known, told.position) == (False, 0.0)
    gateway.send_position(axis, 1, 0x3000)
    gateway.step(0)
    assert told.known
    assert told.position == pytest.approx(zero + 0x2000 * full, rel=1e-5)
    gateway.send_position(axis, 2, 0x1800)
    gateway.step(0)
    assert told.position == pytest.approx(zero + 0x1800 * full, rel=1e-5)
    for channel in (0, 1):
        gateway.send_position(axis, channel, 0, plausibility=2)
    gateway.step(0)
    assert told.known
    assert told.position == pytest.approx(zero + 0x1800 * full, rel=1e-5)


@pytest.mark.parametrize("braking", [list(c) for n in range(3) for c in itertools.combinations(CHANNELS, n)])
def test_two_channels_of_either_axis_that_brake_are_an_emergency(braking: list[tuple[str, int]]) -> None:
    gateway = Gateway()
    for axis, channel in braking:
        gateway.send(STATUS, axis, channel, emr_brk=1)
    gateway.step(0)
    assert bool(gateway.c.emergency_brake) is (len(braking) >= 2)


def test_what_lies_behind_the_three_channels_has_no_say() -> None:
    """Where a fourth steering channel would be, the brake's begin."""
    timeouts = {"position_timeout_ms": 0, "status_timeout_ms": 0, "error_timeout_ms": 0}
    gateway = Gateway(**timeouts)
    behind = ffi.addressof(gateway.c.steer.channels, 0) + 3
    behind.position_rx.seen = behind.plausible = True
    gateway.step(0)
    assert gateway.c.steer.valid_count == 0
    gateway = Gateway(**timeouts)
    behind = ffi.addressof(gateway.c.steer.channels, 0) + 3
    gateway.send(STATUS, "steer", 1, emr_brk=1)
    behind.emergency_brake = True
    gateway.step(0)
    assert not gateway.c.emergency_brake


def test_the_shutdown_says_it_twice() -> None:
    outbox = Outbox()
    lib.raptor_gateway_send_shutdown(outbox.c)
    (frame,) = outbox.take()
    message = database.message("Shutdown_seq")
    assert (frame.bus, frame.id, frame.dlc, frame.flags) == (Bus.CAN3, message.frame_id, 8, 0)
    assert message.decode(frame.data) == (1, 1)
    assert sum(frame.data) == 2


@pytest.mark.parametrize("capacity", [0, 1])
def test_a_full_outbox_takes_no_request_and_moves_no_counter(capacity: int) -> None:
    gateway, outbox = Gateway(), Outbox(capacity)
    gateway.c.steer.known = True
    lib.raptor_gateway_send_requests(gateway.c, 0.1, 1.0e6, 3.0, outbox.c)
    lib.raptor_gateway_send_shutdown(outbox.c)
    assert (outbox.c.count, outbox.c.dropped) == (capacity, 3 - capacity)
    assert (gateway.c.brake_counter, gateway.c.steer_counter) == (capacity, 0)


def test_requests_have_their_address_and_length() -> None:
    gateway, outbox = Gateway(), Outbox()
    gateway.c.steer.known = True
    lib.raptor_gateway_send_requests(gateway.c, 0.1, 1.0e6, 3.0, outbox.c)
    sent = [(frame.bus, frame.id, frame.dlc, frame.flags) for frame in outbox.take()]
    assert sent == [(Bus.CAN3, 0x21, 8, 0), (Bus.CAN3, 0x20, 8, 0)]


def test_before_a_position_is_known_only_the_brake_is_asked_for() -> None:
    gateway, outbox = Gateway(), Outbox()
    lib.raptor_gateway_send_requests(gateway.c, 0.1, 1.0e6, 3.0, outbox.c)
    assert [frame.id for frame in outbox.take()] == [0x21]


def test_requests_count_on() -> None:
    gateway, outbox = Gateway(), Outbox()
    gateway.c.steer.known = True
    for counter in range(3):
        lib.raptor_gateway_send_requests(gateway.c, 0.1, 1.0e6, 3.0, outbox.c)
        for frame in outbox.take():
            finished = database.find(frame.bus, frame.id).finish(frame.pack(), counter)  # type: ignore[union-attr]
            assert frame.pack() == finished


@pytest.mark.parametrize(
    ("angle", "pressure", "speed", "steer_counts", "brake_counts", "kmh"),
    [
        (0.0, 0.0, 0.0, 0x4000, 0x4000, 0),
        (240 * DEG, 6.0e6, 63.1, 0x8000, 0, 227),
        (-240 * DEG, 3.0e6, 1e9, 0, 0x2000, 65_535),
        (9.0, 9.0e6, -1.0, 0x8000, 0, 0),
        (-9.0, -1.0, NAN, 0, 0x4000, 0),
        (-9.0, -6.0e6, 0.0, 0, 0x4000, 0),
        (NAN, NAN, NAN, 0x4000, 0, 0),
        (INF, INF, INF, 0x4000, 0, 65_535),
        (60 * DEG, 1.0, 1.0, 0x5000, 0x4000, 4),
    ],
)
def test_request_counts(
    angle: float, pressure: float, speed: float, steer_counts: int, brake_counts: int, kmh: int
) -> None:
    gateway, outbox = ffi.new("raptor_gateway *"), Outbox()
    gateway.steer.known = True
    lib.raptor_gateway_send_requests(gateway, angle, pressure, speed, outbox.c)
    brake, steer = outbox.take()
    assert database.message("req_steer_pos").decode(steer.data)[:2] == (steer_counts, kmh)
    assert database.message("req_brake_pos").decode(brake.data)[0] == brake_counts


def test_the_brake_request_is_the_last_one_to_be_lost() -> None:
    gateway, outbox = ffi.new("raptor_gateway *"), Outbox(1)
    gateway.steer.known = True
    lib.raptor_gateway_send_requests(gateway, 0.0, 0.0, 0.0, outbox.c)
    assert [frame.id for frame in outbox.take()] == [database.message("req_brake_pos").frame_id]
    assert (outbox.c.dropped, gateway.brake_counter, gateway.steer_counter) == (1, 1, 0)
