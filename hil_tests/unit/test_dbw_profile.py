"""firmware/common/dbw_profile.c: V26 on the wire, V14 inside; nothing is invented, nothing that stops goes on."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable
from fractions import Fraction

import pytest
from actuator_ecus import STEERED_BRAKE, Car, Messages, car_in
from dbw_wire import Wire
from frame_fuzz import announce, seeds
from obc_harness import ObcHarness

from bridge._native import ffi, lib
from dbc.codec import MessageCodec, database, profile
from dbc.frames import FRAME_STRUCT, Bus, Flag, Frame, Station, iterate
from dbc.network import own_network, raw_limits

V26 = profile("V26")
DEFINITIONS = {facts.message.name: facts.message for facts in own_network(profile="V26")}
CAN1 = [message for message in database if message.bus == Bus.CAN1]

#: Messages whose V14 signals V26 has in other places, or not at all.
RESHAPED = {"brake_pressure_cmd", "steering_report", "steering_report_extd"}

FRONT, REAR = 54, 46


def random_frame(message: MessageCodec, generator: random.Random) -> bytes:
    raw = {item.name: generator.randint(*raw_limits(item)) for item in message.definition.signals}
    data = message.definition.encode(raw, scaling=False, strict=False)
    return Frame(0, message.frame_id, message.bus, message.length, 0, message.sender, data.ljust(8, b"\0")).pack()


def decoded(frame: Frame, codec: MessageCodec) -> dict[str, float]:
    """Signals as cantools reads them, which knows nothing of the C."""
    definition = DEFINITIONS[codec.name] if codec.database == "raptor_v26" else codec.definition
    values = definition.decode(frame.data[: frame.dlc], decode_choices=False)
    assert isinstance(values, dict)
    return {name: float(str(value)) for name, value in values.items()}


def v26_frame(name: str, **values: float) -> bytes:
    message = V26.message(name)
    return message.frame(*(values.get(signal, 0.0) for signal in message.signals))


def test_what_is_not_reshaped_has_its_bits_in_both_layouts() -> None:
    """That is why the translation may leave them as they are."""
    for message in CAN1:
        if message.name in RESHAPED:
            continue
        twin = V26.message(message.name)
        assert twin.frame_id == message.frame_id
        assert twin.length >= message.length
        others = {item.name: item for item in twin.definition.signals}
        for item in message.definition.signals:
            other = others[item.name]
            assert (item.start, item.length, item.byte_order, item.is_signed, item.scale, item.offset) == (
                *(other.start, other.length, other.byte_order, other.is_signed, other.scale, other.offset),
            ), item.name


def test_a_profile_that_there_is_not_changes_nothing() -> None:
    wire = Wire()
    assert not lib.dbw_profile_select(wire.c, 2)
    assert wire.c.index == V26.number
    assert wire.receive(v26_frame("novatel_report"))[0] == lib.DBW_PROFILE_NOTHING
    assert lib.dbw_profile_select(wire.c, 0)
    assert wire.receive(v26_frame("novatel_report"))[0] == lib.DBW_PROFILE_FRAME


def test_v14_passes_untouched() -> None:
    """Whatever it is: the ECUs judge V14 themselves."""
    generator, wire = random.Random(14), Wire("V14")
    frames = [FRAME_STRUCT.pack(*(generator.getrandbits(bits) for bits in (64, 32, 8, 8, 8, 8)), generator.randbytes(8))
              for _ in range(500)]  # fmt: skip
    assert [frame.pack() for frame in wire.send(frames)] == frames
    assert [wire.receive(frame) for frame in frames] == [
        (lib.DBW_PROFILE_FRAME, next(iterate(frame))) for frame in frames
    ]
    assert list(wire.c.refused) == [0] * lib.CODEC_STATUS_COUNT


@pytest.mark.parametrize("message", [m for m in CAN1 if m.name not in RESHAPED], ids=lambda message: message.name)
def test_every_message_goes_out_and_comes_back(message: MessageCodec) -> None:
    generator = random.Random(message.name)
    twin, sender, receiver = V26.message(message.name), Wire(), Wire()
    for _ in range(50):
        frame = random_frame(message, generator)
        (sent,) = sender.send([frame])
        assert (sent.id, sent.bus, sent.dlc, sent.flags) == (message.frame_id, Bus.CAN1, twin.length, 0)
        before, values = decoded(next(iterate(frame)), message), decoded(sent, twin)
        added = {"brake_bias_aim_switch": 9.0} if message.name == "dash_switches_cmd" else {}
        assert values == dict.fromkeys(twin.signals, 0.0) | before | added
        verdict, back = receiver.receive(sent.pack())
        assert (verdict, back.dlc) == (lib.DBW_PROFILE_FRAME, message.length)
        assert decoded(back, message) == before


# --- brake


def split(pressure: int) -> int:
    """Rear pressure to the nearest kPa; none is halfway, because 46/54 in lowest terms is 23/27, and 27 is odd."""
    return math.floor(Fraction(pressure * REAR, FRONT) + Fraction(1, 2))


def test_every_brake_command_is_split_by_the_balance_and_joined_again() -> None:
    sender, receiver = Wire(), Wire()
    share = lib.raptor_config_default.brake_axle_share
    assert share[0] == 1.0
    assert share[1] == pytest.approx(REAR / FRONT, rel=1e-6), "the balance that the Raptor expects of the lines"
    message, twin = database.message("brake_pressure_cmd"), V26.message("brake_pressure_cmd")
    frames = message.frames([(pressure, pressure % 256) for pressure in range(8192)])
    for pressure, frame in enumerate(sender.send([frames])):
        assert twin.decode(frame.data) == (pressure, split(pressure), pressure % 256)
        assert message.decode(receiver.receive(frame.pack())[1].data) == (pressure, pressure % 256)


def test_no_axle_brakes_less_than_it_is_asked_to() -> None:
    """And no more than that needs, for any pair of pressures."""
    generator, wire = random.Random(26), Wire()
    ends = (0, 1, 2000, 5111, 6000, 6976, 6977, 6978, 6979, 8190, 8191)
    pairs = [(front, rear) for front in ends for rear in ends]
    pairs += [(generator.randint(0, 8191), generator.randint(0, 8191)) for _ in range(3000)]
    message = database.message("brake_pressure_cmd")
    for front, rear in pairs:
        frame = v26_frame(
            "brake_pressure_cmd", F_brake_pressure_cmd=front, R_brake_pressure_cmd=rear, brk_pressure_cmd_counter=7
        )
        pressure, counter = message.decode(wire.receive(frame)[1].data)
        assert counter == 7
        least = max(front, 0 if rear <= split(front) else math.ceil(Fraction(rear * FRONT, REAR)))
        assert pressure == min(least, 8191), (front, rear)
        if pressure < 8191:
            assert pressure >= front
            assert pressure * REAR >= (rear - 1) * FRONT


# --- steering


def steering(counter: int) -> bytes:
    return v26_frame("steering_report", steering_motor_fdbk_counter=counter)


def angles(average: float) -> bytes:
    return v26_frame("steering_report_extd", average_steering_ang_fdbk=average, primary_steering_angle_fbk=99.0)


def reports(frames: Iterable[bytes]) -> list[tuple[float, ...]]:
    message = database.message("steering_report")
    received = Wire().receive_all(frames)
    assert all((frame.id, frame.dlc) == (message.frame_id, message.length) for frame in received)
    return [message.decode(frame.data) for frame in received]


def test_a_steering_report_takes_a_new_counter_and_a_new_angle() -> None:
    assert reports([steering(5), angles(-105.5)]) == [(-105.5, 5)]
    assert reports([steering(5), angles(1.0), steering(6), angles(2.0)]) == [(1.0, 5), (2.0, 6)]
    assert reports([angles(1.0), steering(5), angles(2.0)]) == [(2.0, 5)], "none before the first counter"
    assert reports([steering(5), angles(1.0), angles(2.0), angles(3.0)]) == [(1.0, 5)], (
        "the counter's frame has stopped"
    )
    assert reports([steering(5), angles(1.0), steering(6), steering(7)]) == [(1.0, 5)], "the angle's frame has stopped"
    assert reports([steering(5), steering(6), angles(1.0)]) == [(1.0, 6)], "the newest counter"
    assert reports([steering(5), angles(1.0), steering(5), angles(2.0)]) == [(1.0, 5), (2.0, 5)], "it stands, and shows"


@pytest.mark.parametrize("seed", seeds(2))
def test_steering_reports_are_pairs_whatever_is_lost(seed: int) -> None:
    generator = announce("test_steering_reports_are_pairs_whatever_is_lost", seed)
    frames, expected, pending = [], [], None
    for _ in range(2000):
        counter, angle = generator.randrange(256), generator.randint(-1024, 1023) / 2
        if generator.random() < 0.5:
            frames.append(steering(counter))
            pending = counter
        else:
            frames.append(angles(angle))
            if pending is not None:
                expected.append((angle, float(pending)))
            pending = None
    assert reports(frames) == expected


def test_the_average_leaves_once_with_two_of_three_sensors() -> None:
    report, sensors = database.message("steering_report"), database.message("steering_report_extd")
    wire, twin = Wire(), V26.message("steering_report_extd")
    both = [report.frame(-105.5, 17), sensors.frame(-105.5, -105.0, -106.0)]
    first, second = wire.send(both)
    assert V26.message("steering_report").decode(first.data[: first.dlc]) == (0, 17, 0)
    assert twin.decode(second.data[: second.dlc]) == (-105.5, -105.0, -105.5)
    assert (first.dlc, second.dlc) == (8, 6)
    assert wire.send([both[1]]) == [], "an average that is not new does not leave"
    third = wire.send([both[1], both[0], both[1]])
    assert [frame.id for frame in third] == [1303, 1312]
    (other,) = Wire().receive_all(frame.pack() for frame in (first, second))
    assert report.decode(other.data) == (-105.5, 17)


def test_rates_are_those_of_the_ecu_and_never_wrap() -> None:
    wire, message = Wire(), V26.message("steering_report")
    report = database.message("steering_report").frame(0, 1)
    for rate, shown in ((0.1, 5.7), (-8.726646, -500.0), (1e4, 3276.7), (-1e4, -3276.7), (math.inf, 3276.7)):
        wire.c.rates.primary, wire.c.rates.commanded = rate, -rate
        (frame,) = wire.send([report])
        assert message.decode(frame.data) == pytest.approx((shown, 1, -shown))


# --- what does not belong


def test_the_reports_that_v26_alone_has_are_not_for_v14() -> None:
    names = {message.name for message in V26} - {message.name for message in database}
    assert len(names) == 6
    wire = Wire()
    for name in names:
        assert wire.receive(v26_frame(name))[0] == lib.DBW_PROFILE_NOTHING
    assert list(wire.c.refused) == [0] * lib.CODEC_STATUS_COUNT


@pytest.mark.parametrize("message", [m for m in V26 if m.bus == Bus.CAN1], ids=lambda message: message.name)
def test_a_short_or_strange_frame_is_refused_and_counted(message: MessageCodec) -> None:
    wire = Wire()
    frame = next(iterate(message.frame(*(message.limits(name)[0] for name in message.signals))))
    for change, status in (
        ({"dlc": message.length - 1}, lib.CODEC_SHORT_FRAME),
        ({"dlc": 0}, lib.CODEC_SHORT_FRAME),
        ({"flags": Flag.REMOTE}, lib.CODEC_REMOTE_FRAME),
        ({"flags": Flag.ERROR}, lib.CODEC_ERROR_FRAME),
        ({"flags": Flag.EXTENDED}, lib.CODEC_UNKNOWN_ID),
        ({"id": 0x7FF}, lib.CODEC_UNKNOWN_ID),
    ):
        before = list(wire.c.refused)
        assert wire.receive(frame._replace(**change).pack())[0] == lib.DBW_PROFILE_REFUSED
        before[-status] += 1
        assert list(wire.c.refused) == before
    assert wire.receive(frame._replace(dlc=15).pack())[0] != lib.DBW_PROFILE_REFUSED


def test_other_buses_and_what_was_sent_before_are_left_alone() -> None:
    wire = Wire()
    request = database.message("req_steer_pos").frame(0x4000, 50, 1, 0, 3, 0)
    unknown = Frame(0, 1303, Bus.CAN_A, 2, 0, Station.NONE, bytes(8))
    for frame in (request, unknown.pack()):
        assert wire.receive(frame) == (lib.DBW_PROFILE_FRAME, next(iterate(frame)))
        assert [sent.pack() for sent in wire.send([frame])] == [frame]
    assert wire.send([Frame(0, 1299, Bus.CAN1, 8, 0, Station.NONE, bytes(8)).pack()]) == [], "no message of CAN1"
    brake = database.message("brake_pressure_cmd").frame(2750, 6)
    kept, changed = wire.send([brake, brake], keep=1)
    assert kept.pack() == brake
    assert changed.data.hex() == "be0a270900060000"


@pytest.mark.parametrize("seed", seeds(2))
def test_any_frame_gives_at_most_one_that_v14_accepts(seed: int) -> None:
    generator = announce("test_any_frame_gives_at_most_one_that_v14_accepts", seed)
    wire, message = Wire(), ffi.new("const codec_message **")
    identifiers = [codec.frame_id for codec in V26 if codec.bus == Bus.CAN1] + list(range(1290, 1360))
    seen = dict.fromkeys((lib.DBW_PROFILE_FRAME, lib.DBW_PROFILE_NOTHING, lib.DBW_PROFILE_REFUSED), 0)
    for _ in range(5000):
        flags = generator.choice((0, 0, 0, 0, generator.getrandbits(8)))
        header = (0, generator.choice(identifiers), Bus.CAN1, generator.randint(0, 9), flags, 0)
        verdict, frame = wire.receive(FRAME_STRUCT.pack(*header, generator.randbytes(8)))
        seen[verdict] += 1
        if verdict == lib.DBW_PROFILE_FRAME:
            c_frame = ffi.new("can_frame *")
            ffi.buffer(c_frame)[:] = frame.pack()
            assert lib.codec_accept(c_frame, message) == lib.CODEC_OK
            assert frame.dlc == message[0].dlc
    assert min(seen.values()) > 100
    assert sum(wire.c.refused) == seen[lib.DBW_PROFILE_REFUSED]


# --- the ECUs


def with_v26_raptor(harness: ObcHarness, change: Callable[[list[Frame]], list[Frame]]) -> None:
    """Let the onboard computer of a harness hear V26, from a Raptor whose frames `change` may spoil."""
    wire = Wire()
    harness.signals["steering_report_extd"] = {}
    harness.periods["steering_report_extd"] = 10_000
    assert lib.obc_select_profile(harness.obc, V26.number)

    def apply(frames: bytes) -> bytes:
        mine = [frame for frame in iterate(frames) if frame.bus == Bus.CAN1]
        rest = [frame for frame in iterate(frames) if frame.bus != Bus.CAN1]
        sent = change(wire.send(frame.pack() for frame in sorted(mine, key=lambda frame: frame.id)))
        return b"".join(frame.pack() for frame in [*sent, *rest])

    harness.filters.append(apply)


def counter_held(frames: list[Frame]) -> list[Frame]:
    return [f._replace(data=f.data[:2] + b"\7" + f.data[3:]) if f.id == 1303 else f for f in frames]


@pytest.mark.parametrize(
    ("fault", "spoil"),
    [
        ("STEERING_REPORT_MISSING", lambda frames: [frame for frame in frames if frame.id != 1303]),
        ("STEERING_REPORT_MISSING", lambda frames: [frame for frame in frames if frame.id != 1312]),
        ("STEERING_REPORT_MISSING", counter_held),
        ("SECOND_COMPUTER", lambda frames: [*frames, *iterate(v26_frame("brake_pressure_cmd"))]),
        ("MISC_REPORT_MISSING", lambda frames: [f._replace(dlc=5) if f.id == 1304 else f for f in frames]),
    ],
    ids=["no 1303", "no 1312", "counter stands", "another computer", "misc_report of V14"],
)
def test_the_onboard_computer_misses_what_stops(fault: str, spoil: Callable[[list[Frame]], list[Frame]]) -> None:
    harness, spoilt = ObcHarness(), False
    with_v26_raptor(harness, lambda frames: spoil(frames) if spoilt else frames)
    harness.signals["steering_report"] = {"steering_motor_ang_avg_fdbk": -45.0}
    harness.launch()
    assert harness.obc.vehicle.control.road_wheel_angle == pytest.approx(math.radians(-3.0), rel=1e-5)
    assert harness.active_faults() == set()
    spoilt = True
    harness.run(30)
    assert harness.active_faults() >= {getattr(lib, f"FAULT_{fault}")}
    refused = harness.obc.rejected_frames
    assert refused == (30 if fault == "MISC_REPORT_MISSING" else 0)


def speak(car: Car, change: Callable[[list[Frame]], list[Frame]]) -> None:
    """Let the Raptor of a car speak V26, to an onboard computer that speaks what `change` makes of V26."""
    assert lib.raptor_select_profile(car.c, V26.number)
    wire, commands = Wire(), car.computer.frames
    car.computer.frames = lambda: [frame.pack() for frame in change(wire.send(commands()))]  # type: ignore[method-assign]


def test_the_raptor_drives_by_v26_and_stops_when_a_counter_stands() -> None:
    spoilt = False

    def hold_counter(frames: list[Frame]) -> list[Frame]:
        return [f._replace(data=f.data[:5] + b"\7" + f.data[6:]) if f.id == 1400 else f for f in frames]

    car = car_in(lib.RAPTOR_SYS_DRIVING)
    speak(car, lambda frames: hold_counter(frames) if spoilt else frames)
    car.set_wheels(20.0)
    car.computer.steer_deg, car.computer.brake_kpa, car.computer.accelerator = 10.0, 0.0, 30.0
    sent = Messages([])
    for _ in range(20):
        sent = car.tick()
    assert car.state == lib.RAPTOR_SYS_DRIVING
    assert car.drive.throttle_demand == pytest.approx(0.3)
    by_id = {frame.id: frame for frame in sent.frames if frame.bus == Bus.CAN1}
    assert all(by_id[m.frame_id].dlc == m.length for m in V26 if m.frame_id in by_id and m.bus == Bus.CAN1)
    assert set(by_id) & {1313, 1314, 1315, 1316, 1344, 1350} == set()
    assert decoded(by_id[1312], V26.message("steering_report_extd")) == dict.fromkeys(
        V26.message("steering_report_extd").signals, 10.0
    )
    car.computer.steer_deg = 12.0
    car.tick()
    rates = [decoded(f, V26.message("steering_report")) for _ in range(3) for f in car.tick().frames if f.id == 1303]
    assert max(rate["primary_steering_angular_rate"] for rate in rates) == pytest.approx(200.0, abs=3.0)
    spoilt = True
    for _ in range(13):
        car.tick()
    assert car.c.commands.faults & lib.RAPTOR_COMMAND_BRAKE_TIMEOUT
    assert car.c.commands.faults & lib.RAPTOR_COMMAND_COUNTER_STUCK
    assert car.state == lib.RAPTOR_SYS_EMERGENCY_SHUTDOWN
    assert car.space_drive.drive.brake_pressure_demand == pytest.approx(STEERED_BRAKE, abs=200)


def test_the_raptor_does_not_take_v14_for_v26() -> None:
    """A V14 brake command has no counter where V26 has it: it never moves, and the car stops."""
    car = car_in(lib.RAPTOR_SYS_DRIVING)
    assert lib.raptor_select_profile(car.c, V26.number)
    car.run(15)
    assert car.c.commands.brake_rx.last_status == lib.CODEC_COUNTER_STUCK
    assert car.state == lib.RAPTOR_SYS_EMERGENCY_SHUTDOWN
