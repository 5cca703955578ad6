"""`raceloop run`: its page, its `summary.json`, and a rejected operation file.

The figures are recomputed from the files that the run left, with other means than the code under test: cantools for
the frames, splines through the published points for the tracking errors.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pyarrow.parquet as pq
import pytest
from cli_harness import Answer, copy_scenarios, edit
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bridge.bus import BIT_RATES
from dbc.buses import DATABASES, DIRECTORY
from dbc.codec import database
from tools.cli import main
from tools.dbw.schedule import analyse

FULL_BRAKE_KPA = 4500
LINE = re.compile(r"\((\d+\.\d+)\) (\w+) ([0-9A-F]+)#([0-9A-F]*) [RT]")
CHANNELS = {"raptor": "CAN1", "space_drive": "CAN3", "autonomy": "CANA", "sensors": "CANS", "radar_esr": "CANR"}


@dataclass(frozen=True)
class Run:
    folder: Path
    answer: Answer
    summary: dict[str, Any]
    frames: list[tuple[float, str, int, bytes]]
    truth: dict[str, NDArray[np.float64]]

    def decoded(self, name: str) -> list[tuple[float, dict[str, Any]]]:
        """Time in s and signals of every frame of a message, by cantools."""
        for stem in DATABASES:
            database = cantools.database.load_file(DIRECTORY / f"{stem}.dbc")
            if any(message.name == name for message in database.messages):
                break
        message, channel = database.get_message_by_name(name), CHANNELS[stem]
        return [
            (time, message.decode(data))
            for time, bus, identifier, data in self.frames
            if bus == channel and identifier == message.frame_id
        ]


def drive(scenario: Path, folder: Path) -> Run:
    out, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        status = main(["run", str(scenario), "--out", str(folder)])
    matches = (LINE.fullmatch(line) for line in (folder / "frames.log").read_text().splitlines())
    frames = [(float(m[1]), m[2], int(m[3], 16), bytes.fromhex(m[4])) for m in matches if m]
    table = pq.read_table(folder / "truth.parquet")
    return Run(
        folder,
        Answer(status, out.getvalue(), error.getvalue()),
        json.loads((folder / "summary.json").read_text()),
        frames,
        {name: table.column(name).to_numpy() for name in table.column_names},
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Power-on to more than 150 km/h: the out-lap begins at once, and time is up soon."""
    folder = tmp_path_factory.mktemp("run")
    scenario = copy_scenarios(folder / "scenarios")
    edit(scenario, "distance_m: 250.0", "distance_m: 10.0")
    edit(scenario, "time_limit_s: 300.0", "time_limit_s: 24.0")
    return drive(scenario, folder / "out")


