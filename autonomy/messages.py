"""Between the partition's objects and CAN frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from autonomy.estimation import GnssSample, ImuSample
from autonomy.geodesy import LocalTangentPlane
from autonomy.localisation import Estimate
from autonomy.opponents.tracker import TrackedObject
from autonomy.planning import Plan
from autonomy.radar_inbox import RadarInbox
from autonomy.status import NodeId, NodeStatus, SensorId, SsmStatus, VehicleStatus
from autonomy.wall_fit import WallFit
from dbc.codec import MessageCodec, database
from dbc.errors import CodecError
from dbc.frames import FRAME_SIZE, FRAME_STRUCT, Buffer, Bus

MPH = 0.44704  # m/s


class GnssInbox:
    """Puts the four frames of an epoch together.

    Parameters
    ----------
    letter : of the receiver's messages, a or b.
    plane : track frame.
    """

    # The receivers report centimetres and hundredths; none is better than its last digit.
    LEAST_STD_POSITION = 0.01
    LEAST_STD_VELOCITY = 0.01
    LEAST_STD_YAW = 0.0005

    def __init__(self, letter: str, plane: LocalTangentPlane) -> None:
        self._plane = plane
        position, velocity, attitude, quality = (
            database.message(f"gnss_{letter}_{part}") for part in ("position", "velocity", "attitude", "quality")
        )
        self._decode = tuple(message.decode for message in (position, velocity, attitude, quality))
        self.identifiers = tuple(m.frame_id for m in (position, velocity, attitude, quality))
        self._parts: list[bytes | None] = [None] * 4
        self.sample: GnssSample | None = None

    def receiver(self, part: int) -> Callable[[bytes], None]:
        """Return the callback for the data of one part: 0 position, 1 velocity, 2 attitude, 3 quality."""

        def receive(data: bytes) -> None:
            # The position frame has the lowest identifier: it opens an epoch, and what is left of the last one goes.
            if part == 0:
                self._parts = [data, None, None, None]
            elif self._parts[0] is not None:
                self._parts[part] = data
                if None not in self._parts:
                    self._complete()
                    self._parts = [None] * 4

        return receive

    def take(self) -> GnssSample | None:
        """Return the epoch completed since the last call, or None."""
        sample, self.sample = self.sample, None
        return sample

    def _complete(self) -> None:
        position, velocity, attitude, quality = (
            decode(data) for decode, data in zip(self._decode, self._parts, strict=True) if data is not None
        )
        east, north, _, std_velocity, velocity_counter = velocity
        yaw, std_yaw, _, attitude_counter = attitude
        std_x, std_y, _, fix_type, _, quality_counter = quality
        if not velocity_counter == attitude_counter == quality_counter or fix_type == 0:
            return  # frames of different epochs, or no solution
        latitude, longitude = position
        x, y, _ = self._plane.to_enu(latitude, longitude, self._plane.height)
        self.sample = GnssSample(
            x=x,
            y=y,
            velocity_east=east,
            velocity_north=north,
            yaw=yaw,
            std_x=max(std_x, self.LEAST_STD_POSITION),
            std_y=max(std_y, self.LEAST_STD_POSITION),
            std_velocity=max(std_velocity, self.LEAST_STD_VELOCITY),
            std_yaw=max(std_yaw, self.LEAST_STD_YAW),
        )


class Inbox:
    """Everything that the partition hears.

    Attributes
    ----------
    radar : what came on CAN-R.
    malformed : frames dropped because they were cut off, too short or not data frames; those of CAN-R do not count.
    """

    def __init__(self, plane: LocalTangentPlane) -> None:
        self.radar = RadarInbox()
        self._gnss = (GnssInbox("a", plane), GnssInbox("b", plane))
        self._rates = database.message("imu_rates")
        self._force = database.message("imu_specific_force")
        self._ssm = database.message("ssm_status")
        self._vehicle = database.message("vehicle_status")
        self._latest: dict[int, bytes] = {}
        self._handlers: dict[tuple[int, int], Callable[[bytes], None]] = {}
        for message in (self._rates, self._force, self._ssm, self._vehicle):
            self._handlers[int(message.bus), message.frame_id] = self._keeper(message.frame_id)
        bus = int(self._rates.bus)
        for inbox in self._gnss:
            for part, identifier in enumerate(inbox.identifiers):
                self._handlers[bus, identifier] = inbox.receiver(part)
        self.malformed = 0

    def push(self, frames: Buffer) -> None:
        """Take the frames that arrived since the last tick. What is not for us is ignored."""
        whole = len(frames) // FRAME_SIZE * FRAME_SIZE
        self.malformed += len(frames) != whole
        handlers = self._handlers
        for time_us, identifier, bus, length, flags, _, data in FRAME_STRUCT.iter_unpack(memoryview(frames)[:whole]):
            handler = handlers.get((bus, identifier))
            if handler is None:
                if bus == Bus.CAN_R:
                    self.radar.receive(time_us, identifier, length, flags, data)
                continue
            if flags or length < 8:
                self.malformed += 1
                continue
            handler(data)

    def imu(self) -> ImuSample | None:
        """Return the sample that arrived since the last call, when it is whole."""
        rates, force = self._latest.pop(self._rates.frame_id, None), self._latest.pop(self._force.frame_id, None)
        if rates is None or force is None:
            return None
        roll_rate, pitch_rate, yaw_rate, _ = self._rates.decode(rates)
        force_x, force_y, force_z, _ = self._force.decode(force)
        return ImuSample(force_x, force_y, force_z, roll_rate, pitch_rate, yaw_rate)

    def gnss(self) -> tuple[GnssSample | None, GnssSample | None]:
        """Epochs of both receivers that arrived since the last call."""
        return self._gnss[0].take(), self._gnss[1].take()

    def ssm_status(self) -> SsmStatus | None:
        """Return the newest, or None before the first."""
        data = self._latest.get(self._ssm.frame_id)
        if data is None:
            return None
        values = self._ssm.decode(data)
        return SsmStatus(int(values[0]), values[5], values[6], values[7])

    def vehicle_status(self) -> VehicleStatus | None:
        """Return the newest, or None before the first."""
        data = self._latest.get(self._vehicle.frame_id)
        if data is None:
            return None
        values = self._vehicle.decode(data)
        return VehicleStatus(int(values[0]), int(values[3]), values[6] * MPH)

    def _keeper(self, identifier: int) -> Callable[[bytes], None]:
        latest = self._latest

        def keep(data: bytes) -> None:
            latest[identifier] = data

        return keep


class EstimateWriter:
    """Three frames per estimate."""

    def __init__(self) -> None:
        self._position = database.message("estimate_position")
        self._motion = database.message("estimate_motion")
        self._quality = database.message("estimate_quality")
        self._counter = 0

    def frames(self, estimate: Estimate) -> bytes:
        """Frames of one estimate; values beyond what the wire carries saturate."""
        e = estimate
        self._counter = (self._counter + 1) & 0xFF
        quality = (e.ax, e.ay, e.source, e.quality, e.distance_a, e.distance_b, e.deviation, self._counter)
        return (
            _saturated(self._position, (e.x, e.y, self._counter))
            + _saturated(self._motion, (e.vx, e.vy, e.yaw, e.yaw_rate))
            + _saturated(self._quality, quality)
        )


class PlanWriter:
    """Frames of a plan, in portions that leave room on the bus for everybody else."""

    POINTS_PER_TICK = 11

    def __init__(self) -> None:
        self._header = database.message("trajectory_header")
        self._pose = database.message("trajectory_pose")
        self._motion = database.message("trajectory_motion")
        self._counter = 0

    def portions(self, plan: Plan, now_us: int) -> list[bytes]:
        """Frames to send in this tick and the following ones: the header, then pose and motion point by point."""
        self._counter = (self._counter + 1) & 0xF
        count = len(plan.x)
        points = np.empty((count, 8))
        index = np.arange(count)
        points[:, 0], points[:, 1], points[:, 2], points[:, 3] = self._counter, index, plan.x, plan.y
        pose = self._pose.frames(points[:, :4])
        points = np.empty((count, 6))
        points[:, 0], points[:, 1] = self._counter, index
        points[:, 2], points[:, 3], points[:, 4], points[:, 5] = plan.yaw, plan.curvature, plan.speed, plan.bank
        motion = self._motion.frames(points)
        both = b"".join(pose[i : i + FRAME_SIZE] + motion[i : i + FRAME_SIZE] for i in range(0, len(pose), FRAME_SIZE))
        flags = (plan.mission, plan.ends_in_stop, plan.follows)
        header = self._header.frame(self._counter, count, *flags, plan.origin_s, (now_us // 1000) & 0xFFFFFFFF)
        step = 2 * self.POINTS_PER_TICK * FRAME_SIZE
        portions = [both[start : start + step] for start in range(0, len(both), step)]
        portions[0] = header + portions[0]
        return portions


class WallWriter:
    """Two frames per polynomial."""

    def __init__(self) -> None:
        self._line = database.message("wall_line")
        self._bend = database.message("wall_bend")
        self._counter = 0

    def frames(self, fit: WallFit | None) -> bytes:
        """Frames of one polynomial; None says that no wall was found, as does one that the wire cannot carry."""
        self._counter = (self._counter + 1) & 0xFF
        counter = self._counter
        if fit is not None:
            c0, c1, c2, c3 = fit.coefficients
            residual = min(fit.residual, self._line.limits("wall_residual")[1])
            begin, end = math.ceil(fit.begin), math.floor(fit.end)
            try:
                line = self._line.frame(c0, c1, fit.order, residual, 100.0 * fit.share, counter)
                return line + self._bend.frame(c2, c3, begin, end, counter)
            except CodecError:
                pass
        return self._line.frame(0.0, 0.0, 0, 0.0, 0.0, counter) + self._bend.frame(0.0, 0.0, 0, 0, counter)


class NodeWriter:
    """Status of one node. The heartbeat counts its finished computations."""

    MESSAGE = "node_status"

    def __init__(self, node: NodeId) -> None:
        self._message = database.message(self.MESSAGE)
        self._node = node
        self.heartbeat = 0

    def frame(self, status: NodeStatus, reliability: float) -> bytes:
        """Frame of this cycle. reliability: 0..1 of the node's result."""
        return self._message.frame(self._node, status, 100.0 * reliability, self.heartbeat & 0xFFFF, 0)


