"""Every defect of the corpus is found, with message, signal and frame, and nothing besides; a sound drive has none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from defect_corpus import DEFECTS, Defect, Traffic, put_places, warm_up
from numpy.typing import NDArray

from bridge.scenario import Condition, load_scenario
from scenarios import DIRECTORY
from tools.check_bench import record
from tools.dbw.conformance import Conformance
from tools.dbw.findings import Finding, Place, Rule
from tools.dbw.log_source import read_chunks

#: The chequered flag falls here, m, so that the recording is short: run-up, pit-out, and the beginning of the stop.
CHEQUERED_M = 10.0
SECONDS = 10.9


SEED = 20221103


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> NDArray[np.void]:
    """What a car that does everything right sends."""
    scenario = load_scenario(DIRECTORY / "short_drive.yaml")
    *before, chequered = scenario.race_control
    chequered = replace(chequered, when=Condition(distance_m=CHEQUERED_M))
    scenario = replace(scenario, race_control=(*before, chequered))
    log = record(scenario, SECONDS, tmp_path_factory.mktemp("drive"))

    def broken(frame: int, text: str) -> None:
        raise AssertionError(f"frame {frame}: {text}")

    return np.concatenate([chunk.copy() for chunk in read_chunks(log, None, broken)])


def found(frames: NDArray[np.void], pieces: int = 1) -> dict[Place, Finding]:
    conformance = Conformance()
    for piece in np.array_split(frames, pieces):
        conformance.update(piece)
    conformance.finish()
    return conformance.findings


@pytest.mark.parametrize("pieces", [1, 2, 61])
def test_a_sound_recording_has_no_findings(drive: NDArray[np.void], pieces: int):
    assert found(drive, pieces) == {}


def test_what_some_defects_are_planted_in_is_sound(drive: NDArray[np.void]):
    traffic = Traffic(drive)
    put_places(traffic, "mylaps_report_2")
    for tyre, degrees in (("FL", 12.0), ("FR", 9.0), ("RL", 6.0), ("RR", 15.0)):
        warm_up(traffic, tyre, degrees)
    assert found(traffic.frames) == {}


def lost(frames: NDArray[np.void], random: np.random.Generator) -> NDArray[np.void]:
    """One frame of a hundred was not recorded."""
    return frames[random.random(len(frames)) >= 0.01]


def one_bus(frames: NDArray[np.void], random: np.random.Generator) -> NDArray[np.void]:
    """The logger was on one bus only."""
    return frames[frames["bus"] == random.integers(2)]


def one_station(frames: NDArray[np.void], random: np.random.Generator) -> NDArray[np.void]:
    """Somebody kept only what one station sends."""
    return frames[frames["sender"] == random.choice(np.unique(frames["sender"]))]


def few_messages(frames: NDArray[np.void], random: np.random.Generator) -> NDArray[np.void]:
    """Somebody kept only some messages."""
    return frames[np.isin(frames["id"], random.choice(np.unique(frames["id"]), 20, replace=False))]


def part(frames: NDArray[np.void], random: np.random.Generator) -> NDArray[np.void]:
    """The logger ran for some of the time."""
    begin = random.integers(len(frames) // 2)
    return frames[begin : begin + len(frames) // 3]


def late_stamps(frames: NDArray[np.void], random: np.random.Generator) -> NDArray[np.void]:
    """The logger's time stamps come up to 3 ms late."""
    return shifted(frames, random.integers(0, 3000, len(frames)))


def other_clock(frames: NDArray[np.void], random: np.random.Generator) -> NDArray[np.void]:
    """The clock of one bus is 4 ms off."""
    return shifted(frames, np.where(frames["bus"] == random.integers(4), 4000, 0))


def shifted(frames: NDArray[np.void], by_us: NDArray[np.int64]) -> NDArray[np.void]:
    later = frames.copy()
    later["time_us"] += by_us.astype(np.uint64)
    return later[np.argsort(later["time_us"], kind="stable")]


@pytest.mark.parametrize(
    "logger", [lost, one_bus, one_station, few_messages, part, late_stamps, other_clock], ids=lambda one: one.__name__
)
def test_what_a_logger_does_is_no_mistake_of_the_car(
    drive: NDArray[np.void], logger: Callable[[NDArray[np.void], np.random.Generator], NDArray[np.void]]
):
    """Lost frames are seen in counters, pauses and skipped states, and nowhere else."""
    random = np.random.default_rng(SEED)
    rules = {place.rule for place in found(logger(drive, random))}
    allowed = {Rule.JUMP, Rule.TIMEOUT, Rule.SEQUENCE} if logger is lost else set()
    assert rules <= allowed, SEED
    assert (Rule.JUMP in rules) == (logger is lost), SEED


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: f"{defect.kind}-{defect.name}")
def test_a_defect_is_found(drive: NDArray[np.void], defect: Defect):
    traffic = Traffic(drive)
    expected = defect.plant(traffic)
    findings = found(traffic.frames)
    assert set(findings) == {expected.place, *expected.also}, "\n".join(map(str, findings.values()))
    assert findings[expected.place].first_frame == expected.frame, findings[expected.place]


def test_the_corpus_is_large_and_of_many_kinds():
    assert len({defect.name for defect in DEFECTS}) == len(DEFECTS) >= 60
    kinds = {"identity", "length", "unused bits", "bit order", "sign", "scale", "offset", "resolution", "rounding"}
    kinds |= {"range", "slew", "counter", "CRC", "timing", "sequence", "stuck", "copy", "between messages"}
    assert {defect.kind for defect in DEFECTS} == kinds
    public = {defect.name.split(":")[0] for defect in DEFECTS if ":" in defect.name}
    assert {"pitt", "purdue", "awsim", "dspace", "gaia", "tum"} <= public
