"""`raceloop run --realtime` over the hub, once from power-on to standstill.

Behaviour only: a shared machine stalls now and then. When it did, the car must have been braked; when it did not, the
run must have gone as in lock step.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from realtime_harness import RealTimeCommand

from bridge.bus import CHANNELS
from bridge.realtime.cycle_log import CycleLog, read_cycle_log
from bridge.replay import read_log
from bridge.scenario import load_scenario
from dbc.buses import car_buses
from dbc.codec import database
from tools.realtime_run import PHASES_US
from tools.run import build_bench, find_scenario

pytestmark = pytest.mark.realtime

#: Slots in a row that a station may miss before others must notice: less than any timeout on the buses.
HARMLESS_SLOTS = 3


@dataclass(frozen=True)
class Run:
    status: int
    folder: Path
    output: list[str]
    errors: list[str]
    summary: dict[str, Any]
    left: list[str]
    cycles: dict[str, CycleLog]
    frames: np.ndarray
    truth: dict[str, np.ndarray]

    @property
    def machine_was_sound(self) -> bool:
        """No station was kept from running for so long that another had to notice."""
        stalled = max(int(log.records["skipped"].max()) for log in self.cycles.values())
        lost = self.summary["real_time"]["plant"]["lost_ms"]
        return stalled <= HARMLESS_SLOTS and lost == 0

    def times(self, name: str) -> np.ndarray:
        """Times of a message's frames, us."""
        message = database.message(name)
        return self.frames["time_us"][(self.frames["bus"] == message.bus) & (self.frames["id"] == message.frame_id)]

    def values(self, name: str, signal: str) -> np.ndarray:
        return pq.read_table(self.folder / "signals" / f"{name}.parquet").column(signal).to_numpy()

    def states(self, machine: str) -> list[str]:
        changes = self.summary[f"{machine}_transitions"]
        return [changes[0]["before"], *(change["state"] for change in changes)]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("realtime") / "out"
    with RealTimeCommand(folder) as command:
        command.wait_for_start("hub", "obc", "raptor", "space-drive", "plant", "autonomy", "recorder")
        status = command.wait()
        table = pq.read_table(folder / "truth.parquet")
        return Run(
            status=status,
            folder=folder,
            output=list(command.output),
            errors=list(command.errors),
            summary=command.summary(),
            left=command.left(),
            cycles={path.stem: read_cycle_log(path) for path in (folder / "cycles").iterdir()},
            frames=read_log(folder / "frames.log"),
            truth={name: table.column(name).to_numpy() for name in table.column_names},
        )


def test_it_finishes_as_in_lock_step_or_brakes_when_the_machine_stalled(run: Run):
    faults = [fault["fault"] for fault in run.summary["faults"]]
    assert abs(run.truth["vx"][-1]) < 0.1
    if not run.machine_was_sound:
        assert run.summary["finished"] or run.states("ssm")[-1] in ("EMERGENCY", "FULL_BRAKE"), faults
        return
    assert faults == []
    assert run.status == 0
    assert run.summary["finished"]
    with build_bench(load_scenario(find_scenario("short_drive"))) as bench:
        assert bench.run()
        bench.finish()
        expected = {
            machine: [change for change in bench.monitor.transitions if change.machine == name]
            for machine, name in (("ssm", "ssm"), ("sys_state", "sys"), ("ct_state", "ct"))
        }
    for machine, changes in expected.items():
        assert run.states(machine) == [changes[0].before, *(change.after for change in changes)], machine
    assert run.summary["top_speed_kmh"] == pytest.approx(50.3, abs=1.5)
    assert run.summary["simulated_s"] == pytest.approx(18.3, abs=1.5)


def test_nothing_is_left_behind(run: Run):
    assert run.left == []
    (address,) = set(run.summary["real_time"]["addresses"].values())
    assert not Path(address.removeprefix("hub:")).parent.exists()


