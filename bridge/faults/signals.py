"""Faults of signals: the frame is well formed, its counter moves and its CRC fits, but a value in it is wrong.

What the bits of a signal cannot hold is limited to what they can.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from bridge.faults.fault import FrameFault, Memory, Selection, check_range, frames_of, parameter, with_values
from bridge.sensors.wgs84 import TrackFrame
from dbc.codec import Codec
from dbc.errors import CodecError
from dbc.frames import Frame
from firmware.parameters import encode_operation
from firmware.tables import own_parameters, parameter_key

#: Sensors by the beginning of the names of their messages.
SENSORS = ("gnss_a", "gnss_b", "imu")

#: Sensors that the onboard computer knows by the notices of their scans, by their names in sensor_notice.
SCANNERS = ("lidar", "radar")


@dataclass(frozen=True, kw_only=True)
class _SignalFault(FrameFault):
    """Changes one signal of one message; frames that are too short for it pass."""

    message: str
    signal: str

    def check(self, database: Codec) -> None:
        database.message(self.message).limits(self.signal)

    def selection(self, database: Codec) -> Selection:
        return frames_of(database, [self.message])

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        codec = memory.database.message(self.message)
        if frame.dlc < codec.length:
            return [frame]

        def change(values: dict[str, float]) -> None:
            values[self.signal] = self.value_of(values[self.signal], memory)

        return [with_values(codec, frame, change)]

    def value_of(self, value: float, memory: Memory) -> float:
        """What is sent instead of a value."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Stuck(_SignalFault):
    """The signal has one value, in the unit of the message."""

    kind = "stuck"
    value: float = parameter()

    def check(self, database: Codec) -> None:
        check_range(f"{self.message}.{self.signal}", self.value, *database.message(self.message).limits(self.signal))

    def value_of(self, value: float, memory: Memory) -> float:
        return self.value


@dataclass(frozen=True, kw_only=True)
class Freeze(_SignalFault):
    """The signal keeps the value of the first frame; so does a counter."""

    kind = "freeze"

    def value_of(self, value: float, memory: Memory) -> float:
        frozen: float = memory.kept.setdefault("value", value)
        return frozen


@dataclass(frozen=True, kw_only=True)
class Offset(_SignalFault):
    """Something is added to the signal, in the unit of the message."""

    kind = "offset"
    value: float = parameter()

    def value_of(self, value: float, memory: Memory) -> float:
        return value + self.value


@dataclass(frozen=True, kw_only=True)
class Scale(_SignalFault):
    """The signal is multiplied."""

    kind = "scale"
    factor: float = parameter()

    def value_of(self, value: float, memory: Memory) -> float:
        return value * self.factor


@dataclass(frozen=True, kw_only=True)
class Noise(_SignalFault):
    """White Gaussian noise on the signal; its standard deviation in the unit of the message."""

    kind = "noise"
    sigma: float = parameter(exclusiveMinimum=0)

    def value_of(self, value: float, memory: Memory) -> float:
        return value + memory.random.gauss(0.0, self.sigma)


# --- nodes of the autonomy partition, each of which reports in one of two messages


def node_report(database: Codec, node: str) -> tuple[str, int]:
    """Message in which a node reports, and its number in there.

    Raises
    ------
    CodecError
        When there is no such node.
    """
    nodes = {
        name.lower(): (message, code)
        for message, signal in (("node_status", "node_id"), ("perception_status", "perception_id"))
        for code, name in database.message(message).choices[signal].items()
    }
    if node not in nodes:
        raise CodecError(f"no node is called {node!r}; there are {', '.join(nodes)}")
    return nodes[node]


@dataclass(frozen=True, kw_only=True)
class _NodeFault(FrameFault):
    """Changes what one node says of itself; the other nodes' frames pass."""

    node: str

    def check(self, database: Codec) -> None:
        node_report(database, self.node)

    def selection(self, database: Codec) -> Selection:
        message, number = node_report(database, self.node)
        of_message = frames_of(database, [message])
        return lambda frames: of_message(frames) & (frames["data"][:, 0] == number)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        message, _ = node_report(memory.database, self.node)
        codec, word = memory.database.message(message), message.removesuffix("status")
        return [with_values(codec, frame, lambda values: self.change(values, word, memory))]

    def change(self, values: dict[str, float], word: str, memory: Memory) -> None:
        """Change the signals of the frame, whose names begin with a word."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class HeartbeatStalled(_NodeFault):
    """A node reports, but its count of finished computations stands still."""

    kind = "heartbeat_stalled"

    def change(self, values: dict[str, float], word: str, memory: Memory) -> None:
        values[f"{word}heartbeat"] = memory.kept.setdefault("heartbeat", values[f"{word}heartbeat"])


@dataclass(frozen=True, kw_only=True)
class StatusCode(_NodeFault):
    """A node reports a status code: 0 OK, 64 initialised, 100 inactive, 128 not initialised, 200 error, 255 dead."""

    kind = "status_code"
    code: int = parameter(minimum=0, maximum=255)

    def change(self, values: dict[str, float], word: str, memory: Memory) -> None:
        values[f"{word}status_code"] = float(self.code)


@dataclass(frozen=True, kw_only=True)
class Reliability(_NodeFault):
    """A node says how far its output can be relied on, in percent."""

    kind = "reliability"
    percent: float = parameter(minimum=0, maximum=100)

    def change(self, values: dict[str, float], word: str, memory: Memory) -> None:
        values[f"{word}reliability"] = self.percent


# --- sensors of perception, of whose scans autonomy gives notice


@dataclass(frozen=True, kw_only=True)
class _ScanFault(FrameFault):
    """Befalls the notices of one sensor's scans: what the onboard computer knows of them."""

    scanner: str = parameter(enum=list(SCANNERS))

    def check(self, database: Codec) -> None:
        if self.scanner not in SCANNERS:
            raise CodecError(f"no scanner is called {self.scanner!r}; there are {', '.join(SCANNERS)}")

    def selection(self, database: Codec) -> Selection:
        notice = database.message("sensor_notice")
        (number,) = (code for code, name in notice.choices["sensor_id"].items() if name.lower() == self.scanner)
        of_message = frames_of(database, [notice.name])
        return lambda frames: of_message(frames) & (frames["data"][:, 0] == number)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        notice = memory.database.message("sensor_notice")
        return [with_values(notice, frame, lambda values: self.change(values, memory))]

    def change(self, values: dict[str, float], memory: Memory) -> None:
        """Change the signals of the notice."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class ScanOutage(_ScanFault):
    """There is no notice of the sensor's scans."""

    kind = "scan_outage"

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return []


