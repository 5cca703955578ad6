"""The estimate of the boundary on walls that are drawn, against closed forms: what it finds, keeps and never does."""

import math

import numpy as np
import pytest
from point_clouds import cloud_of
from scipy.spatial.transform import Rotation

import scenarios
from autonomy.detection.boundary_estimate import (
    _LEAST_WEIGHT,
    _STAGES,
    BoundaryConfig,
    BoundaryEstimate,
    BoundaryStatus,
    _second_differences,
    _solved,
)
from autonomy.detection.cloud import Pose
from autonomy.detection.confirmation import GATE, Confirmation
from autonomy.detection.frenet_raster import FrenetRaster
from autonomy.track_files import load_track

SEED = 20261130
MARGIN = 1.0
STATION = 640.0  # of the car; in a turn
CONFIG = BoundaryConfig()
LEFT, RIGHT = 0, 1


@pytest.fixture(scope="module")
def track():
    return load_track(scenarios.DIRECTORY / "tracks" / "lvms.yaml")


@pytest.fixture(scope="module")
def raster(track):
    return FrenetRaster(track, 11.0)


@pytest.fixture(scope="module")
def drawn_once(track):
    return BoundaryEstimate(track)


@pytest.fixture
def estimate(drawn_once):
    drawn_once.forget()
    drawn_once.offset[:] = 0.0
    return drawn_once


@pytest.fixture(scope="module")
def pose(track):
    x, y, yaw = track.pose_at(STATION, -1.0)
    return Pose(x, y, yaw, 0.02, -0.3)


def drawn(track, pose, station, left, height):
    """Points at stations and offsets, in the vehicle frame of a pose."""
    x, y = track.centre.offset(station, left)
    turn = Rotation.from_euler("ZYX", [pose.yaw, pose.pitch, pose.roll]).as_matrix()
    # With height along the vehicle's own z, x and y in the track frame shift; so they are solved for.
    flat = np.linalg.solve(turn[:2, :2], np.stack((x - pose.x, y - pose.y)) - turn[:2, 2:] * height)
    return cloud_of(*flat, height)


def wall(track, pose, rng, beyond, begin=-50.0, end=70.0, each=0.3, side=RIGHT, noise=0.02):
    """Points on a wall so far outside the file's boundary (m, by station), from station to station off the car's."""
    station = STATION + np.repeat(np.arange(begin, end, each), 3)
    offset = 7.45 + np.broadcast_to(beyond(station), station.shape) + rng.normal(0.0, noise, len(station))
    return drawn(track, pose, station, offset if side == LEFT else -offset, rng.uniform(0.1, 1.1, len(station)))


def car(track, pose, rng, ahead, left, points=150):
    """Points on a car's outline, m from the car at its middle."""
    around = rng.uniform(0.0, 2 * (4.9 + 1.93), points)
    side = np.array([[-2.45, -0.965], [2.45, -0.965], [2.45, 0.965], [-2.45, 0.965], [-2.45, -0.965]])
    ends = np.array([0.0, 4.9, 6.83, 11.73, 13.66])
    station, offset = np.interp(around, ends, side[:, 0]), np.interp(around, ends, side[:, 1])
    return drawn(track, pose, STATION + ahead + station, left + offset, rng.uniform(0.1, 0.9, points))


def places(estimate, track, begin, end):
    """Bins of the lap between stations off the car's, and the stations of their middles."""
    size = track.length / estimate.offset.shape[1]
    bins = np.arange(math.ceil((STATION + begin) / size), math.floor((STATION + end) / size))
    return bins, (bins + 0.5) * size


# --- its parts ---


def test_points_are_projected_as_the_curve_has_them(track, raster):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    worst = 0.0
    for _ in range(40):
        at = rng.uniform(0.0, track.length)
        x, y, yaw = track.pose_at(at, rng.uniform(-6.0, 6.0))
        pose = Pose(x, y, yaw + rng.uniform(-0.2, 0.2), *rng.uniform(-0.3, 0.3, 2))
        station, left = (at + rng.uniform(-90.0, 90.0, 300)) % track.length, rng.uniform(-11.0, 11.0, 300)
        found = raster.project(drawn(track, pose, station, left, rng.uniform(-1.0, 1.0, 300)), pose)
        off = np.abs(np.mod(found[0] - station + 5.0, track.length) - 5.0)
        worst = max(worst, float(off.max()), float(np.abs(found[1] - left).max()))
        for i in range(0, 300, 60):
            assert track.project(*map(float, np.concatenate(track.centre.offset(station[i : i + 1], left[i : i + 1]))))[
                1
            ] == pytest.approx(found[1][i], abs=1e-3)
    assert worst < 0.01


