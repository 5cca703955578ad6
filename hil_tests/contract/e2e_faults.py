"""The communication faults of AUTOSAR E2E and ISO 26262-5, each a pure function from traffic to traffic.

Traffic is a list of ticks, each a list of the frames that one receiver gets in it. A fault changes the frames of one
message, its stream, from one tick on, and leaves all others as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from struct import Struct

from dbc.codec import MessageCodec, database
from dbc.frames import FRAME_STRUCT, Bus, Flag, Frame
from dbc.network import MessageFacts

Traffic = list[list[bytes]]

#: Id, bus, length and flags within a frame.
_ADDRESS = Struct("<IBBB")

#: What an impostor's counter is ahead of the true one; with it no two neighbours in a mixed stream are equal.
FOREIGN_COUNTER = 100


@dataclass(frozen=True)
class Stream:
    """The message that a fault befalls.

    Attributes
    ----------
    facts : the message as its DBC file describes it.
    begin : first tick with the fault.
    limit_ticks : ticks without a valid frame that its receiver bears; None where nobody counts them.
    donor : another message with as many bytes, whose content a wrong address brings along.
    """

    facts: MessageFacts
    begin: int
    limit_ticks: int | None
    donor: MessageFacts

    @property
    def codec(self) -> MessageCodec:
        return database.message(self.facts.message.name)

    @property
    def cycle_ticks(self) -> int:
        return self.facts.cycle_ms // 10

    def owns(self, frame: bytes) -> bool:
        return is_of(self.facts, frame)


def unpack(frame: bytes) -> Frame:
    return Frame._make(FRAME_STRUCT.unpack(frame))


def is_of(facts: MessageFacts, frame: bytes) -> bool:
    """Whether a receiver takes the frame for this message: by id, bus and format."""
    identifier, bus, _, flags = _ADDRESS.unpack_from(frame, 8)
    message = facts.message
    return bool(identifier == message.frame_id and bus == facts.bus and (flags & 1) == message.is_extended_frame)


def is_heartbeat(signal: str) -> bool:
    """A signal that is a counter to those who look into the content; the codec does not."""
    return signal.endswith("_heartbeat")


def with_data(frame: bytes, data: bytes) -> bytes:
    return unpack(frame)._replace(data=data).pack()


def with_bit_flipped(frame: bytes, bit: int) -> bytes:
    word = int.from_bytes(unpack(frame).data, "little") ^ (1 << bit)
    return with_data(frame, word.to_bytes(8, "little"))


def content_bits(facts: MessageFacts) -> list[int]:
    """Bits of the signals that are content, neither counter nor CRC, each signal's from its lowest on."""
    bits: list[int] = []
    for signal in facts.message.signals:
        if signal in (facts.counter, facts.crc) or is_heartbeat(signal.name):
            continue
        if signal.byte_order == "little_endian":
            bits += range(signal.start, signal.start + signal.length)
        else:
            # Counted from the highest bit of the first byte, where such a signal is in one piece.
            last = 8 * (signal.start // 8) + 7 - signal.start % 8 + signal.length - 1
            bits += [8 * (place // 8) + 7 - place % 8 for place in range(last, last - signal.length, -1)]
    return bits


def changed(traffic: Traffic, stream: Stream, change: Callable[[int, bytes], list[bytes]]) -> Traffic:
    """Traffic in which each frame of the stream, from the fault's begin on, is replaced by some others.

    `change` gets the number of the frame, counted from the begin, and the frame.
    """
    number = 0
    result: Traffic = []
    for tick, frames in enumerate(traffic):
        out: list[bytes] = []
        for frame in frames:
            if tick >= stream.begin and stream.owns(frame):
                out += change(number, frame)
                number += 1
            else:
                out.append(frame)
        result.append(out)
    return result


def frames_of(traffic: Traffic, stream: Stream) -> Iterator[bytes]:
    for frames in traffic[stream.begin :]:
        yield from filter(stream.owns, frames)


# --- repetition


def every_frame_twice(traffic: Traffic, stream: Stream) -> Traffic:
    return changed(traffic, stream, lambda _, frame: [frame, frame])


def one_frame_for_ever(traffic: Traffic, stream: Stream) -> Traffic:
    first = next(frames_of(traffic, stream))
    return changed(traffic, stream, lambda _number, _frame: [first])


# --- loss


def one_frame_lost(traffic: Traffic, stream: Stream) -> Traffic:
    return changed(traffic, stream, lambda number, frame: [] if number == 0 else [frame])


def all_frames_lost(traffic: Traffic, stream: Stream) -> Traffic:
    return changed(traffic, stream, lambda _number, _frame: [])


# --- delay


def late_by(traffic: Traffic, stream: Stream, ticks: int) -> Traffic:
    """All frames come so many ticks late; the last ones are still on their way in the end."""
    late: Traffic = [[] for _ in traffic]
    for tick, frames in enumerate(traffic):
        if tick >= stream.begin and tick + ticks < len(traffic):
            late[tick + ticks] = [frame for frame in frames if stream.owns(frame)]
    return [frames + arrived for frames, arrived in zip(all_frames_lost(traffic, stream), late, strict=True)]


def within_the_limit(traffic: Traffic, stream: Stream) -> Traffic:
    """The gap before the first late frame is as long as the receiver bears."""
    return late_by(traffic, stream, 5 if stream.limit_ticks is None else stream.limit_ticks - stream.cycle_ticks)


def beyond_the_limit(traffic: Traffic, stream: Stream) -> Traffic:
    return late_by(traffic, stream, 5 if stream.limit_ticks is None else stream.limit_ticks + 1)


# --- insertion and masquerade


def foreign(stream: Stream, number: int, frame: bytes) -> bytes:
    """A frame with another content and a counter that moves; a sender that knows of no CRC leaves it 0."""
    codec = stream.codec
    other = with_bit_flipped(frame, content_bits(stream.facts)[0])
    values = dict(zip(codec.signals, codec.decode(unpack(other).data), strict=True))
    for signal in stream.facts.message.signals:
        if signal is stream.facts.counter or is_heartbeat(signal.name):
            values[signal.name] = float((number + FOREIGN_COUNTER) % (1 << signal.length))
    if stream.facts.crc is not None:
        values[stream.facts.crc.name] = 0.0
    return with_data(frame, codec.encode(*values.values()))


def forged(stream: Stream, number: int, frame: bytes) -> bytes:
    """A frame whose sender knows the CRC and what it covers."""
    return stream.codec.finish(foreign(stream, number, frame), (number + FOREIGN_COUNTER) & 0xFF)


def foreign_frames_between(traffic: Traffic, stream: Stream) -> Traffic:
    return changed(traffic, stream, lambda number, frame: [frame, foreign(stream, number, frame)])


def forged_frames_between(traffic: Traffic, stream: Stream) -> Traffic:
    return changed(traffic, stream, lambda number, frame: [frame, forged(stream, number, frame)])


def foreign_frames_instead(traffic: Traffic, stream: Stream) -> Traffic:
    return changed(traffic, stream, lambda number, frame: [foreign(stream, number, frame)])


def forged_frames_instead(traffic: Traffic, stream: Stream) -> Traffic:
    return changed(traffic, stream, lambda number, frame: [forged(stream, number, frame)])


# --- wrong address


def another_message_under_this_id(traffic: Traffic, stream: Stream) -> Traffic:
    """Content, counter and CRC of the donor. Without a CRC in the worst case: the counter's place moves."""
    donor = database.message(stream.donor.message.name)
    values = [max(0.0, donor.limits(signal)[0]) for signal in donor.signals]

    def readdressed(number: int, frame: bytes) -> bytes:
        data = unpack(donor.finish(donor.frame(*values), number & 0xFF)).data
        alien = with_data(frame, data)
        return alien if stream.facts.crc is not None else foreign(stream, number, alien)

    return changed(traffic, stream, lambda number, frame: [readdressed(number, frame)])


def on_another_bus(traffic: Traffic, stream: Stream) -> Traffic:
    other = Bus.CAN_S if stream.facts.bus != Bus.CAN_S else Bus.CAN1
    return changed(traffic, stream, lambda _, frame: [unpack(frame)._replace(bus=other).pack()])


def in_the_other_format(traffic: Traffic, stream: Stream) -> Traffic:
    """The same number as a 29-bit identifier."""
    return changed(traffic, stream, lambda _, f: [unpack(f)._replace(flags=unpack(f).flags ^ Flag.EXTENDED).pack()])


# --- wrong sequence


def every_two_frames_swapped(traffic: Traffic, stream: Stream) -> Traffic:
    frames = list(frames_of(traffic, stream))
    order = [number ^ 1 if number ^ 1 < len(frames) else number for number in range(len(frames))]
    return changed(traffic, stream, lambda number, _frame: [frames[order[number]]])


# --- corruption


def one_bit_flipped(traffic: Traffic, stream: Stream) -> Traffic:
    """The same bit of the content in every frame, on its way between the sender's memory and the receiver's."""
    bit = content_bits(stream.facts)[0]
    return changed(traffic, stream, lambda _, frame: [with_bit_flipped(frame, bit)])


def one_byte_short(traffic: Traffic, stream: Stream) -> Traffic:
    length = stream.facts.message.length - 1
    return changed(traffic, stream, lambda _, frame: [unpack(frame)._replace(dlc=length).pack()])


def remote_frames(traffic: Traffic, stream: Stream) -> Traffic:
    return changed(traffic, stream, lambda _, f: [unpack(f)._replace(flags=unpack(f).flags | Flag.REMOTE).pack()])


# --- blocked channel


def bus_silent(traffic: Traffic, stream: Stream) -> Traffic:
    """Nothing comes through on the bus of the stream: not its frames, and none of any other message."""
    return [
        [f for f in frames if tick < stream.begin or unpack(f).bus != stream.facts.bus]
        for tick, frames in enumerate(traffic)
    ]
