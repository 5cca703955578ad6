"""Defects planted in a clean DBC file, one at a time: each is found and named, and nothing else is."""

from __future__ import annotations

from pathlib import Path

import pytest

from dbc.buses import DIRECTORY
from dbc.errors import ConfigurationError
from dbc.network import load_database
from tools.dbw.dbc_diff import differences
from tools.dbw.lint import findings

CLEAN = """VERSION ""

NS_ :

BS_:

BU_: OBC RAPTOR

BO_ 1402 steering_cmd: 8 OBC
 SG_ angle : 0|11@1- (0.5,0) [-512|511] "deg" RAPTOR
 SG_ counter : 16|8@1+ (1,0) [0|255] "" RAPTOR
 SG_ mode : 24|2@1+ (1,0) [0|3] "" RAPTOR

BO_ 1403 gear_cmd: 2 OBC
 SG_ gear : 7|12@0+ (1,0) [0|6] "" RAPTOR

BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgTimeout" INT 0 65535;
BA_DEF_ BO_ "CounterSignal" STRING ;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgTimeout" 0;
BA_DEF_DEF_ "CounterSignal" "";
BA_ "GenMsgCycleTime" BO_ 1402 10;
BA_ "GenMsgTimeout" BO_ 1402 100;
BA_ "CounterSignal" BO_ 1402 "counter";
BA_ "GenMsgCycleTime" BO_ 1403 100;
VAL_ 1402 mode 0 "OFF" 1 "ON" ;
"""

COUNTER = " SG_ counter : 16|8@1+ (1,0) [0|255] "
GEAR = " SG_ gear : 7|12@0+ (1,0) [0|6] "


def written(folder: Path, name: str, *changes: tuple[str, str]) -> Path:
    """The clean file with changes; each text that is replaced must be there once."""
    text = CLEAN
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / f"{name}.dbc"
    path.write_text(text)
    return path


def found(path: Path) -> list[str]:
    return list(findings(load_database(path, strict=False)))


def test_the_clean_file_has_none(tmp_path: Path):
    assert found(written(tmp_path, "clean")) == []


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "[-512|511]",
            "[-1024|511]",
            ", angle: the declared minimum, -1024, is beyond what the bits hold, -512 to 511.5",
        ),
        (
            "[-512|511]",
            "[-512|1023]",
            ", angle: the declared maximum, 1023, is beyond what the bits hold, -512 to 511.5",
        ),
        (COUNTER, COUNTER.replace("16|8", "10|8"), ": angle and counter overlap in bit 10"),
        (COUNTER, COUNTER.replace("16|8", "20|8"), ": counter and mode overlap in bits 24, 25"),
        (COUNTER, COUNTER.replace("16|8", "57|8"), ", counter: bit 64 beyond the 8 bytes of the message"),
        ('"" RAPTOR\n SG_ mode', '"" Vector__XXX\n SG_ mode', ", counter: no receiver"),
        ("steering_cmd: 8 OBC", "steering_cmd: 8 Vector__XXX", ": no sender"),
        ('BA_ "GenMsgCycleTime" BO_ 1402 10;\n', "", ": no cycle time (GenMsgCycleTime)"),
        ('BA_ "GenMsgTimeout" BO_ 1402 100;\n', "", ": a counter but no time-out (GenMsgTimeout)"),
        (
            'BA_ "GenMsgTimeout" BO_ 1402 100;',
            'BA_ "GenMsgTimeout" BO_ 1402 10;',
            ": the time-out, 10 ms, is not longer than the cycle, 10 ms",
        ),
        ('BO_ 1402 "counter"', 'BO_ 1402 "count"', ": CounterSignal names count, which is no signal of it"),
        ('1 "ON" ;', '4 "ON" ;', ", mode: the value table has 4 (ON), which 2 bits do not hold"),
    ],
)
def test_a_defect_is_found(tmp_path: Path, old: str, new: str, told: str):
    assert found(written(tmp_path, "broken", (old, new))) == [f"steering_cmd (57A){told}"]