@pytest.mark.parametrize("stiff", [stage[0] for stage in _STAGES])
def test_the_line_is_that_of_the_normal_equations(stiff):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    datum, weight = rng.normal(0.0, 1.0, 60), rng.uniform(0.0, 1.0, 60) * (rng.uniform(size=60) < 0.6)
    line = _solved(_second_differences(60), stiff, datum, weight)
    # The same least squares as one tall system.
    rows = np.concatenate((np.diag(np.sqrt(weight + _LEAST_WEIGHT)), math.sqrt(stiff) * np.diff(np.eye(60), 2, axis=0)))
    value = np.concatenate((weight * datum / np.sqrt(weight + _LEAST_WEIGHT), np.zeros(58)))
    assert line == pytest.approx(np.linalg.lstsq(rows, value, rcond=None)[0], abs=1e-4)


# --- walls ---

WALLS = {
    "inside": lambda s: -1.5 + 0.0 * s,
    "as in the file": lambda s: 0.0 * s,
    "outside": lambda s: 1.2 + 0.0 * s,
    "turned": lambda s: -1.2 + 0.015 * (s - STATION),
    "bent": lambda s: -1.5 + np.sin((s - STATION) / 25.0),
    "from right to wrong": lambda s: -2.5 * np.clip((s - STATION) / 30.0, 0.0, 1.0),
}


@pytest.mark.parametrize("side", [LEFT, RIGHT])
@pytest.mark.parametrize("name", WALLS)
def test_a_wall_is_where_it_was_drawn(estimate, track, pose, name, side):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    cloud = wall(track, pose, rng, WALLS[name], side=side)
    found = estimate.step(cloud, pose, MARGIN)
    assert found.status is BoundaryStatus.OK
    assert found.seen == (side == LEFT, side == RIGHT)
    bins, station = places(estimate, track, -48.0, 68.0)
    assert np.abs(estimate.offset[side, bins] - WALLS[name](station)).max() < 0.2
    assert (estimate.unseen[side, bins] == 0).all()
    assert (estimate.unseen[1 - side] > CONFIG.memory).all()
    assert not found.inside.any()


@pytest.mark.parametrize("name", WALLS)
def test_the_fence_is_the_tighter_of_the_two(estimate, track, pose, name):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    estimate.step(wall(track, pose, rng, WALLS[name]), pose, MARGIN)
    # So few at a time that they are no wall themselves.
    station, left = STATION + rng.uniform(-45.0, 65.0, (15, 60)), rng.uniform(-9.0, 9.0, (15, 60))
    found = [estimate.step(drawn(track, pose, *at, 0.5), pose, MARGIN) for at in zip(station, left, strict=True)]
    assert {each.status for each in found} == {BoundaryStatus.NO_WALL}
    inside = np.stack([each.inside for each in found])
    off = np.maximum(np.maximum(-left, left) - 7.45 + MARGIN, -left - 7.45 - WALLS[name](station) + CONFIG.margin)
    sure = np.abs(off) > 0.3
    assert (inside == (off < 0.0))[sure].all()
    assert 0.2 < inside.mean() < 0.9
    if name in ("as in the file", "outside"):
        exact = np.maximum(-left, left) - 7.45 + MARGIN
        # The track file's fence, to float32's rounding; where the wall is drawn on it, to the noise of the wall.
        assert (inside == (exact < 0.0))[np.abs(exact) > 0.05].all()


@pytest.mark.parametrize("ahead", [-12.0, 0.0, 9.0, 25.0, 40.0])
@pytest.mark.parametrize("gap", [1.5, 2.0])
@pytest.mark.parametrize("name", ["inside", "turned", "bent"])
def test_a_car_beside_the_wall_stays(estimate, track, raster, pose, ahead, gap, name):
    """Its middle is so far from the wall, and it hides 20 m of it."""
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    at = float(WALLS[name](np.array([STATION + ahead]))[0])
    opponent = car(track, pose, rng, ahead, -(7.45 + at) + gap)
    hidden = (
        wall(track, pose, rng, WALLS[name], end=ahead - 3.0),
        wall(track, pose, rng, WALLS[name], begin=ahead + 17.0, end=90.0),
    )
    for _ in range(3):
        inside = estimate.step(np.concatenate((*hidden, opponent)), pose, MARGIN).inside
        seen = inside[-len(opponent) :]
        assert not inside[: -len(opponent)].any()
        # What is more than the margin off the wall: of 1.93 m all but what reaches into it.
        lefts = raster.project(opponent, pose)[1] - (-(7.45 + at) + gap)
        off = lefts + gap - CONFIG.margin
        assert seen[off > 0.35].all()
        assert seen.mean() > 0.4


