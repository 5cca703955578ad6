"""`raceloop dbw encode` and `decode`: the right bytes, the right words, and what does not fit is refused."""

from __future__ import annotations

import re
import shlex
import shutil
import threading
from pathlib import Path

import can
import numpy as np
import pytest
from cli_harness import Answer, Command, assert_one_line, command, edit
from golden_frames import GOLDEN, GoldenFrame
from hub_process import Hub

from dbc.buses import DIRECTORY
from dbc.codec import MessageCodec, database
from dbc.network import raw_limits

PAGE = Path(__file__).resolve().parents[2] / "docs" / "dbw.md"

PORT = "29536"
"""Of the hub, unless another is given."""

SEED = 20221103

GOLDEN_V26 = (
    (
        "brake_pressure_cmd",
        "578#BE0AFC0800060000",
        "F_brake_pressure_cmd=2750 R_brake_pressure_cmd=2300 brk_pressure_cmd_counter=6",
    ),
    (
        "steering_cmd",
        "57A#2D07052805050A00",
        "steering_motor_ang_cmd=-105.5 steering_motor_cmd_counter=5 driver_steering_P_cmd=4.0 driver_steering_I_cmd=0.5"
        " driver_steering_D_cmd=0.05 driver_steering_FF_cmd=1.0",
    ),
    (
        "steering_report_extd",
        "520#2D072E072D07",
        "primary_steering_angle_fbk=-105.5 secondary_steering_ang_fdbk=-105.0 average_steering_ang_fdbk=-105.5",
    ),
    (
        "dash_switches_cmd",
        "57E#3309000000000000",
        "driver_traction_aim_switch=3 driver_traction_range_switch=3 brake_bias_aim_switch=INDEPENDENT",
    ),
)
"""Of V26; the last one counted by hand."""


@pytest.fixture
def raceloop(capsys: pytest.CaptureFixture[str]) -> Command:
    return command(capsys)


def frame_in(out: str) -> str:
    found = re.match(r"\w+: ([0-9A-F]+#[0-9A-F]*) on ", out)
    assert found is not None, out
    return found[1]


def values_in(out: str) -> dict[str, tuple[float, int]]:
    """Physical and raw value by signal, from the table of a page."""
    rows = re.findall(r"^[a-zA-Z]  (\w+) +(\S+) .*?(-?\d+)  \d+\|\d+@[01][+-]", out, re.MULTILINE)
    return {name: (float(value), int(raw)) for name, value, raw in rows}


@pytest.mark.parametrize("golden", [pytest.param(golden, id=golden.message) for golden in GOLDEN])
def test_golden_frames(raceloop: Command, golden: GoldenFrame):
    """A CRC that no other encoder computed is given as 0, and told to be wrong."""
    facts = database.facts(golden.message)
    values = {name: f"{value:.12g}" for name, value in golden.values.items()}
    values |= {facts.crc.name: "0"} if facts.crc else {}
    encoded = raceloop("dbw", "encode", golden.message, *(f"{name}={value}" for name, value in values.items()))
    assert (encoded.status, encoded.error) == (0, "")
    assert frame_in(encoded.out) == f"{facts.message.frame_id:03X}#{golden.data.upper()}"
    decoded = raceloop("dbw", "decode", frame_in(encoded.out))
    assert values_in(decoded.out) == values_in(encoded.out)
    assert decoded.status == (1 if facts.crc else 0)
    assert facts.crc or decoded == encoded


def test_names_of_a_value_table(raceloop: Command):
    encoded = raceloop("dbw", "encode", "base_to_car_summary", "track_flag=GREEN", "veh_flag=NONE_ALT")
    assert frame_in(encoded.out) == "4B0#4001000000000000"


@pytest.mark.parametrize(("message", "frame", "values"), GOLDEN_V26)
def test_golden_frames_of_v26(raceloop: Command, message: str, frame: str, values: str):
    encoded = raceloop("dbw", "encode", "--profile", "V26", message, *values.split())
    assert (encoded.status, encoded.error) == (0, "")
    assert frame_in(encoded.out) == frame
    assert raceloop("dbw", "decode", frame, "--profile", "V26") == encoded
    assert raceloop("dbw", "decode", frame) != encoded


