"""The radar's inbox: whole scans come out as they went in, of others it is told what they lack, and nothing raises."""

from __future__ import annotations

import numpy as np
import pytest

from autonomy.radar_inbox import SCAN_US, RadarInbox, ReceivedScan, ScanStatus
from dbc.frames import Flag, Frame, iterate
from dbc.radar_tracks import FIRST_ID, TRACK_DTYPE, TRACKS, Tracks, TrackStatus, on_wire, track_frames

SEED = 540
PERIOD_US = 50_000
#: Between the ends of two frames, about.
FRAME_US = 250


def tracks_of(generator: np.random.Generator, count: int, rolling_count: int) -> Tracks:
    """Tracks as the wire carries them, by number."""
    tracks = np.zeros(count, dtype=TRACK_DTYPE)
    tracks["id"] = np.sort(generator.permutation(TRACKS)[:count] + 1)
    tracks["status"] = generator.integers(TrackStatus.NEW, TrackStatus.NEW_COASTED + 1, count)
    tracks["range"], tracks["angle"] = generator.uniform(1.0, 174.0, count), generator.uniform(-0.7, 0.7, count)
    tracks["range_rate"], tracks["rolling_count"] = generator.uniform(-80.0, 80.0, count), rolling_count
    return on_wire(tracks)


def frames_of(tracks: Tracks, rolling_count: int, start_us: int = 0) -> list[Frame]:
    """Frames of a scan with the times that they have on the bus."""
    frames = enumerate(iterate(track_frames(tracks, rolling_count)))
    return [frame._replace(time_us=start_us + FRAME_US * (place + 1)) for place, frame in frames]


def scan(rolling_count: int = 0, start_us: int = 0, count: int = 9, seed: int = SEED) -> list[Frame]:
    return frames_of(tracks_of(np.random.default_rng(seed), count, rolling_count), rolling_count, start_us)


def push(inbox: RadarInbox, frames: list[Frame]) -> None:
    for frame in frames:
        inbox.receive(frame.time_us, frame.id, frame.dlc, frame.flags, frame.data)


def taken(inbox: RadarInbox, now_us: int) -> ReceivedScan:
    result = inbox.take(now_us)
    assert result is not None
    assert inbox.take(now_us) is None, "handed out twice"
    return result


@pytest.mark.parametrize("count", [0, 1, 17, TRACKS])
def test_a_whole_scan_comes_out_as_it_went_in(count: int) -> None:
    print(f"seed {SEED}")
    generator, inbox = np.random.default_rng(SEED + count), RadarInbox()
    for number in range(6):
        tracks = tracks_of(generator, count, number % 2)
        frames = frames_of(tracks, number % 2, PERIOD_US * number)
        push(inbox, frames[:-1])
        assert inbox.take(frames[-2].time_us) is None, "one frame is missing yet"
        push(inbox, frames[-1:])
        result = taken(inbox, frames[-1].time_us)
        assert (result.status, result.frames, result.time_us) == (ScanStatus.COMPLETE, TRACKS, frames[0].time_us)
        assert result.tracks.tobytes() == tracks.tobytes()
    assert inbox.counts == {ScanStatus.COMPLETE: 6, ScanStatus.INCOMPLETE: 0, ScanStatus.MIXED: 0}


def test_frames_may_come_in_any_order() -> None:
    print(f"seed {SEED}")
    generator, inbox = np.random.default_rng(SEED), RadarInbox()
    tracks = tracks_of(generator, 30, 1)
    frames = frames_of(tracks, 1)
    places = generator.permutation(TRACKS)
    push(inbox, [frames[place]._replace(time_us=frames[number].time_us) for number, place in enumerate(places)])
    assert taken(inbox, SCAN_US).tracks.tobytes() == tracks.tobytes()


@pytest.mark.parametrize("missing", [0, 1, 31, TRACKS - 1])
def test_a_scan_that_lacks_a_frame_is_told_and_not_handed_out(missing: int) -> None:
    inbox = RadarInbox()
    frames = scan()
    del frames[missing]
    push(inbox, frames)
    end_us = frames[0].time_us + SCAN_US
    assert inbox.take(end_us - 1) is None
    result = taken(inbox, end_us)
    assert (result.status, result.frames, len(result.tracks)) == (ScanStatus.INCOMPLETE, TRACKS - 1, 0)
    assert result.tracks.dtype == TRACK_DTYPE
    push(inbox, scan(1, PERIOD_US))
    assert taken(inbox, 2 * PERIOD_US).status is ScanStatus.COMPLETE
    assert inbox.counts == {ScanStatus.COMPLETE: 1, ScanStatus.INCOMPLETE: 1, ScanStatus.MIXED: 0}