def test_a_signal_beyond_its_message_and_a_scale_of_nothing(tmp_path: Path):
    beyond = found(written(tmp_path, "beyond", (GEAR, GEAR.replace("7|12", "7|18"))))
    assert beyond == ["gear_cmd (57B), gear: bits 22, 23 beyond the 2 bytes of the message"]
    no_scale = found(written(tmp_path, "no_scale", (" (0.5,0)", " (0,0)")))
    assert no_scale[0] == "steering_cmd (57A), angle: the scale is 0"


def test_the_public_layout_declares_what_its_bits_cannot_hold():
    """Known of V14: steering has 11 bits of half a degree and +-1024 declared; both pedals likewise."""
    lines = found(DIRECTORY / "raptor.dbc")
    beyond = "is beyond what the bits hold"
    assert f"steering_cmd (57A), steering_motor_ang_cmd: the declared maximum, 1023, {beyond}, -512 to 511.5" in lines
    assert f"accelerator_report (516), acc_pedal_fdbk: the declared maximum, 65535, {beyond}, 0 to 6553.5" in lines
    assert all(beyond in line for line in lines)


def test_a_file_that_is_none_is_refused(tmp_path: Path):
    path = tmp_path / "broken.dbc"
    path.write_text(CLEAN.replace("BO_ 1403 gear_cmd: 2 OBC", "BO_ 1403 gear_cmd OBC"))
    with pytest.raises(ConfigurationError, match="not a valid DBC file"):
        load_database(path, strict=False)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ([], []),
        ([("(0.5,0)", "(0.25,0)")], ["steering_cmd (57A), angle: scale 0.5 is now 0.25"]),
        ([("(0.5,0)", "(0.5,-3)")], ["steering_cmd (57A), angle: offset 0 is now -3"]),
        ([("0|11@1-", "0|11@1+")], ["steering_cmd (57A), angle: bits 0|11@1- is now 0|11@1+"]),
        ([("16|8@1+", "40|8@1+")], ["steering_cmd (57A), counter: bits 16|8@1+ is now 40|8@1+"]),
        ([("[0|6]", "[0|7]")], ["gear_cmd (57B), gear: maximum 6 is now 7"]),
        ([('"deg"', '"rad"')], ["steering_cmd (57A), angle: unit deg is now rad"]),
        ([('1 "ON" ;', '1 "ON" 2 "AUTO" ;')], ["steering_cmd (57A), mode: name of 2 none is now AUTO"]),
        ([("gear_cmd: 2", "gear_cmd: 3")], ["gear_cmd (57B): length in bytes 2 is now 3"]),
        ([("gear_cmd: 2 OBC", "gear_cmd: 2 RAPTOR")], ["gear_cmd (57B): sender OBC is now RAPTOR"]),
        ([("BO_ 1403 100", "BO_ 1403 50")], ["gear_cmd (57B): cycle time in ms 100 is now 50"]),
        ([("BO_ 1403 gear_cmd", "BO_ 1403 shift_cmd")], ["gear_cmd (57B): is called shift_cmd"]),
        (
            [
                ("BO_ 1403 gear_cmd", "BO_ 1404 gear_cmd"),
                ('BA_ "GenMsgCycleTime" BO_ 1403', 'BA_ "GenMsgCycleTime" BO_ 1404'),
            ],
            ["gear_cmd (57B): identifier 57B is now 57C"],
        ),
        (
            [
                ("BO_ 1403 gear_cmd", "BO_ 1404 shift_cmd"),
                ('BA_ "GenMsgCycleTime" BO_ 1403', 'BA_ "GenMsgCycleTime" BO_ 1404'),
            ],
            ["gear_cmd (57B): is gone", "shift_cmd (57C): is new"],
        ),
        (
            [(COUNTER, COUNTER.replace("counter", "count")), ('BO_ 1402 "counter"', 'BO_ 1402 "count"')],
            ["steering_cmd (57A), counter: is gone", "steering_cmd (57A), count: is new, 16|8@1+"],
        ),
    ],
)
def test_a_difference_is_told(tmp_path: Path, changes: list[tuple[str, str]], told: list[str]):
    one, other = written(tmp_path, "one"), written(tmp_path, "other", *changes)
    assert list(differences(load_database(one), load_database(other))) == told
