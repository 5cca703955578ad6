"""The hub's reading and writing of socketcand text: against a plain reference, and against python-can's own."""

from __future__ import annotations

import random
import re
from dataclasses import dataclass

import can
import pytest
from can.interfaces.socketcand.socketcand import (
    convert_ascii_message_to_can_message,
    convert_can_message_to_ascii_message,
)

from bridge._native import ffi, lib
from dbc.frames import FRAME_STRUCT, Flag, Frame

SEED = 20
CHANNELS = {"CAN1": 0, "CAN3": 1, "CANA": 2, "CANS": 3, "CANR": 4} | {f"vcan{number}": number for number in range(5)}
BLANKS = " \t\r\n"
NO_FRAME = Frame(0, 0, 0, 0, 0, 0, bytes(8))


@dataclass(frozen=True)
class Read:
    """What was understood: characters taken, kind, bus, frame."""

    taken: int
    kind: int
    bus: int = 0
    frame: Frame = NO_FRAME


def read(text: str) -> Read:
    """By the hub."""
    raw = text.encode("latin-1")
    request = ffi.new("socketcand_request *")
    taken = lib.socketcand_read(raw, len(raw), request)
    frame = Frame._make(FRAME_STRUCT.unpack(bytes(ffi.buffer(ffi.addressof(request, "frame")))))
    return Read(taken, request.kind, request.bus, frame)


def reference(text: str) -> Read:
    """By regular expressions."""
    blank = len(text) - len(text.lstrip(BLANKS))
    rest = text[blank:]
    if not rest:
        return Read(blank, lib.SOCKETCAND_INCOMPLETE)
    whole = re.match(r"<([ \t\r\n!-;=?-~]*)>", rest)
    if whole is None or whole.end() > lib.SOCKETCAND_REQUEST_MAX:
        begun = re.fullmatch(r"<[ \t\r\n!-;=?-~]*", rest) and len(rest) <= lib.SOCKETCAND_REQUEST_MAX
        return Read(blank, lib.SOCKETCAND_INCOMPLETE) if begun else Read(len(text), lib.SOCKETCAND_GARBAGE)
    taken = blank + whole.end()
    match re.findall(r"[^ \t\r\n]+", whole[1]):
        case ["open", channel] if channel in CHANNELS:
            return Read(taken, lib.SOCKETCAND_OPEN, CHANNELS[channel])
        case ["open", _]:
            return Read(taken, lib.SOCKETCAND_UNKNOWN_CHANNEL)
        case ["rawmode"]:
            return Read(taken, lib.SOCKETCAND_RAWMODE)
        case ["echo"]:
            return Read(taken, lib.SOCKETCAND_ECHO)
        case ["bcmmode" | "controlmode" | "isotpmode"]:
            return Read(taken, lib.SOCKETCAND_OTHER_MODE)
        case ["send", *words]:
            frame = reference_frame(words)
            if frame is None:
                return Read(taken, lib.SOCKETCAND_BAD_SEND)
            return Read(taken, lib.SOCKETCAND_SEND, 0, frame)
    return Read(taken, lib.SOCKETCAND_UNKNOWN)


def reference_frame(words: list[str]) -> Frame | None:
    line = re.fullmatch(
        r"(?:([01]?[0-9A-F]{7})|([0-7]?[0-9A-F]{1,2})) ([0-8])((?: [0-9A-F]{1,2})*)", " ".join(words), re.I
    )
    if line is None or (line[1] is not None and len(words[0]) != 8):
        return None
    data = bytes(int(word, 16) for word in line[4].split())
    if len(data) != int(line[3]):
        return None
    return Frame(0, int(words[0], 16), 0, len(data), Flag.EXTENDED if line[1] else 0, 0, data.ljust(8, b"\0"))


WORDS = [
    *CHANNELS,
    *("open", "rawmode", "echo", "send", "bcmmode", "controlmode", "isotpmode", "Send", "can0", "CAN", "CAN12"),
    *(
        "0",
        "1",
        "7",
        "8",
        "9",
        "08",
        "7FF",
        "800",
        "7ff",
        "123",
        "0123",
        "12345678",
        "1FFFFFFF",
        "20000000",
        "FFFFFFFF",
    ),
    *("00", "a", "FF", "fF", "g", "0x1", "-1", "+1", "100", "é", "\x00", "\x7f"),
]


def random_request(generator: random.Random) -> str:
    kind = generator.random()
    if kind < 0.4:
        digits = generator.choice([1, 2, 3, 3, 3, 4, 7, 8, 8, 8, 9])
        length = generator.randrange(10)
        spoken = [f"{generator.getrandbits(4 * digits):0{digits}x}", str(length)]
        spoken += [f"{generator.randrange(256):x}" for _ in range(length + generator.choice([0, 0, 0, -1, 1]))]
        words = ["send", *spoken]
    elif kind < 0.5:
        words = ["open", generator.choice(list(CHANNELS))]
    else:
        words = generator.choices(WORDS, k=generator.randrange(5))
    blanks = [generator.choice([" ", " ", " ", "  ", "\t", "\n", "\r\n"]) for _ in words]
    text = "<" + "".join(blank + word for blank, word in zip(blanks, words, strict=True))
    text += generator.choice([" >", " >", ">", "", " " * generator.randrange(150) + ">"])
    return generator.choice(["", "", " ", "\r\n"]) + text