class PerceptionStatusWriter(NodeWriter):
    """Status of one node of perception, from LIDAR_DETECTION on; the rest is as of any node."""

    MESSAGE = "perception_status"


class SensorNoticeWriter:
    """Notice of each scan that came from one sensor."""

    def __init__(self, sensor: SensorId) -> None:
        self._message = database.message("sensor_notice")
        self._sensor = sensor

    def frame(self, sequence: int, size: int, age_us: int) -> bytes:
        """Frame of one scan.

        Parameters
        ----------
        sequence : number of the scan, counts the new ones; any size.
        size : points of a LiDAR scan, frames of a radar scan; not negative, saturates.
        age_us : of the data now; not negative, saturates.
        """
        return _saturated(self._message, (self._sensor, sequence & 0xFFFF, size, age_us // 1000))


class ObjectWriter:
    """A list of tracked objects: its head, then place and motion object by object."""

    OBJECTS = 6

    def __init__(self) -> None:
        self._list = database.message("object_list")
        self._place = database.message("object_place")
        self._motion = database.message("object_motion")
        self._counter = 0

    def frames(self, objects: Sequence[TrackedObject], now_us: int) -> bytes:
        """Frames of one list; values beyond what the wire carries saturate.

        Parameters
        ----------
        objects : nearest first; those after the sixth are left out.
        now_us : time of the tick, not before that of any object.
        """
        self._counter = counter = (self._counter + 1) & 0xF
        sent = objects[: self.OBJECTS]
        age_us = max((now_us - one.time_us for one in sent), default=0)
        frames = [_saturated(self._list, (counter, len(sent), age_us // 1000))]
        for index, one in enumerate(sent):
            motion = (one.vx, one.vy, _worst_deviation(one), 100.0 * one.existence)
            frames.append(_saturated(self._place, (counter, index, one.identity & 0x1FF, one.x, one.y)))
            frames.append(_saturated(self._motion, (counter, index, *motion)))
        return b"".join(frames)


def _worst_deviation(one: TrackedObject) -> float:
    """1 sigma of the position in its worst direction, m: root of the larger eigenvalue."""
    (xx, xy), (_, yy) = one.covariance[:2, :2].tolist()
    return math.sqrt(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy))


def _saturated(message: MessageCodec, values: tuple[float, ...]) -> bytes:
    """Frame of values that may lie beyond what the message carries; that is rare, so only then they are clipped."""
    try:
        return message.frame(*values)
    except CodecError:
        limits = (message.limits(signal) for signal in message.signals)
        return message.frame(*(max(low, min(high, value)) for value, (low, high) in zip(values, limits, strict=True)))
