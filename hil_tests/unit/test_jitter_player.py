"""The player sends every frame of a stimulus once, in its slot, and holds the wires as they were in the lap."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bridge._native import ffi
from bridge.realtime.wired import Cell, WiredIo
from tools.jitter.player import Player
from tools.jitter.recording import record_stimulus
from tools.jitter.stimulus import ECUS, Stimulus

CYCLES = 60
TICK_US = 10_000


@pytest.fixture(scope="module")
def stimuli() -> dict[str, Stimulus]:
    return {name: record_stimulus(ecu, CYCLES) for name, ecu in ECUS.items()}


@pytest.fixture
def wires(tmp_path: Path) -> Iterator[WiredIo]:
    with WiredIo(tmp_path / "wires", create=True) as wires:
        yield wires


@pytest.mark.parametrize("name", ECUS)
def test_every_slot_gets_its_frames_and_wires(name: str, stimuli: dict[str, Stimulus], wires: WiredIo):
    ecu, stimulus = ECUS[name], stimuli[name]
    player = Player(ecu, stimulus, wires)
    for slot in range(CYCLES):
        assert not player.over
        expected = stimulus.frames[stimulus.bounds[slot] : stimulus.bounds[slot + 1]]
        assert player.step(slot * TICK_US, b"") == expected.tobytes()
        if ecu.wired is not None:
            assert on_wires(wires, ecu.wired) == stimulus.wired[slot].tobytes()
    assert player.over
    assert player.end() == b""
    if ecu.wired is None:
        for cell in Cell:
            assert wires.read(cell, ffi.new("char[1000]")) == 0


def on_wires(wires: WiredIo, name: str) -> bytes:
    struct = ffi.new(f"{name.removesuffix('_in')}_wired_in *")
    assert wires.read(Cell[name.upper()], struct) > 0
    return bytes(ffi.buffer(struct))


def test_frames_of_slots_that_passed_unused_come_with_the_next(stimuli: dict[str, Stimulus], wires: WiredIo):
    stimulus = stimuli["raptor"]
    player = Player(ECUS["raptor"], stimulus, wires)
    player.step(0, b"")
    assert player.step(7 * TICK_US, b"") == stimulus.frames[stimulus.bounds[1] : stimulus.bounds[8]].tobytes()
    assert on_wires(wires, "raptor_in") == stimulus.wired[7].tobytes()
    assert player.step(10_000 * TICK_US, b"") == stimulus.frames[stimulus.bounds[8] :].tobytes()
    assert player.over
    assert player.step(10_001 * TICK_US, b"") == b""


def test_stimulus_survives_its_file(stimuli: dict[str, Stimulus], tmp_path: Path):
    for name, stimulus in stimuli.items():
        stimulus.save(tmp_path / name)
        again = Stimulus.load(tmp_path / name)
        assert again.frames.tobytes() == stimulus.frames.tobytes()
        assert np.array_equal(again.bounds, stimulus.bounds)
        assert np.array_equal(again.wired, stimulus.wired)
