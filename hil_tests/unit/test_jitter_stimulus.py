"""The recorded stimulus is what the ECU would have heard: a fresh ECU that is fed with it sends the same frames."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.scenario import load_scenario
from dbc.codec import database
from dbc.frames import FRAME_DTYPE, FRAME_SIZE, Bus, Station
from tools.jitter.recording import record_stimulus
from tools.jitter.stimulus import ECUS, Ecu, Stimulus
from tools.run import DEFAULT_SCENARIO, build_bench

CYCLES = 1500
TICK_US = 10_000


@pytest.fixture(scope="module")
def lap() -> NDArray[np.void]:
    """All frames of the same stretch of the lap."""
    log = []
    with build_bench(load_scenario(DEFAULT_SCENARIO)) as bench:
        for _ in range(CYCLES):
            if bench.network.log_half_full:
                log.append(bench.network.drain_log())
            bench.tick()
        log.append(bench.network.drain_log())
    return np.concatenate(log)


def sent_again(ecu: Ecu, stimulus: Stimulus) -> Iterator[NDArray[np.void]]:
    """What a fresh ECU sends when it gets the stimulus."""
    prefix = ecu.name.replace("-", "_")
    state = ffi.new(f"{prefix} *")
    getattr(lib, f"{prefix}_init")(state, *([ffi.NULL] if ecu.wired else []))
    storage = ffi.new("can_frame[]", 256)
    out = ffi.new("can_outbox *", {"frames": storage, "capacity": 256})
    wired_in = ffi.new(f"{prefix}_wired_in *") if ecu.wired else None
    wired_out = ffi.new(f"{prefix}_wired_out *") if ecu.wired else None
    for cycle in range(stimulus.cycles):
        out.count = 0
        heard = stimulus.frames[stimulus.bounds[cycle] : stimulus.bounds[cycle + 1]].tobytes()
        frames = ffi.from_buffer("can_frame[]", heard)
        now_us, count = cycle * TICK_US, len(heard) // FRAME_SIZE
        if wired_in is None:
            lib.obc_tick(state, now_us, frames, count, out)
        else:
            row = stimulus.wired[cycle].tobytes()
            assert len(row) == ffi.sizeof(wired_in[0])
            ffi.memmove(wired_in, row, len(row))
            getattr(lib, f"{prefix}_tick")(state, now_us, wired_in, frames, count, wired_out, out)
        sent = np.frombuffer(bytes(ffi.buffer(storage, out.count * FRAME_SIZE)), dtype=FRAME_DTYPE).copy()
        sent["time_us"] = now_us
        yield sent


def in_order(frames: NDArray[np.void]) -> NDArray[np.void]:
    """By tick, bus and identifier, without what a bus adds."""
    frames = frames.copy()
    frames["time_us"] //= TICK_US
    frames["sender"] = Station.NONE
    return frames[np.lexsort((frames["id"], frames["bus"], frames["time_us"]))]


@pytest.mark.parametrize("ecu", ECUS.values(), ids=list(ECUS))
def test_fresh_ecu_sends_what_it_sent_in_the_lap(ecu: Ecu, lap: NDArray[np.void]):
    stimulus = record_stimulus(ecu, CYCLES)
    assert stimulus.cycles == CYCLES
    again = np.concatenate(list(sent_again(ecu, stimulus)))
    recorded = lap[lap["sender"] == ecu.station]
    assert len(recorded) > CYCLES
    assert in_order(again).tobytes() == in_order(recorded).tobytes()


@pytest.mark.parametrize("ecu", ECUS.values(), ids=list(ECUS))
def test_stimulus_holds_others_on_the_ecus_buses_only(ecu: Ecu):
    stimulus = record_stimulus(ecu, 200)
    assert {Bus(bus) for bus in np.unique(stimulus.frames["bus"])} == set(ecu.buses)
    assert ecu.station not in stimulus.frames["sender"]
    assert np.all(np.diff(stimulus.bounds) >= 0)
    assert stimulus.wired.shape[0] == 200


@pytest.mark.parametrize("ecu", ECUS.values(), ids=list(ECUS))
def test_measured_command_is_the_ecus_own_and_sent_in_every_cycle(ecu: Ecu, lap: NDArray[np.void]):
    command = database.message(ecu.command)
    assert command.sender == ecu.station
    assert command.cycle_us == TICK_US
    frames = lap[(lap["id"] == command.frame_id) & (lap["bus"] == command.bus)]
    assert np.array_equal(frames["time_us"] // TICK_US, np.arange(CYCLES))
