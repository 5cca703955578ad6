"""The LiDAR model against geometry: ranges, fields of view, noise, reach, lost echoes, walls behind walls."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from autonomy.track_files import load_track
from bridge._native import ffi, lib
from bridge.sensors.lidar import MOUNTS, PERIOD_US, PHASE_US, Lidar, LidarErrors
from bridge.sensors.suite import SensorSuite
from bridge.sensors.truth import Truth

SEED = 1729
CG_TO_REAR = 1.247
EXACT = LidarErrors(range_white=0.0, grazing_none=0.0, grazing_all=1e-9)
TRACK = load_track(Path(__file__).parents[2] / "scenarios" / "tracks" / "lvms.yaml")

Points = NDArray[np.floating]


class Origin:
    latitude_deg, longitude_deg, height = 36.27222469, -115.0102968, 605.0


def truth(x: float, y: float, yaw: float) -> Truth:
    return Truth(x, y, 0.0, yaw, *(0.0,) * 11)


def lidar(walls: list[Points], errors: LidarErrors | None = None, seed: int = SEED) -> Lidar:
    return Lidar(walls, CG_TO_REAR, np.random.default_rng(seed), errors)


def box(half_length: float, half_width: float) -> Points:
    """A closed wall around the origin; two points per side, since the model takes every second one."""
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)], float) * (half_length, half_width)
    return np.repeat(corners, 2, axis=0)


def test_points_lie_on_the_wall_whatever_the_pose() -> None:
    model = lidar([box(30.0, 20.0)], EXACT)
    for x, y, yaw in ((0.0, 0.0, 0.0), (3.0, -5.0, 2.0), (-11.0, 7.0, -3.1)):
        cloud = model.scan(truth(x, y, yaw))
        c, s = math.cos(yaw), math.sin(yaw)
        world_x, world_y = x + c * cloud[:, 0] - s * cloud[:, 1], y + s * cloud[:, 0] + c * cloud[:, 1]
        off = np.minimum(np.abs(np.abs(world_x) - 30.0), np.abs(np.abs(world_y) - 20.0))
        assert len(cloud) == 3 * 240, "every ray has its echo"
        assert off.max() < 1e-4


def test_each_sensor_looks_its_own_way() -> None:
    cloud = lidar([box(30.0, 30.0)], EXACT).scan(truth(0.0, 0.0, 0.0))
    assert cloud.dtype == np.float32
    for mount, points in zip(MOUNTS, np.split(cloud, 3), strict=True):
        seen = np.arctan2(points[:, 1] - mount.y, points[:, 0] - (mount.x - CG_TO_REAR)) - mount.yaw
        seen = np.degrees(np.arctan2(np.sin(seen), np.cos(seen)))
        assert (seen.min(), seen.max()) == pytest.approx((-59.75, 59.75), abs=1e-3)
        assert np.diff(np.sort(seen)) == pytest.approx(0.5, abs=1e-3)
        assert points[:, 2] == pytest.approx(mount.z + 0.31)


def test_nothing_comes_from_beyond_the_reach() -> None:
    wall = np.array([(-500.0, -6.0), (0.0, -6.0), (0.0, -6.0), (500.0, -6.0), (500.0, -6.1), (500.0, -6.1)])
    cloud = lidar([wall], EXACT).scan(truth(0.0, 0.0, 0.0))
    (front, *_) = np.split(cloud, [int(np.isclose(cloud[:, 2], MOUNTS[0].z + 0.31).sum())])
    farthest = np.hypot(front[:, 0] - (MOUNTS[0].x - CG_TO_REAR), front[:, 1]).max()
    assert 70.0 < farthest <= 80.0


def test_ranges_are_off_by_a_centimetre() -> None:
    model = lidar([box(30.0, 20.0)])
    exact = lidar([box(30.0, 20.0)], EXACT).scan(truth(0.0, 0.0, 0.4))
    scans = [model.scan(truth(0.0, 0.0, 0.4)) for _ in range(200)]
    assert all(len(scan) == len(exact) for scan in scans), "no incidence is grazing here"
    off = np.stack(scans)[:, :, :2] - exact[:, :2]
    along = np.hypot(off[..., 0], off[..., 1])
    assert math.sqrt(float((along**2).mean())) == pytest.approx(0.01, rel=0.02)
    assert np.abs(off.mean(axis=0)).max() < 5 * 0.01 / math.sqrt(200)


def test_echoes_are_lost_at_grazing_incidence_only() -> None:
    wall = np.array([(-200.0, -6.0), (200.0, -6.0), (200.0, -6.0), (0.0, -400.0)])
    wall = np.repeat(wall, 2, axis=0)
    kept, possible = (lidar([wall], errors) for errors in (LidarErrors(range_white=0.0), EXACT))
    counts = np.zeros(3)
    for _ in range(50):
        for k, model in enumerate((kept, possible)):
            cloud = model.scan(truth(0.0, 0.0, 0.0))
            front = cloud[np.isclose(cloud[:, 2], MOUNTS[0].z + 0.31)]
            incidence = np.degrees(np.arctan2(-front[:, 1], front[:, 0] - (MOUNTS[0].x - CG_TO_REAR)))
            if k == 0:
                assert incidence.min() >= 2.0
                counts[0] += ((incidence > 2.5) & (incidence < 5.5)).sum()
                counts[1] += (incidence > 6.0).sum()
            else:
                counts[2] += (incidence > 6.0).sum()
    assert counts[1] == counts[2], "all of the steep ones come back"
    steep = 50 * 6  # rays between 2.5 and 5.5 degrees, were none lost
    assert 0.2 * steep < counts[0] < 0.8 * steep


def test_a_wall_hides_what_is_behind_it() -> None:
    near, far = box(10.0, 8.0), box(40.0, 30.0)
    model = lidar([far, near], EXACT)
    assert model.scan(truth(0.0, 0.0, 0.7)).tolist() == lidar([near], EXACT).scan(truth(0.0, 0.0, 0.7)).tolist()


@pytest.mark.parametrize("seed", range(5))
def test_casting_against_all_rays_and_all_segments(seed: int) -> None:
    generator = np.random.default_rng(seed)
    ends = generator.uniform(-60.0, 60.0, (40, 2))
    segments = np.ascontiguousarray(np.hstack((ends, ends + generator.uniform(-9.0, 9.0, ends.shape))))
    segments[1::2] += np.tile(segments[::2, 2:] - segments[1::2, :2], 2)  # half of them follow their predecessor
    longest = float(np.hypot(*(segments[:, 2:] - segments[:, :2]).T).max())
    angles = np.radians(-59.0 + np.arange(119.0))
    rays = np.column_stack((np.cos(angles), np.sin(angles)))
    axis = float(generator.uniform(-math.pi, math.pi))
    fan = ffi.new("lidar_fan *", {"first": angles[0], "step": math.radians(1.0), "range_max": 50.0, "count": 119})
    c_rays = ffi.from_buffer("double[]", rays)
    fan.rays = c_rays
    pose = ffi.new("lidar_pose *", {"x": 1.0, "y": -2.0, "axis_x": math.cos(axis), "axis_y": math.sin(axis)})
    ranges, incidence = np.empty(119, np.float32), np.empty(119, np.float32)
    c_ranges, c_incidence = (ffi.from_buffer("float[]", array) for array in (ranges, incidence))
    lib.lidar_cast(fan, pose, ffi.from_buffer("double[]", segments), len(segments), longest, c_ranges, c_incidence)
    expected, sines = brute_force(segments, np.array((1.0, -2.0)), angles + axis, 50.0)
    assert ranges == pytest.approx(expected, rel=1e-5)
    assert incidence == pytest.approx(sines, abs=1e-5)
    assert 10 < np.isfinite(ranges).sum() < 119


def brute_force(segments: Points, place: Points, angles: Points, reach: float) -> tuple[Points, Points]:
    """Every ray with every segment, by Cramer's rule."""
    ranges, sines = np.full(len(angles), np.inf), np.zeros(len(angles))
    for i, angle in enumerate(angles):
        u = np.array((math.cos(angle), math.sin(angle)))
        for x0, y0, x1, y1 in segments:
            a, d = np.array((x0, y0)) - place, np.array((x1 - x0, y1 - y0))
            determinant = u[1] * d[0] - u[0] * d[1]
            range_, part = (a[1] * d[0] - a[0] * d[1]) / determinant, (u[0] * a[1] - u[1] * a[0]) / determinant
            if 0.0 < range_ <= min(reach, ranges[i]) and 0.0 <= part <= 1.0:
                ranges[i], sines[i] = range_, abs(determinant) / math.hypot(*d)
    return ranges, sines