@pytest.fixture(scope="module")
def rejected(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("rejected")
    scenario = copy_scenarios(folder / "scenarios")
    edit(folder / "scenarios/operations/solo.yaml", "max_speed: 63.1", "max_speed: -63.1\nmax_sped: .nan")
    return drive(scenario, folder / "out")


def test_keys_of_the_summary(run: Run) -> None:
    assert set(run.summary) == {
        "scenario", "profile", "seed", "finished", "configuration", "offences", "simulated_s", "wall_s",
        "wall_with_recording_s", "real_time_factor", "laps_s", "top_speed_kmh", "top_lateral_acceleration_mps2",
        "distance_m", "tracking", "yaw_error_share_in_band", "cross_track_share_left", "plans",
        "plans_behind_a_car", "times_behind_a_car", "ssm_transitions",
        "ct_state_transitions", "sys_state_transitions", "faults", "injected", "executive", "safety", "buses",
        "frames_lost",
        "frame_log_sha256", "folder", "files",
    }  # fmt: skip
    for row in run.summary["tracking"]:
        assert set(row) == {
            "speed_range_kmh", "samples", "cte_max_m", "cte_abs_mean_m", "cte_std_m", "yaw_error_max_rad",
        }  # fmt: skip


def test_a_profile_is_said_and_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = copy_scenarios(tmp_path / "scenarios")
    edit(scenario, "time_limit_s: 300.0", "time_limit_s: 0.5")
    assert main(["run", str(scenario), "--out", str(tmp_path / "out"), "--profile", "V26"]) == 1
    assert capsys.readouterr().out.startswith("solo_lap, seed 20221103, CAN1 in V26\n")
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["profile"] == "V26"
    assert "F_brake_pressure_cmd" in pq.read_schema(tmp_path / "out/signals/brake_pressure_cmd.parquet").names


def test_run_that_is_out_of_time(run: Run) -> None:
    assert run.answer.status == 1
    assert run.answer.error == ""
    assert run.answer.out.endswith("Not finished within the scenario's 24 s\n")
    summary = run.summary
    assert (summary["finished"], summary["configuration"], summary["offences"]) == (False, "ACCEPTED", [])
    assert (summary["scenario"], summary["seed"], summary["simulated_s"]) == ("solo_lap", 20221103, 24.0)
    assert (summary["laps_s"], summary["faults"], summary["frames_lost"]) == ([], [], 0)
    assert summary["real_time_factor"] == pytest.approx(24.0 / summary["wall_s"])
    assert summary["wall_with_recording_s"] >= summary["wall_s"] > 0.0


def test_files_are_there_and_nothing_else(run: Run) -> None:
    assert {path.name + "/" * path.is_dir() for path in run.folder.iterdir()} == set(run.summary["files"])
    assert hashlib.sha256((run.folder / "frames.log").read_bytes()).hexdigest() == run.summary["frame_log_sha256"]


def test_page_fits_80_columns_and_breaks_no_cell(run: Run) -> None:
    for line in run.answer.out.splitlines():
        assert len(line) <= 80 or line.startswith("Files in "), line
    rows = [line for line in run.answer.out.splitlines() if line.startswith(("  0-100", "100-150", "  > 150"))]
    assert len(rows) == 3
    for line, row in zip(rows, run.summary["tracking"], strict=True):
        for figure in ("cte_max_m", "cte_abs_mean_m", "cte_std_m", "yaw_error_max_rad"):
            assert f" {row[figure]:.3f} (" in line
    assert run.summary["frame_log_sha256"] in run.answer.out


def test_speed_and_distance(run: Run) -> None:
    truth, summary = run.truth, run.summary
    assert summary["top_speed_kmh"] == pytest.approx(3.6 * np.sqrt(truth["vx"] ** 2 + truth["vy"] ** 2).max())
    path = np.hypot(np.diff(truth["x"]), np.diff(truth["y"])).sum()
    assert summary["distance_m"] == pytest.approx(path, rel=2e-3)
    # Lateral acceleration is yaw rate times speed plus the little that the side slip changes.
    turning = np.abs(np.gradient(truth["vy"], 0.01) + truth["yaw_rate"] * truth["vx"])
    assert summary["top_lateral_acceleration_mps2"] == pytest.approx(turning.max(), rel=0.05)


def test_buses(run: Run) -> None:
    counted = Counter(bus for _, bus, _, _ in run.frames)
    assert {name: bus["frames"] for name, bus in run.summary["buses"].items()} == counted
    for bus in run.summary["buses"].values():
        assert bus["frames_per_s"] == pytest.approx(bus["frames"] / 24.0)
        # 8 data bytes: 111 bits with the gap, at most 24 stuff bits (ISO 11898-1, standard identifiers).
        assert 0.9 * 47 * bus["frames"] < bus["load"] * 24.0 * bus["bit_rate"] <= 135 * bus["frames"]
        assert bus["load"] < bus["load_peak"] <= 1.0
        assert bus["lost"] == 0


def test_waits_of_messages(run: Run) -> None:
    bounds = {}
    for bus, rate in BIT_RATES.items():
        _, rows = analyse(database, bus, rate, None)
        bounds.update({row.codec.name: row.response_ns for row in rows})
    for name, bus in run.summary["buses"].items():
        assert sum(message["frames"] for message in bus["messages"].values()) == bus["frames"]
        for key, message in bus["messages"].items():
            assert 0 <= message["mean_queueing_us"] <= message["worst_queueing_us"]
            assert message["worst_queueing_us"] + 44e6 / bus["bit_rate"] <= message["worst_response_us"]
            if message["cycle_us"]:
                assert message["worst_response_us"] <= min(bounds[key] / 1000, message["cycle_us"]), key
        shown = re.search(rf"^{name} +(\S+) .* (\d+) of (\d+)$", run.answer.out, re.MULTILINE)
        assert shown is not None
        assert shown[2] == shown[3]
        shares = {
            key: message["worst_response_us"] / message["cycle_us"]
            for key, message in bus["messages"].items()
            if message["cycle_us"]
        }
        assert shares[shown[1]] == max(shares.values())


@pytest.mark.parametrize(
    ("key", "message", "signal"),
    [
        ("ssm_transitions", "ssm_status", "ssm_state"),
        ("ct_state_transitions", "ct_report", "ct_state"),
        ("sys_state_transitions", "misc_report", "sys_state"),
    ],
)
def test_transitions(run: Run, key: str, message: str, signal: str) -> None:
    states = [(time, str(signals[signal])) for time, signals in run.decoded(message)]
    expected = [
        {"time_s": pytest.approx(time, abs=1e-6), "before": before, "state": state}
        for (_, before), (time, state) in pairwise(states)
        if before != state
    ]
    assert run.summary[key] == expected
    assert len(expected) >= 2


def test_executive(run: Run) -> None:
    _, last = run.decoded("executive_statistics")[-1]
    assert run.summary["executive"] == {
        "frames": last["executive_frames"],
        "overruns": last["executive_overruns"],
        "late_frames": last["executive_late_frames"],
    }
    assert last["executive_frames"] > 2300
    assert last["executive_overruns"] == last["executive_late_frames"] == 0


def published_plans(run: Run) -> list[tuple[float, NDArray[np.float64]]]:
    """When each plan was whole on the bus, and its points: x, y."""
    plans: list[tuple[float, NDArray[np.float64]]] = []
    points: list[tuple[float, float]] = []
    motions = [time for time, _ in run.decoded("trajectory_motion")]
    for place, (_, pose) in enumerate(run.decoded("trajectory_pose")):
        if pose["pose_index"] == 0 and points:
            plans.append((motions[place - 1], np.array(points)))
            points = []
        if place < len(motions):
            points.append((pose["pose_x"], pose["pose_y"]))
    return plans


def test_tracking_against_splines_through_the_plans(run: Run) -> None:
    """The errors of every sample, from a cubic spline through the points of the newest plan."""
    plans, truth = published_plans(run), run.truth
    whole_us = np.array([round(time * 1e6) for time, _ in plans])
    speed = np.hypot(truth["vx"], truth["vy"])
    newest = np.searchsorted(whole_us, truth["time_us"], side="right") - 1
    errors = []
    for number in np.unique(newest[newest >= 0]):
        points = plans[number][1]
        chord = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        spline = CubicSpline(chord, points)
        for sample in np.flatnonzero((newest == number) & (speed > 0.5)):
            here = np.array([truth["x"][sample], truth["y"][sample]])
            along = chord[np.argmin(np.hypot(*(points - here).T))]
            for _ in range(8):  # Newton's foot point: the spline's parameter is its length to one part in 10^4
                away, heading = here - spline(along), spline(along, 1)
                along += away @ heading / (heading @ heading)
            yaw = np.arctan2(heading[1], heading[0])
            turn = truth["yaw"][sample] - yaw
            errors.append(
                (
                    speed[sample] * 3.6,
                    heading[0] * away[1] - heading[1] * away[0],
                    np.arctan2(np.sin(turn), np.cos(turn)),
                )
            )
    kmh, cross_track, yaw_error = np.array(errors).T
    assert kmh.max() > 155.0
    for row, low, high in zip(run.summary["tracking"], (0.0, 100.0, 150.0), (100.0, 150.0, None), strict=True):
        inside = (kmh >= low) & (kmh < (high or np.inf))
        assert row["speed_range_kmh"] == [low, high]
        assert row["samples"] == pytest.approx(inside.sum(), abs=20)  # the last plan is still on its way
        assert inside.sum() > 100
        assert row["cte_max_m"] == pytest.approx(np.abs(cross_track[inside]).max(), abs=4e-3)
        assert row["cte_abs_mean_m"] == pytest.approx(np.abs(cross_track[inside]).mean(), abs=2e-3)
        assert row["cte_std_m"] == pytest.approx(cross_track[inside].std(), abs=2e-3)
        assert row["yaw_error_max_rad"] == pytest.approx(np.abs(yaw_error[inside]).max(), abs=1e-3)
    assert run.summary["yaw_error_share_in_band"] == pytest.approx(np.mean(np.abs(yaw_error) < 0.02), abs=0.02)
    assert run.summary["cross_track_share_left"] == pytest.approx(np.mean(cross_track > 0.0), abs=0.05)


def test_rejected_operation_file_is_told_in_full(rejected: Run) -> None:
    """The run ends soon, with the user's exit status, every offence and the fault in the summary."""
    answer, summary = rejected.answer, rejected.summary
    assert (answer.status, answer.error) == (2, "")
    assert (summary["finished"], summary["configuration"]) == (False, "REJECTED")
    assert 3.0 <= summary["simulated_s"] < 3.5
    offences = [(offence["key"], offence["value"], offence["reason"]) for offence in summary["offences"]]
    assert offences == [("max_speed", "-63.1", "wrong sign"), ("max_sped", "nan", "unknown key")]
    path = rejected.folder.parent / "scenarios/operations/solo.yaml"
    last = answer.out.splitlines()[-4:]
    assert last[0] == f"{path}: rejected, 2 offences"
    assert last[1].startswith("  max_speed: -63.1: wrong sign; allowed: a number from ")
    assert last[2].startswith("  max_sped: nan: unknown key; allowed: ")
    assert last[3] == "Not driven: the onboard computer holds full brake until the next power-on"
    assert [fault["fault"] for fault in summary["faults"]] == ["parameters_rejected"]
    assert summary["faults"][0]["reaction"] == "full_brake"
    assert summary["faults"][0]["cleared_s"] is None
    assert summary["ssm_transitions"][-1]["state"] == "FULL_BRAKE"


def test_rejected_operation_file_holds_the_car(rejected: Run) -> None:
    """Full pressure on CAN1 from the first frame on; the Space Drive applies it; the car stays."""
    pressures = [signals["brake_pressure_cmd"] for _, signals in rejected.decoded("brake_pressure_cmd")]
    assert len(pressures) >= 300
    assert set(pressures) == {FULL_BRAKE_KPA}
    truth = rejected.truth
    assert truth["brake_pressure_front"][100:].min() > 0.9 * truth["brake_pressure_front"].max() > 1.0e6
    assert np.hypot(truth["x"] - truth["x"][0], truth["y"] - truth["y"][0]).max() < 0.01
    assert truth["engine_speed"].max() == 0.0


def test_short_drive_leads_from_power_on_to_standstill(tmp_path: Path) -> None:
    """The shipped scenario that fits into the time of a look: the whole chain, without a fault."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main(["run", "short_drive", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["finished"]
    assert summary["faults"] == []
    assert summary["simulated_s"] < 25.0
    assert 49.0 < summary["top_speed_kmh"] < 51.5
    assert [change["state"] for change in summary["sys_state_transitions"]][-2:] == ["SHUT_ENG", "PWR_OFF"]
