"""What the bench needs from outside itself, as protocols: it imports neither autonomy nor a track."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class Origin(Protocol):
    """Where the track frame lies on the Earth: WGS 84, degrees and m above the ellipsoid."""

    @property
    def latitude_deg(self) -> float:
        """Geodetic latitude, degrees."""
        ...

    @property
    def longitude_deg(self) -> float:
        """Longitude, degrees."""
        ...

    @property
    def height(self) -> float:
        """Height above the ellipsoid, m."""
        ...


class Road(Protocol):
    """The road under the car. Frenet: s along the centre line, d to its left, m; angles in rad."""

    @property
    def length(self) -> float:
        """Length of a lap, m; s = 0 is the start and finish line."""
        ...

    @property
    def origin(self) -> Origin | None:
        """Origin of the east-north-up track frame, or None when the track has no place on the Earth."""
        ...

    def project(self, x: float, y: float) -> tuple[float, float]:
        """Station in [0, length) and lateral offset of a point."""
        ...

    def road_at_station(self, station: float) -> tuple[float, float]:
        """Bank (positive: left side low) and grade (positive: uphill)."""
        ...

    def pose_at(self, station: float, lateral: float) -> tuple[float, float, float]:
        """x, y and heading of a car that stands parallel to the centre line at (s, d)."""
        ...

    def boundaries(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Left and right edge, points across from each other, each of shape (n, 2), m."""
        ...

    def walls(self) -> Sequence[NDArray[np.floating]]:
        """Walls that a LiDAR sees: closed lines of points, each of shape (n, 2), m."""
        ...


class Stateful(Protocol):
    """A part of the bench that saves its state itself, because it is not in plain Python objects and arrays."""

    def save_state(self) -> Any:
        """What `restore_state` needs; nothing that changes while the bench goes on."""
        ...

    def restore_state(self, state: Any) -> None:
        """Go on from there; any number of times."""
        ...


class Autonomy(Protocol):
    """The perception, planning and estimation partition: frames and points in, CAN-A frames out, once per tick.

    A bench whose state is to be saved needs one whose own is in plain Python objects and numpy arrays, generators and
    iterators excepted; parts that keep it elsewhere are `Stateful`.
    """

    def tick(self, now_us: int, frames: bytes, cloud: NDArray[np.float32] | None = None) -> bytes:
        """Run one minor frame.

        Parameters
        ----------
        now_us : start of the tick, simulated microseconds.
        frames : what its station received since the last tick, 24 bytes each.
        cloud : points of a LiDAR scan that ended in this tick, see `bridge.sensors.lidar.Cloud`: shape (n, 4), x, y
            and z, m, and age, s; None when none did.

        Returns
        -------
        bytes
            Frames to send on CAN-A.
        """
        ...


class EndableAutonomy(Autonomy, Protocol):
    """Autonomy in a process of its own, which can be asked to stop."""

    def end(self) -> bytes:
        """Frames for CAN-A that say that the partition has stopped in order."""
        ...