def test_profiles_are_listed_and_compared(raceloop: Command):
    listed = raceloop("dbw", "profiles")
    assert listed.status == 0
    assert [line.split(":")[0] for line in listed.out.splitlines()] == ["V14 (default)", "V26"]
    assert raceloop("dbw", "profiles", "V26", "V26") == Answer(0, "no difference in what is on the wire\n", "")
    there, back = raceloop("dbw", "profiles", "V14", "V26"), raceloop("dbw", "profiles", "V26", "V14")
    assert (there.status, back.status) == (1, 1)
    assert "novatel_report (546): is new\n" in there.out
    assert "novatel_report (546): is gone\n" in back.out
    by_file = raceloop("dbw", "diff", DIRECTORY / "raptor.dbc", DIRECTORY / "raptor_v26.dbc")
    assert by_file.out == there.out


@pytest.mark.parametrize("codec", list(database), ids=lambda codec: codec.name)
def test_every_message_as_cantools_has_it(raceloop: Command, codec: MessageCodec):
    """Random raw values; the values that are printed give the same frame again."""
    random = np.random.default_rng(SEED)
    crc = database.facts(codec.name).crc
    raw = {signal.name: int(random.integers(*raw_limits(signal), endpoint=True)) for signal in codec.definition.signals}
    data = codec.definition.encode(raw, scaling=False, strict=False)
    frame = f"{codec.frame_id:0{8 if codec.extended else 3}X}#{data.hex().upper()}"
    decoded = raceloop("dbw", "decode", frame, "--bus", codec.bus.label)
    assert decoded.status == (0 if crc is None else 1), SEED
    assert frame_in(decoded.out) == frame
    shown = values_in(decoded.out)
    assert {name: number for name, (_, number) in shown.items()} == raw
    physical = codec.definition.decode(data, decode_choices=False)
    assert {name: value for name, (value, _) in shown.items()} == pytest.approx(physical, rel=1e-8)
    # Ten digits are printed, which is more than a step of any signal.
    again = raceloop("dbw", "encode", codec.name, *(f"{name}={value!r}" for name, (value, _) in shown.items()))
    assert again.status == 0, again.error
    assert frame_in(again.out) == frame


def test_an_identifier_of_the_radar_too_is_not_the_radars_unless_it_is_said(raceloop: Command):
    """518 is misc_report on CAN1, of five bytes, and Target25 on CAN-R, of eight."""
    for frame in ("518#8409410604", "518#8409410604000000"):
        answer = raceloop("dbw", "decode", frame)
        assert answer.status == 0
        assert "misc_report" in answer.out
        assert "Target25" not in answer.out
    answer = raceloop("dbw", "decode", "518#8409410604000000", "--bus", "CAN-R")
    assert answer.status == 0
    assert "misc_report" not in answer.out
    assert "Target25" in answer.out
    assert "ESR_Status2" in raceloop("dbw", "decode", "4E1#0000000000000000").out
    assert_one_line(raceloop("dbw", "decode", "518#84", "--bus", "CAN-R"), "Target25 has 8 data bytes, not 1")


def test_a_crc_is_computed_and_checked(raceloop: Command):
    encoded = raceloop("dbw", "encode", "req_brake_pos", "contrl_pos_brk=100", "Appl_Message_Counter=3")
    frame = frame_in(encoded.out)
    assert raceloop("dbw", "decode", frame).status == 0
    broken = frame.replace("#64", "#65")
    answer = raceloop("dbw", "decode", broken)
    assert answer.status == 1
    right = re.search(r"the CRC is wrong; a frame with this content is (\S+)$", answer.out, re.MULTILINE)
    assert right is not None
    assert right[1].startswith("021#65")
    assert raceloop("dbw", "decode", right[1]).status == 0
    given = raceloop("dbw", "encode", "req_brake_pos", "CCIT_CRC=4660")
    assert frame_in(given.out).endswith("3412")


