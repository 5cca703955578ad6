"""Codes and states that the partition shares with the rest of the car; the numbers are those on the wire."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class NodeId(IntEnum):
    """Registered nodes, as node_id and, from LIDAR_DETECTION on, as perception_id."""

    ESTIMATION = 0
    PLANNING = 1
    WALL = 2
    LIDAR_DETECTION = 3
    RADAR_DETECTION = 4
    TRACKING = 5
    PREDICTION = 6


class SensorId(IntEnum):
    """Sensors that autonomy gives notice of, as sensor_id."""

    LIDAR = 3
    RADAR = 4


class NodeStatus(IntEnum):
    """Status codes of nodes, as node_status_code (paper, system status manager)."""

    OK = 0
    INITIALIZED = 64
    INACTIVE = 100
    NOT_INITIALIZED = 128
    ERROR = 200
    DEAD = 255


class Mission(IntEnum):
    """What a plan is for, as plan_mission."""

    HOLD = 0
    PIT_OUT = 1
    CAUTION = 2
    RACE = 3
    STOP = 4


@dataclass(frozen=True)
class SsmStatus:
    """State of the SSM and the limits in force: m/s and m/s2."""

    state: int
    max_speed: float
    max_acceleration: float
    max_deceleration: float


@dataclass(frozen=True)
class VehicleStatus:
    """State of the car and what race control wants of it; target speed in m/s."""

    ct_state: int
    vehicle_flag: int
    round_target_speed: float
