"""Measurements made of numbers, for what is drawn and written from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bridge.realtime.cycle_log import RECORD_DTYPE, CycleLog
from dbc.codec import database
from dbc.frames import FRAME_DTYPE, Bus
from tools.jitter.figures import Distribution
from tools.jitter.measurement import Cycles, Measurement
from tools.jitter.stimulus import ECUS

PERIOD_NS = 10_000_000
EPOCH_NS = 5_000_000_000_000
PHASE_NS = 4_000_000


def records(count: int) -> NDArray[np.void]:
    """Cycles that keep to the grid: 60 us late, 200 us long, of which 150 us on the processor."""
    cycles = np.zeros(count, dtype=RECORD_DTYPE)
    cycles["slot"] = np.arange(count)
    cycles["deadline_ns"] = EPOCH_NS + PHASE_NS + cycles["slot"] * PERIOD_NS
    cycles["wake_ns"] = cycles["deadline_ns"] + 60_000
    cycles["received_ns"] = cycles["wake_ns"] + 20_000
    cycles["ticked_ns"] = cycles["wake_ns"] + 120_000
    cycles["sent_ns"] = cycles["wake_ns"] + 200_000
    cycles["cpu_ns"] = 150_000
    cycles["run_queue_ns"] = 75_000
    cycles["tasks_run"] = 0b101
    cycles["task_us"][:, 0] = 30
    cycles["task_us"][:, 2] = 60
    cycles["frames_in"] = 34
    return cycles


def cycle_log(cycles: NDArray[np.void], name: str = "obc", process: int = 4711) -> CycleLog:
    return CycleLog(
        name=name,
        process=process,
        priority=80,
        cpu=1,
        epoch_ns=EPOCH_NS,
        phase_ns=PHASE_NS,
        period_ns=PERIOD_NS,
        task_names=("receive", "control", "monitor"),
        overwritten=0,
        records=cycles,
    )


def frames_after(cycles: NDArray[np.void], message: str, delay_us: int) -> NDArray[np.void]:
    """A frame of a message per cycle, so long after the end of its logic."""
    codec = database.message(message)
    frames = np.zeros(len(cycles), dtype=FRAME_DTYPE)
    frames["time_us"] = (cycles["ticked_ns"] - EPOCH_NS) // 1000 + delay_us
    frames["id"], frames["bus"], frames["dlc"] = codec.frame_id, codec.bus, codec.length
    return frames


def measurement(count: int = 50, condition: str = "idle", process: int = 4711) -> Measurement:
    """An onboard computer that keeps to the grid, except in cycle 7; sensors come 3 ms before it, estimates 2 ms."""
    cycles = records(count)
    cycles["newest_ns"][:, Bus.CAN_S] = cycles["deadline_ns"] - 3_000_000
    cycles["newest_ns"][:, Bus.CAN_A] = cycles["deadline_ns"] - 2_000_000
    for field in ("ticked_ns", "sent_ns"):
        cycles[field][7] += 1_000_000
    cycles["preemptions"][7] = 2
    own = frames_after(cycles, "brake_pressure_cmd", 50)
    other = frames_after(cycles, "wheel_speed_report", 900)
    frames = np.concatenate([own, other])
    return Measurement(
        condition=condition,
        ecu=ECUS["obc"],
        cycles=Cycles(cycle_log(cycles, process=process)),
        frames=frames[np.argsort(frames["time_us"])],
        machine=Distribution.of_histogram({50.0: count - 1, 90.0: 1}),
        peers={"plain Python loop": EPOCH_NS + np.arange(count) * (PERIOD_NS + 100_000)},
        notes=("the machine stalled",),
    )