def test_what_is_odd_is_said(raceloop: Command):
    between = raceloop("dbw", "encode", "steering_cmd", "steering_motor_ang_cmd=3.3")
    assert between.status == 0
    assert between.out.splitlines()[-1] == "steering_motor_ang_cmd: 3.3 is between two steps of 0.5: 3.5"
    exact = raceloop("dbw", "encode", "steering_cmd", "steering_motor_ang_cmd=3.5")
    assert exact.out.splitlines()[-1].startswith("   7")
    stray = raceloop("dbw", "decode", "57A#0008000000000000")
    assert stray.out.splitlines()[-1] == "bits of no signal are set"
    longer = raceloop("dbw", "decode", "517#2D071100")
    assert longer.out.splitlines()[-1] == "4 bytes, of which the message has 3"


def test_an_identifier_that_two_buses_have_is_shown_for_both(raceloop: Command):
    both = raceloop("dbw", "decode", "060#0000000000000000")
    assert len(re.findall(r"^\w+: 060#0{16} on (\S+),", both.out, re.MULTILINE)) == 2
    one = raceloop("dbw", "decode", "060#0000000000000000", "--bus", "CAN3")
    assert re.findall(r"^\w+: 060#0{16} on (\S+),", one.out, re.MULTILINE) == ["CAN3"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("encode brake_pressure_cmd brake_pressure_cmd=8192", "allowed is 0 to 8191"),
        ("encode steering_cmd steering_motor_ang_cmd=-512.5", "allowed is -512 to 511.5"),
        ("encode steering_cmd steering_motor_ang_cmd=inf", "is not finite; allowed is -512 to 511.5"),
        ("encode steering_cmd steering_motor_ang_cmd=nan", "'nan'; must be a number from -512 to 511.5"),
        ("encode steering_cmd steering_motor_ang_cmd=left", "'left'; must be a number from -512 to 511.5"),
        ("encode ct_report ct_state=RACING", "or UNINITIALISED, PWR_ON"),
        ("encode steering_cmd angle=1", "the nearest is 'steering_motor_ang_cmd'"),
        ("encode steering_cmd steering_motor_ang_cmd", "must be SIGNAL=VALUE; signals are steering_motor_ang_cmd,"),
        ("encode gear_shift_cmd desired_gear=1 desired_gear=2", "is given twice"),
        ("encode steering", "the nearest is 'steering_cmd'"),
        ("decode 57A#2D", "steering_cmd has 8 data bytes, not 1"),
        ("decode 7FF#00", "no message on any bus has the 11-bit identifier 7FF"),
        ("decode 57A#0000000000000000 --bus CAN3", "no message on CAN3 has the 11-bit identifier 57A"),
        ("decode 57A#0000000000000000 --bus CAN2", "allowed are CAN1, CAN3, CAN-A, CAN-S"),
        ("decode 518#8409410604 --profile V26", "misc_report has 6 data bytes, not 5"),
        ("encode brake_pressure_cmd brake_pressure_cmd=1 --profile V26", "the nearest is 'R_brake_pressure_cmd'"),
        ("decode 546#0000000000000000", "no message on any bus has the 11-bit identifier 546"),
        ("decode 518#8409410604 --profile V27", "no profile is called 'V27'; there are V14, V26"),
        ("check drive.log --profile v26", "no profile is called 'v26'; there are V14, V26"),
        ("profiles V14", "must be two profiles to compare, or none to list"),
        ("profiles V14 V26 V14", "must be two profiles to compare, or none to list"),
        ("profiles V14 V27", "no profile is called 'V27'; there are V14, V26"),
        ("decode steering", "must be like 57A#2D07050000000000"),
    ],
)
def test_a_mistake_is_one_line(raceloop: Command, words: str, told: str):
    assert_one_line(raceloop("dbw", *words.split()), told)


