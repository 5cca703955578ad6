"""`raceloop dbw decode`: a frame into physical values."""

from __future__ import annotations

from rich.console import Console

from dbc.buses import Bus
from dbc.codec import Codec, MessageCodec
from dbc.errors import CodecError
from tools.dbw.bus_option import bus_of
from tools.dbw.frame_text import TextFrame, parse_frame
from tools.dbw.page import finished, page, remarks_on
from tools.exit_status import ExitStatus


def decode(database: Codec, text: str, bus: str | None, console: Console) -> int:
    """Print what a frame says; on each bus that has a message of its identifier, unless one bus is named.

    Parameters
    ----------
    database : messages of a profile.
    text : the frame.
    bus : its label; None for all.
    console : to print on.

    Returns
    -------
    int
        Exit status: a CRC that is wrong is a miss, because every receiver drops such a frame.

    Raises
    ------
    CodecError
        When the text is no frame, no message has the identifier, or the frame is too short for it.
    """
    frame = parse_frame(text)
    status = ExitStatus.DONE
    for number, codec in enumerate(_messages(database, frame, bus)):
        codec.decode(frame.data)  # names the length when it is too short
        data = frame.data[: codec.length]
        remarks = remarks_on(codec, data)
        if len(frame.data) > codec.length:
            remarks.append(f"{len(frame.data)} bytes, of which the message has {codec.length}")
        if (right := finished(codec, data)) != data:
            status = ExitStatus.MISSED
            remarks.append(
                f"the CRC is wrong; a frame with this content is {TextFrame(codec.frame_id, codec.extended, right)}"
            )
        for line in [*([""] if number else []), *page(codec, data), *([""] if remarks else []), *remarks]:
            console.print(line, markup=False)
    return status


def _messages(database: Codec, frame: TextFrame, bus: str | None) -> list[MessageCodec]:
    """The messages that a frame can be; where no bus is named, one of the radar only if it is none of the others."""
    buses = list(Bus) if bus is None else [bus_of(bus)]
    found = [codec for one in buses if (codec := database.find(one, frame.frame_id, frame.extended)) is not None]
    found = [codec for codec in found if codec.bus is not Bus.CAN_R] or found
    if not found:
        near = sorted(
            (codec for codec in database if codec.bus in buses), key=lambda one: abs(one.frame_id - frame.frame_id)
        )
        where = "any bus" if bus is None else bus
        raise CodecError(
            f"no message on {where} has the {29 if frame.extended else 11}-bit identifier {frame.frame_id:X};"
            f" the nearest is {near[0].frame_id:X}, {near[0].name}"
        )
    return found
