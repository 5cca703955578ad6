"""Detection as a whole: synthetic scans of a banked track with cars, bad input, and the cross-check by itself."""

import math
from pathlib import Path

import numpy as np
import pytest
from point_clouds import cloud_of, spoilt

from autonomy.detection.cloud import POINTS_MAX, DetectionStatus, Pose
from autonomy.detection.clustering import Clustering
from autonomy.detection.cross_check import VehicleShape, cross_check
from autonomy.detection.detector import DetectionConfig, Detector
from autonomy.track_files import load_track
from tools.lidar_scene import POINTS, LidarScene

SEED = 20261130
SHAPE = VehicleShape()


@pytest.fixture(scope="module")
def track():
    return load_track(Path(__file__).parents[2] / "scenarios" / "tracks" / "lvms.yaml")


@pytest.fixture(scope="module")
def scene(track):
    return LidarScene(track)


@pytest.fixture(scope="module")
def scan(scene):
    """In turn 1, at 20 degrees of bank: a car ahead, one beside."""
    return scene.scan(600.0, -2.0, [(625.0, -3.0), (601.0, 2.5)], SEED)


@pytest.fixture
def detector(track):
    return Detector(track)


def apart(one, other):
    return math.hypot(one[0] - other[0], one[1] - other[1])


# --- scans of a track ---


@pytest.mark.parametrize("station", [20.0, 390.0, 640.0, 960.0, 1235.0, 1800.0])
def test_cars_are_found_where_they_are_and_nothing_else(scene, detector, station):
    print("seed", SEED)
    cars = [(station + 18.0, 2.0), (station + 38.0, -3.5), (station - 25.0, 0.5)]
    scan = scene.scan(station, -1.0, cars, SEED)
    found = detector.step(scan.cloud, scan.pose)
    assert found.status is DetectionStatus.OK
    assert found.cars.fits.all()
    for truth in scan.cars:
        nearest = min(range(len(found.objects)), key=lambda i: apart(found.cars.centre[i], truth))
        assert apart(found.cars.centre[nearest], truth) < 1.0
        assert abs(math.remainder(found.cars.heading[nearest] - truth[2], 2.0 * math.pi)) < math.radians(15.0)
    for centre in found.cars.centre:
        assert min(apart(centre, truth) for truth in scan.cars) < 1.0


@pytest.mark.parametrize("station", [120.0, 500.0, 900.0, 1060.0, 2100.0])
def test_an_empty_road_has_no_objects(scene, detector, station):
    """Banks of 6 to 20 degrees and what lies between, walls on both sides."""
    scan = scene.scan(station, 3.0, [], SEED)
    assert len(scan.cloud) == POINTS
    found = detector.step(scan.cloud, scan.pose)
    assert (found.status, len(found.objects)) == (DetectionStatus.OK, 0)


def test_a_wall_is_an_object_without_the_geofence(scene, track):
    scan = scene.scan(500.0, 3.0, [], SEED)
    detector = Detector(track, DetectionConfig(margin=0.0))
    raised, _ = detector._ground_filter.apply(scan.cloud)
    assert Clustering().apply(raised).objects["points"].max() > 1000


def test_a_step_gives_the_same_whatever_the_order_and_what_came_before(detector, scene, scan):
    first = detector.step(scan.cloud, scan.pose)
    assert len(first.objects) >= 2
    before = scan.cloud.copy()
    detector.step(scene.scan(1235.0, 0.0, [(1255.0, 0.0)], SEED).cloud, scan.pose)
    shuffled = scan.cloud[np.random.default_rng(SEED).permutation(len(scan.cloud))]
    for cloud in (scan.cloud, shuffled, np.asfortranarray(scan.cloud)):
        again = detector.step(cloud, scan.pose)
        assert again.objects.tobytes() == first.objects.tobytes()
        assert (again.cars.centre == first.cars.centre).all()
    assert (scan.cloud == before).all()


def test_points_that_are_not_finite_or_far_change_nothing(detector, scan):
    clean = detector.step(scan.cloud, scan.pose)
    mixed, _, not_finite = spoilt(np.random.default_rng(SEED), scan.cloud)
    found = detector.step(mixed, scan.pose)
    assert found.status is DetectionStatus.OK
    assert found.objects.tobytes() == clean.objects.tobytes()
    assert detector.not_finite == not_finite


# --- bad input ---

