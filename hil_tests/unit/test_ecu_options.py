"""Command line of an ECU's process: every word, and one line for every mistake."""

from __future__ import annotations

from typing import Any

import pytest

from bridge._native import ffi, lib
from dbc.codec import profile
from dbc.frames import Bus

NOW_NS = 5_000_000_000_000
MINUTE_NS = 60_000_000_000
ALL_BUSES = (1 << len(Bus)) - 1
BUS = "--bus=CAN1=hub:/run/hub"


class Parsed:
    """Result of a parse; keeps the strings alive that it points to."""

    def __init__(self, *arguments: str, buses: int = ALL_BUSES, wires: bool = True) -> None:
        self._strings = [ffi.new("char[]", argument.encode()) for argument in arguments]
        array = ffi.new("char *[]", [*self._strings, ffi.NULL])
        sockets = ffi.new("ecu_sockets *", {"buses": buses, "wires": wires})
        mistake = ffi.new("char[]", lib.ECU_MISTAKE_MAX)
        self.c: Any = ffi.new("ecu_options *")
        self.error = lib.ecu_options_parse(self.c, sockets, NOW_NS, len(arguments), array, mistake)
        self.mistake = ffi.string(mistake).decode()
        assert bool(self.error) == bool(self.mistake)
        assert "\n" not in self.mistake

    def text(self, field: str) -> str | None:
        value = getattr(self.c, field)
        return ffi.string(value).decode() if value else None

    def address(self, bus: Bus) -> str | None:
        value = self.c.addresses[bus]
        return ffi.string(value).decode() if value else None


def test_defaults():
    parsed = Parsed(BUS)
    assert parsed.error == 0
    assert [parsed.address(bus) for bus in Bus] == ["hub:/run/hub", *[None] * 4]
    options = parsed.c
    assert (options.epoch_ns, options.phase_us, options.period_us) == (NOW_NS, 0, 10_000)
    assert (options.priority, options.cpu, options.cycles) == (0, -1, 60_000)
    assert (parsed.text("wired"), parsed.text("cycle_log")) == (None, None)
    assert (options.with_parent, options.help) == (False, False)
    assert options.profile == profile("V14").number


@pytest.mark.parametrize("equals", [True, False])
def test_every_word(equals: bool):
    words = [
        ("--bus", "CAN1=socketcan:vcan0"), ("--bus", "CANS=socketcan:vcan3"), ("--bus", "CAN3=hub:/a=b"),
        ("--bus", "CANA=hub:/run/hub"), ("--bus", "CANR=socketcan:can7"),
        ("--epoch", "123"), ("--phase", "1500"), ("--period", "1000"),
        ("--priority", "80"), ("--cpu", "3"), ("--wired", "/run/wires"), ("--cycle-log", "/run/log"),
        ("--cycles", "500"), ("--profile", "V26"),
    ]  # fmt: skip
    arguments = [f"{word}={value}" for word, value in words] if equals else [part for pair in words for part in pair]
    parsed = Parsed(*arguments, "--with-parent")
    assert parsed.mistake == ""
    assert [parsed.address(bus) for bus in Bus] == [
        "socketcan:vcan0", "hub:/a=b", "hub:/run/hub", "socketcan:vcan3", "socketcan:can7",
    ]  # fmt: skip
    options = parsed.c
    assert (options.epoch_ns, options.phase_us, options.period_us) == (123, 1500, 1000)
    assert (options.priority, options.cpu, options.cycles) == (80, 3, 500)
    assert options.profile == profile("V26").number
    assert (parsed.text("wired"), parsed.text("cycle_log")) == ("/run/wires", "/run/log")
    assert options.with_parent


@pytest.mark.parametrize(
    ("word", "minimum", "maximum"),
    [
        ("epoch", 0, NOW_NS + MINUTE_NS),
        ("phase", 0, 1_000_000),
        ("period", 1_000, 1_000_000),
        ("priority", 1, 99),
        ("cpu", 0, 1023),
        ("cycles", 1, 10_000_000),
    ],
)
def test_numbers_are_bounded(word: str, minimum: int, maximum: int):
    for value in (minimum, maximum, f"000{minimum}"):
        assert Parsed(BUS, f"--{word}={value}").mistake == "", value
    wrong = [maximum + 1, 2**64, 2**64 + minimum, 10**30, "", " 5", "5 ", "+5", "-1", "0x5", "5.0", "1e3", "five"]
    for value in [*wrong, *([minimum - 1] if minimum else [])]:
        expected = f"--{word} {value}: allowed is a whole number, {minimum} to {maximum}"
        assert Parsed(BUS, f"--{word}={value}").mistake == expected


