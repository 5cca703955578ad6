"""Defects planted in clean traffic, one kind at a time: each is found in its place, and nothing else is."""

from __future__ import annotations

import binascii
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from bridge._native import lib
from dbc.codec import MessageCodec, database
from dbc.frames import FRAME_DTYPE, Bus, Flag, frame_array
from dbc.network import raw_limits
from tools.dbw.conformance import Conformance, crc16
from tools.dbw.findings import Place, Rule
from tools.dbw.timing import Timing

STEERING = database.message("steering_cmd")
REPORT = database.message("steering_report")
REQUEST = database.message("req_brake_pos")
POWERTRAIN = database.message("pt_report_1")
MESSAGES = (STEERING, REPORT, REQUEST, POWERTRAIN)
SEED = 20221103

Frames = NDArray[np.void]


def traffic(seconds: float = 6.0, wrap: int = 256) -> Frames:
    """What four stations send that do everything right; values move a few steps at a time."""
    random = np.random.default_rng(SEED)
    frames = []
    for codec in MESSAGES:
        facts = database.facts(codec.name)
        cycle_us = codec.cycle_us // facts.frames_per_cycle
        value = 0
        for number, time_us in enumerate(range(1000 * codec.index, round(seconds * 1e6), cycle_us)):
            raw = [0.0] * len(codec.signals)
            signal = codec.definition.signals[0]
            value = int(np.clip(value + random.integers(-2, 2, endpoint=True), 0, min(100, raw_limits(signal)[1])))
            raw[0] = value * float(signal.scale)
            if facts.counter is not None:
                raw[codec.signals.index(facts.counter.name)] = number % wrap
            frame = codec.frame(*raw, time_us=time_us)
            frames.append(frame if facts.crc is None else codec.finish(frame, number % wrap))
    together = frame_array(b"".join(frames))
    return together[np.argsort(together["time_us"], kind="stable")].copy()


def found(frames: Frames, piece: int | None = None) -> dict[Place, tuple[int, int]]:
    """How many frames, and which is the first, by place."""
    conformance = Conformance()
    for begin in range(0, len(frames), piece or max(len(frames), 1)):
        conformance.update(frames[begin : begin + (piece or len(frames))])
    conformance.finish()
    return {place: (one.count, one.first_frame) for place, one in conformance.findings.items()}


def rows_of(frames: Frames, codec: MessageCodec) -> NDArray[np.intp]:
    return np.flatnonzero((frames["id"] == codec.frame_id) & (frames["bus"] == codec.bus))


@pytest.mark.parametrize("wrap", [8, 16, 256])
@pytest.mark.parametrize("piece", [None, 1, 97])
def test_clean_traffic_has_no_findings(wrap: int, piece: int | None):
    assert found(traffic(wrap=wrap), piece) == {}


def test_a_counter_that_wraps_where_nobody_does_jumps():
    places = found(traffic(wrap=10))
    assert set(places) == {
        Place(Rule.JUMP, codec.bus, codec.name, database.facts(codec.name).counter.name)
        for codec in (STEERING, REPORT, REQUEST)
    }


def counter_of(codec: MessageCodec) -> str:
    counter = database.facts(codec.name).counter
    assert counter is not None
    return counter.name


def stuck(frames: Frames) -> tuple[Frames, Place, int]:
    row = rows_of(frames, STEERING)[20]
    frames["data"][row, 2] = frames["data"][rows_of(frames, STEERING)[19], 2]
    # The next one then is two ahead.
    rows = rows_of(frames, STEERING)[21:]
    frames["data"][rows, 2] -= 1
    return frames, Place(Rule.STUCK, Bus.CAN1, STEERING.name, counter_of(STEERING)), row


def lost(frames: Frames) -> tuple[Frames, Place, int]:
    row = rows_of(frames, REPORT)[30]
    kept = np.delete(frames, row)
    return kept, Place(Rule.JUMP, Bus.CAN1, REPORT.name, counter_of(REPORT)), rows_of(kept, REPORT)[30]