@pytest.mark.parametrize("cars", [1, 2, 3])
@pytest.mark.parametrize("side", [LEFT, RIGHT])
def test_cars_in_a_row_are_no_wall(estimate, track, raster, pose, cars, side):
    """Where there is none, with 1 m and more from nose to tail."""
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    for _ in range(40):
        gaps = rng.uniform(1.0, 20.0, cars)
        ahead = rng.uniform(-30.0, 10.0) + np.cumsum(gaps + 4.9)
        left = rng.uniform(4.0, 5.5) * (1 if side == LEFT else -1)
        lefts = left + rng.normal(0.0, 0.1, cars)
        cloud = np.concatenate([car(track, pose, rng, a, d) for a, d in zip(ahead, lefts, strict=True)])
        found = estimate.step(cloud, pose, MARGIN)
        assert found.status is BoundaryStatus.NO_WALL
        assert (found.inside == (np.abs(raster.project(cloud, pose)[1]) < 6.45)).all()


def test_an_opening_is_led_across_and_a_car_in_it_stays(estimate, track, pose):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    opponent = car(track, pose, rng, 20.0, -(7.45 - 1.5) + 2.2)
    parts = wall(track, pose, rng, WALLS["inside"], end=5.0), wall(track, pose, rng, WALLS["inside"], begin=35.0)
    found = estimate.step(np.concatenate((*parts, opponent)), pose, MARGIN)
    assert found.inside[-len(opponent) :].all()
    bins, _ = places(estimate, track, 0.0, 40.0)
    assert np.abs(estimate.offset[RIGHT, bins] + 1.5).max() < 0.15


def test_a_wall_that_ends_is_not_led_to_a_car_past_it(estimate, track, pose):
    """The line goes by the wall alone: it does not bend to the car, whose returns are the outermost there."""
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    for ahead in (10.0, 20.0, 30.0, 45.0):
        opponent = car(track, pose, rng, ahead, -(7.45 - 1.5) + 2.4)
        part = wall(track, pose, rng, WALLS["inside"], end=2.0)
        assert estimate.step(np.concatenate((part, opponent)), pose, MARGIN).inside[-len(opponent) :].all()


# --- state ---


def test_what_is_known_moves_no_farther_than_the_rate(estimate, track, pose):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    bins, _ = places(estimate, track, -45.0, 65.0)
    estimate.step(wall(track, pose, rng, lambda s: 0.0 * s), pose, MARGIN)
    before = estimate.offset[RIGHT, bins].copy()
    for number in range(30):
        estimate.step(wall(track, pose, rng, WALLS["inside"]), pose, MARGIN)
        now = estimate.offset[RIGHT, bins].copy()
        assert np.abs(now - before).max() <= CONFIG.rate + 1e-12
        if number == 0:
            assert now.max() < -0.1
        before = now
    assert before == pytest.approx(-1.5, abs=0.1)


@pytest.mark.parametrize("far", [-20.0, -4.5, 2.5, 20.0])
def test_a_wall_beyond_the_search_is_none(estimate, track, pose, far):
    cloud = wall(track, pose, np.random.default_rng(SEED), lambda s: far + 0.0 * s)
    found = estimate.step(cloud, pose, MARGIN)
    assert found.status is BoundaryStatus.NO_WALL
    assert (estimate.unseen > CONFIG.memory).all()


def test_what_is_not_seen_again_is_forgotten(estimate, track, pose):
    rng = np.random.default_rng(SEED)
    estimate.step(wall(track, pose, rng, WALLS["inside"]), pose, MARGIN)
    between = drawn(track, pose, STATION + np.arange(0.0, 40.0), -(7.45 - 1.5) + 0.3, 0.5)
    for number in range(CONFIG.memory + 3):
        found = estimate.step(between[::9], pose, MARGIN)
        assert found.status is BoundaryStatus.NO_WALL
        # Within 1 m of a wall that was seen, but 1.8 m inside the file's boundary.
        assert found.inside.any() == found.inside.all() == (number >= CONFIG.memory)


def test_the_state_is_all_there_is(track, pose):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    clouds = [wall(track, pose, rng, WALLS[name]) for name in ("inside", "bent", "turned")]
    one, other = BoundaryEstimate(track), BoundaryEstimate(track)
    for cloud in clouds[:2]:
        one.step(cloud, pose, MARGIN)
    other.offset[:], other.unseen[:] = one.offset, one.unseen
    first, second = one.step(clouds[2], pose, MARGIN), other.step(clouds[2], pose, MARGIN)
    assert (first.inside == second.inside).all()
    assert one.offset.tobytes() == other.offset.tobytes()
    assert one.unseen.tobytes() == other.unseen.tobytes()


