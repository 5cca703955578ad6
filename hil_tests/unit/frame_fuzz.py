"""What the fuzz tests share: a seeded disturber of frames, random signals, a judge of what an ECU sends, snapshots."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Iterable
from typing import Any

from bridge._native import ffi, lib
from dbc.codec import MessageCodec, database
from dbc.frames import FRAME_SIZE, FRAME_STRUCT, Frame

#: Ticks of one episode.
EPISODE_TICKS = 200

#: Episodes of one test.
EPISODES = 20

#: Disturbances per frame: from one now and then, which a car rides through, to hardly a whole frame.
RATES = (0.0005, 0.003, 0.02, 0.2, 0.7)

_ODD = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-45, 3.4e38, -3.4e38, 1.0, -1.0, 1e9)


def seeds(count: int) -> list[int]:
    """The seeds of a test: fixed, or the one that RACELOOP_FUZZ_SEED names, or more with RACELOOP_FUZZ_SEEDS."""
    if "RACELOOP_FUZZ_SEED" in os.environ:
        return [int(os.environ["RACELOOP_FUZZ_SEED"])]
    return list(range(int(os.environ.get("RACELOOP_FUZZ_SEEDS", count))))


def announce(test: str, seed: int) -> random.Random:
    """Print how to run this again; the generator of everything random in it."""
    print(f"again: RACELOOP_FUZZ_SEED={seed} python -m pytest hil_tests/unit/test_firmware_fuzz.py -k {test}")
    return random.Random(f"{test} {seed}")


class Disturber:
    """Loses, repeats, delays, reorders, breaks and invents frames. `rate` is per frame and may be changed."""

    def __init__(self, generator: random.Random, buses: Iterable[int]) -> None:
        self._random = generator
        self._messages = [message for message in database if message.bus in set(buses)]
        self._late: list[tuple[int, bytes]] = []
        self.rate = 0.0

    def __call__(self, frames: Iterable[bytes]) -> list[bytes]:
        out = [frame for wait, frame in self._late if wait <= 0]
        self._late = [(wait - 1, frame) for wait, frame in self._late if wait > 0]
        for frame in frames:
            if self._random.random() >= self.rate:
                out.append(frame)
            else:
                out += self._disturb(frame)
        if self._random.random() < self.rate:
            out += [self._invent() for _ in range(self._random.randint(1, 8))]
        if self._random.random() < self.rate:
            self._random.shuffle(out)
        return out

    def forget(self) -> None:
        """Frames on their way are lost."""
        self._late.clear()

    def _disturb(self, frame: bytes) -> list[bytes]:
        kind = self._random.randrange(8)
        if kind == 0:
            return []
        if kind == 1:
            return [frame] * self._random.randint(2, 5)
        if kind == 2:
            self._late.append((self._random.randint(0, 30), frame))
            return []
        if kind == 3:
            return [frame, self._with_bits_flipped(frame)]
        return [self._with_bits_flipped(frame) if kind < 6 else self._readdressed(frame)]

    def _with_bits_flipped(self, frame: bytes) -> bytes:
        data = bytearray(frame)
        for _ in range(self._random.choice((1, 1, 2, 8))):
            data[self._random.randrange(16, FRAME_SIZE)] ^= 1 << self._random.randrange(8)
        return bytes(data)

    def _readdressed(self, frame: bytes) -> bytes:
        """Return the frame with another head: id, bus, length, flags, sender, time."""
        head = list(FRAME_STRUCT.unpack(frame))
        field = self._random.randrange(6)
        head[field] = self._random.choice((
            self._random.getrandbits(8 if field > 1 else 32), self._random.randrange(9), head[field] ^ 1,
        ))  # fmt: skip
        return FRAME_STRUCT.pack(*head)

    def _invent(self) -> bytes:
        """Return a frame of this network with any content and a good CRC, or plain noise."""
        if self._random.random() < 0.2:
            return self._random.randbytes(FRAME_SIZE)
        message: MessageCodec = self._random.choice(self._messages)
        content = self._random.randbytes(8)
        frame = FRAME_STRUCT.pack(0, message.frame_id, message.bus, message.length, 0, 0, content)
        return message.finish(frame, self._random.randrange(256))


def disturb_wires(generator: random.Random, wired: Any, rate: float) -> None:
    """Put odd values (NaN and infinities among them) into the numbers of a struct of wired signals, in place."""
    for name, field in ffi.typeof(wired).item.fields:
        value = getattr(wired, name)
        if field.type.kind == "struct":
            disturb_wires(generator, ffi.addressof(wired, name), rate)
        elif field.type.kind == "array":
            for index in range(len(value)):
                if generator.random() < rate:
                    value[index] = generator.choice(_ODD)
        elif generator.random() < rate:
            kind = field.type.cname
            if kind == "float":
                setattr(wired, name, generator.choice(_ODD))
            else:
                bits = {"_Bool": 1, "uint8_t": 8, "uint16_t": 16}[kind]
                setattr(wired, name, generator.getrandbits(bits))


class Judge:
    """Checks everything that one station sends, tick by tick."""

    def __init__(self, sender: int, most: int) -> None:
        self._sender, self._most = sender, most
        self._counters: dict[tuple[int, int], int] = {}

    def forget(self) -> None:
        """The station starts again from a snapshot."""
        self._counters.clear()

    def check(self, frames: list[Frame], outbox: Any) -> dict[str, tuple[float, ...]]:
        """Content of the frames by message name; asserts what holds for all frames."""
        assert outbox.dropped == 0
        assert len(frames) <= self._most
        found: dict[str, tuple[float, ...]] = {}
        for frame in frames:
            row = lib.codec_find(frame.bus, frame.id, False)
            assert row != ffi.NULL, frame
            assert (frame.dlc, frame.flags) == (row.dlc, 0)
            assert row.sender == self._sender
            if row.counter_length:
                value = int.from_bytes(frame.data, "little") >> row.counter_start & (1 << row.counter_length) - 1
                last = self._counters.get((frame.bus, frame.id))
                assert last is None or value == (last + 1) % (1 << row.counter_length), frame
                self._counters[frame.bus, frame.id] = value
            message = database.find(frame.bus, frame.id)
            assert message is not None
            found[message.name] = message.decode(frame.data)
            assert all(math.isfinite(number) for number in found[message.name])
        return found


class Snapshot:
    """Content of C structs, to go back to."""

    def __init__(self, *structs: Any) -> None:
        self._content = [(struct, bytes(ffi.buffer(struct))) for struct in structs]

    def restore(self) -> None:
        for struct, content in self._content:
            ffi.buffer(struct)[:] = content
