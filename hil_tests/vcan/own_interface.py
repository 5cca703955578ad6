"""A vcan interface of a test's own, and somebody else on it through Python's own socket."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
from contextlib import suppress

from link_ends import LIMIT_S

CAN_FRAME = struct.Struct("<IB3x8s")


def raw_socket() -> socket.socket:
    return socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)


class Interface:
    """A vcan interface of ours."""

    def __init__(self) -> None:
        self.name = f"rl{os.getpid()}"
        self.address = f"socketcan:{self.name}"

    def create(self) -> None:
        run("ip", "link", "add", "dev", self.name, "type", "vcan")

    def up(self) -> None:
        run("ip", "link", "set", self.name, "up")

    def down(self) -> None:
        run("ip", "link", "set", self.name, "down")

    def delete(self) -> None:
        run("ip", "link", "delete", self.name)


class Node:
    """Somebody else on the bus, through Python's own socket."""

    def __init__(self, interface: Interface) -> None:
        self.socket = raw_socket()
        self.socket.settimeout(LIMIT_S)
        self.socket.bind((interface.name,))

    def send(self, can_id: int, data: bytes = b"", length: int | None = None) -> None:
        self.socket.send(CAN_FRAME.pack(can_id, len(data) if length is None else length, data))

    def receive(self) -> tuple[int, bytes]:
        can_id, length, data = CAN_FRAME.unpack(self.socket.recv(CAN_FRAME.size))
        return can_id, data[:length]

    def rest(self) -> list[tuple[int, bytes]]:
        """What has come in and nobody has heard yet."""
        frames = []
        self.socket.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                frames.append(self.receive())
        self.socket.settimeout(LIMIT_S)
        return frames
