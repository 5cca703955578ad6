"""An ECU's executable under test: on real buses, or with the hub's end of each bus in the hands of the test."""

from __future__ import annotations

import re
import signal
import subprocess
from collections.abc import Mapping
from pathlib import Path
from time import monotonic, monotonic_ns, sleep

from link_ends import LIMIT_S, HubSocket, Peer

from bridge.realtime.programs import program
from dbc.codec import database
from dbc.frames import Bus, Frame, iterate

BUSES = {
    "obc": (Bus.CAN1, Bus.CAN_A, Bus.CAN_S),
    "raptor": (Bus.CAN1, Bus.CAN3),
    "space-drive": (Bus.CAN3,),
}
OPTION = {Bus.CAN1: "CAN1", Bus.CAN3: "CAN3", Bus.CAN_A: "CANA", Bus.CAN_S: "CANS", Bus.CAN_R: "CANR"}


def mistake_of(name: str, *arguments: str) -> str:
    """The one line with which an ECU refuses its command line, without the program's name."""
    done = subprocess.run(
        [program(f"raceloop-{name}"), *arguments], capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    assert done.stdout == ""
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    prefix = f"raceloop-{name}: "
    assert line.startswith(prefix)
    return line.removeprefix(prefix)


class Ecu:
    """A running ECU; a context manager that ends it.

    Parameters
    ----------
    addresses : of the buses that it is attached to.
    arguments : the rest of its command line.
    """

    def __init__(self, name: str, folder: Path, addresses: Mapping[Bus, str], *arguments: str) -> None:
        self.name = name
        self._stderr = folder / f"{name}.err"
        buses = [f"--bus={OPTION[bus]}={address}" for bus, address in addresses.items()]
        self._command = [program(f"raceloop-{name}"), *buses, *arguments]

    def __enter__(self) -> Ecu:
        with self._stderr.open("w") as stderr:
            self.process = subprocess.Popen(self._command, stdin=subprocess.DEVNULL, stderr=stderr)
        try:
            self.join()
            self.wait_for_line("runs: ")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    def join(self) -> None:
        """Let it onto its buses."""

    @property
    def log(self) -> list[str]:
        """What it has written to standard error, line by line."""
        prefix = f"raceloop-{self.name}: "
        lines = self._stderr.read_text().splitlines()
        assert all(line.startswith(prefix) for line in lines), lines
        return [line.removeprefix(prefix) for line in lines]

    def lines(self, text: str) -> list[str]:
        """Lines of the log that hold the text."""
        return [line for line in self.log if text in line]

    def wait_for_line(self, text: str) -> str:
        end = monotonic() + LIMIT_S
        while not self.lines(text):
            assert monotonic() < end, f"no line with {text!r}: {self.log}"
            assert self.process.poll() is None, self.log
            sleep(0.001)
        return self.lines(text)[0]

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Ask it to stop; returns its exit status."""
        self.process.send_signal(number)
        return self.process.wait(LIMIT_S)

    def counts(self, subject: str) -> dict[str, int]:
        """Statistics that it wrote at its end: of "cycles", or of a bus by its option's name."""
        (line,) = [line for line in self.log if re.match(rf"{subject} \d+|{subject}: received", line)]
        text = line.removeprefix(f"{subject}: ")
        return {name: int(count) for name, count in re.findall(r"([a-z][a-z -]*?) (\d+)", text)}


class EcuProcess(Ecu):
    """An ECU whose buses end in the hands of the test."""

    def __init__(self, name: str, folder: Path, *arguments: str) -> None:
        self.hub = HubSocket(folder / "hub")
        super().__init__(name, folder, dict.fromkeys(BUSES[name], self.hub.address), *arguments)
        self.peers: dict[Bus, Peer] = {}

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        for peer in self.peers.values():
            peer.close()
        self.hub.close()

    def __enter__(self) -> EcuProcess:
        super().__enter__()
        return self

    def join(self) -> None:
        for _ in BUSES[self.name]:
            peer = self.hub.accept()
            peer.welcome()
            self.peers[Bus(peer.bus)] = peer

    def hear(self, bus: Bus, message: str) -> dict[str, float]:
        """Values of the next frame of a message that the ECU sends."""
        codec = database.message(message)
        end = monotonic() + LIMIT_S
        while monotonic() < end:
            for frame in self.peers[bus].packet():
                if (frame.bus, frame.id) == (codec.bus, codec.frame_id):
                    return dict(zip(codec.signals, codec.decode(frame.data), strict=True))
        raise AssertionError(f"no {message}")

    def say(self, bus: Bus, *frames: bytes) -> None:
        """Put frames on a bus, now."""
        now_us = monotonic_ns() // 1000
        self.peers[bus].send(*(next(iterate(frame))._replace(time_us=now_us) for frame in frames))

    def rest(self, bus: Bus) -> list[Frame]:
        """What an ECU that has ended sent and nobody has heard yet."""
        frames: list[Frame] = []
        while packet := self.peers[bus].packet():
            frames += packet
        return frames