def test_what_the_stations_said_is_on_standard_error(run: Run):
    for name in ("obc", "raptor", "space-drive"):
        assert any(line.startswith(f"{name}: runs: period 10000 us, phase {PHASES_US[name]} us") for line in run.errors)
        assert any(line.startswith(f"{name}: stops on Terminated: full brake") for line in run.errors)
    assert any(line.startswith("hub: local ") and "socketcand 127.0.0.1:" in line for line in run.errors)
    assert not any("{" in line for line in run.errors)
    assert not any("Traceback" in line for line in run.errors)


def test_the_recording_holds_every_bus_in_order_of_time(run: Run):
    times = run.frames["time_us"].astype(np.int64)
    if run.summary["real_time"]["out_of_order"] == 0:
        assert np.all(np.diff(times) >= 0)
    counts = {CHANNELS[bus]: int((run.frames["bus"] == bus).sum()) for bus in car_buses()}
    assert {name: bus["frames"] for name, bus in run.summary["buses"].items()} == counts
    assert all(bus["frames"] > 1000 and 0.05 < bus["load"] < 1.0 for bus in run.summary["buses"].values())
    assert run.summary["frames_lost"] == 0
    assert {path.name + "/" * path.is_dir() for path in run.folder.iterdir()} == set(run.summary["files"])


def test_periodic_messages_come_as_often_as_their_station_cycled(run: Run):
    for station, name in (("obc", "brake_pressure_cmd"), ("plant", "imu_rates")):
        log, times = run.cycles[station], run.times(name)
        assert abs(times.size - len(log.records)) <= 5 + run.summary["real_time"]["plant"]["caught_up_slots"]
        if run.machine_was_sound:
            assert np.median(np.diff(times.astype(np.int64))) == pytest.approx(10_000, abs=1_000)


def test_every_station_keeps_its_phase_on_the_common_epoch(run: Run):
    assert set(run.cycles) == set(PHASES_US)
    assert {log.epoch_ns for log in run.cycles.values()} == {run.summary["real_time"]["epoch_ns"]}
    for name, log in run.cycles.items():
        records = log.records
        due = log.epoch_ns + PHASES_US[name] * 1000 + records["slot"] * 10_000_000
        assert np.array_equal(due, records["deadline_ns"]), name
        assert np.all(records["wake_ns"] >= records["deadline_ns"])
        assert np.all(np.diff(records["slot"].astype(np.int64)) >= 1)
        summed = run.summary["real_time"]["stations"][name]
        assert summed["cycles"] == len(records) > 500
        assert summed["skipped"] == int(records["skipped"].sum())
        # A stall counts from the first slot that it cost.
        late_ns = records["wake_ns"] - records["deadline_ns"] + records["skipped"] * np.uint64(10_000_000)
        assert summed["lateness_us"]["maximum"] == pytest.approx(float(late_ns.max()) * 1e-3)
    phases = [PHASES_US[name] for name in ("plant", "autonomy", "obc", "raptor", "space-drive")]
    assert all(before < after for before, after in pairwise(phases))


def test_the_car_is_left_at_full_brake(run: Run):
    """The stations were asked to stop, and said full brake until they were gone."""
    assert run.values("brake_pressure_cmd", "brake_pressure_cmd")[-1] in (3500.0, 4500.0)
    assert run.summary["ssm_transitions"][-1]["state"] != "CONFIG_CHECK"


def test_truth_and_buses_share_one_time(run: Run):
    """The speed that the Raptor reports follows the true one within its delay, on one time axis."""
    table = pq.read_table(run.folder / "signals" / "wheel_speed_report.parquet")
    times = table.column("time_us").to_numpy()
    reported = table.column("wheel_speed_FL").to_numpy()
    true = np.interp(times - 20_000, run.truth["time_us"], run.truth["vx"]) * 3.6
    assert reported.max() > 1.0 or not run.machine_was_sound
    assert np.percentile(np.abs(reported - true), 95) < 2.0


def test_the_page_fits_80_columns(run: Run):
    for line in run.output:
        assert len(line) <= 80 or line.startswith("Files in "), line
    assert any(line.startswith("station") for line in run.output)
    for name in PHASES_US:
        assert any(line.startswith(f"{name} ") for line in run.output)
