"""Dual-antenna GNSS receiver, 20 Hz: position reduced to the centre of gravity, velocity, heading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bridge.interfaces import Origin
from bridge.sensors.noise import DriftingNoise
from bridge.sensors.truth import Truth
from bridge.sensors.wgs84 import TrackFrame
from dbc.codec import database

PERIOD_US = 50_000

FIX_RTK_FIXED = 4
FIX_RTK_FLOAT = 3


@dataclass(frozen=True)
class GnssErrors:
    """One-sigma errors of a receiver.

    Position and heading lie inside what TUM's AV-21 estimator assumes of its receivers (0.10 m and 1.8 degrees;
    TUMFTM/3DVehicleDynamicsStateEstimation); the velocity figure is the manufacturer's 0.03 m/s. The split into a
    white part and a drift of some tens of seconds, as multipath and corrections give it, is ours.
    """

    position_white: float = 0.02  # m, east and north each
    position_drift: float = 0.05  # m
    height_white: float = 0.05  # m
    height_drift: float = 0.10  # m
    velocity_white: float = 0.03  # m/s, each component
    yaw_white: float = 0.0025  # rad
    yaw_drift: float = 0.001  # rad
    time_constant_s: float = 60.0
    fix_type: int = FIX_RTK_FIXED
    satellites: int = 17

    @property
    def position_std(self) -> float:
        """Standard deviation of east and north that the receiver reports, m."""
        return math.hypot(self.position_white, self.position_drift)


#: Receiver A has the long baseline (antennas 1.98 m apart along the car), B the short one (0.995 m across it), so
#: its heading is worse by that ratio; and it runs on a float solution (AWSIM, av21 urdf, for the baselines).
ERRORS_A = GnssErrors()
ERRORS_B = GnssErrors(
    position_white=0.03,
    position_drift=0.08,
    velocity_white=0.05,
    yaw_white=0.005,
    yaw_drift=0.002,
    fix_type=FIX_RTK_FLOAT,
    satellites=14,
)


class Gnss:
    """One receiver: emits quality, attitude, velocity and position every 50 ms.

    Height is the road's where the plant measures it, along its middle: it climbs with the grade, and so does the
    velocity. What the car gains by moving up or down a bank is left out of both.

    Parameters
    ----------
    name : ``a`` or ``b``, as in the names of its messages.
    origin : of the track frame.
    generator : source of the noise.
    errors : one-sigma figures.
    phase_us : offset of its solutions in the period.
    """

    def __init__(
        self, name: str, origin: Origin, generator: np.random.Generator, errors: GnssErrors, phase_us: int = 0
    ) -> None:
        self._frame = TrackFrame(origin.latitude_deg, origin.longitude_deg, origin.height)
        self._errors = errors
        self._phase_us = phase_us
        horizontal = (errors.position_white, errors.position_drift)
        height = (errors.height_white, errors.height_drift)
        velocity = (errors.velocity_white, 0.0)
        parts = [horizontal, horizontal, height, velocity, velocity, velocity, (errors.yaw_white, errors.yaw_drift)]
        self._noise = DriftingNoise(
            generator,
            white=[white for white, _ in parts],
            drift=[drift for _, drift in parts],
            time_constant_s=errors.time_constant_s,
            period_s=PERIOD_US * 1e-6,
        )
        self._position = database.message(f"gnss_{name}_position")
        self._velocity = database.message(f"gnss_{name}_velocity")
        self._attitude = database.message(f"gnss_{name}_attitude")
        self._quality = database.message(f"gnss_{name}_quality")
        self._counter = 0

    def due(self, now_us: int) -> bool:
        """True in the ticks in which the receiver has a solution."""
        return now_us % PERIOD_US == self._phase_us

    def emit(self, truth: Truth) -> bytes:
        """Frames of one solution."""
        errors = self._errors
        east, north, up, v_east, v_north, v_up, yaw = self._noise.next()
        cosine, sine = math.cos(truth.yaw), math.sin(truth.yaw)
        # Velocity is in the road plane, which banks and climbs.
        along = truth.vx * math.cos(truth.road_pitch)
        across = truth.vy * math.cos(truth.road_roll)
        latitude, longitude, height = self._frame.geodetic(truth.x + east, truth.y + north, truth.z + up)
        counter = self._counter
        self._counter = (counter + 1) & 0xFF
        std_up = math.hypot(errors.height_white, errors.height_drift)
        return b"".join(
            (
                self._position.frame(latitude, longitude),
                self._velocity.frame(
                    along * cosine - across * sine + v_east,
                    along * sine + across * cosine + v_north,
                    -truth.vx * math.sin(truth.road_pitch) + v_up,
                    errors.velocity_white,
                    counter,
                ),
                self._attitude.frame(
                    _wrap(truth.yaw + yaw), math.hypot(errors.yaw_white, errors.yaw_drift), height, counter
                ),
                self._quality.frame(
                    errors.position_std, errors.position_std, std_up, errors.fix_type, errors.satellites, counter
                ),
            )
        )


def _wrap(angle: float) -> float:
    """Angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % math.tau
