"""The car's motion taken out of a scan: against the exponential of the twist by scipy, and against the LiDAR model."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import scenarios
from autonomy.detection.cloud import Pose
from autonomy.detection.motion_compensation import SWEEPS, MotionCompensation
from autonomy.detection.road_objects import levelled, no_objects
from autonomy.vehicle import CG_TO_REAR_AXLE, load_vehicle
from bridge.sensors.lidar import MOUNTS, PERIOD_US
from bridge.sensors.spatial_lidar import BeamPattern, Motion, Scan, SpatialLidar
from bridge.sensors.surfaces import boxes

TO_AXLE = load_vehicle(scenarios.DIRECTORY / "vehicles" / "av21.yaml")["cg_to_rear_axle"]
POST = boxes((((29.95, 30.05), (4.95, 5.05), (0.0, 2.0)),))


def by_exponential(cloud: np.ndarray, age: np.ndarray, vx: float, vy: float, yaw_rate: float) -> np.ndarray:
    twist = np.array([[0.0, -yaw_rate, vx], [yaw_rate, 0.0, vy], [0.0, 0.0, 0.0]])
    moved = cloud.astype(np.float64)
    for row, one in enumerate(age):
        # Where the frame of then lies in the frame of the end.
        x, y, _ = expm(-float(one) * twist) @ [*moved[row, :2], 1.0]
        moved[row, :2] = x, y
    return moved


@pytest.mark.parametrize(("vx", "vy", "yaw_rate"), [(63.0, -1.0, 0.27), (63.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0, 0, 0)])
def test_a_cloud_by_the_exponential_of_the_twist(vx: float, vy: float, yaw_rate: float) -> None:
    print("seed 4")
    generator = np.random.default_rng(4)
    cloud = generator.uniform(-100.0, 100.0, (300, 3)).astype(np.float32)
    age = generator.uniform(0.0, 0.05, 300).astype(np.float32)
    moved = MotionCompensation().cloud(np.column_stack((cloud, age)), vx, vy, yaw_rate)
    assert moved.dtype == np.float32
    assert moved.shape == cloud.shape
    assert np.allclose(moved, by_exponential(cloud, age, vx, vy, yaw_rate), atol=2.0e-5)
    assert np.array_equal(moved[:, 2], cloud[:, 2])


def test_an_age_that_is_none_raises() -> None:
    scan = np.ones((3, 4), np.float32)
    scan[1, 3] = np.nan
    with pytest.raises(ValueError, match="an age is not finite"):
        MotionCompensation().cloud(scan, 60.0, 0.0, 0.1)


def test_nothing_in_nothing_out() -> None:
    none = np.empty((0, 4), np.float32)
    assert MotionCompensation().cloud(none, 60.0, 0.0, 0.1).shape == (0, 3)
    assert len(MotionCompensation().objects(no_objects(), 60.0, 0.0)) == 0


def test_the_sweeps_are_those_of_the_lidars() -> None:
    """Places, headings, field of view and period; the two sides share no code."""
    assert TO_AXLE == CG_TO_REAR_AXLE
    pattern = BeamPattern()
    for sweep, mount in zip(SWEEPS, MOUNTS, strict=True):
        assert (sweep.x, sweep.y, sweep.heading) == pytest.approx((mount.x - TO_AXLE, mount.y, mount.yaw))
        assert sweep.field_of_view == pattern.field_of_view
        assert sweep.period_s == pytest.approx(PERIOD_US * 1e-6)


def post_at(azimuth_deg: float) -> tuple[float, float, SpatialLidar, Scan]:
    """A post 30 m away, and a scan of it by a car that stands."""
    x, y = 30.0 * math.cos(math.radians(azimuth_deg)), 30.0 * math.sin(math.radians(azimuth_deg))
    post = boxes((((x - 0.2, x + 0.2), (y - 0.2, y + 0.2), (-1.0, 3.0)),))
    lidars = SpatialLidar(post, np.random.default_rng(1), origin=(TO_AXLE, 0.0, -0.31))
    return x, y, lidars, lidars.scan(Motion(0.0, 0.0))


@pytest.mark.parametrize("azimuth_deg", [-57.0, -10.0, 0.0, 35.0, 57.0, 62.5, 100.0, 178.0, -100.0])
def test_the_age_is_that_of_the_column_that_met_the_place(azimuth_deg: float) -> None:
    """A post somewhere around the standing car: the columns with an echo of it say when they looked."""
    x, y, lidars, scan = post_at(azimuth_deg)
    assert len(scan.cloud)
    pattern = lidars.pattern
    number = scan.beam // (pattern.columns * pattern.lines)
    column = scan.beam % (pattern.columns * pattern.lines) // pattern.lines
    ages = np.array([sweep.age(np.array([x]), np.array([y]))[0] for sweep in SWEEPS])
    for lidar in np.unique(number):
        taken = 0.05 * (pattern.columns - column[number == lidar] - 0.5) / pattern.columns
        # Within a column, and the width of the post.
        assert ages[lidar] == pytest.approx(float(np.median(taken)), abs=2.0e-4)
    assert np.isfinite(ages).sum() >= 1


@pytest.mark.parametrize("azimuth_deg", [-59.0, 59.0])
def test_there_is_no_age_where_nobody_looks(azimuth_deg: float) -> None:
    """The LiDARs stand apart, so that there are gaps between their fields of view."""
    x, y, _, scan = post_at(azimuth_deg)
    assert len(scan.cloud) == 0
    assert all(np.isnan(sweep.age(np.array([x]), np.array([y]))[0]) for sweep in SWEEPS)


@pytest.mark.parametrize("yaw_rate", [0.0, 0.3])
def test_what_stands_still_keeps_its_place(yaw_rate: float) -> None:
    """Scanned at 60 m/s, a post is where it is; without compensation it is off by metres."""
    lidars = SpatialLidar(POST, np.random.default_rng(2), origin=(TO_AXLE, 0.0, -0.31))
    scan = lidars.scan(Motion(0.0, 0.0, velocity=(60.0, -1.0, 0.0), rate=(0.0, 0.0, yaw_rate)))
    pattern = lidars.pattern
    column = scan.beam % (pattern.columns * pattern.lines) // pattern.lines
    assert np.allclose(scan.age, 0.05 * (pattern.columns - column - 0.5) / pattern.columns)
    moved = MotionCompensation().cloud(scan.aged, 60.0, -1.0, yaw_rate)
    assert len(moved)
    off = np.abs(moved[:, :2] - [30.0, 5.0])
    assert off.max() < 0.05 + 5 * 0.01 + 1e-3
    assert np.abs(scan.cloud[:, 0] - 30.0).min() > 1.0


def test_cars_are_taken_on_to_the_end_of_the_scan() -> None:
    """Straight ahead the LiDAR looks in the middle of its scan: half a period of the own speed, and its doubt."""
    seen = no_objects(2)
    seen["x"], seen["y"] = [40.0, -20.0], [0.0, 0.0]
    compensation = MotionCompensation()
    later = compensation.objects(seen, 60.0, 2.0)
    assert later["x"][0] == pytest.approx(40.0 + 60.0 * 0.025)
    assert later["y"][0] == pytest.approx(2.0 * 0.025)
    assert later["covariance"][0] == pytest.approx((compensation.speed_std * 0.025) ** 2 * np.eye(2))
    assert np.isfinite(later["x"]).all()
    assert seen["x"].tolist() == [40.0, -20.0]


def test_levelled_is_the_turn_by_pitch_and_roll() -> None:
    print("seed 6")
    generator = np.random.default_rng(6)
    seen = no_objects(20)
    seen["x"], seen["y"], seen["yaw"] = generator.uniform(-1.0, 1.0, (3, 20)) * [[80.0], [20.0], [3.0]]
    height = generator.uniform(-5.0, 5.0, 20)
    seen["covariance"] = np.diag([4.0, 1.0])
    pose = Pose(5.0, 6.0, 1.0, pitch=0.05, roll=-0.35)
    level = levelled(seen, height, pose)
    turn = Rotation.from_euler("ZYX", [0.0, pose.pitch, pose.roll])
    places = turn.apply(np.column_stack((seen["x"], seen["y"], height)))
    assert np.allclose(np.column_stack((level["x"], level["y"])), places[:, :2])
    ahead = turn.apply(np.column_stack((np.cos(seen["yaw"]), np.sin(seen["yaw"]), np.zeros(20))))
    assert np.allclose(level["yaw"], np.arctan2(ahead[:, 1], ahead[:, 0]))
    plane = turn.as_matrix()[:2, :2]
    assert np.allclose(level["covariance"], plane @ np.diag([4.0, 1.0]) @ plane.T)
    flat = levelled(seen, height, Pose(5.0, 6.0, 1.0))
    assert np.allclose(flat["x"], seen["x"])
    assert np.allclose(flat["y"], seen["y"])
