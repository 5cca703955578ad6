"""The geofence against the track model's own projection, point by point."""

import math
from pathlib import Path

import numpy as np
import pytest
from point_clouds import cloud_of, spoilt
from scipy.spatial.transform import Rotation

from autonomy.detection.cloud import Pose
from autonomy.detection.geofence import Geofence
from autonomy.frenet import Curve, Projector
from autonomy.track import Track
from autonomy.track_files import load_track

TRACKS = Path(__file__).parents[2] / "scenarios" / "tracks"
SEED = 20261130
NEAR = 2e-3  # m; so near to the fence, rounding may decide


def wavy(clockwise=False, turn=0.0, move=(0.0, 0.0)):
    """A lap with turns both ways and widths that change."""
    angle = np.linspace(0.0, 2.0 * math.pi, 240, endpoint=False)
    angle = -angle if clockwise else angle
    radius = 150.0 + 30.0 * np.sin(3.0 * angle)
    x, y = 1.5 * radius * np.cos(angle), radius * np.sin(angle)
    x, y = x * math.cos(turn) - y * math.sin(turn) + move[0], x * math.sin(turn) + y * math.cos(turn) + move[1]
    centre = Curve.through(x, y, 1100)
    phase = 2.0 * math.pi * np.arange(centre.count) / centre.count
    return Track(
        "wavy",
        None,
        centre,
        width_left=6.0 + 2.0 * np.sin(5.0 * phase),
        width_right=8.0 + 3.0 * np.cos(7.0 * phase),
        bank=np.zeros(centre.count),
        grade=np.zeros(centre.count),
    )


MAKERS = {
    "lvms": lambda: load_track(TRACKS / "lvms.yaml"),
    "ims": lambda: load_track(TRACKS / "ims.yaml"),
    "wavy": wavy,
    "clockwise": lambda: wavy(clockwise=True),
    "far from the origin": lambda: wavy(move=(40_000.0, -55_000.0)),
}


@pytest.fixture(scope="module", params=MAKERS)
def track(request):
    return MAKERS[request.param]()


@pytest.fixture(scope="module")
def lvms():
    return MAKERS["lvms"]()


def clearance(track, x, y, margin):
    """Distance to the fence, m, positive inside: brute force for the node, then the track model's projection."""
    width_left, width_right = (np.append(w, w[0]) for w in (track.width_left, track.width_right))
    stations = np.append(track.centre.stations, track.length)
    result = []
    for px, py in zip(x.tolist(), y.tolist(), strict=True):
        s, d = Projector(track.centre).project(px, py)
        left, right = np.interp(s, stations, width_left), np.interp(s, stations, width_right)
        result.append(min(left - margin - d, right - margin + d))
    return np.array(result)


def compare(fence, track, cloud, pose, x, y):
    """The kept points are those inside; gives how many are inside."""
    away = clearance(track, x, y, fence.margin)
    kept, tally = fence.apply(cloud, pose)
    kept_set = set(map(tuple, kept.tolist()))
    got = np.array([tuple(row) in kept_set for row in cloud.tolist()])
    clear = np.abs(away) > NEAR
    assert np.count_nonzero(~clear) < 0.01 * len(away)
    assert (got[clear] == (away[clear] > 0.0)).all()
    assert tally.kept == len(kept) == np.count_nonzero(got)
    return len(kept)


@pytest.mark.parametrize("margin", [0.0, 1.0, 2.5])
def test_points_around_the_lap_are_kept_as_the_track_model_says(track, margin):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    fence = Geofence(track, margin)
    for _ in range(4):
        station = rng.uniform(0.0, track.length)
        x0, y0, yaw = track.pose_at(station, rng.uniform(-3.0, 3.0))
        lateral = rng.uniform(-14.0, 14.0, 400)
        x, y = track.centre.offset(rng.uniform(station - 80.0, station + 80.0, 400), lateral)
        dx, dy = x - x0, y - y0
        cloud = cloud_of(dx * math.cos(yaw) + dy * math.sin(yaw), dy * math.cos(yaw) - dx * math.sin(yaw), 0.0)
        back = cloud.astype(float)
        x = x0 + back[:, 0] * math.cos(yaw) - back[:, 1] * math.sin(yaw)
        y = y0 + back[:, 0] * math.sin(yaw) + back[:, 1] * math.cos(yaw)
        assert 50 < compare(fence, track, cloud, Pose(x0, y0, yaw), x, y) < 350