def test_a_wall_clock_time_is_no_epoch():
    assert "--epoch" in Parsed(BUS, "--epoch", "1795000000000000000").mistake


@pytest.mark.parametrize("value", ["", "CAN2=hub:/x", "CAN1", "can1=hub:/x", "CAN=hub:/x", "CAN11=hub:/x", "=hub:/x"])
def test_buses_that_do_not_exist(value: str):
    expected = f"--bus {value}: allowed is NAME=ADDRESS, NAME one of CAN1 CAN3 CANA CANS CANR"
    assert Parsed("--bus", value).mistake == expected


def test_buses_that_the_ecu_is_not_on():
    parsed = Parsed("--bus", "CAN1=hub:/x", buses=1 << Bus.CAN3 | 1 << Bus.CAN_S)
    assert parsed.mistake == "--bus CAN1=hub:/x: allowed is NAME=ADDRESS, NAME one of CAN3 CANS"


def test_a_bus_that_is_given_twice():
    assert Parsed(BUS, BUS).mistake == "--bus CAN1=hub:/run/hub: this bus is given twice"


@pytest.mark.parametrize(
    ("arguments", "mistake"),
    [
        ([], "no bus: give --bus NAME=ADDRESS; --help says more"),
        (["--priority", "5"], "no bus: give --bus NAME=ADDRESS; --help says more"),
        ([BUS, "--bus"], "--bus needs a value; --help tells of what kind"),
        ([BUS, "--cpu"], "--cpu needs a value; --help tells of what kind"),
        ([BUS, "--speed", "5"], "unknown argument --speed; --help lists what is allowed"),
        ([BUS, "speed"], "unknown argument speed; --help lists what is allowed"),
        ([BUS, ""], "unknown argument ; --help lists what is allowed"),
        ([BUS, "--"], "unknown argument --; --help lists what is allowed"),
        ([BUS, "-cpu", "5"], "unknown argument -cpu; --help lists what is allowed"),
        ([BUS, "--cp", "5"], "unknown argument --cp; --help lists what is allowed"),
        ([BUS, "--cpus=5"], "unknown argument --cpus=5; --help lists what is allowed"),
        ([BUS, "--with-parent=1"], "unknown argument --with-parent=1; --help lists what is allowed"),
    ],
)
def test_words_that_are_none(arguments: list[str], mistake: str):
    assert Parsed(*arguments).mistake == mistake


def test_wires_of_an_ecu_that_has_none():
    assert Parsed(BUS, "--wired", "/x", wires=False).mistake == "--wired /x: this ECU has no wires to the plant"


@pytest.mark.parametrize("value", ["", "v26", "V2", "V260", "V27"])
def test_profiles_that_do_not_exist(value: str):
    assert Parsed(BUS, "--profile", value).mistake == f"--profile {value}: allowed is one of V14 V26"


def test_a_profile_of_an_ecu_that_is_not_on_can1():
    parsed = Parsed("--bus=CAN3=hub:/x", "--profile=V26", buses=1 << Bus.CAN3)
    assert parsed.mistake == "--profile V26: this ECU is not on CAN1"


def test_a_mistake_of_any_length_is_one_short_line():
    for argument in ("x" * 5000, "--bus=" + "x" * 5000, "--cpu=" + "9" * 5000):
        assert 0 < len(Parsed(argument).mistake) < lib.ECU_MISTAKE_MAX


def test_help_comes_first_and_names_every_word():
    parsed = Parsed("--help", "nonsense")
    assert (parsed.error, parsed.c.help) == (0, True)
    text = ffi.string(lib.ecu_options_help()).decode()
    words = ["bus", "epoch", "phase", "period", "priority", "cpu", "wired", "cycle-log", "cycles"]
    words += ["profile", "with-parent"]
    assert [line.split()[0] for line in text.splitlines()] == [f"--{word}" for word in words]


def test_names_of_buses():
    names = [ffi.string(lib.ecu_bus_name(bus)).decode() for bus in Bus]
    assert names == ["CAN1", "CAN3", "CANA", "CANS", "CANR"]
    assert ffi.string(lib.ecu_bus_name(5)).decode() == "?"