ROW = np.zeros((5, 3), dtype=np.float32)
BAD = {
    "none": (None, DetectionStatus.NOT_FLOAT32),
    "list": ([[1.0, 2.0, 3.0]], DetectionStatus.NOT_FLOAT32),
    "bytes": (b"12 bytes long", DetectionStatus.NOT_FLOAT32),
    "double": (ROW.astype(float), DetectionStatus.NOT_FLOAT32),
    "integers": (ROW.astype(np.int32), DetectionStatus.NOT_FLOAT32),
    "other byte order": (ROW.astype(">f4"), DetectionStatus.NOT_FLOAT32),
    "objects": (ROW.astype(object), DetectionStatus.NOT_FLOAT32),
    "scalar": (np.array(1.0, dtype=np.float32), DetectionStatus.BAD_SHAPE),
    "flat": (ROW.ravel(), DetectionStatus.BAD_SHAPE),
    "four columns": (np.zeros((5, 4), dtype=np.float32), DetectionStatus.BAD_SHAPE),
    "three dimensions": (np.zeros((5, 3, 1), dtype=np.float32), DetectionStatus.BAD_SHAPE),
    "empty": (ROW[:0], DetectionStatus.EMPTY),
    "too many": (np.zeros((POINTS_MAX + 1, 3), dtype=np.float32), DetectionStatus.TOO_MANY_POINTS),
    "not finite": (ROW + np.float32(np.nan), DetectionStatus.NOTHING_FINITE),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_cloud_gives_a_status_and_is_counted(detector, name):
    cloud, status = BAD[name]
    found = detector.step(cloud, Pose(0.0, 0.0, 0.0))
    assert (found.status, len(found.objects), len(found.cars.fits), len(found.cars.centre)) == (status, 0, 0, 0)
    assert detector.scans == {status: 1}


@pytest.mark.parametrize("field", ["x", "y", "yaw", "pitch", "roll"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_pose_that_is_not_finite_gives_a_status(detector, scan, field, value):
    pose = Pose(**{"x": 0.0, "y": 0.0, "yaw": 0.0, field: value})
    assert detector.step(scan.cloud, pose).status is DetectionStatus.BAD_POSE


def test_scans_are_counted_by_status(detector, scan):
    pose = scan.pose
    for cloud in (scan.cloud, None, ROW[:0], scan.cloud, ROW[:0], ROW[:0]):
        detector.step(cloud, pose)
    assert detector.scans == {DetectionStatus.OK: 2, DetectionStatus.NOT_FLOAT32: 1, DetectionStatus.EMPTY: 3}
    assert detector.step(scan.cloud, pose).status is DetectionStatus.OK


def test_a_car_far_off_the_track_sees_nothing(detector, scan):
    for place in (1e5, 1e30, 1e300):
        found = detector.step(scan.cloud, Pose(place, -place, 0.0))
        assert (found.status, len(found.objects)) == (DetectionStatus.OK, 0)


# --- the cross-check by itself ---


def outline(x, y, heading, parts):
    """Points on straight parts of a car's outline: (forward, left) pairs in its frame."""
    along, across = np.concatenate([np.linspace(a, b, 60) for a, b in parts]).T
    c, s = math.cos(heading), math.sin(heading)
    return cloud_of(x + along * c - across * s, y + along * s + across * c, 0.5)


REAR = ((-2.45, -0.965), (-2.45, 0.965))
RIGHT = ((-2.45, -0.965), (2.45, -0.965))
FRONT = ((2.45, -0.965), (2.45, 0.965))
LEFT = ((-2.45, 0.965), (2.45, 0.965))


def check(cloud, direction):
    found = Clustering().apply(cloud)
    return cross_check(cloud, found.labels, found.objects, np.full(len(found.objects), direction), SHAPE)


@pytest.mark.parametrize(
    ("place", "parts"),
    [
        ((30.0, 4.0), (REAR,)),
        ((30.0, 4.0), (REAR, RIGHT)),
        ((30.0, -4.0), (REAR, LEFT)),
        ((-30.0, 4.0), (FRONT, RIGHT)),
        ((0.5, 4.0), (RIGHT,)),
        ((0.5, -4.0), (LEFT,)),
        ((30.0, 4.0), (REAR, RIGHT, FRONT, LEFT)),
    ],
)
@pytest.mark.parametrize("heading", [-0.06, 0.0, 0.1])
def test_the_middle_of_a_car_follows_from_its_near_sides(place, parts, heading):
    seen = check(outline(*place, heading, parts), direction=heading + 0.02)
    assert seen.fits.tolist() == [True]
    assert seen.centre[0] == pytest.approx(place, abs=0.02)
    assert seen.heading[0] == pytest.approx(heading, abs=1e-3)


def test_a_part_that_points_anywhere_takes_the_direction_of_the_road():
    slanted = cloud_of(20.0 + np.linspace(0.0, 0.6, 20), np.linspace(0.0, 0.6, 20), 0.5)
    assert check(slanted, direction=0.2).heading.tolist() == pytest.approx([0.2])
    assert check(slanted, direction=-2.9).heading.tolist() == pytest.approx([-2.9])


@pytest.mark.parametrize(
    ("length", "width", "fits"), [(5.3, 2.3, True), (5.5, 1.0, False), (1.0, 2.5, False), (14.0, 0.1, False)]
)
def test_what_is_larger_than_a_car_is_none(length, width, fits):
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.0, length, 0.05), np.arange(0.0, width, 0.05)))
    seen = check(cloud_of(15.0 + x, y, 0.5), direction=0.0)
    assert seen.fits.tolist() == [fits]
    assert (seen.length[0], seen.width[0]) == pytest.approx((np.ptp(x), np.ptp(y)), abs=1e-4)
    if not fits:
        assert seen.centre[0] == pytest.approx((15.0 + np.ptp(x) / 2, np.ptp(y) / 2), abs=1e-4)


@pytest.mark.parametrize(
    "wrong", [{"length": 1.0}, {"width": 0.0}, {"tolerance": math.nan}, {"yaw_range_deg": 46.0}, {"length": math.inf}]
)
def test_a_shape_that_is_none_is_refused(wrong):
    with pytest.raises(ValueError, match="must be 0"):
        VehicleShape(**wrong)
