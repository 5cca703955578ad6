"""The C codec, its Python binding and cantools agree: on random frames, at every boundary, on what they refuse.

Three implementations and a judge. The C codec is cantools' generated pack and unpack functions behind
dbc/codec_values.c. The binding is dbc/codec.py, frame by frame and in columns. cantools' own Python decoder is the
judge, and a slow one: so it judges some thousand frames of every message, all boundaries among them, and with them a
second decoder in numpy (layout_reference.py), written from the numbers of the DBC files. That one then stands in for
it on 100,000 random frames of every message. RACELOOP_CANTOOLS_FRAMES=100000 lets cantools judge all of them itself.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from cantools.autosar.end_to_end import compute_profile5_crc
from cantools.database.can import Message
from cantools.database.errors import EncodeError
from crccheck.crc import Crc16CcittFalse
from golden_frames import GOLDEN, GoldenFrame
from layout_reference import Data, boundary_values, physical_values, raw_values, used_bits
from numpy.typing import NDArray

from dbc._codec import ffi, lib
from dbc.codec import Codec, MessageCodec, database, profile
from dbc.errors import CodecError
from dbc.frames import FRAME_DTYPE, frame_array, iterate
from dbc.network import own_network, raw_limits

SEED = int(os.environ.get("RACELOOP_SEED", "20210107"))
FRAMES = 100_000
CANTOOLS_FRAMES = int(os.environ.get("RACELOOP_CANTOOLS_FRAMES", "500"))

V26 = profile("V26")
#: By profile and name.
DEFINITIONS = {
    (codec.profile, facts.message.name): facts.message
    for codec in (database, V26)
    for facts in own_network(profile=codec.profile)
}
#: Of V26 what is not V14's as well.
MESSAGES = [
    *(pytest.param(message, id=message.name) for message in database),
    *(pytest.param(message, id=f"V26.{message.name}") for message in V26 if message.database == "raptor_v26"),
]

#: What cantools raises, strict or not, when a value does not fit.
CANTOOLS_REFUSALS = (EncodeError, OverflowError, ValueError)


def codec_of(message: MessageCodec) -> Codec:
    return V26 if message.database == "raptor_v26" else database


def definition_of(message: MessageCodec) -> Message:
    return DEFINITIONS[codec_of(message).profile, message.name]


def generator(message: MessageCodec, stream: int) -> np.random.Generator:
    """Random numbers of one test of one message; prints how to get them again."""
    print(f"again: RACELOOP_SEED={SEED} python -m pytest {__file__} -k '{message.name}'")
    return np.random.default_rng([SEED, codec_of(message).number, message.index, stream])


def frames_of(message: MessageCodec, data: Data) -> NDArray[np.void]:
    """Frames of a message with these data bytes."""
    frames = np.zeros(len(data), dtype=FRAME_DTYPE)
    frames["id"], frames["bus"], frames["dlc"] = message.frame_id, message.bus, message.length
    frames["flags"] = int(message.extended)
    frames["data"] = data
    return frames


def cantools_encode(definition: Message, values: Mapping[str, float]) -> bytes:
    """cantools' encoding; not strict, since the declared ranges of the public layouts are wrong in places."""
    return definition.encode(dict(values), scaling=True, padding=False, strict=False).ljust(8, b"\0")


def cantools_decode(definition: Message, data: bytes) -> tuple[float, ...]:
    decoded = definition.decode(data, decode_choices=False, allow_excess=True)
    return tuple(float(decoded[signal.name]) for signal in definition.signals)


def c_decode(message: MessageCodec, data: bytes) -> tuple[float, ...]:
    values = ffi.new("double[]", len(message.signals))
    assert lib.codec_values_decode(codec_of(message).number, message.index, data, len(data), values) == lib.CODEC_OK
    return tuple(values)


def c_encode(message: MessageCodec, values: tuple[float, ...]) -> bytes:
    data = ffi.new("uint8_t[8]", [0xA5] * 8)
    assert (
        lib.codec_values_encode(codec_of(message).number, message.index, ffi.new("double[]", values), data)
        == lib.CODEC_OK
    )
    return bytes(data)


def check_with_cantools(message: MessageCodec, data: Data) -> None:
    """All implementations decode every row alike, and encode the result into the bits that it came from."""
    definition = definition_of(message)
    reference = physical_values(definition, data).T.tolist()
    kept = data & used_bits(definition)
    columns = message.columns(frames_of(message, data)).T.tolist()
    for row, content, bits, column in zip(reference, data, kept, columns, strict=True):
        values = cantools_decode(definition, content.tobytes())
        assert values == tuple(row) == tuple(column), content
        assert message.decode(content.tobytes()) == values, content
        expected = bits.tobytes()
        assert cantools_encode(definition, dict(zip(message.signals, values, strict=True))) == expected, content
        assert message.encode(*values) == expected, content


# --- layouts