def corrupted(frames: Frames) -> tuple[Frames, Place, int]:
    """The last one: the counter of a frame that nobody accepts is not looked at, so the one after it would jump."""
    row = rows_of(frames, REQUEST)[-1]
    frames["data"][row, 0] ^= 0x10
    return frames, Place(Rule.CRC, Bus.CAN3, REQUEST.name, "CCIT_CRC"), row


def wrong_address(frames: Frames) -> tuple[Frames, Place, int]:
    row = rows_of(frames, POWERTRAIN)[5]
    frames["id"][row] = 0x7AB
    return frames, Place(Rule.UNKNOWN, Bus.CAN1, "7AB"), row


def cut_short(frames: Frames) -> tuple[Frames, Place, int]:
    row = rows_of(frames, POWERTRAIN)[5]
    frames["dlc"][row] = 7
    return frames, Place(Rule.SHORT, Bus.CAN1, POWERTRAIN.name), row


def too_long(frames: Frames) -> tuple[Frames, Place, int]:
    row = rows_of(frames, REPORT)[5]
    frames["dlc"][row] = 8
    return frames, Place(Rule.LONG, Bus.CAN1, REPORT.name), row


def remote(frames: Frames) -> tuple[Frames, Place, int]:
    row = rows_of(frames, POWERTRAIN)[7]
    frames["flags"][row] = Flag.REMOTE
    return frames, Place(Rule.REMOTE, Bus.CAN1, POWERTRAIN.name), row


def error(frames: Frames) -> tuple[Frames, Place, int]:
    row = rows_of(frames, POWERTRAIN)[9]
    frames["flags"][row] = Flag.ERROR
    return frames, Place(Rule.ERROR, Bus.CAN1, f"{POWERTRAIN.frame_id:X}"), row


def extended(frames: Frames) -> tuple[Frames, Place, int]:
    row = rows_of(frames, POWERTRAIN)[9]
    frames["flags"][row] = Flag.EXTENDED
    return frames, Place(Rule.UNKNOWN, Bus.CAN1, f"{POWERTRAIN.frame_id:08X}"), row


def out_of_range(frames: Frames) -> tuple[Frames, Place, int]:
    signal = next(one for one in POWERTRAIN.definition.signals if one.name == "throttle_position")
    assert signal.maximum is not None
    assert signal.maximum < POWERTRAIN.limits(signal.name)[1]
    row = rows_of(frames, POWERTRAIN)[11]
    values = dict(zip(POWERTRAIN.signals, POWERTRAIN.decode(frames["data"][row].tobytes()), strict=True))
    values[signal.name] = signal.maximum + 1.0
    frames["data"][row] = np.frombuffer(POWERTRAIN.encode(*values.values()), np.uint8)
    return frames, Place(Rule.RANGE, Bus.CAN1, POWERTRAIN.name, signal.name), row


def clock(frames: Frames) -> tuple[Frames, Place, int]:
    """The clock of the logger was set back between two frames of CAN3, which has one sender here."""
    row = rows_of(frames, REQUEST)[40]
    after = np.flatnonzero((frames["bus"] == Bus.CAN3) & (np.arange(len(frames)) >= row))
    frames["time_us"][after] -= 30_000
    return frames, Place(Rule.CLOCK, Bus.CAN3), row


def silent(frames: Frames) -> tuple[Frames, Place, int]:
    """A pause longer than the time-out, after which the sender counts on."""
    rows = rows_of(frames, STEERING)
    pause = rows[100 : 100 + STEERING.timeout_us // STEERING.cycle_us + 1]
    after = rows[rows > pause[-1]]
    frames["data"][after, 2] -= len(pause)
    first = after[0] - len(pause)
    return np.delete(frames, pause), Place(Rule.TIMEOUT, Bus.CAN1, STEERING.name), int(first)


DEFECTS = (
    stuck,
    lost,
    corrupted,
    wrong_address,
    cut_short,
    too_long,
    remote,
    error,
    extended,
    out_of_range,
    clock,
    silent,
)


@pytest.mark.parametrize("piece", [None, 50])
@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.__name__)
def test_a_defect_is_found_in_its_place(defect: Callable[[Frames], tuple[Frames, Place, int]], piece: int | None):
    frames, place, row = defect(traffic())
    assert found(frames, piece) == {place: (1, row)}


