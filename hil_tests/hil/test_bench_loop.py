"""The loop itself: order within a tick, both plant versions, silence of stations, files that are wrong."""

from __future__ import annotations

import gc
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import plant_fmu
from bridge.bench import Bench
from bridge.monitor import RunMonitor
from bridge.operator import Verdict
from bridge.scenario import Condition, Scenario, load_scenario
from bridge.surroundings import TICK_US
from dbc.codec import database
from dbc.errors import ConfigurationError, PlantError, RaceloopError
from dbc.frames import Bus, Station
from dbc.network import DIRECTORY
from dbc.states import SysState
from tools.run import DEFAULT_SCENARIO, build_bench


@pytest.fixture
def scenario() -> Scenario:
    return load_scenario(DEFAULT_SCENARIO)


def ticks(bench: Bench, count: int) -> None:
    for _ in range(count):
        bench.tick()


def test_everyone_speaks_in_every_tick_in_the_order_of_the_design(scenario: Scenario):
    with build_bench(scenario) as bench:
        ticks(bench, 15)  # the configuration is through
        logged = bench.network.logged()
        bench.tick()
        frames = bench.network.log_view(logged)
        first = {Station(sender): int(np.argmax(frames["sender"] == sender)) for sender in np.unique(frames["sender"])}
        assert sorted(first, key=lambda station: first[station]) == [
            Station.SENSORS,
            Station.AUTONOMY,
            Station.OBC,
            Station.RAPTOR,
            Station.SPACE_DRIVE,
        ]
        assert np.all(frames["time_us"] // TICK_US == 15)


def test_senders_are_those_of_the_dbc_files(scenario: Scenario):
    with build_bench(scenario) as bench:
        ticks(bench, 40)
        for frame in bench.network.log_view():
            message = database.find(int(frame["bus"]), int(frame["id"]), bool(frame["flags"] & 1))
            assert message is not None
            assert message.sender == frame["sender"], message.name
            assert message.length == frame["dlc"], message.name


def test_both_plant_versions_give_the_same_frames(scenario: Scenario):
    logs = []
    for version in (2, 3):
        with build_bench(replace(scenario, fmi_version=version)) as bench:
            assert bench.run(Condition(sys_state=SysState.ENG_IDLE))
            ticks(bench, 50)
            logs.append((bench.now_us, bench.network.drain_log().tobytes()))
    assert logs[0] == logs[1]


def test_the_seed_changes_the_noise_and_nothing_else_does(scenario: Scenario):
    logs = []
    for seed in (1, 1, 2):
        with build_bench(replace(scenario, seed=seed)) as bench:
            ticks(bench, 40)
            log = bench.network.drain_log()
            logs.append(log[log["bus"] == Bus.CAN_S].tobytes())
    assert logs[0] == logs[1] != logs[2]


def test_the_operator_learns_the_verdict(scenario: Scenario):
    with build_bench(scenario) as bench:
        ticks(bench, 100)
        assert bench.operator.verdict is Verdict.ACCEPTED
        assert bench.operator.offences == []


def test_monitor_digests_any_chunks_alike(scenario: Scenario):
    with build_bench(scenario) as bench:
        bench.run(Condition(time_us=400_000))
        log = bench.network.drain_log()
    whole, pieces = RunMonitor(), RunMonitor()
    whole.update(log)
    for start in range(0, len(log), 37):
        pieces.update(log[start : start + 37])
    assert sorted(pieces.transitions, key=str) == sorted(whole.transitions, key=str) != []
    assert pieces.faults == whole.faults
    assert pieces.executive_overruns == whole.executive_overruns == 0


@pytest.mark.parametrize(
    "station", [Station.SENSORS, Station.AUTONOMY, Station.OBC, Station.RAPTOR, Station.SPACE_DRIVE]
)
def test_a_silent_station_sends_nothing_and_hears_nothing(scenario: Scenario, station: Station):
    with build_bench(scenario) as bench:
        ticks(bench, 30)
        bench.silent.add(station)
        logged = bench.network.logged()
        ticks(bench, 10)
        senders = set(bench.network.log_view(logged)["sender"].tolist())
        assert senders == set(Station) - {Station.NONE, station}
        assert bench.losses == 0
        bench.silent.clear()
        logged = bench.network.logged()
        ticks(bench, 2)
        assert station in bench.network.log_view(logged)["sender"]


def test_time_limit_ends_a_run(scenario: Scenario):
    with build_bench(replace(scenario, time_limit_us=200_000)) as bench:
        seen = []
        assert not bench.run(on_progress=lambda progress: seen.append(progress.situation.time_us))
        assert bench.now_us == 200_000
        assert seen == [100_000, 200_000]


def test_no_fmu_and_no_origin_are_one_line(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    with pytest.raises(PlantError, match="no such FMU file"):
        build_bench(replace(scenario, fmu=tmp_path / "none.fmu"))
    track = tmp_path / "track.yaml"
    lines = scenario.track.read_text().splitlines()
    origin = lines.index("origin:")
    track.write_text("\n".join(lines[:origin] + lines[origin + 4 :]))
    with pytest.raises(ConfigurationError) as caught:
        build_bench(replace(scenario, track=track))
    assert "origin" in str(caught.value)
    monkeypatch.setenv(plant_fmu.FMU_DIR_VARIABLE, os.fspath(tmp_path))
    with pytest.raises(PlantError, match="not found"):
        build_bench(scenario)
    assert capfd.readouterr() == ("", "")


def test_changed_dbc_file_is_refused_at_the_start(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in DIRECTORY.glob("*.dbc"):
        (tmp_path / path.name).write_bytes(path.read_bytes() + (b"\n" if path.stem == "sensors" else b""))
    monkeypatch.setattr(database, "_directory", tmp_path)
    with pytest.raises(ConfigurationError, match=r"sensors\.dbc: differs .* build again"):
        build_bench(scenario, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_wrong_operation_file_is_refused_before_anything_is_written(scenario: Scenario, tmp_path: Path):
    bad = tmp_path / "bad.yaml"
    bad.write_text("- not a mapping\n")
    out = tmp_path / "out"
    with pytest.raises(RaceloopError, match=r"bad\.yaml"):
        build_bench(replace(scenario, operation=bad), out)
    assert not out.exists()


def test_a_bench_that_is_left_leaves_no_recording(scenario: Scenario, tmp_path: Path):
    with build_bench(scenario, tmp_path / "out") as bench:
        ticks(bench, 20)
    assert list((tmp_path / "out").iterdir()) == []


def test_the_loop_leaves_nothing_for_the_garbage_collector(scenario: Scenario):
    """It runs with the collector paused: that is sound only while it makes no reference cycles."""
    with build_bench(scenario) as bench:
        bench.run(until=Condition(time_us=8_000_000))
        gc.collect()
        paused = []
        bench.run(until=Condition(time_us=12_000_000), on_progress=lambda _: paused.append(not gc.isenabled()))
        assert gc.collect() == 0
        assert gc.isenabled()
        assert len(paused) == 40
        assert all(paused)
