"""The front radar in the loop: its frames on CAN-R against model, cantools and bit counts, and what it leaves alone."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pyarrow.parquet as pq
import pytest

from autonomy.partition import AutonomyPartition
from autonomy.radar_inbox import ReceivedScan, ScanStatus
from bridge._native import ffi, lib
from bridge.bench import Bench
from bridge.bus import BIT_RATES
from bridge.faults.frames import Drop, Partition
from bridge.replay import read_log, replay_obc
from bridge.scenario import Scenario, load_scenario
from bridge.sensors.radar import PERIOD_US, PHASE_US
from bridge.surroundings import TICK_US
from dbc.buses import DIRECTORY, car_buses
from dbc.codec import database
from dbc.frames import Bus, Station
from dbc.radar_tracks import FIRST_ID, TRACKS, Tracks, TrackStatus, rolling_counts, unpack
from tools.dbw.conformance import Conformance
from tools.run import build_bench, find_scenario

SCANS = 12
TICKS = (PHASE_US + SCANS * PERIOD_US) // TICK_US
MESSAGES = cantools.database.load_file(DIRECTORY / "radar_esr.dbc")


@pytest.fixture
def scenario() -> Scenario:
    return replace(load_scenario(find_scenario("short_drive")), radar=True)


@pytest.fixture
def bench(scenario: Scenario) -> Iterator[Bench]:
    with build_bench(scenario) as made:
        yield made


def autonomy_of(bench: Bench) -> AutonomyPartition:
    partition = bench._autonomy
    assert isinstance(partition, AutonomyPartition)
    return partition


def twin_of(bench: Bench) -> Any:
    """A radar that goes on as the bench's would, from now."""
    return copy.deepcopy(bench.surroundings._sensors.radar)


def drive(bench: Bench, ticks: int = TICKS) -> tuple[np.ndarray, list[ReceivedScan]]:
    """All frames, and the scans that autonomy took."""
    pieces, scans = [], []
    for _ in range(ticks):
        bench.tick()
        pieces.append(bench.network.drain_log())
        scan = autonomy_of(bench).radar.take(bench.now_us - TICK_US)
        scans += [] if scan is None else [scan]
    return np.concatenate(pieces), scans


def of_radar(log: np.ndarray) -> np.ndarray:
    return log[log["bus"] == Bus.CAN_R]


def test_frames_decode_with_cantools_to_what_the_model_said(bench: Bench) -> None:
    twin, said = twin_of(bench), []
    pieces = []
    for _ in range(TICKS):
        if twin.due(bench.now_us):
            said.append(twin.scan(bench.truth))
        bench.tick()
        pieces.append(of_radar(bench.network.drain_log()))
    log = np.concatenate(pieces)
    assert len(said) == SCANS
    assert len(log) == SCANS * TRACKS
    assert set(log["sender"]) == {Station.SENSORS}
    assert sum(map(len, said)) > SCANS, "the walls of the track are in view"
    for tracks, frames in zip(said, log.reshape(SCANS, TRACKS), strict=True):
        assert frames["id"].tolist() == list(range(FIRST_ID, FIRST_ID + TRACKS))
        values = [MESSAGES.decode_message(int(f["id"]), bytes(f["data"]), decode_choices=False) for f in frames]
        assert {row["CAN_TX_TRACK_ROLLING_COUNT"] for row in values} == {int(tracks["rolling_count"][0])}
        seen = {place + 1: row for place, row in enumerate(values) if row["CAN_TX_TRACK_STATUS"]}
        assert list(seen) == tracks["id"].tolist()
        for track in tracks:
            row = seen[int(track["id"])]
            assert row["CAN_TX_TRACK_STATUS"] == track["status"] != TrackStatus.NO_TARGET
            assert row["CAN_TX_TRACK_RANGE"] == pytest.approx(track["range"])
            assert row["CAN_TX_TRACK_ANGLE"] == pytest.approx(-np.degrees(track["angle"]))
            assert row["CAN_TX_TRACK_RANGE_RATE"] == pytest.approx(track["range_rate"])
            assert row["CAN_TX_TRACK_RANGE_ACCEL"] == pytest.approx(track["range_acceleration"])
            assert row["CAN_TX_TRACK_MED_RANGE_MODE"] == track["mode"]


