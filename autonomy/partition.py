"""The autonomy partition: frames of CAN-S, CAN-A and CAN-R and LiDAR points in, frames of CAN-A out, once per 10 ms."""

from __future__ import annotations

from pathlib import Path

from autonomy.detection.motion_compensation import AgedCloud
from autonomy.localisation import Estimate, Localiser, Quality
from autonomy.messages import EstimateWriter, Inbox, NodeWriter, PlanWriter
from autonomy.perception import Perception, PerceptionConfig
from autonomy.perception_nodes import PerceptionNodes, own_motion
from autonomy.planning import Planner
from autonomy.race_path import RacePath
from autonomy.radar_inbox import RadarInbox
from autonomy.status import NodeId, NodeStatus
from autonomy.track import Track
from autonomy.track_files import load_track
from autonomy.vehicle import VehicleLimits, load_vehicle
from autonomy.wall_node import WallNode
from dbc.errors import ConfigurationError
from dbc.frames import Buffer
from dbc.states import SsmState

PLAN_PERIOD_US = 50_000

#: Scans end in the fifth tick of fifty milliseconds, plans are made in the first.
SLICED = PerceptionConfig(look_us=20_000, follow_us=30_000)

# Reliability of the estimate by its quality level.
_RELIABILITY = {Quality.LOST: 0.0, Quality.BAD: 0.25, Quality.DEGRADED: 0.6, Quality.GOOD: 1.0}
_OFF_PATH = 10.0  # m; a plan that far from the car is none


class AutonomyPartition:
    """Estimation, planning and the look at the wall behind one door.

    Parameters
    ----------
    track : with an origin; ConfigurationError without.
    vehicle : limits of the car.
    perception_map : track by which perception tells what is on it; None for a car without perception.
    """

    def __init__(self, track: Track, vehicle: VehicleLimits, perception_map: Track | None = None) -> None:
        if track.origin is None:
            raise ConfigurationError(track.name, "origin", "is missing; positions of the receivers need it")
        self.track = track
        try:
            self.path = RacePath(track, vehicle)
        except ValueError as error:
            raise ConfigurationError(track.name, "width", str(error)) from None
        self._inbox = Inbox(track.origin.tangent_plane())
        self._localiser = Localiser(track.road_at)
        self._planner = Planner(self.path, vehicle)
        self._estimate_writer = EstimateWriter()
        self._plan_writer = PlanWriter()
        self._estimation = NodeWriter(NodeId.ESTIMATION)
        self._planning = NodeWriter(NodeId.PLANNING)
        self._wall = WallNode(track, spatial=perception_map is not None)
        #: None in a car without.
        self.perception: PerceptionNodes | None
        try:
            self.perception = None if perception_map is None else PerceptionNodes(Perception(perception_map, SLICED))
        except ValueError as error:
            raise ConfigurationError(track.name, "width", str(error)) from None
        #: The newest; None before the first.
        self.estimate: Estimate | None = None
        self._launched = False
        self._next_plan_us = 0
        self._portions: list[bytes] = []
        self._planning_status = NodeStatus.INITIALIZED

    @classmethod
    def from_files(cls, track_file: str | Path, vehicle_file: str | Path) -> AutonomyPartition:
        """Partition for a track (YAML or CSV) and a car (YAML).

        Raises
        ------
        ConfigurationError : a file is missing or wrong.
        """
        return cls(load_track(track_file), VehicleLimits.from_parameters(vehicle_file, load_vehicle(vehicle_file)))

    @property
    def malformed_frames(self) -> int:
        """Frames dropped so far because they were cut off, too short or not data frames."""
        return self._inbox.malformed

    @property
    def radar(self) -> RadarInbox:
        """Scans of the front radar; perception takes them where there is one."""
        return self._inbox.radar

    def tick(self, now_us: int, frames: Buffer, cloud: AgedCloud | None = None) -> bytes:
        """One minor frame.

        Parameters
        ----------
        now_us : simulated time.
        frames : what arrived on CAN-S, CAN-A and CAN-R since the last tick, 24 bytes each.
        cloud : scan of the LiDARs that ended in this tick, from the ground below the centre of gravity; None without
            one.

        Returns
        -------
        Frames to send on CAN-A.
        """
        inbox = self._inbox
        inbox.push(frames)
        if not self._launched:
            ssm = inbox.ssm_status()
            # Modules run only after the configuration was accepted.
            if ssm is None or not SsmState.LAUNCHING <= ssm.state <= SsmState.EMERGENCY:
                return self._all(NodeStatus.NOT_INITIALIZED)
            self._launched = True
            return self._all(NodeStatus.INITIALIZED)
        frames = self._localise(now_us)
        motion = None if self.estimate is None else own_motion(self.estimate, self.track)
        if self.perception is not None:
            frames += self.perception.tick(now_us, motion, cloud, inbox.radar.take(now_us))
        return frames + self._wall.tick(now_us, cloud, motion)

    def _localise(self, now_us: int) -> bytes:
        """Frames of estimation and planning."""
        estimate = self.estimate = self._localiser.step(now_us, self._inbox.imu(), *self._inbox.gnss())
        if estimate is None:
            return self._status(NodeStatus.INITIALIZED, 0.0, NodeStatus.INITIALIZED, 0.0)
        self._estimation.heartbeat += 1
        if now_us >= self._next_plan_us:
            self._plan(now_us, estimate)
        reliability = _RELIABILITY[estimate.quality]
        lost = estimate.quality is Quality.LOST
        return (
            self._status(
                NodeStatus.ERROR if lost else NodeStatus.OK,
                reliability,
                self._planning_status,
                reliability if self._planning_status is NodeStatus.OK else 0.0,
            )
            + self._estimate_writer.frames(estimate)
            + (self._portions.pop(0) if self._portions else b"")
        )

    def end(self) -> bytes:
        """Frames for CAN-A that say that the modules have stopped in order."""
        return self._all(NodeStatus.INACTIVE)

    def _plan(self, now_us: int, estimate: Estimate) -> None:
        self._next_plan_us = now_us + PLAN_PERIOD_US
        ssm, vehicle = self._inbox.ssm_status(), self._inbox.vehicle_status()
        if ssm is None or vehicle is None:
            return
        predictions = () if self.perception is None else self.perception.predictions
        plan = self._planner.plan(estimate, ssm, vehicle, predictions)
        if abs(self._planner.cross_track) > _OFF_PATH:
            self._planning_status = NodeStatus.ERROR
            return
        self._planning_status = NodeStatus.OK
        self._planning.heartbeat += 1
        self._portions = self._plan_writer.portions(plan, now_us)

    def _all(self, status: NodeStatus) -> bytes:
        """No node computes."""
        perception = b"" if self.perception is None else self.perception.inactive(status)
        return self._status(status, 0.0, status, 0.0) + self._wall.inactive(status) + perception

    def _status(
        self, estimation: NodeStatus, estimation_reliability: float, planning: NodeStatus, planning_reliability: float
    ) -> bytes:
        return self._estimation.frame(estimation, estimation_reliability) + self._planning.frame(
            planning, planning_reliability
        )