def test_lint_and_diff_by_their_exit_status(raceloop: Command, tmp_path: Path):
    sensors, other = DIRECTORY / "sensors.dbc", tmp_path / "other.dbc"
    assert raceloop("dbw", "lint", sensors) == Answer(0, f"{sensors}: 10 messages, nothing to say\n", "")
    broken = raceloop("dbw", "lint", DIRECTORY / "raptor.dbc")
    assert broken.status == 1
    assert all(line.startswith(f"{DIRECTORY / 'raptor.dbc'}: ") for line in broken.out.splitlines())
    assert raceloop("dbw", "diff", sensors, sensors) == Answer(0, "no difference in what is on the wire\n", "")
    edit(Path(shutil.copy(sensors, other)), "BO_ 256 gnss_a_position: 8", "BO_ 256 gnss_a_position: 7")
    differing = raceloop("dbw", "diff", sensors, other)
    assert differing == Answer(1, "gnss_a_position (100): length in bytes 8 is now 7\n", "")


@pytest.mark.parametrize("content", [None, b"", b"\x00\xff\x81", b"BO_ 1 x"], ids=["none", "empty", "binary", "cut"])
def test_a_file_that_is_no_dbc_is_one_line(raceloop: Command, tmp_path: Path, content: bytes | None):
    path = tmp_path / "broken.dbc"
    if content is not None:
        path.write_bytes(content)
    for arguments in (("lint", path), ("diff", DIRECTORY / "sensors.dbc", path)):
        assert_one_line(raceloop("dbw", *arguments), path)


def test_the_guide_shows_what_is_printed(raceloop: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "dbc").symlink_to(DIRECTORY)
    mine = Path(shutil.copy(DIRECTORY / "raptor.dbc", tmp_path / "mine.dbc"))
    edit(mine, "steering_motor_ang_cmd : 0|11@1- (0.5,0)", "steering_motor_ang_cmd : 0|11@1- (0.25,0)")
    edit(mine, "BO_ 1403 gear_shift_cmd", "BO_ 1409 gear_shift_cmd")
    edit(mine, 'BA_ "GenMsgCycleTime" BO_ 1403', 'BA_ "GenMsgCycleTime" BO_ 1409')
    (log,) = re.findall(r"^`drive.log`[^\n]*\n\n```text\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    (tmp_path / "drive.log").write_text(log)
    monkeypatch.chdir(tmp_path)
    shown = re.findall(r"^```sh\n(raceloop dbw [^\n]*)\n```\n\n```text\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    assert {line.split()[2] for line, _ in shown} == {
        "encode",
        "decode",
        "lint",
        "diff",
        "check",
        "monitor",
        "profiles",
    }
    on_the_hub = [line for line, _ in shown if PORT in line]
    assert len(on_the_hub) == 1
    for line, out in shown:
        if line not in on_the_hub:
            answer = raceloop(*shlex.split(line)[1:])
            assert answer.out + answer.error == out, line


def test_the_guide_shows_what_is_printed_of_a_bus_in_use(raceloop: Command, tmp_path: Path):
    """Numbers of frames and times are those of the moment."""
    ((line, out),) = re.findall(
        rf"^```sh\n(raceloop [^\n]*{PORT}[^\n]*)\n```\n\n```text\n(.*?)^```", PAGE.read_text(), re.M | re.S
    )
    over = threading.Event()
    with Hub(tmp_path) as hub:

        def talk() -> None:
            with hub.client() as mouth:
                while not over.wait(0.01):
                    mouth.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=[0]))

        talking = threading.Thread(target=talk)
        talking.start()
        try:
            answer = raceloop(*shlex.split(line.replace(PORT, str(hub.port)))[1:])
        finally:
            over.set()
            talking.join()
        shown = (answer.out + answer.error).replace(str(hub.port), PORT)
    assert of_any_moment(shown) == of_any_moment(out)


def of_any_moment(text: str) -> str:
    return re.sub(r"at \d+\.\d{6} s", "at T s", re.sub(r"\d+ (times|frames)", r"N \1", text))
