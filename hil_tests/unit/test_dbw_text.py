"""Frames in words and bits in pictures, against what cantools does with the same bits."""

from __future__ import annotations

import pytest

from dbc.codec import MessageCodec, database
from dbc.errors import CodecError
from tools.dbw.frame_text import TextFrame, parse_frame
from tools.dbw.layout import LETTERS, describe, picture, places

MESSAGES = pytest.mark.parametrize("codec", list(database), ids=lambda codec: codec.name)


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        ("57A#2D07050000000000", TextFrame(0x57A, False, bytes.fromhex("2d07050000000000"))),
        ("57a#2d.07.05", TextFrame(0x57A, False, bytes.fromhex("2d0705"))),
        ("7FF#", TextFrame(0x7FF, False, b"")),
        ("000#FF", TextFrame(0, False, b"\xff")),
        ("1FFFFFFF#00", TextFrame(0x1FFFFFFF, True, b"\0")),
        ("0000057A#00", TextFrame(0x57A, True, b"\0")),
    ],
)
def test_a_frame_is_read_as_can_utils_write_it(text: str, frame: TextFrame):
    assert parse_frame(text) == frame
    assert parse_frame(str(frame)) == frame


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("57A", "must be like"),
        ("57A2D#00", "must be like"),
        ("57A#2D0", "must be like"),
        ("57A#2G", "must be like"),
        ("57A#2D..07", "must be like"),
        ("", "must be like"),
        ("800#00", "at most 7FF"),
        ("20000000#00", "at most 1FFFFFFF"),
        ("57A#R", "remote frame"),
        ("57A##100", "CAN FD"),
        ("57A#000000000000000000", "9 data bytes; at most 8"),
    ],
)
def test_what_is_no_frame_is_refused(text: str, words: str):
    with pytest.raises(CodecError, match=words):
        parse_frame(text)


@MESSAGES
def test_places_are_those_that_cantools_writes(codec: MessageCodec):
    """One bit of one signal at a time: cantools sets the bit that `places` names, and no other."""
    for signal in codec.definition.signals:
        for order, place in enumerate(reversed(places(signal))):
            raw = 1 << order
            if signal.is_signed and order == signal.length - 1:
                raw = -raw
            values = dict.fromkeys((other.name for other in codec.definition.signals), 0) | {signal.name: raw}
            data = codec.definition.encode(values, scaling=False, strict=False)
            assert int.from_bytes(data, "little") == 1 << place, (signal.name, order)


@MESSAGES
def test_every_signal_has_a_letter(codec: MessageCodec):
    assert len(codec.signals) <= len(LETTERS)


def test_picture_of_a_big_endian_signal_across_bytes():
    codec = database.message("pt_report_1")
    signals = dict(zip(LETTERS, codec.definition.signals, strict=False))
    (letter,) = (letter for letter, signal in signals.items() if signal.name == "engine_speed_rpm")
    lines = picture(signals, bytes.fromhex("c05d0105f781c348"))
    assert lines[0].split() == ["byte", *"76543210"]
    assert [line.split()[-1] for line in lines[1:]] == ["C0", "5D", "01", "05", "F7", "81", "C3", "48"]
    shown = "".join(cell[1] for line in lines[1:] for cell in line.split()[1:-1] if cell[0] == letter)
    assert int(shown, 2) == 6110  # read from left to right, as a person does


def test_form_of_a_signal():
    signals = {signal.name: describe(signal) for signal in database.message("steering_cmd").definition.signals}
    assert signals == {"steering_motor_ang_cmd": "0|11@1-", "steering_motor_cmd_counter": "16|8@1+"}
