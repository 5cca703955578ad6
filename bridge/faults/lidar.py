"""Faults of the LiDARs: what gets from them to autonomy, which is no frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bridge.faults.fault import CloudFault, Memory, parameter
from bridge.sensors.lidar import Cloud


@dataclass(frozen=True, kw_only=True)
class LidarSilent(CloudFault):
    """No scan comes."""

    kind = "lidar_silent"

    def scan(self, cloud: Cloud, memory: Memory) -> Cloud | None:
        return None


@dataclass(frozen=True, kw_only=True)
class LidarFrozen(CloudFault):
    """The first scan comes again and again."""

    kind = "lidar_frozen"

    def scan(self, cloud: Cloud, memory: Memory) -> Cloud | None:
        kept: Cloud = memory.kept.setdefault("scan", cloud)
        return kept


@dataclass(frozen=True, kw_only=True)
class LidarNotFinite(CloudFault):
    """Scans come without a number in them."""

    kind = "lidar_not_finite"

    def scan(self, cloud: Cloud, memory: Memory) -> Cloud | None:
        return np.full_like(cloud, np.nan)


@dataclass(frozen=True, kw_only=True)
class LidarSparse(CloudFault):
    """Only a share of the points comes, evenly taken: a dirty window, rain."""

    kind = "lidar_sparse"
    share: float = parameter(minimum=0, exclusiveMaximum=1)

    def scan(self, cloud: Cloud, memory: Memory) -> Cloud | None:
        kept = np.arange(round(self.share * len(cloud))) / max(self.share, 1e-9)
        return np.ascontiguousarray(cloud[kept.astype(np.int64)])


@dataclass(frozen=True, kw_only=True)
class LidarSlow(CloudFault):
    """Only every so many scans one comes."""

    kind = "lidar_slow"
    every: int = parameter(minimum=2)

    def scan(self, cloud: Cloud, memory: Memory) -> Cloud | None:
        return cloud if memory.number % self.every == 0 else None
