"""Traces, read back with Perfetto's own classes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from jitter_samples import EPOCH_NS, measurement
from perfetto.protos.perfetto.trace import perfetto_trace_pb2 as perfetto

from dbc.codec import database
from dbc.errors import RaceloopError
from tools.jitter.perfetto import Trace
from tools.jitter.trace import trace_of

BEGIN, END, INSTANT, COUNTER = (
    perfetto.TrackEvent.Type.Value(f"TYPE_{name}") for name in ("SLICE_BEGIN", "SLICE_END", "INSTANT", "COUNTER")
)


class Reader:
    """What a trace says: its tracks, and its events with their names resolved."""

    def __init__(self, content: bytes) -> None:
        self.tracks: dict[int, perfetto.TrackDescriptor] = {}
        self.events: list[tuple[int, int, int, str, dict[str, object]]] = []
        self.values: list[tuple[int, int, float]] = []
        names: dict[int, str] = {}
        annotations: dict[int, str] = {}
        trace = perfetto.Trace.FromString(content)
        flags = perfetto.TracePacket.SequenceFlags
        assert trace.packet[0].sequence_flags & flags.Value("SEQ_INCREMENTAL_STATE_CLEARED")
        for packet in trace.packet:
            assert not unknown_fields(packet)
            assert packet.trusted_packet_sequence_id == 1
            assert packet.sequence_flags & flags.Value("SEQ_NEEDS_INCREMENTAL_STATE")
            names |= {entry.iid: entry.name for entry in packet.interned_data.event_names}
            annotations |= {entry.iid: entry.name for entry in packet.interned_data.debug_annotation_names}
            if packet.HasField("track_descriptor"):
                assert packet.track_descriptor.uuid not in self.tracks
                self.tracks[packet.track_descriptor.uuid] = packet.track_descriptor
            if packet.HasField("track_event"):
                event = packet.track_event
                assert event.track_uuid in self.tracks, "a track is described before its first event"
                if event.type == COUNTER:
                    self.values.append((event.track_uuid, packet.timestamp, event.double_counter_value))
                    continue
                values = {annotations[item.name_iid]: value(item) for item in event.debug_annotations}
                name = names[event.name_iid] if event.type != END else ""
                self.events.append((event.track_uuid, packet.timestamp, event.type, name, values))

    def slices(self, track: int) -> list[tuple[str, int, int, int]]:
        """Name, begin, end and depth of the slices of a track; they nest, and none is left open."""
        done, open_slices, now = [], [], 0
        for uuid, time_ns, kind, name, _ in self.events:
            if uuid != track or kind == INSTANT:
                continue
            assert time_ns >= now, "events of a track are in order of time"
            now = time_ns
            if kind == BEGIN:
                open_slices.append((name, time_ns))
            else:
                began = open_slices.pop()
                done.append((began[0], began[1], time_ns, len(open_slices)))
        assert not open_slices
        return done

    def track(self, name: str) -> int:
        """The track of this name."""
        (found,) = (
            uuid
            for uuid, track in self.tracks.items()
            if name in (track.name, track.process.process_name, track.thread.thread_name)
        )
        return found


def value(annotation: perfetto.DebugAnnotation) -> object:
    return getattr(annotation, annotation.WhichOneof("value"))


def unknown_fields(message: perfetto.TracePacket) -> bool:
    """True when a message holds a field that its definition does not know; those are lost on the way through JSON."""
    copy = type(message)()
    copy.CopyFrom(message)
    copy.DiscardUnknownFields()
    return copy.SerializeToString() != message.SerializeToString()


def test_every_kind_of_event():
    trace = Trace()
    process = trace.process(77, "obc, idle")
    thread = trace.thread(77, "obc cycle")
    counter = trace.counter("lateness", "us", process)
    group = trace.track("CAN buses")
    bus = trace.track("CAN1", group)
    trace.begin(thread, 1_000, "cycle", slot=3, late_us=60.5, text="µs")
    trace.begin(thread, 1_200, "receive")
    trace.end(thread, 1_300)
    trace.end(thread, 1_300)
    trace.instant(bus, 2_000, "brake_pressure_cmd", id=-1, big=2**62)
    trace.value(counter, 3_000, -0.25)
    read = Reader(trace.to_bytes())
    assert (read.tracks[process].process.pid, read.tracks[process].process.process_name) == (77, "obc, idle")
    described = read.tracks[thread].thread
    assert (described.pid, described.tid, described.thread_name) == (77, 77, "obc cycle")
    assert (read.tracks[counter].parent_uuid, read.tracks[counter].counter.unit_name) == (process, "us")
    assert (read.tracks[bus].name, read.tracks[bus].parent_uuid) == ("CAN1", group)
    assert read.slices(thread) == [("receive", 1_200, 1_300, 1), ("cycle", 1_000, 1_300, 0)]
    assert read.events[0] == (thread, 1_000, BEGIN, "cycle", {"slot": 3, "late_us": 60.5, "text": "µs"})
    assert read.events[-1] == (bus, 2_000, INSTANT, "brake_pressure_cmd", {"id": -1, "big": 2**62})
    assert read.values == [(counter, 3_000, -0.25)]


def test_names_are_interned_once():
    trace = Trace()
    track = trace.track("bus")
    for time_ns in range(1000):
        trace.instant(track, time_ns, "a_message_with_a_long_name", identifier=time_ns)
    content = trace.to_bytes()
    assert content.count(b"a_message_with_a_long_name") == 1
    assert len(content) < 1000 * 40
    events = Reader(content).events
    assert [event[4]["identifier"] for event in events] == list(range(1000))


@pytest.fixture(scope="module")
def read() -> Reader:
    return Reader(trace_of([measurement()]).to_bytes())


def test_cycles_and_tasks_are_slices(read: Reader):
    slices = read.slices(read.track("obc cycle"))
    # The first phase of a cycle and the first task have one name.
    assert Counter(name for name, *_ in slices) == {
        "cycle": 50, "receive": 100, "logic": 50, "monitor": 50, "send": 50
    }  # fmt: skip
    first = {(name, depth): (begin, end) for name, begin, end, depth in slices[:6]}
    wake = EPOCH_NS + 4_060_000
    assert first["cycle", 0] == (wake, wake + 200_000)
    assert first["receive", 1] == (wake, wake + 20_000)
    assert first["logic", 1] == (wake + 20_000, wake + 120_000)
    assert first["receive", 2] == (wake + 20_000, wake + 50_000)  # the task of this name
    assert first["monitor", 2] == (wake + 50_000, wake + 110_000)
    assert first["send", 1] == (wake + 120_000, wake + 200_000)


def test_tasks_never_leave_their_cycle():
    sample = measurement()
    sample.cycles.log.records["task_us"][:, 2] = 60_000
    slices = Reader(trace_of([sample]).to_bytes())
    for name, _, end, _ in slices.slices(slices.track("obc cycle")):
        assert (name != "monitor") or end in sample.cycles.log.records["ticked_ns"]


def test_frames_are_on_their_bus(read: Reader):
    group, bus = read.track("CAN buses"), read.track("CAN1")
    assert read.tracks[bus].parent_uuid == group
    frames = [event for event in read.events if event[0] == bus]
    assert Counter(event[3] for event in frames) == {"brake_pressure_cmd": 50, "wheel_speed_report": 50}
    assert frames[0][1] == EPOCH_NS + 4_230_000
    assert frames[0][4]["data"] == " ".join(["00"] * database.message("brake_pressure_cmd").length)


def test_lateness_is_a_counter(read: Reader):
    track = read.track("wake-up lateness")
    assert read.tracks[track].parent_uuid == read.track("obc, idle")
    assert [value for uuid, _, value in read.values if uuid == track] == [60.0] * 50


def test_what_stands_out_is_marked():
    sample = measurement()
    records = sample.cycles.log.records
    records["skipped"][20] = 2
    records["sent_ns"][30] = records["deadline_ns"][30] + 10_000_001
    read = Reader(trace_of([sample]).to_bytes())
    marks = read.track("worst, skipped and overrun cycles")
    events = [(event[2], event[3], event[4].get("slot")) for event in read.events if event[0] == marks]
    assert (INSTANT, "2 cycles skipped", None) in events
    assert (INSTANT, "overrun", None) in events
    worst = [slot for kind, _, slot in events if kind == BEGIN]
    assert {7, 30} <= set(worst)
    assert len(worst) == 5
    assert [name for _, name, _ in events].count("overrun") == 1


def test_two_measurements_share_the_buses_but_not_the_process():
    first, second = measurement(), measurement(condition="cpu load", process=4712)
    read = Reader(trace_of([first, second]).to_bytes())
    processes = {track.process.pid: track.process.process_name for track in read.tracks.values() if track.process.pid}
    assert processes == {4711: "obc, idle", 4712: "obc, cpu load"}
    assert [track.name for track in read.tracks.values()].count("CAN1") == 1


def test_file_appears_whole_or_not_at_all(tmp_path: Path):
    path = tmp_path / "run.pftrace"
    trace = trace_of([measurement()])
    trace.write(path)
    assert path.read_bytes() == trace.to_bytes()
    with pytest.raises(RaceloopError, match="cannot be written"):
        trace.write(tmp_path / "nowhere" / "run.pftrace")
    assert list(tmp_path.iterdir()) == [path]