def test_a_scan_takes_the_bus_for_as_long_as_its_bits_take(bench: Bench) -> None:
    """500 kbit/s, nothing else on the bus: 64 frames need more than a tick, and the last ones come in the next one."""
    log = of_radar(drive(bench)[0])
    wire = ffi.new("can_wire *")
    lib.can_wire_init(wire)
    stuff = ffi.new("uint32_t *")
    bits = [lib.can_wire_bits(wire, ffi.from_buffer("can_frame *", frame.tobytes()), stuff) for frame in log]
    times = log["time_us"].astype(int).reshape(SCANS, TRACKS)
    for number, lengths in enumerate(np.array(bits).reshape(SCANS, TRACKS)):
        starts_us = PHASE_US + number * PERIOD_US
        ends = np.cumsum(lengths + 3) - 3  # intermission
        assert times[number].tolist() == (starts_us + 2 * ends).tolist()
    assert (times[:, 0] // TICK_US < times[:, -1] // TICK_US).all()
    total = sum(bits) + 3 * len(bits)
    # 8 data bytes: 108 bits, at most 24 stuff bits (ISO 11898-1, 11-bit identifiers), and 3 of intermission.
    assert 111 * len(bits) <= total <= 135 * len(bits)
    statistics = bench.network.statistics()[Bus.CAN_R]
    assert (statistics.frames, statistics.lost, statistics.bits) == (SCANS * TRACKS, 0, total)
    assert statistics.load == pytest.approx(total / BIT_RATES[Bus.CAN_R] / (bench.now_us * 1e-6))
    assert statistics.load_peak == pytest.approx(1.0, abs=0.05)


def test_autonomy_gathers_every_scan(bench: Bench) -> None:
    log, scans = drive(bench)
    assert [scan.status for scan in scans] == [ScanStatus.COMPLETE] * SCANS
    for scan, frames in zip(scans, of_radar(log).reshape(SCANS, TRACKS), strict=True):
        assert scan.time_us == frames["time_us"][0]
        assert scan.tracks.tobytes() == unpack(frames["data"]).tobytes()
    counts = [int(rolling_counts(frames["data"])[0]) for frames in of_radar(log).reshape(SCANS, TRACKS)]
    assert counts == [(number + 1) % 2 for number in range(SCANS)]


def test_the_walls_are_seen_where_they_are(bench: Bench) -> None:
    """At standstill every track that is no false alarm is near a wall, and stands."""
    walls = np.concatenate([np.asarray(wall) for wall in bench.surroundings.road.walls()])
    radar = twin_of(bench)
    _, scans = drive(bench)
    kept: Tracks = np.concatenate([scan.tracks[scan.tracks["status"] == TrackStatus.UPDATED] for scan in scans])
    assert len(kept) > 10
    truth = bench.truth
    x, y = truth.x + radar._x * np.cos(truth.yaw), truth.y + radar._x * np.sin(truth.yaw)
    sight = truth.yaw + kept["angle"]
    places = np.column_stack([x + kept["range"] * np.cos(sight), y + kept["range"] * np.sin(sight)])
    nearest = np.hypot(*(places[:, None] - walls[None]).transpose(2, 0, 1)).min(axis=1)
    spacing = max(np.hypot(*np.diff(np.asarray(wall), axis=0).T).max() for wall in bench.surroundings.road.walls())
    slack = 5 * radar.errors.range_white + 5 * radar.errors.medium_range.angle_white * kept["range"] + spacing
    assert (nearest < slack).all()
    assert (np.abs(kept["range_rate"]) < 5 * radar.errors.rate_white).all()


def test_a_radar_changes_no_frame_of_the_other_buses(scenario: Scenario) -> None:
    logs = []
    for radar in (False, True):
        with build_bench(replace(scenario, radar=radar)) as bench:
            log, scans = drive(bench, 300)
            logs.append(log)
            assert (len(of_radar(log)) > 0) == (len(scans) > 0) == radar
            assert bench.losses == 0
            assert (bench.network.statistics()[Bus.CAN_R].frames > 0) == radar
    without, with_radar = logs
    assert with_radar[with_radar["bus"] != Bus.CAN_R].tobytes() == without.tobytes()


def test_a_run_is_the_same_twice_and_another_seed_sees_otherwise(scenario: Scenario) -> None:
    logs = []
    for seed in (1, 1, 2):
        with build_bench(replace(scenario, seed=seed)) as bench:
            logs.append(of_radar(drive(bench)[0]).tobytes())
    assert logs[0] == logs[1] != logs[2]


def test_a_saved_state_goes_on_with_the_same_scans(bench: Bench) -> None:
    drive(bench, 17)  # between two scans, with tracks
    state = bench.save()
    first = drive(bench)
    bench.restore(state)
    second = drive(bench)
    assert first[0].tobytes() == second[0].tobytes()
    assert [scan.tracks.tobytes() for scan in first[1]] == [scan.tracks.tobytes() for scan in second[1]]
    assert len(first[1]) >= SCANS


def test_scans_with_a_lost_frame_are_told_and_not_handed_out(bench: Bench) -> None:
    lost = bench.inject(Drop(message="Target7"), for_frames=3)
    _, scans = drive(bench)
    assert lost.count == 3
    assert [scan.status for scan in scans[:3]] == [ScanStatus.INCOMPLETE] * 3
    assert all(len(scan.tracks) == 0 and scan.frames == TRACKS - 1 for scan in scans[:3])
    assert {scan.status for scan in scans[3:]} == {ScanStatus.COMPLETE}


def test_a_bus_that_is_cut_brings_no_scan(bench: Bench) -> None:
    bench.inject(Partition(bus=Bus.CAN_R, station=Station.AUTONOMY))
    _, scans = drive(bench)
    assert scans == []


def test_the_recording_has_the_frames_and_nothing_is_wrong_with_it(scenario: Scenario, tmp_path: Path) -> None:
    with build_bench(scenario, tmp_path) as bench:
        for _ in range(200):
            bench.tick()
        recording = bench.finish()
    assert recording is not None
    log = read_log(recording.candump)
    frames = of_radar(log)
    assert len(frames) > 30 * TRACKS
    blf = read_log(recording.blf)
    assert np.array_equal(of_radar(blf)["data"], frames["data"])
    assert set(log["bus"]) == set(car_buses(radar=True))
    for place in (0, 20, TRACKS - 1):
        table = pq.read_table(recording.signals / f"Target{place + 1}.parquet")
        own = frames[frames["id"] == FIRST_ID + place]
        assert table.column("time_us").to_pylist() == own["time_us"].tolist()
        expected = [MESSAGES.decode_message(FIRST_ID + place, bytes(f["data"]), decode_choices=False) for f in own]
        for name in database.message(f"Target{place + 1}").signals:
            assert table.column(name).to_pylist() == pytest.approx([row[name] for row in expected])
    conformance = Conformance()
    conformance.update(log)
    conformance.finish()
    assert [place for place in conformance.findings if place.bus is Bus.CAN_R] == []
    assert replay_obc(log).identical
