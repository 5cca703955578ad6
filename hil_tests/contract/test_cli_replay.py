"""`raceloop replay` on a real recording, on a changed one, and on what is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from bridge.scenario import Condition, load_scenario
from tools.cli import main
from tools.run import DEFAULT_SCENARIO, build_bench


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run-up to a moving car."""
    folder = tmp_path_factory.mktemp("recording")
    with build_bench(load_scenario(DEFAULT_SCENARIO), folder) as bench:
        bench.run(until=Condition(time_us=9_000_000))
        assert bench.truth.vx > 1.0
        bench.finish()
    return folder


@pytest.mark.parametrize("name", ["frames.log", "frames.blf"])
def test_recording_replays_identically(recording: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(recording / name)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "replayed identically" in out
    assert int(out.split(": ")[1].split(" ")[0]) > 5_000


def test_a_recording_of_another_profile_replays_by_that_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The scenario says V26; the run of a second and a half has its configuration, states and commands."""
    with build_bench(replace(load_scenario(DEFAULT_SCENARIO), profile="V26"), tmp_path) as bench:
        bench.run(until=Condition(time_us=1_500_000))
        bench.finish()
    columns = pq.read_schema(tmp_path / "signals" / "brake_pressure_cmd.parquet").names
    assert columns == ["time_us", "F_brake_pressure_cmd", "R_brake_pressure_cmd", "brk_pressure_cmd_counter"]
    log = str(tmp_path / "frames.log")
    assert main(["replay", log, "--profile", "V26"]) == 0
    assert "replayed identically" in " ".join(capsys.readouterr().out.split())
    assert main(["replay", log]) == 1
    assert main(["replay", log, "--profile", "V27"]) == 2
    assert capsys.readouterr().err == "raceloop: no profile is called 'V27'; there are V14, V26\n"


def test_changed_input_is_told_with_its_time(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = (recording / "frames.log").read_text().splitlines(keepends=True)
    place = next(i for i, line in enumerate(lines) if " CANA 048#" in line and float(line[1 : line.index(")")]) > 8.0)
    stamp, channel, frame = lines[place].split()[:3]
    changed = frame[:4] + f"{int(frame[4:6], 16) ^ 0x80:02X}" + frame[6:]
    lines[place] = lines[place].replace(f"{stamp} {channel} {frame}", f"{stamp} {channel} {changed}")
    copy = tmp_path / "frames.log"
    copy.write_text("".join(lines))
    assert main(["replay", str(copy)]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert f"first difference is in the tick at {int(float(stamp[1:-1]) * 100) / 100:.2f} s" in out


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("frames.log", "not a log\n", "not a readable log"),
        ("frames.log", "(0.000000) CANS 120#0000000000000000 R\n", "holds no frame of the onboard computer"),
        ("frames.log", "(0.000000) vcan0 120#0000000000000000 R\n", "channel vcan0"),
        ("frames.asc", "", "allowed are .log"),
        ("frames.log", None, "No such file"),
    ],
)
def test_what_is_no_recording_gives_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: str | None, said: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    assert main(["replay", str(path)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert str(path) in captured.err
    assert said in captured.err
