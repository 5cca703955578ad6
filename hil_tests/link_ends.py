"""The two ends of a link: the C link under test, and the hub's end of its local socket, packet by packet."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import monotonic_ns, sleep
from typing import Any

from bridge._native import ffi, lib
from dbc.frames import FRAME_SIZE, Bus, Frame, iterate

LIMIT_S = 20.0  # for what takes milliseconds on an idle machine
EVERYTHING = lib.CAN_LINK_EVERYTHING


def frame(frame_id: int, data: bytes = b"", *, bus: int = Bus.CAN1, time_us: int = 0, flags: int = 0) -> Frame:
    return Frame(time_us, frame_id, bus, len(data), flags, 0, data.ljust(8, b"\0"))


def pack(frames: Iterable[Frame]) -> bytes:
    return b"".join(one.pack() for one in frames)


class Link:
    """A can_link with storage for its frames."""

    def __init__(self) -> None:
        self.c: Any = ffi.new("can_link *")

    def open(
        self, address: str, bus: int = Bus.CAN1, filters: list[tuple[int, bool]] | None = None, epoch_ns: int = 0
    ) -> int:
        count = EVERYTHING if filters is None else len(filters)
        array = ffi.new("can_link_filter[]", [{"id": i, "extended": extended} for i, extended in filters or []])
        return int(lib.can_link_open(self.c, address.encode(), bus, epoch_ns, array, count))

    def receive(self, capacity: int = 256) -> list[Frame]:
        storage = ffi.new("can_frame[]", capacity)
        count = lib.can_link_receive(self.c, storage, capacity)
        assert count <= capacity
        return list(iterate(bytes(ffi.buffer(storage, count * FRAME_SIZE))))

    def receive_until(self, count: int) -> list[Frame]:
        """Receive until there are `count` frames; whatever else comes with the last of them is there too."""
        frames: list[Frame] = []
        end_ns = monotonic_ns() + int(LIMIT_S * 1e9)
        while len(frames) < count:
            assert monotonic_ns() < end_ns, f"{len(frames)} of {count} frames came"
            frames += self.receive()
            sleep(0.001)
        return frames

    def receive_until_state(self, state: int) -> None:
        end_ns = monotonic_ns() + int(LIMIT_S * 1e9)
        while self.c.state != state:
            assert monotonic_ns() < end_ns, f"state {self.c.state}, not {state}"
            self.receive()
            sleep(0.001)

    def send(self, *frames: Frame) -> int:
        packed = pack(frames)
        array = ffi.new("can_frame[]", len(frames))
        ffi.memmove(array, packed, len(packed))
        return int(lib.can_link_send(self.c, array, len(frames)))

    @property
    def statistics(self) -> dict[str, int]:
        """All counts that are not 0."""
        names = [name for name, _ in ffi.typeof("can_link_statistics").fields]
        counts = {name: int(getattr(self.c.statistics, name)) for name in names}
        return {name: count for name, count in counts.items() if count}

    def close(self) -> None:
        lib.can_link_close(self.c)


class Peer:
    """The hub's end of one station's socket."""

    def __init__(self, end: socket.socket) -> None:
        self.socket = end
        end.settimeout(LIMIT_S)
        hello = end.recv(8192)
        magic, version, self.bus, self.filter_count = struct.unpack_from("<IIII", hello)
        assert (magic, version) == (lib.HUB_MAGIC, lib.HUB_VERSION)
        self.filters = [(i, bool(extended)) for i, extended in struct.iter_unpack("<IB3x", hello[16:])]

    def welcome(self, error: int = 0, version: int = lib.HUB_VERSION) -> None:
        self.socket.send(struct.pack("<IIi", lib.HUB_MAGIC, version, error))

    def send(self, *frames: Frame) -> None:
        assert len(frames) <= lib.HUB_BATCH_MAX
        self.socket.send(pack(frames))

    def packet(self) -> list[Frame]:
        return list(iterate(self.socket.recv(8192)))

    @property
    def process(self) -> int:
        """Id of the station's process."""
        credentials = self.socket.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        return int(struct.unpack("3i", credentials)[0])

    def close(self) -> None:
        self.socket.close()


class HubSocket:
    """The hub's listening socket."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.address = f"hub:{path}"
        path.unlink(missing_ok=True)
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.bind(str(path))
        self.socket.listen(8)
        self.socket.settimeout(LIMIT_S)

    def accept(self) -> Peer:
        """Take a station that says hello; it is not welcomed yet."""
        return Peer(self.socket.accept()[0])

    def join(self, link: Link, **arguments: Any) -> Peer:
        """Open the link to this hub, which welcomes it."""
        with ThreadPoolExecutor(1) as pool:
            opened = pool.submit(link.open, self.address, **arguments)
            peer = self.accept()
            peer.welcome()
            assert opened.result() == 0
        return peer

    def close(self) -> None:
        """Stop listening; the path stays behind, as a hub that was killed leaves it."""
        self.socket.close()