@dataclass(frozen=True, kw_only=True)
class ScanFrozen(_ScanFault):
    """Every scan is the first one again."""

    kind = "scan_frozen"

    def change(self, values: dict[str, float], memory: Memory) -> None:
        values["sensor_sequence"] = memory.kept.setdefault("sequence", values["sensor_sequence"])


@dataclass(frozen=True, kw_only=True)
class ScanSize(_ScanFault):
    """Every scan has so many points (lidar) or frames (radar)."""

    kind = "scan_size"
    size: int = parameter(minimum=0, maximum=(1 << 24) - 1)

    def change(self, values: dict[str, float], memory: Memory) -> None:
        values["sensor_data_size"] = float(self.size)


# --- sensors


@dataclass(frozen=True, kw_only=True)
class _SensorFault(FrameFault):
    """Befalls the frames of one sensor."""

    sensor: str = parameter(enum=list(SENSORS))

    def check(self, database: Codec) -> None:
        if self.sensor not in SENSORS:
            raise CodecError(f"no sensor is called {self.sensor!r}; there are {', '.join(SENSORS)}")

    def selection(self, database: Codec) -> Selection:
        return frames_of(database, [message.name for message in database if message.name.startswith(self.sensor + "_")])


@dataclass(frozen=True, kw_only=True)
class SensorOutage(_SensorFault):
    """The sensor sends nothing."""

    kind = "sensor_outage"

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        return []


@dataclass(frozen=True, kw_only=True)
class SensorFrozen(_SensorFault):
    """The sensor repeats the values of its first sample; its counters move."""

    kind = "sensor_frozen"

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        codec = memory.database.find(frame.bus, frame.id)
        assert codec is not None

        def change(values: dict[str, float]) -> None:
            first = memory.kept.setdefault(frame.id, dict(values))
            values |= {name: value for name, value in first.items() if not name.endswith("_counter")}

        return [with_values(codec, frame, change)]


@dataclass(frozen=True, kw_only=True)
class GnssBias(_SensorFault):
    """A receiver's position is off, by m to the east and north. For other quantities there is `Offset`."""

    kind = "gnss_bias"
    sensor: str = parameter(enum=["gnss_a", "gnss_b"])
    east: float = parameter(default=0.0)
    north: float = parameter(default=0.0)

    def selection(self, database: Codec) -> Selection:
        return frames_of(database, [f"{self.sensor}_position"])

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        def change(values: dict[str, float]) -> None:
            latitude, longitude = values.values()
            moved = TrackFrame(latitude, longitude, 0.0).geodetic(self.east, self.north, 0.0)
            values |= dict(zip(values, moved[:2], strict=True))

        return [with_values(memory.database.message(f"{self.sensor}_position"), frame, change)]


# --- parameters


@dataclass(frozen=True, kw_only=True)
class ParameterAltered(FrameFault):
    """An operation parameter has another value on its way to the onboard computer.

    Attributes
    ----------
    name : of the parameter in the operation file.
    value : a number of the type that the YAML value has; true or false for a switch.
    """

    kind = "parameter_altered"
    name: str
    value: float | int | bool = parameter()

    def check(self, database: Codec) -> None:
        names = [row.name for row in own_parameters().parameters]
        if self.name not in names:
            nearest = get_close_matches(self.name, names, n=1, cutoff=0.0)[0]
            raise CodecError(f"no parameter is called {self.name!r}; the nearest is {nearest!r}")

    def selection(self, database: Codec) -> Selection:
        of_message = frames_of(database, ["parameter_write"])
        key = np.frombuffer(parameter_key(self.name).to_bytes(3, "little"), dtype=np.uint8)
        return lambda frames: of_message(frames) & (frames["data"][:, :3] == key).all(axis=1)

    def alter(self, frame: Frame, memory: Memory) -> list[Frame]:
        altered = encode_operation([(self.name, self.value)], own_parameters())[0]
        return [frame._replace(data=altered[-8:])]
