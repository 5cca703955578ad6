"""`raceloop dbw check`: recordings of every kind, whole and broken, in pages and files that other programs read."""

from __future__ import annotations

import gzip
import json
import shutil
import zlib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from xml.etree import ElementTree

import can
import numpy as np
import pytest
from cli_harness import Answer, Command, assert_one_line, command

from bridge.bus import CHANNELS
from dbc.buses import Bus
from dbc.codec import database
from tools.cli import main
from tools.dbw.timing import RESOLUTION

SUFFIXES = (".log", ".blf", ".asc", ".log.gz", ".asc.gz")


@pytest.fixture
def raceloop(capsys: pytest.CaptureFixture[str]) -> Command:
    return command(capsys)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of a car that does everything right."""
    folder = tmp_path_factory.mktemp("drive") / "out"
    assert main(["run", "short_drive", "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def recorded(drive: Path) -> list[can.Message]:
    """The first seconds of it on CAN1."""
    with can.LogReader(drive / "frames.log") as reader:
        return [message for message, _ in zip(reader, range(10_000), strict=False) if message.channel == "CAN1"]


@pytest.fixture
def messages(recorded: list[can.Message]) -> list[can.Message]:
    """The same, to be changed."""
    return deepcopy(recorded)


def written(path: Path, messages: list[can.Message]) -> Path:
    """A recording that python-can has written, whose channel has the number of the bus."""
    with can.Logger(path) as logger:
        for message in messages:
            message.channel = int(Bus.CAN1)
            logger.on_message_received(message)
    return path


@pytest.mark.parametrize("name", ["frames.log", "frames.blf"])
def test_a_clean_recording_has_no_findings(raceloop: Command, drive: Path, name: str):
    answer = raceloop("dbw", "check", drive / name)
    assert (answer.status, answer.error) == (0, "")
    summary = json.loads((drive / "summary.json").read_text())
    frames = sum(bus["frames"] for bus in summary["buses"].values())
    assert answer.out.startswith(f"{drive / name}: {frames} frames of ")
    assert answer.out.endswith(" messages, 0 findings\n")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_recordings_of_every_kind_say_the_same(
    raceloop: Command, tmp_path: Path, messages: list[can.Message], suffix: str
):
    defective = [message for message in messages if not (message.arbitration_id == 0x57A and message.data[2] == 20)]
    path = tmp_path / f"drive{suffix}"
    if suffix.endswith(".gz"):
        plain = written(tmp_path / f"plain{path.suffixes[0]}", defective)
        path.write_bytes(gzip.compress(plain.read_bytes()))
    else:
        written(path, defective)
    answer = raceloop("dbw", "check", path)
    assert answer.status == 1
    (finding, summary) = answer.out.splitlines()
    assert finding.startswith("CAN1 steering_cmd.steering_motor_cmd_counter: counter jump, 1 time, first in frame ")
    assert finding.endswith(": 19 is followed by 21")
    assert f"{len(defective)} frames" in summary
    assert "1 finding" in summary


def test_every_suffix_that_is_offered_has_a_reader(raceloop: Command, tmp_path: Path):
    """MF4 needs a package that is not among ours, and says which."""
    path = tmp_path / "drive.mf4"
    path.write_bytes(b"MDF     4.10    ")
    assert_one_line(raceloop("dbw", "check", path), path)
    path = tmp_path / "drive.trc"
    path.write_text(";$FILEVERSION=2.1\n;$STARTTIME=45000.0\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n")
    assert_one_line(raceloop("dbw", "check", path), path, "holds no frame")


def test_counters_as_the_user_wants_them(raceloop: Command, tmp_path: Path, messages: list[can.Message]):
    """A sender that counts to 7, one that skips, and one that stays."""
    steering = [message for message in messages if message.arbitration_id == 0x57A]
    for number, message in enumerate(steering):
        message.data[2] = number % 8
    log = written(tmp_path / "short.log", steering)
    assert raceloop("dbw", "check", log).status == 0
    strict = raceloop("dbw", "check", log, "--counter", "plus-one")
    assert strict.status == 1
    assert "counter jump" in strict.out.splitlines()[0]
    assert raceloop("dbw", "check", log, "--counter", "changed").status == 0
    steering[40].data[2] = steering[39].data[2]
    log = written(tmp_path / "stuck.log", steering)
    (finding, _) = raceloop("dbw", "check", log, "--counter", "changed").out.splitlines()
    assert "counter stuck, 1 time, first in frame 40 " in finding
    with pytest.raises(SystemExit):
        main(["dbw", "check", str(log), "--counter", "plus-two"])


def test_times_between_frames_on_request(raceloop: Command, tmp_path: Path, messages: list[can.Message]):
    steering = [message for message in messages if message.arbitration_id == 0x57A]
    del steering[60:72]
    log = written(tmp_path / "drive.log", steering)
    json_path = tmp_path / "it.json"
    page = raceloop("dbw", "check", log, "--timing", "--json", json_path).out.splitlines()
    assert page[-4].split() == ["bus", "message", "frames", "cycle", "mean", "jitter", "p99", "longest", "time-outs"]
    row = page[-3].split()
    assert row[:3] == ["CAN1", "steering_cmd", str(len(steering))]
    intervals_ms = np.diff(np.rint([message.timestamp * 1e6 for message in steering])) / 1000
    cycle, mean, jitter, p99, longest = (float(word) for word in row[3:8])
    assert (cycle, row[8]) == (10.0, "1")
    assert mean == pytest.approx(intervals_ms.mean(), abs=0.001)
    assert jitter == pytest.approx(intervals_ms.std(), abs=0.001)
    assert p99 == pytest.approx(np.percentile(intervals_ms, 99, method="inverted_cdf"), rel=RESOLUTION, abs=0.001)
    assert longest == pytest.approx(intervals_ms.max(), abs=0.0011)
    figures = json.loads(json_path.read_text())["messages"]["steering_cmd"]
    assert (figures["timeouts"], figures["p99_us"]) == (1, pytest.approx(p99 * 1000, abs=0.5))
    assert len(raceloop("dbw", "check", log).out.splitlines()) == len(page) - 3


def test_files_for_other_programs(raceloop: Command, tmp_path: Path, messages: list[can.Message]):
    log = written(tmp_path / "drive.log", messages[:200] + messages[:5])
    answer = raceloop("dbw", "check", log, "--json", tmp_path / "it.json", "--junit", tmp_path / "it.xml")
    assert answer.status == 1
    content = json.loads((tmp_path / "it.json").read_text())
    assert content["frames"] == 205
    assert len(content["findings"]) == len(answer.out.splitlines()) - 1
    clock = next(finding for finding in content["findings"] if finding["rule"] == "clock")
    assert (clock["bus"], clock["first_frame"], clock["frames"]) == ("CAN1", 200, 1)
    steering = content["messages"]["steering_cmd"]
    assert steering["cycle_us"] == database.message("steering_cmd").cycle_us
    suite = ElementTree.parse(tmp_path / "it.xml").getroot()
    failing = {case.get("name") for case in suite if case.find("failure") is not None}
    assert int(suite.get("tests", 0)) == len(suite)
    assert int(suite.get("failures", 0)) == len(failing)
    assert failing == {finding["message"] or finding["bus"] for finding in content["findings"]}


def cut_blf(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def bad_line(path: Path) -> Path:
    lines = path.read_text().splitlines()
    lines[100] = "(1.0 nonsense \N{DEGREE SIGN}"
    path.write_text("\n".join(lines), encoding="latin-1")
    return path


def cut_gzip(path: Path) -> Path:
    """The stream ends between two lines, wherever half of the drive is; a line cut in two would be told as well."""
    lines = path.read_bytes().splitlines(keepends=True)
    packer = zlib.compressobj(wbits=zlib.MAX_WBITS | 16)  # with gzip's header
    cut = path.with_name("drive.log.gz")
    cut.write_bytes(packer.compress(b"".join(lines[: len(lines) // 2])) + packer.flush(zlib.Z_SYNC_FLUSH))
    return cut


@pytest.mark.parametrize(
    ("suffix", "broken", "told"),
    [
        (".blf", cut_blf, "breaks off: "),
        (".log", bad_line, "line 101 is no frame: (1.0 nonsense"),
        (".log", cut_gzip, "breaks off: "),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_what_can_be_read_of_a_broken_recording_is_checked(
    raceloop: Command,
    tmp_path: Path,
    messages: list[can.Message],
    suffix: str,
    broken: Callable[[Path], Path],
    told: str,
):
    answer = raceloop("dbw", "check", broken(written(tmp_path / f"drive{suffix}", messages)))
    assert answer.status == 1
    assert answer.error == ""
    lines = answer.out.splitlines()
    assert len([line for line in lines if line.startswith("recording: unreadable, 1 time") and told in line]) == 1, (
        answer.out
    )
    assert int(lines[-1].split()[1]) > 90


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("drive.log", b"", "holds no frame"),
        ("drive.log", b"\x00\xff\xfe", "holds no frame"),
        ("drive.blf", b"", "holds no frame"),
        ("drive.blf", b"LOGG" + bytes(200), "holds no frame"),
        ("drive.asc", b"\xff" * 100, "holds no frame"),
        ("drive.trc", b"\x00\x1b[31m\xff\n" * 3, "holds no frame; "),
        ("drive.log", b"\x00\x1b[31m\xff\n" * 3, "holds no frame; line 1 is no frame: ??[31m"),
        ("drive.csv.bak", b"", "unknown kind of log; allowed are .asc, .blf, .log, .mf4, .trc"),
        ("drive", b"", "unknown kind of log"),
        (
            "drive.log",
            b"(1.000000) can7 57A#00\n",
            "channel can7: unknown; allowed are CAN1, CAN3, CANA, CANS, CANR, vcan0",
        ),
    ],
)
def test_what_is_no_recording_is_one_line(raceloop: Command, tmp_path: Path, name: str, content: bytes, told: str):
    path = tmp_path / name
    path.write_bytes(content)
    assert_one_line(raceloop("dbw", "check", path), path, told)


def test_a_recording_that_is_not_there(raceloop: Command, tmp_path: Path):
    assert_one_line(raceloop("dbw", "check", tmp_path / "drive.log"), "No such file or directory")
    assert_one_line(raceloop("dbw", "check", tmp_path), "unknown kind of log")


def test_a_channel_of_any_name_with_the_bus_said(raceloop: Command, tmp_path: Path):
    path = tmp_path / "drive.log"
    path.write_text("(1.000000) can7 57A#2D07050000000000\n(1.010000) can7 57A#2D07060000000000 T\n")
    assert raceloop("dbw", "check", path, "--bus", "CAN1") == Answer(
        0, f"{path}: 2 frames of 1 messages, 0 findings\n", ""
    )
    assert raceloop("dbw", "check", path, "--bus", "CAN3").status == 1
    assert_one_line(raceloop("dbw", "check", path, "--bus", "CAN7"), "allowed are CAN1, CAN3, CAN-A, CAN-S")


def test_a_file_that_cannot_be_written_is_one_line(raceloop: Command, tmp_path: Path, drive: Path):
    path = shutil.copy(drive / "frames.log", tmp_path / "drive.log")
    assert_one_line(raceloop("dbw", "check", path, "--json", tmp_path / "none" / "it.json"), "none/it.json")


def test_channels_are_called_as_loggers_do(raceloop: Command, tmp_path: Path):
    path = tmp_path / "drive.log"
    for names in (CHANNELS.values(), [bus.label for bus in Bus], [f"vcan{number}" for number in range(5)]):
        path.write_text("".join(f"(1.000000) {name} 7FF#00\n" for name in names))
        found = [line.split()[0] for line in raceloop("dbw", "check", path).out.splitlines()[:-1]]
        assert found == ["CAN1", "CAN3", "CAN-A", "CAN-S", "CAN-R"]
