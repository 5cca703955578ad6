"""The speed limit that plans keep to: the path's own, entered from a cap without a corner."""

from __future__ import annotations

import numpy as np
import pytest

import scenarios
from autonomy.race_path import RacePath
from autonomy.track_files import load_track
from autonomy.vehicle import VehicleLimits, load_vehicle

CAP = 63.1


@pytest.fixture(scope="module")
def path() -> RacePath:
    vehicle = scenarios.DIRECTORY / "vehicles" / "av21.yaml"
    return RacePath(
        load_track(scenarios.DIRECTORY / "tracks" / "lvms.yaml"),
        VehicleLimits.from_parameters(vehicle, load_vehicle(vehicle)),
    )


def test_never_above_the_path_and_the_cap_in_turns(path: RacePath) -> None:
    limit = path.limit_below(path.race, CAP)
    turns = limit < CAP - 1.0e-6
    assert 0.2 < turns.mean() < 0.9  # the turns of this track are slower than the cap, its straights are not
    assert np.all(limit <= path.race.speed_limit + 1.0e-9)
    assert limit[turns].min() == pytest.approx(path.race.speed_limit.min(), abs=1.0e-6)


def test_meets_the_cap_without_a_corner(path: RacePath) -> None:
    driven = np.minimum(path.limit_below(path.race, CAP), CAP)
    plain = np.minimum(path.race.speed_limit, CAP)

    def largest_jerk(speed: np.ndarray) -> float:
        acceleration = np.diff(np.append(speed, speed[0]) ** 2) / (2.0 * path.spacing)
        return float(np.abs(np.diff(acceleration) * speed[1:] / path.spacing).max())

    assert largest_jerk(driven) < 0.5 * largest_jerk(plain)
    assert largest_jerk(driven) < 12.0


def test_lowered_cap_is_left_to_comfortable_braking(path: RacePath) -> None:
    np.testing.assert_array_equal(path.limit_below(path.race, 10.0), path.race.speed_limit)
