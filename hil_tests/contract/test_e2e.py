"""Every communication fault of AUTOSAR E2E on every message that an ECU counts, and the ECU's verdict.

The ECUs are the real firmware. Which messages they count is found out, not listed: a new one is covered by itself.
"""

from __future__ import annotations

import os
from functools import cache

import numpy as np
import pytest
from crccheck.crc import Crc16CcittFalse
from e2e_faults import Stream, Traffic, bus_silent, frames_of, is_of, unpack, with_data
from e2e_receivers import (
    BEGIN,
    NETWORK,
    OBC_WRONG_SIZE,
    TICKS,
    Receiver,
    Run,
    addressed_to,
    obc_conditions,
    onboard_computer,
    receivers,
    timeout_ms,
)
from e2e_verdicts import COUNTER, CRC, MISSED, REMOTE, ROWS, SHORT, Protection, Row, protection

from bridge._native import lib
from dbc.codec import database
from dbc.frames import Flag, Frame, Station
from dbc.network import MessageFacts

SEED = int(os.environ.get("RACELOOP_SEED", "20210107"))

#: Read by the onboard computer in ways of their own, which count no codec_rx.
READ_OTHERWISE = {
    "node_status", "perception_status", "trajectory_header", "trajectory_pose", "trajectory_motion",
    "wall_line", "wall_bend",
}  # fmt: skip

#: A frame of a sample that the onboard computer misses by the sample's size, not by its age.
FOLLOWERS = {
    *(f"gnss_{which}_{part}" for which in "ab" for part in ("velocity", "attitude", "quality")),
    "imu_specific_force",
}  # fmt: skip

REASONS = {
    lib.CODEC_COUNTER_STUCK: COUNTER,
    lib.CODEC_CRC_MISMATCH: CRC,
    lib.CODEC_SHORT_FRAME: SHORT,
    lib.CODEC_REMOTE_FRAME: REMOTE,
}


