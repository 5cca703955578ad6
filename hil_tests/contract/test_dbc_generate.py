"""dbc/generate.py: the same DBC files give the same C, broken ones one line."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from dbc.buses import DIRECTORY, STEMS
from dbc.errors import ConfigurationError
from dbc.generate import generate_all, main
from dbc.network import load_database, load_network


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    folder = tmp_path / "dbc"
    folder.mkdir()
    for stem in STEMS:
        shutil.copy(DIRECTORY / f"{stem}.dbc", folder)
    return folder


def test_two_runs_are_identical_and_dated_by_hash(tmp_path: Path, sources: Path) -> None:
    for out in ("one", "two"):
        assert main(["--out", str(tmp_path / out), "--dbc", str(sources)]) == 0
    one = {path.name: path.read_bytes() for path in sorted((tmp_path / "one" / "generated").iterdir())}
    two = {path.name: path.read_bytes() for path in sorted((tmp_path / "two" / "generated").iterdir())}
    assert one == two
    assert set(one) == {f"{name}.{end}" for name in (*STEMS, "codec_table", "codec_values_table") for end in "hc"}
    for stem in STEMS:
        digest = hashlib.sha256((sources / f"{stem}.dbc").read_bytes()).hexdigest().encode()
        for name in (f"{stem}.h", f"{stem}.c", "codec_table.c", "codec_values_table.c"):
            assert digest in one[name], name
    for name, content in one.items():
        assert not re.search(rb"\b(Mon|Tue|Wed|Thu|Fri|Sat|Sun) |\b\d\d:\d\d:\d\d\b", content), name


def test_another_source_gives_another_hash(sources: Path) -> None:
    before = generate_all(sources)
    path = sources / "sensors.dbc"
    path.write_text(path.read_text(encoding="ascii").replace('VERSION "1"', 'VERSION "2"'), encoding="ascii")
    after = generate_all(sources)
    changed = {name for name in before if before[name] != after[name]}
    assert changed == {f"{n}.{end}" for n in ("sensors", "codec_table", "codec_values_table") for end in "hc"}


def edit(old: str, new: str) -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        text = path.read_text(encoding="ascii")
        assert old in text
        path.write_text(text.replace(old, new, 1), encoding="ascii")

    return apply


BREAKS: list[tuple[str, Callable[[Path], None], str]] = [
    ("missing", lambda path: path.unlink(), r"raptor\.dbc: No such file or directory"),
    ("empty", lambda path: path.write_text("", encoding="ascii"), r"raptor\.dbc: "),
    ("not a dbc", lambda path: path.write_bytes(bytes(range(256))), r"raptor\.dbc: not a valid DBC file: "),
    ("cut off", lambda path: path.write_bytes(path.read_bytes()[:5000]), r"raptor\.dbc: Baudrate: is missing"),
    ("cut in a line", lambda path: path.write_bytes(path.read_bytes()[:-20]), r"raptor\.dbc: not a valid DBC file: "),
    ("overlap", edit("acc_pedal_cmd_counter : 16|8", "acc_pedal_cmd_counter : 15|8"), r"raptor\.dbc: .*overlapping"),
    ("beyond the end", edit("veh_num : 48|8", "veh_num : 60|8"), r"raptor\.dbc: .*does not fit"),
    ("too long", edit("BO_ 1400 brake_pressure_cmd: 8", "BO_ 1400 brake_pressure_cmd: 12"), r"12 bytes; classic CAN"),
    (
        "no sender",
        edit("steering_cmd: 8 OBC", "steering_cmd: 8 Vector__XXX"),
        r"steering_cmd: needs exactly one sender",
    ),
    (
        "no receiver",
        edit('base_to_car_heartbeat : 0|4@1+ (1,0) [0|0] "" OBC', 'base_to_car_heartbeat : 0|4@1+ (1,0) [0|0] "" TEAM'),
        r"base_to_car_summary: needs receivers, all out of",
    ),
    (
        "no such counter",
        edit('BO_ 1402 "steering_motor_cmd_counter"', 'BO_ 1402 "steering_counter"'),
        r"steering_cmd: attribute names the signal steering_counter, which does not exist",
    ),
    (
        "counter too wide",
        edit("steering_motor_cmd_counter : 16|8", "steering_motor_cmd_counter : 16|9"),
        r"steering_cmd\.steering_motor_cmd_counter: must be little-endian, unsigned, unscaled, 1 to 8 bits",
    ),
    (
        "counter big-endian",
        edit("steering_motor_cmd_counter : 16|8@1+", "steering_motor_cmd_counter : 23|8@0+"),
        r"steering_cmd\.steering_motor_cmd_counter: must be little-endian",
    ),
    ("float", edit("VERSION", "SIG_VALTYPE_ 226 Latitude : 1;\nVERSION"), r"raptor\.dbc: "),
    (
        "multiplexed",
        edit(
            'SG_ base_to_car_heartbeat : 0|4@1+ (1,0) [0|0] "" OBC\n SG_ track_flag :',
            'SG_ base_to_car_heartbeat M : 0|4@1+ (1,0) [0|0] "" OBC\n SG_ track_flag m0 :',
        ),
        r"base_to_car_summary: multiplexed",
    ),
]


@pytest.mark.parametrize(("change", "problem"), [pytest.param(*row[1:], id=row[0]) for row in BREAKS])
def test_broken_dbc_file_is_one_line(
    sources: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Callable[[Path], None], problem: str
) -> None:
    change(sources / "raptor.dbc")
    assert main(["--out", str(tmp_path / "out"), "--dbc", str(sources)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(sources / "raptor.dbc") in error
    assert re.search(problem, error)
    assert not (tmp_path / "out").exists()  # nothing half-written


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        load_network(tmp_path / "nowhere")


def test_folder_instead_of_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="Is a directory"):
        load_database(tmp_path)