def test_on_the_seam_of_the_lap_it_is_as_anywhere(track):
    rng = np.random.default_rng(SEED)
    x, y, yaw = track.pose_at(5.0, 0.0)
    pose, estimate = Pose(x, y, yaw), BoundaryEstimate(track)
    station = np.repeat(np.arange(-50.0, 70.0, 0.3), 3) % track.length
    found = estimate.step(drawn(track, pose, station, -5.95 + rng.normal(0, 0.02, len(station)), 0.5), pose, MARGIN)
    assert found.seen == (False, True)
    assert not found.inside.any()
    assert estimate.offset[RIGHT, [-20, -1, 0, 20]] == pytest.approx(-1.5, abs=0.1)


# --- what can be wrong ---


def test_an_empty_cloud_has_a_status(estimate, pose):
    found = estimate.step(np.empty((0, 3), dtype=np.float32), pose, MARGIN)
    assert (found.status, len(found.inside), found.seen) == (BoundaryStatus.EMPTY, 0, (False, False))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_pose_that_is_not_finite_has_a_status_and_changes_nothing(estimate, track, pose, value):
    cloud = wall(track, pose, np.random.default_rng(SEED), WALLS["inside"])
    estimate.step(cloud, pose, MARGIN)
    before = estimate.offset.copy(), estimate.unseen.copy()
    found = estimate.step(cloud, Pose(pose.x, value, pose.yaw), MARGIN)
    assert found.status is BoundaryStatus.BAD_POSE
    assert not found.inside.any()
    assert (estimate.offset == before[0]).all()
    assert (estimate.unseen == before[1]).all()


def test_nothing_that_is_finite_makes_it_raise_or_lose_its_bounds(estimate, pose):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    for number in range(150):
        count = int(rng.integers(1, 400))
        spread = 10.0 ** rng.uniform(-3.0, 2.1)
        cloud = rng.normal(0.0, spread, (count, 3)).clip(-127.9, 127.9).astype(np.float32)
        far = Pose(*(rng.normal(0.0, 10.0 ** rng.uniform(0.0, 9.0), 2)), *rng.uniform(-3.0, 3.0, 3))
        found = estimate.step(cloud, pose if number % 2 else far, MARGIN)
        assert found.inside.shape == (count,)
        assert np.isfinite(estimate.offset).all()
        assert estimate.offset.min() >= -CONFIG.inward
        assert estimate.offset.max() <= CONFIG.outward


@pytest.mark.parametrize(
    "wrong",
    [{"margin": -1.0}, {"inward": 0.0}, {"dense": 0}, {"run": 1.0}, {"gain": 0.0}, {"rate": math.nan}, {"memory": -1}],
)
def test_thresholds_that_are_none_are_refused(wrong):
    with pytest.raises(ValueError, match="must be"):
        BoundaryConfig(**wrong)


# --- confirmation ---


def test_confirmation_is_two_of_three_scans_within_the_gate():
    """Against all pairs of objects, one by one, in the track frame."""
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    confirmation, before, counts = Confirmation(), [], [0, 0]
    for _ in range(300):
        pose = Pose(*rng.uniform(-5.0, 5.0, 2), rng.uniform(-3.0, 3.0))
        centres = rng.uniform(-20.0, 20.0, (int(rng.integers(0, 5)), 2))
        turn = Rotation.from_euler("Z", pose.yaw).as_matrix()[:2, :2]
        places = [turn @ centre + [pose.x, pose.y] for centre in centres]
        expected = [
            any(math.dist(place, old) <= back * GATE for back, olds in enumerate(before, start=1) for old in olds)
            for place in places
        ]
        assert confirmation.step(centres, pose).tolist() == expected
        counts[0] += len(expected)
        counts[1] += sum(expected)
        before = [places, *before[:1]]
    assert 0.2 * counts[0] < counts[1] < 0.8 * counts[0]


def test_a_scan_of_no_use_counts_as_one_without_objects():
    confirmation, here = Confirmation(), np.zeros((1, 2))
    assert confirmation.step(here, Pose(0.0, 0.0, 0.0)).tolist() == [False]
    assert confirmation.step(here, Pose(math.nan, 0.0, 0.0)).tolist() == [False]
    assert confirmation.step(here, Pose(0.0, 0.0, 0.0)).tolist() == [True]
    for _ in range(2):
        assert confirmation.step(np.empty((0, 2)), Pose(0.0, 0.0, 0.0)).tolist() == []
    assert confirmation.step(here, Pose(0.0, 0.0, 0.0)).tolist() == [False]


@pytest.mark.parametrize("gate", [0.0, -1.0, math.nan, math.inf])
def test_a_gate_that_is_none_is_refused(gate):
    with pytest.raises(ValueError, match="must be above 0"):
        Confirmation(gate)
