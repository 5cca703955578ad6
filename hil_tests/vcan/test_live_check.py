"""A live check beside candump's player: what is on the interfaces is heard, whole, with the kernel's times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from can_utils import INTERFACES, PATIENCE_S, process

from bridge.bus import CHANNELS
from dbc.buses import Bus, car_buses
from dbc.codec import database
from dbc.frames import FRAME_DTYPE
from tools.dbw.conformance import Conformance
from tools.dbw.findings import Rule
from tools.dbw.live_source import LiveSource, parse

pytestmark = pytest.mark.vcan

ROUNDS = 20
MISSING = 7


def drive() -> np.ndarray:
    """A frame of every message in turn, counters counting; in one round the steering command is left out."""
    frames = b""
    codecs = [codec for codec in database if codec.bus in car_buses()]
    for number in range(ROUNDS):
        for place, codec in enumerate(codecs):
            if number != MISSING or codec.name != "steering_cmd":
                values = [0.0] * len(codec.signals)
                frames += codec.finish(codec.frame(*values, time_us=1_000_000 + 20_000 * number + 200 * place), number)
    return np.frombuffer(frames, FRAME_DTYPE)


def test_what_canplayer_plays_is_checked(tmp_path: Path) -> None:
    frames = drive()
    log = tmp_path / "drive.log"
    names = {int(bus): name for bus, name in CHANNELS.items()}
    digits = {int(codec.frame_id): 8 if codec.extended else 3 for codec in database}
    with log.open("w") as out:
        for frame in frames:
            seconds, micros = divmod(int(frame["time_us"]), 1_000_000)
            identifier = f"{int(frame['id']):0{digits[int(frame['id'])]}X}"
            data = bytes(frame["data"])[: int(frame["dlc"])].hex().upper()
            out.write(f"({seconds}.{micros:06d}) {names[int(frame['bus'])]} {identifier}#{data}\n")
    assignment = [f"{INTERFACES[bus]}={channel}" for bus, channel in CHANNELS.items()]
    heard: list[np.ndarray] = []
    addresses = [parse(f"socketcan:{name}", None) for name in INTERFACES.values()]
    assert [address.bus for address in addresses] == list(Bus)
    with (
        LiveSource(addresses, lambda frame, text: pytest.fail(f"frame {frame}: {text}")) as source,
        process("canplayer", "-I", str(log), *assignment),
    ):
        pieces = source.chunks(PATIENCE_S, lambda: False)
        while sum(map(len, heard)) < len(frames):
            heard.append(next(pieces))
    together = np.concatenate(heard)
    for bus in Bus:
        played, here = (some[some["bus"] == bus] for some in (frames, together))
        for field in ("id", "dlc", "data"):
            assert np.array_equal(here[field], played[field]), bus
        assert np.all(np.diff(here["time_us"].astype(np.int64)) >= 0)
    conformance = Conformance()
    conformance.update(together)
    jumps = {place.message for place in conformance.findings if place.rule is Rule.JUMP}
    assert jumps == {"steering_cmd"}
