"""One end of CAN1 in a profile: what firmware/common/dbw_profile.c makes of frames that leave an ECU and reach it."""

from __future__ import annotations

from collections.abc import Iterable

from bridge._native import ffi, lib
from dbc.codec import profile
from dbc.frames import FRAME_SIZE, Frame, iterate


class Wire:
    """The translation of one ECU.

    Attributes
    ----------
    c : its C struct.
    """

    def __init__(self, name: str = "V26") -> None:
        self.c = ffi.new("dbw_profile *")
        assert lib.dbw_profile_select(self.c, profile(name).number)

    def send(self, frames: Iterable[bytes], keep: int = 0) -> list[Frame]:
        """Frames of V14 as they leave; the first `keep` are not touched."""
        joined = b"".join(frames)
        storage = ffi.new("can_frame[]", max(len(joined) // FRAME_SIZE, 1))
        ffi.memmove(storage, joined, len(joined))
        count = len(joined) // FRAME_SIZE
        out = ffi.new("can_outbox *", {"frames": storage, "capacity": count, "count": count})
        lib.dbw_profile_send(self.c, out, keep)
        return list(iterate(bytes(ffi.buffer(storage, out.count * FRAME_SIZE))))

    def receive(self, frame: bytes) -> tuple[int, Frame]:
        """Verdict on a frame that arrives, and the frame of V14, which holds with DBW_PROFILE_FRAME alone."""
        arrived, translated = ffi.new("can_frame *"), ffi.new("can_frame *")
        ffi.buffer(arrived)[:] = frame
        verdict = lib.dbw_profile_receive(self.c, arrived, translated)
        return verdict, next(iterate(bytes(ffi.buffer(translated))))

    def receive_all(self, frames: Iterable[bytes]) -> list[Frame]:
        """Those that there are in V14."""
        received = (self.receive(frame) for frame in frames)
        return [frame for verdict, frame in received if verdict == lib.DBW_PROFILE_FRAME]