def test_a_sender_that_is_too_slow():
    frames = traffic()
    rows = rows_of(frames, POWERTRAIN)
    thinned = np.delete(frames, rows[::3])
    left = rows_of(thinned, POWERTRAIN)
    assert found(thinned, 64) == {Place(Rule.CYCLE, Bus.CAN1, POWERTRAIN.name): (len(left) - 1, left[0])}


def test_defects_are_counted_together():
    frames = traffic()
    rows = rows_of(frames, POWERTRAIN)[10:15]
    frames["dlc"][rows] = 3
    assert found(frames, 64) == {Place(Rule.SHORT, Bus.CAN1, POWERTRAIN.name): (5, rows[0])}


def test_crc_is_that_of_the_standard_library_and_of_the_firmware():
    random = np.random.default_rng(SEED)
    data = random.integers(0, 256, (50, 6), dtype=np.uint8)
    frame_id = 0x2AB
    expected = [binascii.crc_hqx(bytes(row) + bytes([frame_id & 0xFF, frame_id >> 8]), 0xFFFF) for row in data]
    assert crc16(data, frame_id).tolist() == expected
    assert lib.codec_crc16(0xFFFF, b"123456789", 9) == binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1


def test_times_between_frames():
    timing = Timing()
    random = np.random.default_rng(SEED)
    intervals = random.integers(5_000, 15_000, 1000)
    for piece in np.array_split(intervals, 7):
        timing.add(piece)
    assert (timing.count, timing.shortest, timing.longest) == (1000, intervals.min(), intervals.max())
    assert timing.mean == pytest.approx(intervals.mean())
    assert timing.jitter == pytest.approx(intervals.std(), rel=1e-9)
    assert (Timing().mean, Timing().jitter) == (0.0, 0.0)


def test_random_frames_are_all_accounted_for():
    """Whatever comes, nothing is raised, and every frame that no receiver accepts is in a finding."""
    random = np.random.default_rng(SEED)
    frames = np.zeros(5000, dtype=FRAME_DTYPE)
    frames["time_us"] = np.sort(random.integers(0, 10**7, len(frames)))
    frames["id"] = random.integers(0, 0x800, len(frames))
    frames["bus"] = random.integers(0, len(Bus), len(frames))
    frames["dlc"] = random.integers(0, 16, len(frames))
    frames["flags"] = random.choice([0, 0, 0, 1, 2, 4, 5], len(frames))
    frames["data"] = random.integers(0, 256, (len(frames), 8))
    conformance = Conformance()
    conformance.update(frames)
    conformance.finish()
    refused = sum(
        one.count
        for place, one in conformance.findings.items()
        if place.rule in (Rule.UNKNOWN, Rule.REMOTE, Rule.ERROR, Rule.SHORT)
    )
    assert refused == np.count_nonzero(database.identify(frames) < 0), SEED
    assert conformance.frames == len(frames)


def test_no_frames_are_no_findings():
    assert found(np.zeros(0, FRAME_DTYPE)) == {}


def test_noise_is_told_up_to_a_thousand_identifiers():
    """Memory and time must not grow with the number of identifiers that exist."""
    count = 20_000
    frames = np.zeros(count, dtype=FRAME_DTYPE)
    frames["id"] = np.random.default_rng(1).choice(1 << 29, count, replace=False)
    frames["flags"] = Flag.EXTENDED
    frames["time_us"] = np.arange(count)
    conformance = Conformance()
    for piece in np.array_split(frames, 3):
        conformance.update(piece)
    conformance.finish()
    assert len(conformance.findings) == 1001
    others = conformance.findings[Place(Rule.UNKNOWN, Bus.CAN1)]
    assert others.count == count - 1000
    assert sum(finding.count for finding in conformance.findings.values()) == count


def test_identifiers_of_11_and_29_bits_are_told_apart():
    frames = np.zeros(4, dtype=FRAME_DTYPE)
    frames["id"] = 0x123
    frames["flags"] = [0, Flag.EXTENDED, Flag.EXTENDED, 0]
    frames["time_us"] = np.arange(4)
    conformance = Conformance()
    conformance.update(frames)
    found = {place.message: finding.first_frame for place, finding in conformance.findings.items()}
    assert found == {"123": 0, "00000123": 1}
