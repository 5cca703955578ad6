"""The loop that a user would write with the same packages, as the peer that `raceloop bench` measures against.

Everything that decides is the same: ECU firmware, autonomy, sensor models, FMU, scenario. What differs is how it is
joined: the FMU through fmpy's instance methods, frames as python-can messages over virtual buses, and every value
through cantools, encoded once by its sender and decoded once by each receiver. Nothing is recorded.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterable, Mapping
from types import TracebackType
from typing import Any

import can
import cantools
import fmpy
import numpy as np
from cantools.database.can import Database
from fmpy.fmi3 import FMU3Slave
from numpy.typing import NDArray

from bridge._native import ffi, lib
from bridge.interfaces import Autonomy, Road
from bridge.plant import REQUIRED_INPUTS, REQUIRED_OUTPUTS
from bridge.scenario import Scenario, load_vehicle
from bridge.surroundings import TICK_US, Surroundings
from dbc.buses import DIRECTORY
from dbc.codec import MessageCodec
from dbc.codec import database as codec_database
from dbc.frames import FRAME_STRUCT, Bus, Station
from firmware.parameters import parameter_frames
from plant_fmu import fmu_path

_FILES = {
    Bus.CAN1: "raptor",
    Bus.CAN3: "space_drive",
    Bus.CAN_A: "autonomy",
    Bus.CAN_S: "sensors",
    Bus.CAN_R: "radar_esr",
}
_MEMBERS = {
    Bus.CAN1: (Station.OBC, Station.RAPTOR),
    Bus.CAN3: (Station.RAPTOR, Station.SPACE_DRIVE),
    Bus.CAN_A: (Station.AUTONOMY, Station.OPERATOR, Station.OBC),
    Bus.CAN_S: (Station.SENSORS, Station.AUTONOMY, Station.OBC),
    Bus.CAN_R: (Station.SENSORS, Station.AUTONOMY),
}
_OUTBOX = 256


class PlainPlant:
    """The FMU through fmpy's instance methods.

    Parameters
    ----------
    start : start values by name.
    """

    def __init__(self, start: Mapping[str, float]) -> None:
        path = fmu_path(3)
        description = fmpy.read_model_description(str(path))
        variables = {variable.name: variable for variable in description.modelVariables}
        self._folder = fmpy.extract(str(path))
        self._fmu = FMU3Slave(
            guid=description.guid,
            unzipDirectory=self._folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="plain",
        )
        self._fmu.instantiate()
        for name, value in start.items():
            self._fmu.setFloat64([variables[name].valueReference], [value])
        self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        self.inputs: NDArray[np.float64] = np.zeros(len(REQUIRED_INPUTS))
        self.outputs: NDArray[np.float64] = np.zeros(len(REQUIRED_OUTPUTS))
        self.output_names = REQUIRED_OUTPUTS
        self._inputs = [(i, variables[name]) for i, name in enumerate(REQUIRED_INPUTS)]
        self._outputs = [(i, variables[name]) for i, name in enumerate(REQUIRED_OUTPUTS)]
        self._read()

    def step(self, time_s: float, step_s: float) -> None:
        """Set all inputs, step, get all outputs."""
        for kind, setter, convert in (
            ("Float64", self._fmu.setFloat64, float),
            ("Int32", self._fmu.setInt32, int),
            ("Boolean", self._fmu.setBoolean, bool),
        ):
            chosen = [(i, variable.valueReference) for i, variable in self._inputs if variable.type == kind]
            setter([reference for _, reference in chosen], [convert(self.inputs[i]) for i, _ in chosen])
        self._fmu.doStep(currentCommunicationPoint=time_s, communicationStepSize=step_s)
        self._read()

    def _read(self) -> None:
        for kind, getter in (
            ("Float64", self._fmu.getFloat64),
            ("Int32", self._fmu.getInt32),
            ("Boolean", self._fmu.getBoolean),
        ):
            chosen = [(i, variable.valueReference) for i, variable in self._outputs if variable.type == kind]
            for (i, _), value in zip(chosen, getter([reference for _, reference in chosen]), strict=True):
                self.outputs[i] = value

    def close(self) -> None:
        """Release the FMU."""
        self._fmu.terminate()
        self._fmu.freeInstance()
        shutil.rmtree(self._folder, ignore_errors=True)


class PlainLoop:
    """One car, joined by python-can and cantools.

    Parameters
    ----------
    scenario, road, autonomy : as a `bridge.bench.Bench` is made from them.

    Attributes
    ----------
    frames : frames sent so far.
    unpacking_s : wall time spent on what a plain loop would not do, see `_send`.
    surroundings : of the ECUs, with the truth.
    """

    def __init__(self, scenario: Scenario, road: Road, autonomy: Autonomy) -> None:
        x, y, yaw = road.pose_at(scenario.start_s_m, scenario.start_d_m)
        plant = PlainPlant(load_vehicle(scenario.vehicle) | {"x0": x, "y0": y, "yaw0": yaw, "v0": 0.0})
        self.frames = 0
        self.unpacking_s = 0.0
        self.now_us = 0
        self._autonomy = autonomy
        self._databases: dict[Bus, Database] = {}
        self._codecs: dict[tuple[int, int], MessageCodec] = {}
        self._buses: dict[tuple[Bus, Station], can.BusABC] = {}
        for bus in scenario.buses:
            database = cantools.database.load_file(DIRECTORY / f"{_FILES[bus]}.dbc")
            assert isinstance(database, Database)
            self._databases[bus] = database
            for message in database.messages:
                self._codecs[bus, message.frame_id] = codec_database.message(message.name)
            for station in _MEMBERS[bus]:
                self._buses[bus, station] = can.Bus(interface="virtual", channel=f"plain {bus.name} {id(self)}")
        self.surroundings = Surroundings(
            plant,  # type: ignore[arg-type]
            road,
            scenario,
            parameter_frames(scenario.operation),
        )
        self._obc: Any = ffi.new("obc *")
        self._raptor: Any = ffi.new("raptor *")
        self._space_drive: Any = ffi.new("space_drive *")
        lib.obc_init(self._obc)
        lib.raptor_init(self._raptor, ffi.NULL)
        lib.space_drive_init(self._space_drive, ffi.NULL)
        self._outbox: Any = ffi.new("can_outbox *")
        self._out_frames: Any = ffi.new("can_frame[]", _OUTBOX)
        self._outbox.frames = self._out_frames
        self._outbox.capacity = _OUTBOX
        self._states = {"sys_state": 0, "ct_state": 0}

    def __enter__(self) -> PlainLoop:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for bus in self._buses.values():
            bus.shutdown()
        self.surroundings.close()

    def tick(self) -> None:
        """One minor frame, in the order of the bench."""
        now_us, surroundings = self.now_us, self.surroundings
        surroundings.act()
        self._send(Station.SENSORS, surroundings.sense(now_us))
        self._send(Station.OPERATOR, surroundings.operator.tick(now_us, self._receive(Station.OPERATOR)))
        heard, cloud = self._receive(Station.AUTONOMY), surroundings.scan(now_us)
        self._send(Station.AUTONOMY, self._autonomy.tick(now_us, heard, cloud))
        for station, ecu in (
            (Station.OBC, self._tick_obc),
            (Station.RAPTOR, self._tick_raptor),
            (Station.SPACE_DRIVE, self._tick_space_drive),
        ):
            received = self._receive(station)
            self._outbox.count = 0
            ecu(now_us, ffi.from_buffer("can_frame[]", received), len(received) // FRAME_STRUCT.size)
            self._send(station, bytes(ffi.buffer(self._out_frames, self._outbox.count * FRAME_STRUCT.size)))
        surroundings.advance(now_us * 1e-6)
        self.now_us = now_us + TICK_US
        surroundings.observe(self.now_us, self._states["sys_state"], self._states["ct_state"])

    def _tick_obc(self, now_us: int, frames: Any, count: int) -> None:
        lib.obc_tick(self._obc, now_us, frames, count, self._outbox)

    def _tick_raptor(self, now_us: int, frames: Any, count: int) -> None:
        wiring = self.surroundings.wiring
        lib.raptor_tick(self._raptor, now_us, wiring.raptor_in, frames, count, wiring.raptor_out, self._outbox)

    def _tick_space_drive(self, now_us: int, frames: Any, count: int) -> None:
        wiring = self.surroundings.wiring
        lib.space_drive_tick(
            self._space_drive, now_us, wiring.space_drive_in, frames, count, wiring.space_drive_out, self._outbox
        )

    def _send(self, station: Station, frames: bytes) -> None:
        """Encode the values of every frame with cantools and send it as a python-can message.

        The shared firmware hands over finished frames, where a user's sender would have values. Getting them back is
        not part of the plain loop: the time goes to `unpacking_s`, for the measurement to take off.
        """
        started = time.perf_counter()
        sent = [
            (bus, identifier, codec.signals, codec.decode(data))
            for _time, identifier, bus, _dlc, _flags, _sender, data in FRAME_STRUCT.iter_unpack(frames)
            for codec in (self._codecs[bus, identifier],)
        ]
        self.unpacking_s += time.perf_counter() - started
        for bus, identifier, signals, signal_values in sent:
            message = self._databases[bus].get_message_by_frame_id(identifier)
            values = dict(zip(signals, signal_values, strict=True))
            self._buses[bus, station].send(
                can.Message(
                    arbitration_id=identifier,
                    is_extended_id=message.is_extended_frame,
                    data=message.encode(values, strict=False),  # the public ranges are wrong in places
                    timestamp=self.now_us * 1e-6,
                )
            )
            self.frames += 1

    def _receive(self, station: Station) -> bytes:
        """Receive all messages of a station and decode each with cantools, as its user needs the values."""
        frames = bytearray()
        for bus in Bus:
            interface = self._buses.get((bus, station))
            if interface is None:
                continue
            for message in _pending(interface):
                identifier, data = message.arbitration_id, bytes(message.data)
                values = self._databases[bus].decode_message(identifier, data)
                self._notice(bus, values)
                frames += FRAME_STRUCT.pack(self.now_us, identifier, bus, len(data), 0, 0, data.ljust(8, b"\0"))
        return bytes(frames)

    def _notice(self, bus: Bus, values: Any) -> None:
        """The scenario's conditions look at the states on CAN1."""
        if bus is Bus.CAN1:
            for state in self._states:
                if state in values:
                    value = values[state]  # with its name, where the value table has one
                    self._states[state] = int(getattr(value, "value", value))


def _pending(interface: can.BusABC) -> Iterable[can.Message]:
    while (message := interface.recv(timeout=0)) is not None:
        yield message