class Rules:
    """The rules of docs/protocol.md for one message, written without a look at the firmware's."""

    def __init__(self, facts: MessageFacts, counter: int) -> None:
        self._facts = facts
        self._counter = counter

    def judge(self, frame: Frame) -> int:
        """Give the codec_status of a frame of this message."""
        facts = self._facts
        if frame.flags & Flag.REMOTE:
            return int(lib.CODEC_REMOTE_FRAME)
        if frame.dlc < facts.message.length:
            return int(lib.CODEC_SHORT_FRAME)
        word = int.from_bytes(frame.data, "little")
        if facts.crc is not None:
            covered = frame.data[: facts.crc.start // 8] + facts.message.frame_id.to_bytes(2, "little")
            if word >> facts.crc.start & 0xFFFF != Crc16CcittFalse.calc(covered):
                return int(lib.CODEC_CRC_MISMATCH)
        if facts.counter is not None:
            before, self._counter = self._counter, word >> facts.counter.start & (1 << facts.counter.length) - 1
            if before == self._counter:
                return int(lib.CODEC_COUNTER_STUCK)
        return int(lib.CODEC_OK)


@cache
def of(station: Station) -> Receiver:
    return next(receiver for receiver in receivers() if receiver.station == station)


@cache
def receptions(station: Station, name: str) -> tuple[int, ...]:
    """Places of all that counts a message in an ECU."""
    return tuple(of(station).receptions_of(NETWORK[name]).values())


@cache
def counted(station: Station) -> tuple[MessageFacts, ...]:
    """Messages that an ECU counts."""
    return tuple(facts for facts in addressed_to(station) if receptions(station, facts.message.name))


STATIONS = (Station.OBC, Station.RAPTOR, Station.SPACE_DRIVE)
STREAMS = [
    pytest.param(station, facts, id=f"{station.name}-{facts.message.name}")
    for station in STATIONS
    for facts in counted(station)
]


def stream_of(station: Station, facts: MessageFacts) -> Stream:
    limit = timeout_ms(station, facts)
    donor = next(
        other
        for other in addressed_to(station)
        if other is not facts
        and other.bus == facts.bus
        and other.message.length >= facts.message.length
        and (other.crc is None) == (facts.crc is None)
    )
    return Stream(facts, BEGIN, None if limit is None else limit // 10, donor)


def horizon(stream: Stream) -> int:
    """Ticks that show all that a fault does: a delay beyond the limit, and the frames that come after it."""
    return min(TICKS, BEGIN + (stream.limit_ticks or 5) + 3 * stream.cycle_ticks + 5)


@cache
def healthy(station: Station, ticks: int) -> Run:
    receiver = of(station)
    return receiver.run(receiver.traffic[:ticks])


def check_reception(station: Station, facts: MessageFacts, traffic: Traffic, run: Run) -> list[int]:
    """All that counts this message agrees with the rules, tick by tick; what the rules said from BEGIN on."""
    receiver = of(station)
    offsets = receptions(station, facts.message.name)
    starts = {receiver.reception(receiver.state, offset) for offset in offsets}
    (start,) = starts
    rules = Rules(facts, start.counter)
    valid, rejected, last = start.valid, start.rejected, start.last_status
    said = []
    for tick, frames in enumerate(traffic):
        for frame in frames:
            if not is_of(facts, frame):
                continue
            status = rules.judge(unpack(frame))
            if tick >= BEGIN:
                said.append(status)
            # The onboard computer drops these two before it looks at whose message they are.
            if station == Station.OBC and status in (lib.CODEC_SHORT_FRAME, lib.CODEC_REMOTE_FRAME):
                continue
            valid, rejected, last = valid + (status == 0), rejected + (status != 0), status
        for offset in offsets:
            assert run.reception(tick, offset)[:3] == (valid, rejected, last), tick
    return said


def is_of_any(facts: MessageFacts, frames: list[bytes]) -> bool:
    return any(is_of(facts, frame) for frame in frames)


# --- the ground that the tests stand on


@pytest.mark.parametrize("station", STATIONS)
def test_without_a_fault_nothing_is_dropped_and_nothing_missed(station: Station) -> None:
    receiver = of(station)
    run = healthy(station, TICKS)
    for facts in counted(station):
        assert set(check_reception(station, facts, receiver.traffic, run)) == {lib.CODEC_OK}, facts.message.name
    assert not any(run.missed(tick) for tick in range(TICKS))


@pytest.mark.parametrize("station", STATIONS)
def test_every_message_is_counted_or_read_otherwise_or_leaves_no_trace(station: Station) -> None:
    receiver = of(station)
    whole = healthy(station, BEGIN).states[-1]
    names = {facts.message.name for facts in counted(station)}
    for facts in addressed_to(station):
        without = receiver.run([[f for f in frames if not is_of(facts, f)] for frames in receiver.traffic[:BEGIN]])
        trace = without.states[-1] != whole
        assert trace == (facts.message.name in names | READ_OTHERWISE), facts.message.name
    assert len(names) == {Station.OBC: 23, Station.RAPTOR: 24, Station.SPACE_DRIVE: 2}[station]


def test_all_protections_occur() -> None:
    kinds = {(station, protection(facts)) for station in STATIONS for facts in counted(station)}
    assert kinds == {
        (Station.OBC, Protection.COUNTER), (Station.OBC, Protection.HEARTBEAT), (Station.OBC, Protection.NONE),
        (Station.RAPTOR, Protection.CRC), (Station.RAPTOR, Protection.COUNTER), (Station.RAPTOR, Protection.NONE),
        (Station.SPACE_DRIVE, Protection.CRC),
    }  # fmt: skip


# --- the verdicts


@pytest.mark.parametrize("row", [pytest.param(row, id=f"{row.fault}, {row.shape}") for row in ROWS])
@pytest.mark.parametrize(("station", "facts"), STREAMS)
def test_verdict(station: Station, facts: MessageFacts, row: Row) -> None:
    receiver, stream = of(station), stream_of(station, facts)
    ticks = horizon(stream)
    genuine = receiver.traffic[:ticks]
    traffic = row.inject(genuine, stream)
    assert traffic != genuine or len(set(frames_of(genuine, stream))) == 1, "only a content that stands hides anything"
    run, control = receiver.run(traffic), healthy(station, ticks)
    said = set(check_reception(station, facts, traffic, run))
    noticed = run.noticed(control)
    verdict = {REASONS[status] for status in said - {lib.CODEC_OK}} | ({MISSED} if noticed else set())
    expected = row.verdicts[protection(facts)]
    if stream.limit_ticks is None and row.inject is not bus_silent:
        expected -= {MISSED}
    assert verdict == expected, noticed
    assert not noticed or noticed[0] >= BEGIN
    if station == Station.OBC:
        dropped = run.ecu(-1).rejected_frames - control.ecu(-1).rejected_frames
        new = [f for now, before in zip(traffic, genuine, strict=True) for f in set(now) - set(before)]
        assert dropped == sum(not accepted(frame) for frame in new)


def accepted(frame: bytes) -> bool:
    """Whether the frame is a whole data frame of a message of this network."""
    head = unpack(frame)
    message = database.find(head.bus, head.id, bool(head.flags & Flag.EXTENDED))
    return message is not None and not head.flags & Flag.REMOTE and head.dlc >= message.length


@pytest.mark.parametrize(("station", "facts"), STREAMS)
def test_a_loss_is_told_exactly_when_the_time_out_is_over(station: Station, facts: MessageFacts) -> None:
    stream = stream_of(station, facts)
    if stream.limit_ticks is None:
        assert facts.message.name in FOLLOWERS | {"gear_shift_cmd", "marelli_report_1", "dash_switches_cmd"}
        return
    (lost,) = (row for row in ROWS if (row.fault, row.shape) == ("loss", "of all frames"))
    receiver, ticks = of(station), horizon(stream)
    traffic = lost.inject(receiver.traffic[:ticks], stream)
    noticed = receiver.run(traffic).noticed(healthy(station, ticks))
    last = max(tick for tick, frames in enumerate(traffic) if is_of_any(facts, frames))
    assert noticed == list(range(last + stream.limit_ticks + 1, ticks)), "and for as long as it lasts"


@pytest.mark.parametrize(("station", "facts"), STREAMS)
def test_a_delay_beyond_the_time_out_is_told_only_until_old_frames_come(station: Station, facts: MessageFacts) -> None:
    """The honest limit: no frame carries its time, so late ones are taken for new as soon as they flow again."""
    stream = stream_of(station, facts)
    if stream.limit_ticks is None:
        return
    (late,) = (row for row in ROWS if (row.fault, row.shape) == ("delay", "beyond the time-out"))
    receiver, ticks = of(station), horizon(stream)
    traffic = late.inject(receiver.traffic[:ticks], stream)
    noticed = receiver.run(traffic).noticed(healthy(station, ticks))
    first = next(tick for tick in range(BEGIN, ticks) if is_of_any(facts, traffic[tick]))
    assert noticed
    assert noticed[-1] == first - 1 < ticks - 1


@pytest.mark.parametrize("name", sorted(FOLLOWERS))
def test_a_follower_is_missed_by_the_size_of_its_sample(name: str) -> None:
    facts = NETWORK[name]
    stream = stream_of(Station.OBC, facts)
    receiver = onboard_computer()
    for row in ROWS:
        if (row.fault, row.shape) in (("loss", "of one frame"), ("loss", "of all frames")):
            run = receiver.run(row.inject(receiver.traffic[:60], stream))
            short = [tick for tick in range(60) if obc_conditions(run.ecu(tick), OBC_WRONG_SIZE)]
            # The sample without it is complete when the next one begins.
            assert short[0] == BEGIN + stream.cycle_ticks
            assert (short[-1] == 59) == (row.shape == "of all frames")


# --- corruption, bit by bit


@pytest.mark.parametrize(("station", "facts"), STREAMS)
def test_corruption_of_any_bits(station: Station, facts: MessageFacts) -> None:
    """One bit after the other, then any number of them: a CRC finds them all but for one in 65,536."""
    print(f"again: RACELOOP_SEED={SEED} python -m pytest {__file__} -k '{station.name}-{facts.message.name}'")
    random = np.random.default_rng([SEED, facts.message.frame_id])
    receiver, codec = of(station), database.message(facts.message.name)
    genuine = next(f for frames in receiver.traffic[BEGIN:] for f in frames if is_of(facts, f))
    size = facts.message.length
    single = [1 << bit for bit in range(8 * size)]
    errors = [*single, *(int.from_bytes(random.bytes(size), "little") for _ in range(100))]
    quiet: Traffic = [[] for _ in range(BEGIN)]
    corrupt: Traffic = []
    for number, error in enumerate(errors):
        frame = codec.finish(genuine, number & 0xFF)
        word = int.from_bytes(unpack(frame).data, "little") ^ error
        corrupt.append([with_data(frame, word.to_bytes(8, "little"))])
    traffic = quiet + corrupt
    run = receiver.run(traffic)
    said = check_reception(station, facts, traffic, run)
    if facts.crc is not None:
        assert said == [lib.CODEC_CRC_MISMATCH] * len(errors)
    else:
        assert said.count(lib.CODEC_OK) > 0.95 * len(errors), "nobody notices, but where a counter happens to stand"
