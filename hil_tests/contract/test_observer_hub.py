"""The observer on a real hub, into a real recording; and a recording whose run was cut off."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from hub_process import Hub, until

from bridge.realtime.link import CanLink
from bridge.realtime.observer import Observer
from bridge.recorder import Recorder
from bridge.replay import read_log
from dbc.codec import database
from dbc.frames import FRAME_DTYPE, FRAME_STRUCT, Bus

COUNT = 50


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    hub = Hub(tmp_path / "hub")
    yield hub
    hub.stop()


def frame(bus: Bus, number: int) -> bytes:
    return FRAME_STRUCT.pack(0, 0x100 + bus, bus, 8, 0, 0, number.to_bytes(8, "little"))


def test_every_frame_is_recorded_in_order_of_time_also_when_the_hub_dies(hub: Hub, tmp_path: Path):
    recorder = Recorder(tmp_path / "out", (), (), keep=True)
    with ExitStack() as stack:
        epoch_ns = time.monotonic_ns()
        address = f"hub:{hub.local}"
        ears = [stack.enter_context(CanLink(address, bus, epoch_ns)) for bus in Bus]
        mouths = {bus: stack.enter_context(CanLink(address, bus, epoch_ns, [])) for bus in Bus}
        observer = Observer(ears, recorder.add_frames)

        def now_us() -> int:
            return (time.monotonic_ns() - epoch_ns) // 1000

        def heard() -> int:
            observer.poll(now_us())
            return sum(ear.statistics.received for ear in ears)

        for number in range(COUNT):
            for bus in Bus:
                assert mouths[bus].send(frame(bus, number)) == 1
                heard()
        until(lambda: heard() == COUNT * len(Bus), "all frames")
        hub.stop(signal.SIGKILL)
        until(lambda: heard() is not None and all(ear.state.name == "DOWN" for ear in ears), "the links to go down")
        observer.finish()
        assert observer.late == 0
        assert [statistics["frames"] for statistics in observer.load.statistics(1.0).values()] == [COUNT] * len(Bus)
    log = read_log(recorder.finish().candump)
    assert np.all(np.diff(log["time_us"].astype(np.int64)) >= 0)
    assert log["time_us"][-1] < now_us()
    # The order in which they were sent over all buses is that of the recording, as far as the stamps tell.
    numbers = log["data"].copy().view("<u8").reshape(-1).astype(int)
    for bus in Bus:
        assert numbers[log["bus"] == bus].tolist() == list(range(COUNT))
    assert np.all(np.diff(numbers) >= 0)


@pytest.mark.parametrize("keep", [True, False])
def test_a_recording_whose_run_is_killed(tmp_path: Path, keep: bool):
    """What cannot be repeated is kept; what can be repeated leaves nothing that looks complete."""
    code = f"""
import os, sys
import numpy as np
from pathlib import Path
from bridge.recorder import Recorder
from dbc.codec import database
from dbc.frames import FRAME_DTYPE
recorder = Recorder(Path(sys.argv[1]), ["vx"], ["m/s"], keep={keep})
frames = np.zeros(100, FRAME_DTYPE)
frames["time_us"] = range(100)
frames["id"], frames["bus"], frames["dlc"] = {database.message("ssm_status").frame_id}, 2, 8
recorder.add_frames(frames)
for row in range(512):
    recorder.add_truth(row * 10_000, np.array([1.0]))
recorder.add_frames(frames[:0])
while not recorder._records.empty():
    pass  # when the last record is taken, those before it are with the writer
print("given", flush=True)
sys.stdin.read()
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    folder = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "given\n"
    until((folder / ".partial").exists, "the writer to begin")
    assert not (folder / "frames.log").exists()
    process.kill()
    process.communicate()
    until(lambda: not (folder / ".partial").exists(), "the writer to end")
    if keep:
        log = read_log(folder / "frames.log")
        assert log.dtype == FRAME_DTYPE
        assert log["time_us"].tolist() == list(range(100))
        assert {path.name for path in folder.iterdir()} == {"frames.log", "frames.blf", "signals", "truth.parquet"}
    else:
        assert list(folder.iterdir()) == []
