"""Casting of the spatial LiDAR against every beam with every triangle, closed forms, and the scenes of detection."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from beam_reference import PERIOD, beam_frames, column_times, directions, pose_at, ranges_between

from autonomy.track_files import load_track
from bridge._native import ffi, lib
from bridge.sensors.lidar import AXLE_HEIGHT, MOUNTS, Mount
from bridge.sensors.spatial_lidar import BeamPattern, Motion, SpatialLidar, _native_motion
from bridge.sensors.surfaces import CAR_PARTS, QuadMesh, boxes, strip, track_mesh
from tools.lidar_scene import LidarScene

SEED = 20261130
TRACK = load_track(Path(__file__).parents[2] / "scenarios" / "tracks" / "lvms.yaml")
AHEAD = Mount(0.0, 0.0, 0.0, 0.0)
NOTHING = QuadMesh(np.empty((0, 4, 3)), np.empty(0))
SMALL = BeamPattern(columns=48, lines=24, elevation=(math.radians(-30.0), math.radians(25.0)), range_max=60.0)


def lidar(mesh=NOTHING, mounts=(AHEAD,), pattern=None, **others):
    return SpatialLidar(mesh, np.random.default_rng(SEED), mounts=mounts, pattern=pattern, **others)


def quad(*corners, reflectivity=1.0):
    return QuadMesh(np.array([corners], float), np.array([reflectivity]))


def ground(height=0.0, half=500.0):
    return quad((-half, -half, height), (half, -half, height), (half, half, height), (-half, half, height))


def wall(distance, *, half=400.0, low=-50.0, high=50.0):
    """A wall across the x axis."""
    return quad((distance, -half, low), (distance, half, low), (distance, half, high), (distance, -half, high))


# --- everything with everything ---


def random_motion(rng, spread, speed, rate):
    place, angles = rng.uniform(-spread, spread, 3), rng.uniform(-0.4, 0.4, 3)
    return Motion(
        *place,
        *(math.pi * 2.5 * angles[0], angles[1], angles[2]),
        tuple(rng.uniform(-speed, speed, 3)),
        tuple(rng.uniform(-rate, rate, 3)),
    )


def random_quads(rng, count):
    """Large and small, near and far, flat and folded, convex and not; all around the LiDAR."""
    centre = rng.normal(0.0, 1.0, (count, 1, 3)) * rng.choice([1.0, 4.0, 15.0, 30.0], (count, 1, 1))
    spread = rng.normal(0.0, 1.0, (count, 4, 3)) * rng.choice([0.3, 2.0, 10.0], (count, 1, 1))
    flat = rng.random(count) < 0.5
    # In a plane: the corners are combinations of two directions.
    one, other = rng.normal(0.0, 2.0, (2, count, 1, 3))
    turn = np.sort(rng.uniform(0.0, 2.0 * math.pi, (count, 4)), axis=1)[..., None]
    spread[flat] = (np.cos(turn) * one + np.sin(turn) * other)[flat]
    return centre + spread


@pytest.mark.parametrize("speed", [0.0, 30.0, 90.0])
@pytest.mark.parametrize("seed", range(6))
def test_every_beam_ends_where_it_does_with_every_triangle(seed, speed):
    print("seed", seed)
    rng = np.random.default_rng(seed)
    mesh = QuadMesh(random_quads(rng, 40), np.ones(40))
    body = boxes(CAR_PARTS[:3], 1.0)
    mount = Mount(0.7, -0.3, 0.5, rng.uniform(-math.pi, math.pi))
    vehicle = random_motion(rng, 3.0, speed, 2.0)
    cars = [random_motion(rng, 8.0, speed, 2.0) for _ in range(3)]
    ranges, echoes = lidar(mesh, [mount], SMALL, car=body).cast(vehicle, cars)
    still = Motion(0.0, 0.0)
    bodies = [(mesh.corners, still), *((body.corners, car) for car in cars)]
    # Rounding may decide whether an edge is met: the range lies between those of larger and of smaller triangles.
    least, most = ranges_between(SMALL, mount, vehicle, bodies)
    assert np.isfinite(most).mean() > 0.1
    assert (ranges[0] >= least * (1.0 - 1e-6)).all()
    assert (ranges[0] <= most * (1.0 + 1e-6)).all()
    assert np.mean(np.isclose(least, most, rtol=1e-6)) > 0.98, "the bounds say something"
    assert ((echoes > 0.0) == np.isfinite(ranges)).all()


def test_the_echo_is_the_sine_of_the_incidence():
    rng = np.random.default_rng(SEED)
    mesh = QuadMesh(random_quads(rng, 1), np.array([0.5]))
    for _ in range(20):
        corners = random_quads(rng, 1)
        corners[0, 3] = corners[0, 0] + corners[0, 2] - corners[0, 1]  # flat
        mesh = QuadMesh(corners, np.array([0.5]))
        ranges, echoes = lidar(mesh, pattern=SMALL).cast(Motion(0.0, 0.0))
        normal = np.cross(corners[0, 1] - corners[0, 0], corners[0, 2] - corners[0, 0])
        sine = np.abs(directions(SMALL) @ (normal / np.linalg.norm(normal)))
        seen = np.isfinite(ranges[0])
        np.testing.assert_allclose(echoes[0][seen], 0.5 * sine[seen], atol=1e-9)
        assert not echoes[0][~seen].any()


@pytest.mark.parametrize("time", [-0.05, -0.013, 0.0, 0.4])
def test_motion_is_the_exponential_of_the_twist(time):
    rng = np.random.default_rng(SEED)
    for rate in (0.0, 1e-6, 0.3, 3.0, 7.0):
        motion = random_motion(rng, 100.0, 90.0, rate)
        pose = lib.rigid_motion_at(_native_motion(motion), time)
        expected = pose_at(motion, time)
        np.testing.assert_allclose(np.reshape(list(pose.axes), (3, 3)), expected[:3, :3], atol=1e-13)
        np.testing.assert_allclose(list(pose.place), expected[:3, 3], atol=1e-11)


def test_poses_are_put_into_each_other_and_out_again():
    rng = np.random.default_rng(SEED)
    one, other = (lib.rigid_motion_at(_native_motion(random_motion(rng, 9.0, 0.0, 0.0)), 0.0) for _ in range(2))
    c_one, c_other = ffi.new("rigid_pose *", one), ffi.new("rigid_pose *", other)
    inside = ffi.new("rigid_pose *", lib.rigid_pose_in(c_one, c_other))
    back = lib.rigid_pose_out(c_one, inside)
    np.testing.assert_allclose(list(back.place) + list(back.axes), list(other.place) + list(other.axes), atol=1e-12)
    assert list(inside.place) != pytest.approx(list(other.place))


# --- closed forms ---


def test_a_level_road():
    pattern = BeamPattern()
    ranges, echoes = lidar(ground(), [Mount(0.0, 0.0, 0.8, 0.3)], pattern).cast(Motion(5.0, -7.0, yaw=1.0))
    elevation = np.linspace(*pattern.elevation, pattern.lines)
    with np.errstate(divide="ignore"):
        expected = np.where(elevation < 0.0, -0.8 / np.sin(elevation), np.inf)
    expected[expected > pattern.range_max] = np.inf
    np.testing.assert_allclose(ranges[0], np.broadcast_to(expected, ranges[0].shape), rtol=1e-9)
    met = np.isfinite(expected)
    np.testing.assert_allclose(echoes[0][:, met], np.broadcast_to(-np.sin(elevation[met]), echoes[0][:, met].shape))


def test_a_banked_road_is_level_for_a_car_that_stands_on_it():
    bank = math.radians(20.0)
    half, rise = 400.0, 400.0 * math.tan(bank)
    road = quad((-half, -half, rise), (half, -half, rise), (half, half, -rise), (-half, half, -rise))
    mounts = [Mount(0.0, 0.0, 0.8, mount.yaw) for mount in MOUNTS]
    banked, _ = lidar(road, mounts).cast(Motion(0.0, 0.0, roll=-bank))
    level, _ = lidar(ground(), mounts).cast(Motion(0.0, 0.0))
    np.testing.assert_allclose(banked, level, rtol=1e-9)


def test_a_wall_across():
    ranges, echoes = lidar(wall(30.0), pattern=BeamPattern(range_max=1000.0)).cast(Motion(0.0, 0.0))
    x = directions(BeamPattern())[..., 0]
    np.testing.assert_allclose(ranges[0], 30.0 / x, rtol=1e-9)
    np.testing.assert_allclose(echoes[0], x, rtol=1e-9)


def test_a_box_ahead():
    sides = np.array(((20.0, 24.0), (-1.5, 0.5), (-0.4, 0.6)))
    ranges, _ = lidar(boxes([sides])).cast(Motion(0.0, 0.0))
    beams = directions(BeamPattern())
    with np.errstate(divide="ignore"):
        to = sides[:, 0] / beams, sides[:, 1] / beams
    enter, leave = np.minimum(*to).max(axis=-1), np.maximum(*to).min(axis=-1)
    expected = np.where((enter <= leave) & (leave > 0.0), enter, np.inf)
    np.testing.assert_allclose(ranges[0], expected, rtol=1e-9)
    assert 50 < np.isfinite(expected).sum() < 2000


# --- what must not be seen ---


def test_nothing_comes_from_behind():
    around = QuadMesh.merged([wall(-10.0), wall(-0.6), boxes([((-30.0, -5.0), (-40.0, 40.0), (-5.0, 5.0))])])
    ranges, _ = lidar(around).cast(Motion(0.0, 0.0))
    assert not np.isfinite(ranges).any()


@pytest.mark.parametrize("yaw", [120.0, -120.0, 180.0])
def test_each_lidar_has_its_own_sector_only(yaw):
    ranges, _ = lidar(wall(20.0, half=8.0), [Mount(0.0, 0.0, 0.0, math.radians(yaw))]).cast(Motion(0.0, 0.0))
    assert not np.isfinite(ranges).any()


def test_nothing_comes_from_beyond_the_reach_and_nothing_from_too_near():
    pattern = BeamPattern(range_min=2.0, range_max=50.0)
    near, _ = lidar(wall(1.0, half=0.9, low=-0.2, high=0.2), pattern=pattern).cast(Motion(0.0, 0.0))
    assert not np.isfinite(near).any()
    far, _ = lidar(wall(50.01), pattern=pattern).cast(Motion(0.0, 0.0))
    assert not np.isfinite(far).any()
    edge, _ = lidar(wall(49.0), pattern=pattern).cast(Motion(0.0, 0.0))
    expected = 49.0 / directions(pattern)[..., 0]
    assert (np.isfinite(edge[0]) == (expected < 50.0)).all()
    assert 100 < np.isfinite(edge).sum() < edge.size


def test_no_echo_through_a_wall():
    hidden = [wall(31.0), wall(90.0), boxes([((40.0, 50.0), (-5.0, 5.0), (-3.0, 3.0))])]
    alone, _ = lidar(wall(30.0)).cast(Motion(0.0, 0.0))
    for order in ([*hidden, wall(30.0)], [wall(30.0), *hidden]):
        ranges, _ = lidar(QuadMesh.merged(order)).cast(Motion(0.0, 0.0), [Motion(60.0, 0.0)])
        np.testing.assert_array_equal(ranges, alone)


def test_no_echo_through_a_car():
    both = [Motion(20.0, 0.0, -0.8), Motion(30.0, 0.0, -0.8)]
    model = lidar(wall(120.0))
    ranges, _ = model.cast(Motion(0.0, 0.0), both)
    swapped, _ = model.cast(Motion(0.0, 0.0), both[::-1])
    nearest, _ = model.cast(Motion(0.0, 0.0), both[:1])
    farther, _ = model.cast(Motion(0.0, 0.0), both[1:])
    np.testing.assert_array_equal(ranges, swapped)
    np.testing.assert_array_equal(ranges, np.minimum(nearest, farther))
    shadow = nearest < 25.0
    assert shadow.sum() > 100
    np.testing.assert_array_equal(ranges[shadow], nearest[shadow])


def test_surfaces_that_share_an_edge_leave_no_gap():
    """A folded floor of small quads below: every beam that goes down far enough ends on it."""
    rng = np.random.default_rng(SEED)
    x, y = np.meshgrid(np.linspace(-40.0, 40.0, 41), np.linspace(-40.0, 40.0, 41), indexing="ij")
    grid = np.stack((x, y, rng.uniform(-1.3, -1.1, x.shape)), axis=-1)
    floor = QuadMesh.merged(strip(grid[i], grid[i + 1], 1.0, closed=False) for i in range(40))
    pattern = BeamPattern(elevation=(math.radians(-70.0), math.radians(-3.0)), range_max=100.0)
    for velocity in ((0.0, 0.0, 0.0), (80.0, 3.0, 0.0)):
        motion = Motion(0.0, 0.0, yaw=0.4, velocity=velocity, rate=(0.1, -0.2, 0.7))
        ranges, _ = lidar(floor, [Mount(0.0, 0.0, 0.0, yaw) for yaw in (0.0, 2.1, -2.1)], pattern).cast(motion)
        assert np.isfinite(ranges).all()


# --- the track ---


def standing(station, lateral):
    x, y, yaw = TRACK.pose_at(station, lateral)
    bank, _ = TRACK.road_at_station(station)
    return Motion(x, y, -lateral * math.tan(bank), yaw, roll=-bank)


@pytest.fixture(scope="module")
def scene():
    return LidarScene(TRACK)


@pytest.fixture(scope="module")
def fenced():
    pattern = BeamPattern(elevation=(math.radians(-22.0), math.radians(8.0)), range_max=220.0)
    return lidar(track_mesh(TRACK, step=1, fence=True), MOUNTS, pattern, origin=(0.0, 0.0, -AXLE_HEIGHT))


@pytest.mark.parametrize("station", [20.0, 390.0, 640.0, 1000.0, 1500.0, 2300.0])
def test_scans_are_those_of_the_scene(scene, fenced, station):
    """Surfaces from other formulas: bank at the exact station, arcs instead of chords, and a march along each beam."""
    places = [(station, -1.0), (station + 20.0, 2.0), (station + 38.0, -3.0), (station - 12.0, 3.0)]
    motions = [standing(*place) for place in places]
    ranges, echoes = fenced.cast(motions[0], motions[1:])
    expected, _ = scene.cast(*places[0], places[1:])
    expected = expected.reshape(ranges.shape)
    seen, there = np.isfinite(ranges), np.isfinite(expected)
    assert (seen != there).sum() < 50
    assert (seen & there).sum() > 70_000
    both = seen & there
    # Off the surface, not along the beam, which may graze it; asphalt reflects least.
    off = np.abs(ranges[both] - expected[both]) * echoes[both] / 0.15
    assert np.percentile(off, 99.9) < 0.005
    assert (off > 0.02).sum() <= 0.0005 * both.sum(), "beams that pass an edge"


def test_fewer_lines_across_cost_a_centimetre(fenced):
    coarse = lidar(track_mesh(TRACK, fence=True), MOUNTS, fenced.pattern, origin=(0.0, 0.0, -AXLE_HEIGHT))
    for station in (100.0, 640.0, 1200.0):
        motion = standing(station, 0.0)
        (fine, echoes), (found, _) = (model.cast(motion) for model in (fenced, coarse))
        both = np.isfinite(fine) & np.isfinite(found)
        assert (np.isfinite(fine) != np.isfinite(found)).sum() < 0.002 * fine.size
        off = np.abs(fine[both] - found[both]) * echoes[both] / 0.15
        assert np.percentile(off, 99) < 0.025


def test_the_road_lies_where_the_track_says():
    mesh = track_mesh(TRACK, step=1)
    road = mesh.corners[: TRACK.centre.count]
    for i in range(0, TRACK.centre.count, 97):
        bank, _ = TRACK.road_at_station(i * TRACK.centre.spacing)
        left, right = road[i, 0], road[i, 3]
        assert left[2] - right[2] == pytest.approx(-math.tan(bank) * math.hypot(*(left - right)[:2]))
        assert left[2] * TRACK.width_right[i] == pytest.approx(-right[2] * TRACK.width_left[i])
        assert road[i, 1] == pytest.approx(road[(i + 1) % len(road), 0])


def test_a_track_climbs_by_its_grade_and_closes():
    class Hill:
        """A ring that climbs for half a lap."""

        length, origin = 400.0, None

        def boundaries(self):
            angle = np.arange(400) * 2.0 * math.pi / 400
            ring = np.column_stack((np.cos(angle), np.sin(angle)))
            return ring * (self.length / (2.0 * math.pi) - 5.0), ring * (self.length / (2.0 * math.pi) + 5.0)

        def pose_at(self, station, lateral):
            angle = station / self.length * 2.0 * math.pi
            radius = self.length / (2.0 * math.pi) - lateral
            return radius * math.cos(angle), radius * math.sin(angle), angle + 0.5 * math.pi

        def road_at_station(self, station):
            return 0.0, 0.05 if station < 200.0 else -0.05

        def walls(self):
            return [self.boundaries()[0]]

    mesh = track_mesh(Hill(), step=4)
    road, heights = mesh.corners[:100], mesh.corners[:100, 0, 2]
    assert np.ptp(heights) == pytest.approx(200.0 * math.tan(0.05), rel=1e-6)
    assert heights.mean() == pytest.approx(0.0, abs=1e-9)
    assert np.argmax(heights) == 50
    # Road, apron outside, wall inside.
    assert len(mesh.corners) == 300
    np.testing.assert_allclose(mesh.corners[200:, 0, 2], road[:, 0, 2])
    np.testing.assert_allclose(mesh.corners[200:, 3, 2] - mesh.corners[200:, 0, 2], 1.1)


@pytest.mark.parametrize("step", [0, -1, 1500])
def test_a_step_must_leave_lines_across(step):
    with pytest.raises(ValueError, match=f"step is {step}"):
        track_mesh(TRACK, step=step)


def test_the_reference_moves_as_said():
    """The columns go from right to left, and the scan ends with the motion's own pose."""
    times = column_times(SMALL)
    assert times[0] == pytest.approx(-PERIOD * (1.0 - 0.5 / 48))
    assert times[-1] == pytest.approx(-PERIOD * 0.5 / 48)
    starts, beams = beam_frames(SMALL, AHEAD, Motion(1.0, 0.0, velocity=(10.0, 0.0, 0.0)))
    np.testing.assert_allclose(starts[:, 0], 1.0 + 10.0 * times)
    assert beams[0, 0, 1] < 0.0 < beams[-1, 0, 1]