def test_the_next_scan_ends_one_that_nobody_asked_for() -> None:
    inbox = RadarInbox()
    push(inbox, scan()[:40])
    push(inbox, scan(1, PERIOD_US))
    assert taken(inbox, 2 * PERIOD_US).status is ScanStatus.COMPLETE
    assert inbox.counts[ScanStatus.INCOMPLETE] == 1


def test_halves_of_two_scans_are_no_scan() -> None:
    """The second half of one scan and the first of the next but one: the same rolling count, 64 frames, no scan."""
    inbox = RadarInbox()
    push(inbox, scan(0, 0)[32:] + scan(0, 2 * PERIOD_US)[:32])
    assert taken(inbox, 3 * PERIOD_US) == (ScanStatus.INCOMPLETE, 2 * PERIOD_US + FRAME_US, 32, pytest.approx([]))
    assert inbox.counts == {ScanStatus.COMPLETE: 0, ScanStatus.INCOMPLETE: 2, ScanStatus.MIXED: 0}


@pytest.mark.parametrize("odd", [0, 20, TRACKS - 1])
def test_one_frame_of_another_scan_spoils_it(odd: int) -> None:
    inbox = RadarInbox()
    frames, other = scan(0), scan(1)
    frames[odd] = other[odd]
    push(inbox, frames)
    result = taken(inbox, frames[-1].time_us)
    assert (result.status, result.frames, len(result.tracks)) == (ScanStatus.MIXED, TRACKS, 0)


def test_repeated_frames_make_no_scan_of_their_own() -> None:
    inbox = RadarInbox()
    frames = scan()
    push(inbox, [one for frame in frames for one in (frame, frame._replace(time_us=frame.time_us + 1))])
    assert taken(inbox, frames[-1].time_us).status is ScanStatus.COMPLETE
    push(inbox, [frame._replace(time_us=frames[0].time_us + SCAN_US - 1) for frame in frames[-3:]])
    assert inbox.take(10 * PERIOD_US) is None
    assert sum(inbox.counts.values()) == 1


@pytest.mark.parametrize(
    "change",
    [{"dlc": 7}, {"dlc": 0}, {"flags": Flag.EXTENDED}, {"flags": Flag.REMOTE}, {"flags": Flag.ERROR}],
    ids=str,
)
def test_what_is_no_frame_of_a_track_is_missing(change: dict[str, int]) -> None:
    inbox = RadarInbox()
    frames = scan()
    frames[5] = frames[5]._replace(**change)
    push(inbox, frames)
    assert taken(inbox, PERIOD_US).status is ScanStatus.INCOMPLETE


@pytest.mark.parametrize("identifier", [0x4E0, 0x4E1, FIRST_ID - 1, FIRST_ID + TRACKS, 0x540, 0, 0x1FFFFFFF])
def test_other_messages_of_the_bus_begin_nothing(identifier: int) -> None:
    inbox = RadarInbox()
    inbox.receive(0, identifier, 8, 0, bytes(8))
    assert inbox.take(10 * PERIOD_US) is None
    assert sum(inbox.counts.values()) == 0


def test_nothing_comes_from_nothing() -> None:
    assert RadarInbox().take(0) is None


def test_random_frames_raise_nothing_and_only_whole_scans_have_tracks() -> None:
    print(f"seed {SEED}")
    generator, inbox = np.random.default_rng(SEED), RadarInbox()
    now_us, told = 0, 0
    for _ in range(20_000):
        now_us = int(generator.integers(0, 1 << 40)) if generator.random() < 0.001 else now_us + 100
        identifier = int(generator.integers(FIRST_ID - 2, FIRST_ID + TRACKS + 2))
        length, flags = (int(generator.choice(some)) for some in ([8, 8, 8, 0, 3, 15], [0, 0, 0, 1, 7]))
        inbox.receive(now_us, identifier, length, flags, generator.bytes(8))
        result = inbox.take(now_us)
        if result is not None:
            told += 1
            assert len(result.tracks) == 0 or result.status is ScanStatus.COMPLETE
    assert told == sum(inbox.counts.values()) > 10