def test_the_cloud_is_turned_by_yaw_pitch_and_roll(lvms):
    rng = np.random.default_rng(SEED)
    fence = Geofence(lvms)
    for _ in range(4):
        x0, y0, yaw = lvms.pose_at(rng.uniform(0.0, lvms.length), 1.0)
        pitch, roll = rng.uniform(-0.4, 0.4, 2)
        cloud = rng.uniform([-60, -20, -2], [60, 20, 12], (400, 3)).astype(np.float32)
        world = Rotation.from_euler("ZYX", [yaw, pitch, roll]).apply(cloud.astype(float))
        inside = compare(fence, lvms, cloud, Pose(x0, y0, yaw, pitch, roll), x0 + world[:, 0], y0 + world[:, 1])
        assert 40 < inside < 360


def test_the_margin_is_kept_to_the_millimetre(lvms):
    fence = Geofence(lvms, 1.0)
    stations = np.arange(0.3, lvms.length, 11.7)
    for side, width in ((1.0, lvms.width_left), (-1.0, lvms.width_right)):
        edge = width[0] - 1.0
        for lateral, inside in ((edge - 0.005, True), (edge + 0.005, False), (width[0] + 3.0, False), (40.0, False)):
            x, y = lvms.centre.offset(stations, np.full(len(stations), side * lateral))
            assert [fence.has(*place) for place in zip(x.tolist(), y.tolist(), strict=True)] == [inside] * len(stations)


def test_a_turned_and_moved_track_keeps_the_same_points():
    rng = np.random.default_rng(SEED)
    plain, turned = wavy(), wavy(turn=0.7, move=(300.0, -80.0))
    cloud = rng.uniform([-60, -30, 0], [60, 30, 0], (2000, 3)).astype(np.float32)
    x, y, yaw = plain.pose_at(100.0, 0.5)
    there = turned.pose_at(100.0, 0.5)
    assert there[2] == pytest.approx(math.remainder(yaw + 0.7, 2.0 * math.pi))
    one, _ = Geofence(plain).apply(cloud, Pose(x, y, yaw))
    other, _ = Geofence(turned).apply(cloud, Pose(*there))
    # Only points on the fence may differ.
    assert len(set(map(tuple, one.tolist())) ^ set(map(tuple, other.tolist()))) <= 2
    assert 100 < len(one) < 1900


def test_the_order_of_points_does_not_matter_and_stays(lvms):
    rng = np.random.default_rng(SEED)
    fence, pose = Geofence(lvms), Pose(*lvms.pose_at(500.0, 0.0))
    cloud = rng.uniform(-60, 60, (3000, 3)).astype(np.float32)
    kept, _ = fence.apply(cloud, pose)
    shuffle = rng.permutation(len(cloud))
    again, _ = fence.apply(cloud[shuffle], pose)
    member = np.array([fence.apply(cloud[i : i + 1], pose)[1].kept == 1 for i in range(len(cloud))])
    assert (kept == cloud[member]).all()
    assert (again == cloud[shuffle][member[shuffle]]).all()


def test_what_is_not_finite_or_far_is_dropped_and_counted(lvms):
    rng = np.random.default_rng(SEED)
    fence, pose = Geofence(lvms), Pose(*lvms.pose_at(900.0, 0.0))
    cloud = rng.uniform(-30, 30, (700, 3)).astype(np.float32)
    clean, before = fence.apply(cloud, pose)
    mixed, far, not_finite = spoilt(rng, cloud)
    room = mixed.copy()
    kept, tally = fence.apply(room, pose, out=room)
    assert (kept == clean).all()
    assert (tally.kept, tally.removed, tally.far, tally.not_finite) == (before.kept, before.removed, far, not_finite)


@pytest.mark.parametrize("place", [(1e6, 0.0), (-1e300, 1e300), (0.0, 0.0)])
def test_a_car_off_the_track_sees_nothing_on_it(lvms, place):
    cloud = np.random.default_rng(SEED).uniform(-50, 50, (500, 3)).astype(np.float32)
    kept, tally = Geofence(lvms).apply(cloud, Pose(*place, 0.3))
    assert (len(kept), tally.removed) == (0, 500)
    assert not Geofence(lvms).has(*place)


def test_what_cannot_be_fenced_in_is_refused(lvms):
    for margin in (-0.1, 7.45, math.nan):
        with pytest.raises(ValueError, match=r"must be 0 or more and below 7\.45 m"):
            Geofence(lvms, margin)
    with pytest.raises(ValueError, match="pose is not finite"):
        Geofence(lvms).apply(np.zeros((1, 3), dtype=np.float32), Pose(0.0, math.nan, 0.0))