def test_the_track_has_its_wall_outside_only() -> None:
    (wall,) = TRACK.walls()
    _, right = TRACK.boundaries()
    assert wall is not right
    assert np.array_equal(wall, right)
    for station in (0.0, 400.0, 700.0, 1235.0, 2000.0):
        x, y, yaw = TRACK.pose_at(station, 2.0)
        cloud = lidar([wall]).scan(truth(x, y, yaw))
        beside = cloud[np.abs(cloud[:, 0]) < 1.0]
        assert beside[:, 1] == pytest.approx(-(7.45 + 2.0), abs=0.1)


def test_scans_are_due_20_times_a_second_and_leave_the_other_sensors_alone() -> None:
    x, y, yaw = TRACK.pose_at(300.0, 0.0)
    motion = truth(x, y, yaw)
    suites = [SensorSuite(Origin(), 7, walls, CG_TO_REAR) for walls in ((), TRACK.walls())]
    due = []
    for tick in range(40):
        now_us = 10_000 * tick
        frames = [suite.emit(now_us, motion) for suite in suites]
        clouds = [suite.scan(now_us, motion) for suite in suites]
        assert frames[0] == frames[1]
        assert (clouds[0] is None) == (clouds[1] is None)
        if clouds[1] is not None:
            due.append(now_us)
            assert len(clouds[1]) > 100
            assert clouds[0] is not None
            assert len(clouds[0]) == 0
    assert due == list(range(PHASE_US, 400_000, PERIOD_US))


def test_a_seed_gives_the_same_scans_again() -> None:
    x, y, yaw = TRACK.pose_at(600.0, -1.0)
    one, other, third = (lidar(TRACK.walls(), seed=seed) for seed in (1, 1, 2))
    scans = [[model.scan(truth(x, y, yaw)).tobytes() for _ in range(5)] for model in (one, other, third)]
    assert scans[0] == scans[1]
    assert scans[0] != scans[2]
    assert len(set(scans[0])) == 5