@pytest.mark.parametrize("codec", [database, V26], ids=["V14", "V26"])
def test_messages_are_those_of_the_dbc_files(codec: Codec) -> None:
    definitions = {name: definition for (of, name), definition in DEFINITIONS.items() if of == codec.profile}
    assert [message.name for message in codec] == list(definitions)
    for message in codec:
        definition = definitions[message.name]
        assert message.signals == tuple(signal.name for signal in definition.signals)
        assert (message.frame_id, message.extended, message.length) == (
            definition.frame_id,
            definition.is_extended_frame,
            definition.length,
        )


@pytest.mark.parametrize("codec", [database, V26], ids=["V14", "V26"])
def test_no_two_messages_share_an_address(codec: Codec) -> None:
    addresses = {(message.bus, message.extended, message.frame_id) for message in codec}
    assert len(addresses) == len(codec)


# --- random frames


@pytest.mark.parametrize("message", MESSAGES)
def test_random_frames_as_cantools_has_them(message: MessageCodec) -> None:
    check_with_cantools(message, generator(message, 0).integers(0, 256, (CANTOOLS_FRAMES, 8), dtype=np.uint8))


@pytest.mark.parametrize("message", MESSAGES)
def test_every_bit_alone(message: MessageCodec) -> None:
    """One bit set and one bit clear, bits of no signal among them."""
    bits = np.eye(64, dtype=np.uint8)
    walks = np.concatenate([bits, 1 - bits, np.zeros((1, 64), np.uint8), np.ones((1, 64), np.uint8)])
    check_with_cantools(message, np.packbits(walks, axis=1, bitorder="little"))


@pytest.mark.parametrize("message", MESSAGES)
def test_a_hundred_thousand_random_frames(message: MessageCodec) -> None:
    definition = definition_of(message)
    data = generator(message, 1).integers(0, 256, (FRAMES, 8), dtype=np.uint8)
    frames = frames_of(message, data)
    columns = message.columns(frames)
    assert np.array_equal(columns, physical_values(definition, data))
    (decoded,) = codec_of(message).decode_columns(frames).values()
    for signal, column in zip(message.signals, columns, strict=True):
        assert np.array_equal(decoded[signal][1], column)
    encoded = frame_array(message.frames(columns.T))
    assert np.array_equal(encoded["data"], data & used_bits(definition))
    for field in ("id", "bus", "dlc", "flags"):
        assert np.array_equal(encoded[field], frames[field])


@pytest.mark.parametrize("message", MESSAGES)
def test_random_values_between_the_steps_round_alike(message: MessageCodec) -> None:
    """Physical values off the grid, as controllers compute them; single frames and batch must agree."""
    definition = definition_of(message)
    limits = [message.limits(name) for name in message.signals]
    random = generator(message, 2)
    rows = np.column_stack([random.uniform(low, high, 200) for low, high in limits])
    batch = [frame.data for frame in iterate(message.frames(rows))]
    assert batch == [cantools_encode(definition, dict(zip(message.signals, row, strict=True))) for row in rows.tolist()]
    assert batch == [message.encode(*row) for row in rows.tolist()]


# --- boundaries


def boundary_rows(definition: Message) -> Iterator[tuple[int, ...]]:
    """Each signal at each of its boundaries, with all others at their lowest, then at their highest value."""
    limits = [raw_limits(signal) for signal in definition.signals]
    for background in (0, 1):
        base = [ends[background] for ends in limits]
        for index, signal in enumerate(definition.signals):
            for value in boundary_values(signal):
                yield (*base[:index], value, *base[index + 1 :])


@pytest.mark.parametrize("message", MESSAGES)
def test_boundary_values(message: MessageCodec) -> None:
    definition = definition_of(message)
    for raw in boundary_rows(definition):
        values = tuple(s.scale * value + s.offset for s, value in zip(definition.signals, raw, strict=True))
        data = c_encode(message, values)
        assert data == message.encode(*values)
        assert data == cantools_encode(definition, dict(zip(message.signals, values, strict=True))), raw
        assert c_decode(message, data) == message.decode(data) == cantools_decode(definition, data) == values, raw
        content = np.frombuffer(data, dtype=np.uint8)[None, :]
        assert tuple(int(raw_values(signal, content)[0]) for signal in definition.signals) == raw


# --- refusals


@pytest.mark.parametrize("message", MESSAGES)
def test_what_the_bits_do_not_hold_is_refused(message: MessageCodec) -> None:
    """The generated C would wrap these silently; each signal alone must be refused, by name, and by cantools too."""
    definition = definition_of(message)
    lowest = [message.limits(name)[0] for name in message.signals]
    for index, signal in enumerate(definition.signals):
        low, high = raw_limits(signal)
        for raw in (low - 1, high + 1, low - 0.51, high + 0.51, math.nan, math.inf, -math.inf):
            values = list(lowest)
            values[index] = signal.scale * raw + signal.offset
            untouched = ffi.new("uint8_t[8]")
            assert (
                lib.codec_values_encode(codec_of(message).number, message.index, ffi.new("double[]", values), untouched)
                == index + 1
            )
            assert bytes(untouched) == bytes(8), "a refused value leaves no data"
            with pytest.raises(CodecError, match=rf"^{message.name}\.{signal.name}: "):
                message.encode(*values)
            with pytest.raises(CodecError, match=rf"^row 1: {message.name}\.{signal.name}: "):
                message.frames([lowest, values])
            with pytest.raises(CANTOOLS_REFUSALS):
                cantools_encode(definition, dict(zip(message.signals, values, strict=True)))
        for raw in (low - 0.49, high + 0.49):  # still rounds to the last step
            values = list(lowest)
            values[index] = signal.scale * raw + signal.offset
            expected = cantools_encode(definition, dict(zip(message.signals, values, strict=True)))
            assert message.encode(*values) == expected


