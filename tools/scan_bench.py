"""What the benchmarks of LiDAR scans share: scenes around the lap, times, options."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from autonomy.track import Track

LATERAL = -1.0
"""m, of the car with the LiDARs."""

#: Cars of each scene: stations from the car with the LiDARs on, and lateral offsets, m.
_CARS = (
    ((20.0, 2.0),),
    ((38.0, -3.0), (66.0, 3.0)),
    ((-1.0, 3.0), (70.0, 0.0)),
    ((8.0, 0.5), (30.0, -2.0), (-12.0, 3.0)),
    (),
)

Result = TypeVar("Result")


@dataclass
class Times:
    """Times of one piece of work, ms."""

    name: str
    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)

    def take(self, work: Callable[..., Result], *arguments: object) -> Result:
        """Do the work once and add its times."""
        wall, cpu = time.perf_counter_ns(), time.process_time_ns()
        result = work(*arguments)
        self.cpu.append((time.process_time_ns() - cpu) * 1e-6)
        self.wall.append((time.perf_counter_ns() - wall) * 1e-6)
        return result


def scenes(track: Track, count: int) -> Iterator[tuple[float, list[tuple[float, float]]]]:
    """Give stations from all around the lap, and for each the stations and lateral offsets of other cars, m."""
    for number in range(count):
        station = (number + 0.5) * track.length / count
        yield station, [(station + ahead, lateral) for ahead, lateral in _CARS[number % len(_CARS)]]


def parse(text: str | None, rounds: int, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read `scans` and `rounds` from the command line; leave with a line when they are wrong.

    Parameters
    ----------
    text : of the module; its first line is the command's description.
    rounds : unless they are given.
    arguments : instead of the command line's.
    """
    parser = argparse.ArgumentParser(description=(text or "").splitlines()[0])
    for name, default, what in (("scans", 15, "scans around the lap"), ("rounds", rounds, "times through all of them")):
        parser.add_argument(f"--{name}", type=int, default=default, metavar="N", help=f"{what} (default: {default})")
    options = parser.parse_args(arguments)
    for name in ("scans", "rounds"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} is {getattr(options, name)}; must be at least 1")
    return options
