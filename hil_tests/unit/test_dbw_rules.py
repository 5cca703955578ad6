"""Rules for one signal and for several, each by itself; and the numbers that the firmware has, too."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bridge._native import lib
from bridge.safety import limits
from dbc.codec import database
from firmware.tables import own_parameters
from tools.dbw import car_rules
from tools.dbw.conformance import Conformance
from tools.dbw.counters import Counter, CounterMode
from tools.dbw.findings import Offence, Rule
from tools.dbw.history import Histories, Piece
from tools.dbw.signal_rules import Motion, NamedValues, Resolution, Runs, Setting, SignalRule, Slew

ROOT = Path(__file__).resolve().parents[2]
SEED = 20221103
CYCLE_US = 10_000


def told(rule: SignalRule, values: list[float] | NDArray[np.float64], piece: int = 10**6) -> list[Offence]:
    """What a rule says of values that come every 10 ms, in frames 100, 101, and so on."""
    values = np.asarray(values, dtype=np.float64)
    numbers = np.arange(100, 100 + len(values))
    times = (numbers - 100) * CYCLE_US
    offences: list[Offence] = []
    for begin in range(0, len(values), piece):
        rows = slice(begin, begin + piece)
        offences += rule.update(values[rows], times[rows], numbers[rows])
    return offences + list(rule.finish())


@pytest.mark.parametrize("piece", [1, 3, 100])
def test_slew(piece: int):
    slow = Slew(100.0, 0.5, CYCLE_US, "deg")
    assert told(slow, np.arange(50) * 1.4, piece) == []
    fast = told(Slew(100.0, 0.5, CYCLE_US, "deg"), [0.0, 1.0, 3.0, 3.0, 1.4], piece)
    assert [(one.frame, one.text) for one in fast][:1] == [
        (102, "from 1 to 3 deg in 10.0 ms; at most 100 deg/s"),
    ]
    assert sum(one.count for one in fast) == 2


def test_slew_counts_the_time_of_lost_frames_and_not_that_of_pushed_ones():
    rule = Slew(100.0, 0.01, CYCLE_US)
    assert list(rule.update(np.array([0.0, 5.0]), np.array([0, 50_000]), np.array([0, 1]))) == []
    assert list(rule.update(np.array([6.0]), np.array([50_001]), np.array([2]))) == []
    assert len(list(rule.update(np.array([7.1]), np.array([50_002]), np.array([3])))) == 1


@pytest.mark.parametrize("piece", [1, 4, 1000])
def test_what_has_to_move(piece: int):
    moving = np.arange(300) // 10 % 16
    assert told(Motion(200_000), moving, piece) == []
    moving[100:] = 3
    offences = told(Motion(200_000), moving, piece)
    assert (offences[0].frame, sum(one.count for one in offences)) == (100 + 100 + 21, 179)


def test_names_of_values():
    rule = NamedValues({0: "NONE", 3: "RED"})
    (offence,) = told(rule, [0, 3, 2, 3, 1])
    assert offence == Offence(2, 102, 20_000, "2 has no name; named are 0, 3")


def test_a_setting_may_come_late_but_has_to_come():
    assert told(Setting(), [0.0] * 50 + [7.0] + [0.0] * 9) == []
    assert told(Setting(), [0.0] * 9) == []
    assert told(Setting(), [0.0] * 10, piece=3) == [Offence(10, 100, 0, "always 0, which is no value")]


def walk(count: int, step: float) -> NDArray[np.float64]:
    random = np.random.default_rng(SEED)
    return np.cumsum(random.choice([-2.0, -1.0, 0.0, 1.0, 2.0], count)) * step


@pytest.mark.parametrize("piece", [1, 7, 1000])
def test_resolution(piece: int):
    assert told(Resolution(0.5, 0.0, "deg"), walk(200, 0.5), piece) == []
    (offence,) = told(Resolution(0.5, 0.0, "deg"), walk(200, 1.0), piece)
    assert (offence.frame, offence.count) == (100, 200)
    assert re.fullmatch(r"only multiples of 1 deg in \d+ changes; the signal has steps of 0.5", offence.text)
    assert told(Resolution(0.1, -100.0), walk(200, 0.1) + 40.0, piece) == []


def test_a_ramp_or_a_few_changes_tell_nothing_of_the_resolution():
    assert told(Resolution(0.5, 0.0), np.arange(300) * 1.0) == []
    assert told(Resolution(0.5, 0.0), walk(30, 1.0)) == []
    assert told(Resolution(0.5, 0.0), np.tile([0.0, 1.0], 200)) == []


@pytest.mark.parametrize("piece", [1, 2, 5, 100])
def test_offences_in_a_row(piece: int):
    wrong = np.array([0, 1, 1, 0, 1, 1, 1, 1, 0, 0, 1, 1, 1], dtype=np.bool_)
    numbers = np.arange(len(wrong))
    runs = Runs(least=3)
    offences: list[Offence] = []
    for begin in range(0, len(wrong), piece):
        rows = slice(begin, begin + piece)
        offences += runs.update(wrong[rows], numbers[rows] * CYCLE_US, numbers[rows], "in row {}".format)
    assert {one.frame for one in offences} == {4, 10}
    assert sum(one.count for one in offences) == 7


def test_offences_that_last():
    runs = Runs(lasting_us=50_000)
    numbers = np.arange(20)
    wrong = (numbers != 4) & (numbers != 15)
    (offence,) = runs.update(wrong, numbers * CYCLE_US, numbers, lambda row: f"from {row}")
    assert offence == Offence(10, 5, 50_000, "from 5")


def counted(mode: CounterMode, values: list[int]) -> list[tuple[Rule, int, int]]:
    """Rule, first frame and number of what a mode says of an eight-bit counter."""
    counter = Counter(255, mode)
    numbers = np.arange(len(values))
    found = [*counter.update(np.array(values), numbers * CYCLE_US, numbers), *counter.finish()]
    return [(rule, offence.frame, offence.count) for rule, offence in found]


@pytest.mark.parametrize(
    ("values", "automatic", "plus_one", "changed"),
    [
        (list(range(256)) * 2, [], [], []),
        ([0, 1, 2, 3, 4, 5, 6, 7] * 3, [], [(Rule.JUMP, 8, 2)], []),
        ([0, 1, 2, 4, 5], [(Rule.JUMP, 3, 1)], [(Rule.JUMP, 3, 1)], []),
        ([5, 9, 2, 7], [(Rule.JUMP, 1, 3)], [(Rule.JUMP, 1, 3)], []),
        ([5, 6, 6, 7], [(Rule.STUCK, 2, 1)], [(Rule.STUCK, 2, 1)], [(Rule.STUCK, 2, 1)]),
        ([0, 1, 2] * 3, [(Rule.JUMP, 3, 2)], [(Rule.JUMP, 3, 2)], []),
    ],
)
def test_counter_modes(
    values: list[int],
    automatic: list[tuple[Rule, int, int]],
    plus_one: list[tuple[Rule, int, int]],
    changed: list[tuple[Rule, int, int]],
):
    assert counted(CounterMode.AUTOMATIC, values) == automatic
    assert counted(CounterMode.PLUS_ONE, values) == plus_one
    assert counted(CounterMode.CHANGED, values) == changed


def test_a_history_keeps_what_was_in_force_and_not_more():
    codec = database.message("steering_cmd")
    histories = Histories({codec.name: codec})
    random = np.random.default_rng(SEED)
    times = np.cumsum(random.integers(0, 20_000, 3000))
    for begin in range(0, 3000, 100):
        rows = np.arange(begin, begin + 100)
        histories.extend(Piece(codec, np.tile(rows * 1.0, (2, 1)), times[rows], rows))
        history = histories[codec.name]
        moments = times[rows]
        window = history.window(moments, 300_000, 0)
        for place, moment in enumerate(moments.tolist()):
            last = int(np.searchsorted(times, moment, side="right")) - 1
            first = int(np.searchsorted(times, moment - 300_000, side="right")) - 1
            last = min(last, begin + 99)
            assert window.known[place] == (first >= 0)
            if first >= 0:
                assert history.numbers[window.first[place]] == first
                assert history.numbers[window.last[place]] == last
        histories.trim([codec.name])
        assert len(history.times) <= 1024


def test_the_limits_are_those_of_the_firmware():
    config = lib.raptor_config_default
    assert pytest.approx(config.pedal_conflict_throttle * 100) == limits.PEDAL_THROTTLE_PERCENT
    assert pytest.approx(config.pedal_conflict_brake / 1000) == limits.PEDAL_BRAKE_KPA
    assert config.pedal_conflict_us == limits.PEDAL_US
    assert pytest.approx(config.brake_out_of_spec / 1000) == car_rules.BRAKE_ERROR_KPA
    assert pytest.approx(config.brake_out_of_spec_share) == car_rules.BRAKE_ERROR_SHARE
    assert pytest.approx(config.brake_axle_share[1]) == car_rules.REAR_SHARE
    header = (ROOT / "firmware/space_drive/space_drive.h").read_text()
    stop = {name: float(value) for name, value in re.findall(r"#define SPACE_DRIVE_(\w+_STOP_\w+) +([\d.e]+)f", header)}
    assert pytest.approx(np.degrees(stop["STEER_STOP_RAD"])) == car_rules.STEER_STOP_DEG
    assert pytest.approx(stop["BRAKE_STOP_PA"] / 1000) == car_rules.BRAKE_STOP_KPA
    assert f"SPACE_DRIVE_NEUTRAL = 0x{limits.NEUTRAL_COUNTS:04X}" in header
    axes = (ROOT / "firmware/space_drive/space_drive.c").read_text()
    steer, brake = (float(value) for value in re.findall(r"\.deviation = ([\d.e]+)f", axes))
    assert pytest.approx(np.degrees(steer), rel=1e-4) == car_rules.STEER_DEVIATION_DEG
    assert pytest.approx(brake / 1000) == car_rules.BRAKE_DEVIATION_KPA
    (slew,) = (one for one in own_parameters().parameters if one.name == "steering_slew")
    assert pytest.approx(np.degrees(slew.max) * 15.0, abs=0.1) == car_rules.STEERING_CMD_DEG_S


def test_every_rule_goes_by_names_that_there_are():
    """On this profile none is left out by a slip of the pen; on one that lacks a message, its rules are."""
    known = {(codec.name, signal) for codec in database for signal in codec.signals}
    for relation in car_rules.RELATIONS:
        assert relation.needs <= known, relation
    for pair in car_rules.PAIRS:
        assert pair.needs <= known, pair
    keys = {*car_rules.SLEW_LIMITS, *car_rules.MOVING, *car_rules.SETTINGS}
    assert keys <= known


class Without:
    """The database, as a profile would be that lacks some messages."""

    def __init__(self, lacking: frozenset[str]) -> None:
        self._messages = [codec for codec in database if codec.name not in lacking]

    def __iter__(self):
        return iter(self._messages)

    def __len__(self) -> int:
        return len(self._messages)

    def __getattr__(self, name: str):
        return getattr(database, name)


@pytest.mark.parametrize("lacking", ["steering_cmd", "misc_report", "calb_steer_pos_2", "wheel_speed_report"])
def test_rules_of_what_a_profile_lacks_are_left_out(lacking: str):
    conformance = Conformance(Without(frozenset({lacking})))
    left = {name for judgement in conformance._judgements for name in judgement.relation.messages}
    assert left
    assert lacking not in left