def test_a_value_half_way_between_two_steps_is_where_cantools_differs() -> None:
    """C rounds it away from zero, Python to the even step: one step apart every other time, and at the very end."""
    brake, steer = database.message("brake_pressure_cmd"), database.message("steering_cmd")
    halves = {0.5: (1, 0), 1.5: (2, 2), 2.5: (3, 2), 3.5: (4, 4), 8190.5: (8191, 8190)}
    for value, (ours, theirs) in halves.items():
        named = {"brake_pressure_cmd": value, "brk_pressure_cmd_counter": 0.0}
        assert brake.decode(brake.encode(*named.values()))[0] == ours
        assert cantools_decode(brake.definition, cantools_encode(brake.definition, named))[0] == theirs
    below = {"steering_motor_ang_cmd": -512.25, "steering_motor_cmd_counter": 0.0}
    assert cantools_decode(steer.definition, cantools_encode(steer.definition, below))[0] == -512
    with pytest.raises(CodecError):
        steer.encode(*below.values())


def test_declared_ranges_are_where_strict_cantools_differs() -> None:
    """It goes by the range that the file declares: refuses what the bits hold, and lets pass what they do not."""
    bounded, wide = database.message("ct_report"), database.message("steering_cmd")
    counter = dict.fromkeys(bounded.signals, 0.0) | {"ct_state_rolling_counter": 10.0}
    with pytest.raises(EncodeError, match="ct_state_rolling_counter"):
        bounded.definition.encode(counter, strict=True)
    assert bounded.encode(*counter.values()) == cantools_encode(bounded.definition, counter)
    angle = {"steering_motor_ang_cmd": 600.0, "steering_motor_cmd_counter": 0.0}
    with pytest.raises(OverflowError):  # from the packer behind cantools: the range check had no objection
        wide.definition.encode(angle, strict=True)
    with pytest.raises(CodecError, match=r"allowed is -512 to 511\.5"):
        wide.encode(*angle.values())


@pytest.mark.parametrize("message", MESSAGES)
def test_frames_that_are_too_short_are_refused(message: MessageCodec) -> None:
    values = ffi.new("double[]", [77.0] * len(message.signals))
    for length in range(message.length):
        assert (
            lib.codec_values_decode(codec_of(message).number, message.index, bytes(8), length, values)
            == lib.CODEC_SHORT_FRAME
        )
        assert list(values) == [77.0] * len(message.signals)
        with pytest.raises(CodecError):
            message.decode(bytes(length))
    assert message.decode(bytes(message.length)) == message.decode(bytes(8))


# --- facts from elsewhere


@pytest.mark.parametrize("golden", [pytest.param(golden, id=golden.message) for golden in GOLDEN])
def test_golden_frames(golden: GoldenFrame) -> None:
    message = database.message(golden.message)
    definition = definition_of(message)
    assert set(golden.values) <= set(message.signals)
    data = bytes.fromhex(golden.data)
    assert len(data) == message.length
    values = tuple(golden.values.get(signal, 0.0) for signal in message.signals)
    padded = data.ljust(8, b"\0")
    assert c_encode(message, values) == message.encode(*values) == padded
    assert cantools_encode(definition, dict(zip(message.signals, values, strict=True))) == padded
    decoded = message.decode(data)
    assert decoded == c_decode(message, data) == cantools_decode(definition, data)
    assert decoded == pytest.approx(values, abs=1e-9)


def test_the_crc_is_the_catalogues_and_that_of_autosar_profile_5() -> None:
    """Profile 5 has its CRC in front and a data id behind the data; ours has it at the end and the CAN id there."""
    assert lib.codec_crc16(0xFFFF, b"123456789", 9) == Crc16CcittFalse.calc(b"123456789") == 0x29B1
    random = np.random.default_rng(SEED)
    protected = [message for message in database if lib.codec_table[message.index].crc_length]
    assert {"req_steer_pos", "req_brake_pos", "calb_steer_pos_1", "calb_brake_pos_3"} <= {m.name for m in protected}
    for message in protected:
        facts = database.facts(message.name)
        assert facts.crc is not None
        start = facts.crc.start // 8
        for data in random.integers(0, 256, (200, 8), dtype=np.uint8):
            (frame,) = iterate(message.finish(frames_of(message, data[None, :]).tobytes(), int(data[0])))
            crc = int.from_bytes(frame.data[start : start + 2], "little")
            content = frame.data[:start]
            assert crc == compute_profile5_crc(bytes(2) + content, message.frame_id)
            assert crc == Crc16CcittFalse.calc(content + message.frame_id.to_bytes(2, "little"))