def mutated(generator: random.Random, text: str) -> str:
    characters = list(text)
    for _ in range(generator.randrange(3)):
        place = generator.randrange(len(characters) + 1)
        characters[place : place + generator.randrange(2)] = generator.choice("<> x0\x00\xff\n")
    return "".join(characters)


def test_random_text_is_read_as_the_reference_reads_it():
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    seen = dict.fromkeys(range(lib.SOCKETCAND_GARBAGE + 1), 0)
    for _ in range(30_000):
        text = random_request(generator)
        if generator.random() < 0.4:
            text = mutated(generator, text + random_request(generator))
        result = read(text)
        assert result == reference(text), text
        seen[result.kind] += 1
    assert all(count > 20 for count in seen.values()), seen


def test_random_bytes_are_read_as_the_reference_reads_them():
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    for _ in range(5_000):
        text = "<" * generator.randrange(2) + generator.randbytes(generator.randrange(300)).decode("latin-1")
        assert read(text) == reference(text), text


@pytest.mark.parametrize("length", range(lib.SOCKETCAND_REQUEST_MAX - 2, lib.SOCKETCAND_REQUEST_MAX + 3))
def test_the_longest_request_ends_with_its_last_character(length: int):
    for text in ("<echo" + " " * (length - 6) + ">", "<" + "x" * (length - 2) + ">", "<" + "x" * (length - 1)):
        assert len(text) == length
        assert read(text) == reference(text)
    fits = length <= lib.SOCKETCAND_REQUEST_MAX
    assert (read("<echo" + " " * (length - 6) + ">").kind == lib.SOCKETCAND_ECHO) == fits


def test_text_in_pieces_is_read_as_in_one():
    """A request that has not ended is left alone, until what has come so far cannot become one."""
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    for _ in range(2_000):
        text = mutated(generator, random_request(generator))
        whole = read(text)
        for end in range(len(text)):
            part = read(text[:end])
            if part.kind == lib.SOCKETCAND_INCOMPLETE:
                assert text[: part.taken].strip(BLANKS) == ""
            elif part.kind == lib.SOCKETCAND_GARBAGE:
                assert whole.kind == lib.SOCKETCAND_GARBAGE
            else:
                assert part == whole
                break


def messages(generator: random.Random, count: int) -> list[can.Message]:
    result = []
    for _ in range(count):
        extended = generator.random() < 0.5
        result.append(
            can.Message(
                arbitration_id=generator.getrandbits(29 if extended else 11),
                is_extended_id=extended,
                data=generator.randbytes(generator.randrange(9)),
            )
        )
    return result


def test_what_python_can_sends_is_understood():
    print(f"seed {SEED}")
    for message in messages(random.Random(SEED), 2_000):
        text = convert_can_message_to_ascii_message(message)
        result = read(text)
        assert (result.kind, result.taken) == (lib.SOCKETCAND_SEND, len(text))
        assert result.frame == Frame(
            0,
            message.arbitration_id,
            0,
            message.dlc,
            Flag.EXTENDED if message.is_extended_id else 0,
            0,
            bytes(message.data).ljust(8, b"\0"),
        )


def write(frame: Frame, wall_us: int) -> str:
    text = ffi.new("char[]", lib.SOCKETCAND_FRAME_MAX)
    length = lib.socketcand_write(text, ffi.from_buffer("can_frame *", frame.pack()), wall_us)
    assert length < lib.SOCKETCAND_FRAME_MAX
    written = ffi.string(text)
    assert len(written) == length
    return written.decode("ascii")


def test_python_can_understands_what_is_written():
    print(f"seed {SEED}")
    generator = random.Random(SEED)
    for message in messages(generator, 2_000):
        wall_us = generator.randrange(2 * 10**15)
        flags = Flag.EXTENDED if message.is_extended_id else 0
        data = bytes(message.data).ljust(8, b"\0")
        text = write(Frame(0, message.arbitration_id, 0, message.dlc, flags, 0, data), wall_us)
        heard = convert_ascii_message_to_can_message(text)
        assert heard.equals(message, timestamp_delta=None, check_direction=False)
        assert heard.timestamp == pytest.approx(wall_us * 1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (Frame(0, 0x12, 0, 0, 0, 0, bytes(8)), "< frame 012 1.000002  >"),
        (Frame(0, 0x12, 0, 2, 0, 0, b"\x0a\xb0" + bytes(6)), "< frame 012 1.000002 0AB0 >"),
        (Frame(0, 0x12, 0, 1, Flag.EXTENDED, 0, b"\xff" * 8), "< frame 00000012 1.000002 FF >"),
        (Frame(0, 0x4, 0, 8, Flag.ERROR, 0, b"\xff" * 8), "< error 004 1.000002 >"),
        (Frame(0, 0x1FFFFFFF, 0, 8, Flag.ERROR, 0, b"\xff" * 8), "< error 1FFFFFFF 1.000002 >"),
        (Frame(0, 0x12, 0, 4, Flag.REMOTE, 0, bytes(8)), ""),
    ],
)
def test_texts(frame: Frame, text: str):
    assert write(frame, 1_000_002) == text


def test_the_longest_text_fits():
    frame = Frame(0, 0x1FFFFFFF, 0, 8, Flag.EXTENDED, 0, b"\xff" * 8)
    assert write(frame, 2**64 - 1) == "< frame 1FFFFFFF 18446744073709.551615 FFFFFFFFFFFFFFFF >"
