"""The stations of a real-time run in one process, stepped by slots: real wires and ECUs, no clock, no links.

Two ways to carry frames: the network of lock step, with arbitration, and a plain hand-over in the order of sending.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from autonomy.track_files import load_track
from bridge._native import ffi, lib
from bridge.bus import Network
from bridge.realtime.autonomy_station import AutonomyStation
from bridge.realtime.cloud import CloudReceiver, CloudSender
from bridge.realtime.plant_station import PlantStation
from bridge.realtime.truth_file import TruthWriter
from bridge.realtime.wired import Cell, WiredIo
from bridge.scenario import Scenario
from bridge.surroundings import TICK_US, Surroundings
from dbc.codec import profile
from dbc.frames import FRAME_SIZE, Bus, Station, frame_array, iterate
from tools.run import make_autonomy

MEMBERS = {
    Bus.CAN1: (Station.SENSORS, Station.OBC, Station.RAPTOR),  # the plant's process listens on CAN1
    Bus.CAN3: (Station.RAPTOR, Station.SPACE_DRIVE),
    Bus.CAN_A: (Station.AUTONOMY, Station.OPERATOR, Station.OBC),
    Bus.CAN_S: (Station.SENSORS, Station.AUTONOMY, Station.OBC),
}


class Carrier(Protocol):
    """Carries frames between stations."""

    def begin(self, now_us: int) -> None: ...
    def send(self, station: Station, frames: bytes, *buses: Bus) -> None: ...
    def take(self, station: Station) -> bytes: ...
    def end(self) -> None: ...
    def frames(self) -> NDArray[np.void]:
        """All frames so far, in order of time."""
        ...


class ByNetwork:
    """The network of lock step."""

    def __init__(self) -> None:
        self.network = Network()
        self.log: list[NDArray[np.void]] = []
        self._heard = b""

    def begin(self, now_us: int) -> None:
        self.network.begin_tick(now_us, now_us + TICK_US)

    def send(self, station: Station, frames: bytes, *buses: Bus) -> None:
        self.network.submit(station, frames)
        self.network.transmit(*buses)

    def take(self, station: Station) -> bytes:
        if station is Station.OPERATOR:
            heard, self._heard = self._heard, b""
            return heard + self.network.take(station)
        return self.network.take(station)

    def end(self) -> None:
        self.network.end_tick()
        drained = self.network.drain_log()
        self._heard = drained[drained["bus"] == Bus.CAN1].tobytes()
        self.log.append(drained)

    def frames(self) -> NDArray[np.void]:
        return np.concatenate(self.log)


class ByHand:
    """Every frame is with its receivers as soon as it is sent, in the order of sending, and takes no time."""

    def __init__(self) -> None:
        self._inboxes = {station: bytearray() for station in Station}
        self._log = bytearray()
        self._now_us = 0

    def begin(self, now_us: int) -> None:
        self._now_us = now_us

    def send(self, station: Station, frames: bytes, *_buses: Bus) -> None:
        for frame in iterate(frames):
            stamped = frame._replace(time_us=self._now_us, sender=Station.NONE).pack()
            self._log += stamped
            for member in MEMBERS[Bus(frame.bus)]:
                if member is not station:
                    self._inboxes[member] += stamped

    def take(self, station: Station) -> bytes:
        sources = (Station.SENSORS, Station.OPERATOR) if station is Station.OPERATOR else (station,)
        taken = b"".join(bytes(self._inboxes[source]) for source in sources)
        for source in sources:
            self._inboxes[source].clear()
        return taken

    def end(self) -> None:
        pass

    def frames(self) -> NDArray[np.void]:
        return frame_array(bytes(self._log))


class Chain:
    """Plant, autonomy and the three ECUs; a context manager.

    Parameters
    ----------
    scenario : what to run.
    folder : for wires and truth.
    carrier : of the frames.

    Attributes
    ----------
    held : stations that are stopped: they do not step, and what they would have heard waits for them.
    said : lines of the plant.
    """

    def __init__(self, scenario: Scenario, folder: Path, carrier: Carrier) -> None:
        self.carrier = carrier
        road = load_track(scenario.track)
        self.surroundings = Surroundings.from_scenario(scenario, road)
        plant = self.surroundings.plant
        self.wires = WiredIo(folder / "wires", create=True)
        self.truth_path = folder / "truth"
        self.truth = TruthWriter(
            self.truth_path, plant.output_names, plant.output_units, scenario.time_limit_us // TICK_US + 1
        )
        self.said: list[str] = []
        self.clouds = CloudReceiver(folder / "clouds"), CloudSender(folder / "clouds")
        self.plant = PlantStation(self.surroundings, scenario, self.wires, self.truth, self.said.append, self.clouds[1])
        self.autonomy = AutonomyStation(make_autonomy(scenario, road), self.clouds[0])
        self.held: set[Station] = set()
        self.slot = 0
        self._outbox: Any = ffi.new("can_outbox *")
        self._out_frames: Any = ffi.new("can_frame[]", lib.BENCH_OUTBOX_MAX)
        self._outbox.frames, self._outbox.capacity = self._out_frames, lib.BENCH_OUTBOX_MAX
        self.obc: Any = ffi.new("obc *")
        self.raptor: Any = ffi.new("raptor *")
        self.space_drive: Any = ffi.new("space_drive *")
        lib.obc_init(self.obc)
        lib.raptor_init(self.raptor, ffi.NULL)
        lib.space_drive_init(self.space_drive, ffi.NULL)
        lib.obc_select_profile(self.obc, profile(scenario.profile).number)
        lib.raptor_select_profile(self.raptor, profile(scenario.profile).number)
        self._raptor_wires = ffi.new("raptor_wired_in *"), ffi.new("raptor_wired_out *")
        self._space_drive_wires = ffi.new("space_drive_wired_in *"), ffi.new("space_drive_wired_out *")

    def __enter__(self) -> Chain:
        return self

    def __exit__(self, *_: object) -> None:
        self.surroundings.close()
        for clouds in self.clouds:
            clouds.close()
        self.truth.close()
        self.wires.close()

    @property
    def now_us(self) -> int:
        return self.slot * TICK_US

    def step(self) -> None:
        """One slot, in the order of the phases."""
        now_us, carrier = self.now_us, self.carrier
        carrier.begin(now_us)
        if Station.OPERATOR not in self.held:
            sent = frame_array(self.plant.step(now_us, carrier.take(Station.OPERATOR)))
            carrier.send(Station.SENSORS, sent[sent["bus"] == Bus.CAN_S].tobytes(), Bus.CAN_S)
            # Lock step lets the operator's frames go together with autonomy's.
            carrier.send(Station.OPERATOR, sent[sent["bus"] == Bus.CAN_A].tobytes())
        if Station.AUTONOMY not in self.held:
            carrier.send(Station.AUTONOMY, self.autonomy.step(now_us, carrier.take(Station.AUTONOMY)), Bus.CAN_A)
        if Station.OBC not in self.held:
            received = carrier.take(Station.OBC)
            sent_by_obc = self._tick(lib.obc_tick, self.obc, received)
            carrier.send(Station.OBC, sent_by_obc, Bus.CAN1, Bus.CAN_A)
        if Station.RAPTOR not in self.held:
            self.wires.read(Cell.RAPTOR_IN, self._raptor_wires[0])
            sent_by_raptor = self._tick(lib.raptor_tick, self.raptor, carrier.take(Station.RAPTOR), self._raptor_wires)
            self.wires.write(Cell.RAPTOR_OUT, self._raptor_wires[1])
            carrier.send(Station.RAPTOR, sent_by_raptor, Bus.CAN1, Bus.CAN3)
        if Station.SPACE_DRIVE not in self.held:
            self.wires.read(Cell.SPACE_DRIVE_IN, self._space_drive_wires[0])
            received = carrier.take(Station.SPACE_DRIVE)
            sent_by_drive = self._tick(lib.space_drive_tick, self.space_drive, received, self._space_drive_wires)
            self.wires.write(Cell.SPACE_DRIVE_OUT, self._space_drive_wires[1])
            carrier.send(Station.SPACE_DRIVE, sent_by_drive, Bus.CAN3)
        carrier.end()
        self.slot += 1

    def steps(self, count: int) -> None:
        """Several slots."""
        for _ in range(count):
            self.step()

    def _tick(self, tick: Any, ecu: Any, received: bytes, wires: tuple[Any, Any] | None = None) -> bytes:
        self._outbox.count = 0
        frames = ffi.from_buffer("can_frame[]", received)
        count = len(received) // FRAME_SIZE
        if wires is None:
            tick(ecu, self.now_us, frames, count, self._outbox)
        else:
            tick(ecu, self.now_us, wires[0], frames, count, wires[1], self._outbox)
        return bytes(ffi.buffer(self._out_frames, self._outbox.count * FRAME_SIZE))
