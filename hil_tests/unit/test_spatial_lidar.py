"""Scans of the spatial LiDAR: lost echoes, noise, motion within a scan, seeds, bad input, and detection of them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from beam_reference import column_times, directions
from scipy import stats

from autonomy.detection.cloud import POINTS_MAX, DetectionStatus, Pose, check_cloud
from autonomy.detection.detector import Detector
from autonomy.track_files import load_track
from bridge.sensors.lidar import CG_OVER_AXLE, MOUNTS, Mount
from bridge.sensors.spatial_lidar import BeamPattern, Detection, Motion, SpatialLidar
from bridge.sensors.surfaces import CAR_PARTS, QuadMesh, boxes, track_mesh

SEED = 20261130
TRACK = load_track(Path(__file__).parents[2] / "scenarios" / "tracks" / "lvms.yaml")
AXLE_HEIGHT = 0.31
AHEAD = Mount(0.0, 0.0, 0.0, 0.0)
EXACT = Detection(range_noise=0.0, gain=1e12)
NOTHING = QuadMesh(np.empty((0, 4, 3)), np.empty(0))


def lidar(mesh, mounts=(AHEAD,), seed=SEED, **others):
    return SpatialLidar(mesh, np.random.default_rng(seed), mounts=mounts, **others)


def wall(distance, reflectivity=1.0, slant=0.0):
    """A wall across the x axis, turned by an angle, large enough to fill the field of view."""
    half, shift = 2000.0, 2000.0 * math.tan(slant)
    corners = [
        (distance - shift, -half, -half),
        (distance + shift, half, -half),
        (distance + shift, half, half),
        (distance - shift, -half, half),
    ]
    return QuadMesh(np.array([corners]), np.array([reflectivity]))


def ranges_in(scan, mount=AHEAD):
    return np.linalg.norm(scan.cloud.astype(float) - (mount.x, mount.y, mount.z), axis=1)


# --- noise and loss ---


def test_ranges_are_off_by_a_normal_distribution():
    print("seed", SEED)
    model = lidar(wall(40.0), detection=Detection(gain=1e12))
    exact, _ = model.cast(Motion(0.0, 0.0))
    scans = [model.scan(Motion(0.0, 0.0)) for _ in range(20)]
    off = np.concatenate([ranges_in(scan) - exact.reshape(-1)[scan.beam] for scan in scans])
    assert len(off) == 20 * 480 * 64
    assert off.mean() == pytest.approx(0.0, abs=5.0 * 0.01 / math.sqrt(len(off)))
    assert off.std() == pytest.approx(0.01, rel=0.01)
    # The distribution is a ladder of 4096 steps.
    assert stats.kstest(off, stats.norm(0.0, 0.01).cdf).statistic < 1.0 / 4096 + 2.0 / math.sqrt(len(off))
    assert np.abs(off).max() < 0.04
    pairs = off.reshape(20, 480, 64)
    for one, other in ((pairs[:, :, 1:], pairs[:, :, :-1]), (pairs[:, 1:], pairs[:, :-1]), (pairs[1:], pairs[:-1])):
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 5.0 / math.sqrt(one.size)


@pytest.mark.parametrize(("distance", "slant"), [(30.0, 0.0), (60.0, 0.0), (30.0, 1.2), (90.0, 0.4)])
def test_echoes_are_lost_by_range_and_incidence(distance, slant):
    print("seed", SEED)
    gain, reflectivity, scans = 30_000.0, 0.15, 40
    pattern = BeamPattern(columns=120, range_max=400.0)
    model = lidar(wall(distance, reflectivity, slant), pattern=pattern, detection=Detection(gain=gain))
    counts = np.zeros(pattern.columns * pattern.lines)
    for _ in range(scans):
        counts[model.scan(Motion(0.0, 0.0)).beam] += 1.0
    # Closed form, of the wall's plane and the law in beam_echo.h.
    normal = np.array((math.cos(slant), -math.sin(slant), 0.0))
    sine = directions(pattern) @ normal
    with np.errstate(divide="ignore"):
        ranges = distance * math.cos(slant) / sine
    chance = np.where((sine > 0.0) & (ranges < 400.0), 1.0 - np.exp(-gain * reflectivity * sine / ranges**2), 0.0)
    chance = chance.ravel()
    assert not counts[chance == 0.0].any()
    order = np.argsort(chance)
    for group in np.array_split(order[chance[order] > 0.0], 12):
        expected, spread = scans * chance[group].sum(), math.sqrt(scans * (chance[group] * (1.0 - chance[group])).sum())
        assert abs(counts[group].sum() - expected) < 5.0 * spread + 1e-9
    assert 0.02 < counts.sum() / (scans * len(counts)) < 0.98


def test_more_is_lost_farther_off_and_at_grazing_incidence():
    def share(distance, slant):
        model = lidar(wall(distance, 0.15, slant), detection=Detection(gain=30_000.0))
        return len(model.scan(Motion(0.0, 0.0)).cloud)

    assert share(20.0, 0.0) > share(40.0, 0.0) > share(80.0, 0.0) > 0
    assert share(40.0, 0.0) > share(40.0, 1.1)


def test_without_gain_there_is_nothing_and_with_enough_all():
    assert len(lidar(wall(20.0), detection=Detection(gain=0.0)).scan(Motion(0.0, 0.0)).cloud) == 0
    assert len(lidar(wall(20.0), detection=EXACT).scan(Motion(0.0, 0.0)).cloud) == 480 * 64
    assert len(lidar(wall(20.0, reflectivity=0.0), detection=EXACT).scan(Motion(0.0, 0.0)).cloud) == 0


def test_noise_and_loss_of_a_beam_do_not_depend_on_other_beams():
    ego, car = Motion(0.0, 0.0), Motion(25.0, 0.0, -0.8)
    alone = lidar(wall(60.0, 0.2), detection=Detection(gain=30_000.0)).scan(ego)
    model = lidar(wall(60.0, 0.2), detection=Detection(gain=30_000.0))
    _, without = model.cast(ego)
    _, with_car = model.cast(ego, [car])
    beside = np.flatnonzero((without == with_car).ravel())
    both = model.scan(ego, [car])
    kept = [dict(zip(scan.beam.tolist(), scan.cloud.tolist(), strict=True)) for scan in (alone, both)]
    assert 50 < without.size - len(beside) < 2000
    assert 0.3 < len(alone.beam) / without.size < 0.9
    for beam in beside.tolist():
        assert kept[0].get(beam) == kept[1].get(beam)


# --- motion within the scan ---


def test_a_wall_ahead_comes_nearer_during_the_scan():
    speed, distance = 80.0, 60.0
    model = lidar(wall(distance), detection=EXACT)
    scan = model.scan(Motion(0.0, 0.0, velocity=(speed, 0.0, 0.0)))
    column = scan.beam // 64
    expected = distance - speed * column_times(BeamPattern())[column]
    assert scan.cloud[:, 0] == pytest.approx(expected, abs=1e-4)
    assert np.ptp(expected) > 3.9


def test_a_yaw_rate_turns_a_wall_the_other_way():
    rate, distance = 0.6, 40.0
    scan = lidar(wall(distance), detection=EXACT).scan(Motion(0.0, 0.0, rate=(0.0, 0.0, rate)))
    angle = rate * column_times(BeamPattern())[scan.beam // 64]
    x, y = scan.cloud[:, 0].astype(float), scan.cloud[:, 1].astype(float)
    assert x * np.cos(angle) - y * np.sin(angle) == pytest.approx(np.full(len(x), distance), abs=1e-4)
    assert np.ptp(x * np.cos(0.0)) > 0.5, "it is not straight in the cloud"


def test_a_circle_is_driven_as_a_circle():
    """At 60 m/s and 0.3 rad/s, seen from the side: the path is an arc, and the axes turn with it."""
    speed, rate, side = 60.0, 0.3, Mount(0.0, 0.0, 0.0, math.radians(90.0))
    half = 500.0
    fence = QuadMesh(
        np.array([[(-half, 20.0, -half), (half, 20.0, -half), (half, 20.0, half), (-half, 20.0, half)]]), np.ones(1)
    )
    scan = lidar(fence, [side], detection=EXACT).scan(
        Motion(0.0, 0.0, velocity=(speed, 0.0, 0.0), rate=(0.0, 0.0, rate))
    )
    time = column_times(BeamPattern())[scan.beam // 64]
    angle, radius = rate * time, speed / rate
    x, y = scan.cloud[:, 0].astype(float), scan.cloud[:, 1].astype(float)
    across = radius * (1.0 - np.cos(angle)) + x * np.sin(angle) + y * np.cos(angle)
    assert across == pytest.approx(np.full(len(x), 20.0), abs=1e-4)


def test_a_car_that_drives_along_is_not_distorted_and_one_that_stands_is():
    model = lidar(NOTHING, detection=EXACT, pattern=BeamPattern(columns=960))
    fast = (70.0, 0.0, 0.0)
    still = model.cast(Motion(0.0, 0.0), [Motion(20.0, 4.0, -0.8)])[0]
    along = model.cast(Motion(0.0, 0.0, velocity=fast), [Motion(20.0, 4.0, -0.8, velocity=fast)])[0]
    np.testing.assert_allclose(along, still, rtol=1e-9)
    stands = model.scan(Motion(0.0, 0.0, velocity=fast), [Motion(20.0, 4.0, -0.8)])
    moved = model.scan(Motion(0.0, 0.0), [Motion(20.0, 4.0, -0.8, velocity=(-70.0, 0.0, 0.0))])
    np.testing.assert_allclose(stands.cloud, moved.cloud, atol=1e-4)
    # It is where it was when its columns were taken, which are about in the middle of the scan: 0.4 of 50 ms before.
    time = column_times(BeamPattern(columns=960))[stands.beam // 64].mean()
    reference = model.scan(Motion(0.0, 0.0), [Motion(20.0 - 70.0 * time, 4.0, -0.8)])
    assert -0.024 < time < -0.015
    assert stands.cloud[:, 0].min() == pytest.approx(reference.cloud[:, 0].min(), abs=0.3)


# --- seeds, bad input ---


@pytest.fixture(scope="module")
def mesh():
    return track_mesh(TRACK)


def on_track(station, lateral, speed=0.0, height=0.0):
    """Something that stands on the road, parallel to it, or drives along the bend."""
    x, y, yaw = TRACK.pose_at(station, lateral)
    bank, _ = TRACK.road_at_station(station)
    curvature = float(TRACK.centre.at(np.array([station]))[3][0])
    rate = speed * curvature / (1.0 - curvature * lateral)
    roll = -bank
    z = -lateral * math.tan(bank) + height
    # The road's bank turns with the car: a rate about the track's z axis, in the car's own axes.
    return Motion(x, y, z, yaw, 0.0, roll, (speed, 0.0, 0.0), (0.0, rate * math.sin(roll), rate * math.cos(roll)))


def test_a_seed_gives_the_same_bytes_again(mesh):
    ego, cars = on_track(640.0, -1.0, 60.0), [on_track(662.0, 2.0, 55.0)]
    models = [lidar(mesh, MOUNTS, seed) for seed in (1, 1, 2)]
    clouds = [[model.scan(ego, cars).cloud.tobytes() for _ in range(3)] for model in models]
    assert clouds[0] == clouds[1]
    assert clouds[0] != clouds[2]
    assert len(set(clouds[0])) == 3


def test_a_scan_does_not_change_with_what_was_cast_before(mesh):
    ego = on_track(640.0, -1.0, 60.0)
    one, other = lidar(mesh, MOUNTS), lidar(mesh, MOUNTS)
    other.cast(on_track(100.0, 2.0), [on_track(110.0, 2.0)])
    assert one.scan(ego).cloud.tobytes() == other.scan(ego).cloud.tobytes()


def test_a_result_is_not_touched_by_the_next(mesh):
    model = lidar(mesh, MOUNTS)
    first = model.scan(on_track(640.0, -1.0))
    before = first.cloud.tobytes(), first.beam.tobytes()
    model.scan(on_track(100.0, 1.0))
    assert (first.cloud.tobytes(), first.beam.tobytes()) == before


@pytest.mark.parametrize("field", ["x", "z", "yaw", "velocity", "rate"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_motions_must_be_finite(mesh, field, value):
    spoilt = Motion(**({"x": 0.0, "y": 0.0} | {field: (0.0, value, 0.0) if field in ("velocity", "rate") else value}))
    model, untouched = lidar(mesh), lidar(mesh)
    for motions in ((spoilt, []), (Motion(0.0, 0.0), [spoilt])):
        for take in (model.scan, model.cast):
            with pytest.raises(ValueError, match="not finite"):
                take(*motions)
    ego = on_track(640.0, -1.0)
    assert model.scan(ego).cloud.tobytes() == untouched.scan(ego).cloud.tobytes()


@pytest.mark.parametrize(
    "wrong",
    [
        {"columns": 0},
        {"columns": 1025},
        {"lines": 0},
        {"lines": 129},
        {"field_of_view": 0.0},
        {"field_of_view": math.radians(151.0)},
        {"field_of_view": math.nan},
        {"elevation": (0.1, 0.0)},
        {"elevation": (-1.5, 0.0)},
        {"elevation": (0.0, math.nan)},
        {"range_min": 0.0},
        {"range_min": 300.0},
        {"range_max": math.inf},
        {"range_max": math.nan},
    ],
)
def test_patterns_are_checked(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong)).split("_m")[0]):
        BeamPattern(**wrong)


@pytest.mark.parametrize(
    "wrong", [{"gain": -1.0}, {"gain": math.nan}, {"range_noise": -0.1}, {"range_noise": math.inf}]
)
def test_detection_is_checked(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Detection(**wrong)


@pytest.mark.parametrize("pattern", [BeamPattern(columns=1, lines=1), BeamPattern(columns=1024, lines=128)])
def test_the_smallest_and_the_largest_pattern(pattern):
    ranges, _ = lidar(wall(30.0), pattern=pattern).cast(Motion(0.0, 0.0))
    assert ranges[0] == pytest.approx(30.0 / directions(pattern)[..., 0], rel=1e-9)


# --- clouds as detection takes them ---


@pytest.mark.parametrize("station", np.arange(40.0, 2440.0, 400.0).tolist())
@pytest.mark.parametrize("speed", [0.0, 60.0])
def test_cars_are_found_where_they_are(mesh, station, speed):
    print("seed", SEED)
    model = lidar(mesh, MOUNTS, origin=(0.0, 0.0, -AXLE_HEIGHT))
    ego = on_track(station, -1.0, speed)
    places = [(station + 18.0, 2.0), (station + 36.0, -3.0), (station - 20.0, 1.0)]
    scan = model.scan(ego, [on_track(*place, speed) for place in places])
    assert check_cloud(scan.cloud) is DetectionStatus.OK
    assert scan.cloud.flags.c_contiguous
    assert np.isfinite(scan.cloud).all()
    assert 40_000 < len(scan.cloud) <= POINTS_MAX
    found = Detector(TRACK).step(scan.cloud, Pose(ego.x, ego.y, ego.yaw, ego.pitch, ego.roll))
    assert found.status is DetectionStatus.OK
    cos, sin = math.cos(ego.yaw), math.sin(ego.yaw)
    for place in places:
        x, y, _ = TRACK.pose_at(*place)
        there = cos * (x - ego.x) + sin * (y - ego.y), cos * (y - ego.y) - sin * (x - ego.x)
        apart = np.hypot(*(found.cars.centre[found.cars.fits] - there).T)
        assert apart.min(initial=np.inf) < 1.0
    assert len(found.objects) <= len(places) + 1


@pytest.mark.parametrize("station", [100.0, 700.0, 1300.0, 1900.0])
def test_on_an_empty_track_nothing_is_found(mesh, station):
    ego = on_track(station, 1.0, 70.0)
    scan = lidar(mesh, MOUNTS, origin=(0.0, 0.0, -AXLE_HEIGHT)).scan(ego)
    found = Detector(TRACK).step(scan.cloud, Pose(ego.x, ego.y, ego.yaw, ego.pitch, ego.roll))
    assert found.status is DetectionStatus.OK
    assert len(found.objects) == 0


def test_the_origin_moves_the_cloud_only(mesh):
    """From the centre of gravity, or from the ground under the rear axle: the same echoes."""
    origin = (1.247, 0.0, CG_OVER_AXLE)
    station = 20.0
    low = on_track(station, 0.0)
    bank = -low.roll
    axes = {
        "x": (math.cos(low.yaw), math.sin(low.yaw), 0.0),
        "z": (-math.sin(low.yaw) * math.sin(bank), math.cos(low.yaw) * math.sin(bank), math.cos(bank)),
    }
    up = AXLE_HEIGHT + CG_OVER_AXLE
    place = np.array((low.x, low.y, low.z)) + 1.247 * np.array(axes["x"]) + up * np.array(axes["z"])
    high = Motion(*place.tolist(), low.yaw, 0.0, low.roll)
    one, _ = lidar(mesh, MOUNTS, origin=(0.0, 0.0, -AXLE_HEIGHT)).cast(low)
    other, _ = lidar(mesh, MOUNTS, origin=origin).cast(high)
    # A beam that passes the top of a wall may end anywhere.
    assert np.isclose(one, other, rtol=1e-6).mean() > 0.9999


def test_a_car_is_as_large_as_it_is_said():
    corners = boxes(CAR_PARTS).corners
    assert corners.min(axis=(0, 1)) == pytest.approx((-2.45, -0.965, 0.0))
    assert corners.max(axis=(0, 1)) == pytest.approx((2.45, 0.965, 1.1))
    assert len(corners) == 6 * len(CAR_PARTS)
    # Each box: three pairs of sides, whose normals point out or in but are along the axes, and whose areas add up.
    for box, sides in zip(CAR_PARTS, corners.reshape(-1, 6, 4, 3), strict=True):
        dx, dy, dz = np.ptp(np.array(box), axis=1)
        areas = [np.linalg.norm(np.cross(side[1] - side[0], side[3] - side[0])) for side in sides]
        assert sum(areas) == pytest.approx(2.0 * (dx * dy + dy * dz + dz * dx))
