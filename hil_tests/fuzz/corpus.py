"""What the fuzz targets start from, made anew each time: recordings of healthy ECUs, and seeds from golden frames.

`corpus.py FOLDER` writes FOLDER/recordings/ECU.bin and FOLDER/corpus/TARGET/. Nothing in it is random.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterable
from pathlib import Path

sys.path += [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parents[1] / "contract")]

from actuator_ecus import RUN_UP, Car, Requests, SpaceDrive
from golden_frames import GOLDEN
from obc_harness import ObcHarness

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import FRAME_STRUCT

STARTS = 6
"""As ECU_EPISODE_STARTS."""

CALM = 0x80
"""Bit of an episode's head: recorded ticks follow unchanged."""


class Recording:
    """The input of one ECU, tick by tick, as ecu_episode.c reads it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ticks: list[bytes] = []

    def add(self, frames: bytes, wired: bytes = b"") -> None:
        self.ticks.append(struct.pack("<I", len(frames) // FRAME_STRUCT.size) + wired + frames)

    def write(self) -> None:
        self.path.write_bytes(b"".join(self.ticks))


def record_obc(path: Path) -> None:
    """Configuration, launch, run-up, and driving at 20 m/s."""
    recording = Recording(path)
    harness = ObcHarness()

    def keep(frames: bytes) -> bytes:
        recording.add(frames)
        return frames

    harness.filters.append(keep)
    harness.plan_speed = 40.0
    harness.drive()
    harness.set_speed(20.0)
    harness.signals["pt_report_1"] |= {"current_gear": 2, "engine_speed_rpm": 5000}
    harness.run(400)
    recording.write()


def record_raptor(path: Path) -> None:
    """Run-up to DRIVING, then a drive with throttle, brake, steering and gears."""
    recording = Recording(path)
    car = Car()

    def run(ticks: int) -> None:
        for _ in range(ticks):
            wired = bytes(ffi.buffer(car.wired))
            car.tick()
            recording.add(b"".join(car.heard), wired)

    for reached, ct_state, flag, switch in RUN_UP:
        car.computer.ct_state = ct_state
        car.wired.race_control.track_flag = flag
        car.wired.safety_switch = switch
        if reached == 9:
            car.computer.ct_state = 6
            run(10)
            car.computer.ct_state = ct_state
        for _ in range(2000):
            if car.state == reached:
                break
            run(1)
        assert car.state == reached, (car.state, reached)
    car.computer.ct_state = 8
    run(10)
    car.computer.brake_kpa = 0.0
    for accelerator, steer, gear, speed in ((40.0, 10.0, 1, 5.0), (60.0, -20.0, 2, 20.0), (0.0, 0.0, 2, 20.0)):
        car.computer.accelerator, car.computer.steer_deg, car.computer.gear = accelerator, steer, gear
        car.set_wheels(speed)
        run(60)
    assert car.state == 9
    recording.write()


def record_space_drive(path: Path) -> None:
    """A Raptor that steers and brakes to and fro."""
    recording = Recording(path)
    drive, requests = SpaceDrive(), Requests(brake=1.0e6)
    for tick in range(400):
        requests.steer, requests.brake = 0.01 * (tick % 100), 1.0e4 * (tick % 200)
        frames = requests.frames()
        recording.add(b"".join(frames), bytes(ffi.buffer(drive.wired)))
        drive.tick(frames)
    assert drive.c.emergency == 0
    recording.write()


def row_of(name: str) -> int:
    """Row of a message in codec_table."""
    message = database.message(name)
    return int(lib.codec_find(message.bus, message.frame_id, False) - lib.codec_table)


def episodes() -> Iterable[bytes]:
    """Every golden frame into every start, a second of loss, a changed frame, an odd number, a wrong clock."""
    for start in range(STARTS):
        for golden in GOLDEN:
            yield (
                bytes([start, 0x04 | CALM, row_of(golden.message)]) + bytes.fromhex(golden.data).ljust(8, b"\0") + b"\5"
            )
        yield bytes([start]) + b"\x10" * 100
        yield bytes([start, 0x01 | CALM, 3, 1, 2, 0xFF, 100])
        yield bytes([start, 0x20 | CALM, 0, 0xFF, 0, 0, 0, 100])
        for kind in range(5):
            yield bytes([start, 0x40 | CALM, kind, 100])
        yield bytes([start, CALM, 255, CALM, 255])


def codec_seeds() -> Iterable[bytes]:
    for golden in GOLDEN:
        message = database.message(golden.message)
        data = bytes.fromhex(golden.data).ljust(8, b"\0")
        frame = FRAME_STRUCT.pack(0, message.frame_id, message.bus, message.length, 0, 0, data)
        values = [golden.values.get(signal, 0.0) for signal in message.signals]
        yield bytes([0, row_of(golden.message)]) + frame + struct.pack(f"<{len(values)}d", *values)


def log_seeds() -> Iterable[bytes]:
    for number, golden in enumerate(GOLDEN):
        message = database.message(golden.message)
        data = bytes.fromhex(golden.data)
        spaced, time = data.hex(" ").upper(), f"{number}.{number:06d}"
        yield b"\0" + f"({time}) can0 {message.frame_id:03X}#{data.hex().upper()}\n".encode()
        yield b"\1" + f"{time} 1 {message.frame_id:X} Rx d {len(data)} {spaced}\n".encode()
        yield b"\2" + f"{number + 1:7} {number}.5 DT {message.frame_id:04X} Rx {len(data)} {spaced}\n".encode()
        head = struct.pack("<4sHHII", b"LOBJ", 32, 1, 48, 1) + struct.pack("<IHHQ", 2, 0, 0, number * 1000)
        body = struct.pack("<HBBI8s", 1, 0, len(data), message.frame_id, data.ljust(8, b"\0"))
        yield b"\3" + head + body


def socketcand_seeds() -> Iterable[bytes]:
    yield b"< open CAN1 >< rawmode >< echo >< open vcan3 >< bcmmode >"
    for golden in GOLDEN:
        data = bytes.fromhex(golden.data)
        yield f"< send {database.message(golden.message).frame_id:X} {len(data)} {data.hex(' ')} >".encode()


def bus_seeds() -> Iterable[bytes]:
    """Two nodes join, queue golden frames, and the bus runs; with disturbances, with random errors."""
    join = bytes([0, 0, 0, 1])
    frames = b"".join(
        bytes([3, number % 2, 0]) + struct.pack("<I", database.message(golden.message).frame_id)
        + bytes.fromhex(golden.data).ljust(8, b"\0")
        for number, golden in enumerate(GOLDEN)
    )  # fmt: skip
    run = bytes([5, 0]) + struct.pack("<I", 40_000_000)
    yield bytes([0]) + join + frames + run
    yield (
        bytes([0])
        + join
        + bytes([7, 255])
        + struct.pack("<IIBH", 0, 0, 200, 30)
        + frames
        + run * 4
        + bytes([6, 0])
        + run
    )
    yield bytes([0x80, 100, 0, 7, 0]) + join + frames + run + bytes([8, 0])
    yield bytes([0x18]) + join + bytes([3, 0, 0xB8]) + struct.pack("<IB", 0x123, 64) + bytes(8) + run


def parameter_seeds() -> Iterable[bytes]:
    yield bytes([255, 4])
    yield bytes([255, 4, 2, 0, 4, 3, 3])
    yield bytes([10, 0, 3, 0]) + struct.pack("<f", float("nan")) + bytes([4])
    yield bytes([255, 0x84, 0, 0])
    yield bytes([255, 0x44, 0, 0, 0, 0])


def main(folder: Path) -> None:
    recordings, corpus = folder / "recordings", folder / "corpus"
    recordings.mkdir(parents=True, exist_ok=True)
    record_obc(recordings / "obc.bin")
    record_raptor(recordings / "raptor.bin")
    record_space_drive(recordings / "space_drive.bin")
    seeds = {
        "obc": episodes, "raptor": episodes, "space_drive": episodes, "codec": codec_seeds, "logs": log_seeds,
        "socketcand": socketcand_seeds, "can_bus": bus_seeds, "parameters": parameter_seeds,
    }  # fmt: skip
    for target, source in seeds.items():
        (corpus / target).mkdir(parents=True, exist_ok=True)
        for number, content in enumerate(source()):
            (corpus / target / f"seed-{number:04d}").write_bytes(content)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
