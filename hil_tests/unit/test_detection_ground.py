"""Ground removal against closed forms on planes, and against a plain implementation on anything."""

import math

import numpy as np
import pytest
from point_clouds import as_set, cloud_of, spoilt

from autonomy.detection.cloud import POINTS_MAX
from autonomy.detection.ground_filter import GroundConfig, GroundFilter

SEED = 20261130
# The size of cells is exact in binary.
CONFIG = GroundConfig(cell_size=0.5)
WHOLE = GroundConfig(cell_size=0.5, foot_points=POINTS_MAX)


@pytest.fixture(scope="module", params=[CONFIG, WHOLE], ids=["without feet", "whole cells"])
def ground_filter(request):
    return GroundFilter(request.param)


@pytest.fixture(scope="module")
def whole():
    return GroundFilter(WHOLE)


def plane(rng, count, bank_deg, azimuth, noise=0.0):
    x, y = rng.uniform(-100.0, 100.0, (2, count))
    climb = math.tan(math.radians(bank_deg))
    return cloud_of(
        x, y, climb * (x * math.cos(azimuth) + y * math.sin(azimuth)) + rng.normal(0.0, noise or 1e-9, count)
    )


def reference(cloud, config):
    """Which points stay, by dictionaries of cells; the same float32 operations, so the same to the bit."""
    per_m = np.float32(1.0) / np.float32(config.cell_size)
    cells = {}
    for row in cloud:
        cells.setdefault(tuple(np.floor(row[:2] * per_m + np.float32(260.0)).astype(int)), []).append(row)
    slope, threshold = np.float32(math.tan(math.radians(config.slope_max_deg))), np.float32(config.height_threshold)
    kept = []
    for rows in cells.values():
        low = min(rows, key=lambda p: (p[2], p[0], p[1]))
        high = min(rows, key=lambda p: (-p[2], p[0], p[1]))

        def height(row, low=low):
            dx, dy = row[0] - low[0], row[1] - low[1]
            return row[2] - low[2] - slope * np.sqrt(dx * dx + dy * dy)

        if len(rows) > config.points_threshold and height(high) > threshold:
            feet = len(rows) > config.foot_points
            kept += [tuple(map(float, row)) for row in rows if not feet or height(row) > threshold]
    return sorted(kept)


@pytest.mark.parametrize("bank_deg", [0.0, 3.0, 9.0, 15.0, 20.0])
def test_a_plane_of_any_bank_is_ground(ground_filter, bank_deg):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    for azimuth in rng.uniform(-math.pi, math.pi, 6):
        cloud = plane(rng, 30_000, bank_deg, azimuth, noise=0.004)
        for one in (ground_filter, GroundFilter()):
            kept, tally = one.apply(cloud)
            assert len(kept) == 0
            assert tally.removed == 30_000 - tally.far


@pytest.mark.parametrize("lattice", [0.05, 0.1, 0.13])
@pytest.mark.parametrize("slope_deg", [22.0, 30.0, 33.0, 38.0, 45.0, 60.0])
def test_a_steeper_plane_is_an_object_when_it_climbs_by_the_threshold(whole, slope_deg, lattice):
    across = np.arange(0.01, 0.5, lattice)
    x, y = (v.ravel() for v in np.meshgrid(across, across))
    climb = (across[-1] - across[0]) * (math.tan(math.radians(slope_deg)) - math.tan(math.radians(22.0)))
    kept, _ = whole.apply(cloud_of(x, y, math.tan(math.radians(slope_deg)) * x))
    assert abs(climb - CONFIG.height_threshold) > 1e-3
    assert len(kept) == (len(x) if climb > CONFIG.height_threshold else 0)


@pytest.mark.parametrize(("height", "stays"), [(0.05, False), (0.099, False), (0.101, True), (1.0, True)])
def test_a_step_is_an_object_from_the_threshold_on(ground_filter, height, stays):
    kept, _ = ground_filter.apply(cloud_of(10.1, -5.2, [0.3, 0.3 + height]))
    assert len(kept) == (2 if stays else 0)


@pytest.mark.parametrize("threshold", [0, 1, 5])
def test_a_cell_needs_more_points_than_the_threshold(threshold):
    ground_filter = GroundFilter(GroundConfig(points_threshold=threshold, foot_points=100))
    for count in (threshold, threshold + 1):
        kept, _ = ground_filter.apply(cloud_of(1.2, 1.2, np.linspace(0.0, 1.0, max(count, 1))))
        assert len(kept) == (count if count > threshold and count > 1 else 0)


@pytest.mark.parametrize("count", [3, 4, 5, 40])
def test_an_object_of_many_points_loses_those_at_its_foot(count):
    heights = np.linspace(0.0, 1.0, count)
    kept, tally = GroundFilter(CONFIG).apply(cloud_of(3.2, -7.1, heights))
    stays = heights if count <= CONFIG.foot_points else heights[heights > CONFIG.height_threshold]
    assert kept[:, 2] == pytest.approx(stays)
    assert (tally.kept, tally.removed) == (len(stays), count - len(stays))


def test_the_road_beside_a_wall_goes_with_the_foot():
    """On a bank of 20 degrees across the wall, with the wall on the upper side and on the lower."""
    climb = math.tan(math.radians(20.0))
    for side in (1.0, -1.0):
        away = np.tile(np.linspace(0.02, 0.42, 9), 5)
        road = cloud_of(20.03 + away, np.repeat(np.linspace(0.05, 0.45, 5), 9), side * climb * away)
        wall = cloud_of(20.01, np.linspace(0.05, 0.45, 5).repeat(4), np.tile([0.3, 0.5, 0.7, 0.9], 5))
        kept, _ = GroundFilter(CONFIG).apply(np.concatenate((road, wall)))
        assert as_set(kept) == as_set(wall)


def test_a_box_on_a_banked_road_stays_and_the_road_goes(whole):
    rng = np.random.default_rng(SEED)
    road = plane(rng, 50_000, 20.0, 1.0)
    climb = math.tan(math.radians(20.0))
    side = rng.uniform(0.0, 1.0, (400, 2))
    x, y = 20.2 + 0.1 * side[:, 0], 5.0 + 3.0 * side[:, 0]
    z = climb * (x * math.cos(1.0) + y * math.sin(1.0)) + side[:, 1]
    kept, _ = whole.apply(np.concatenate((road, cloud_of(x, y, z))))
    assert set(as_set(cloud_of(x, y, z))) <= set(as_set(kept))
    others = kept[np.abs(kept[:, 0] - 20.25) > 0.5]
    assert len(others) == 0


@pytest.mark.parametrize("number", range(6))
def test_anything_is_filtered_as_by_the_plain_implementation(ground_filter, number):
    print("seed", SEED + number)
    rng = np.random.default_rng(SEED + number)
    spread = rng.choice([2.0, 8.0, 120.0])
    cloud = rng.uniform(-spread, spread, (4000, 3)).astype(np.float32)
    cloud[:, 2] *= rng.choice([0.01, 0.05])
    cloud[::3] = np.round(cloud[::3] * 16) / 16  # equal heights and places
    kept, tally = ground_filter.apply(cloud)
    assert 0 < tally.kept < len(cloud)
    assert as_set(kept) == reference(cloud, ground_filter.config)


def test_the_order_of_points_does_not_matter_and_stays(ground_filter):
    rng = np.random.default_rng(SEED)
    cloud = np.unique(np.round(rng.uniform(-20.0, 20.0, (3000, 3)) * [8, 8, 0.4]).astype(np.float32) / 8, axis=0)
    stays = set(as_set(ground_filter.apply(cloud)[0]))
    assert 0 < len(stays) < len(cloud)
    for _ in range(5):
        shuffled = cloud[rng.permutation(len(cloud))]
        kept, _ = ground_filter.apply(shuffled)
        assert list(map(tuple, kept.tolist())) == [row for row in map(tuple, shuffled.tolist()) if row in stays]


def test_moving_by_cells_and_turning_by_quarters_changes_nothing(ground_filter):
    rng = np.random.default_rng(SEED)
    cloud = (np.round(rng.uniform(-20.0, 20.0, (3000, 3)) * [64, 64, 3.2]) / 64).astype(np.float32)
    cloud[:, :2] += np.float32(1 / 128)  # off the edges of cells
    kept, _ = ground_filter.apply(cloud)
    assert 0 < len(kept) < len(cloud)
    moved, _ = ground_filter.apply(cloud + np.float32([7.5, -31.0, 2.0]))
    assert (moved == kept + np.float32([7.5, -31.0, 2.0])).all()
    # Ties of height are broken by x, then y, which a turn changes; without ties it must not.
    single = cloud[np.sort(np.unique(cloud[:, 2], return_index=True)[1])]
    single = np.repeat(single, 2, axis=0) + np.tile(np.float32([[0, 0, 0], [0, 0, 0.2]]), (len(single), 1))
    kept, _ = ground_filter.apply(single)
    turned, _ = ground_filter.apply(np.ascontiguousarray(single[:, [1, 0, 2]] * np.float32([-1, 1, 1])))
    assert (turned == kept[:, [1, 0, 2]] * np.float32([-1, 1, 1])).all()


def test_what_is_not_finite_or_far_is_dropped_and_counted(ground_filter):
    rng = np.random.default_rng(SEED)
    cloud = rng.uniform(-2.0, 2.0, (500, 3)).astype(np.float32)
    clean, before = ground_filter.apply(cloud)
    mixed, far, not_finite = spoilt(rng, cloud)
    kept, tally = ground_filter.apply(mixed)
    assert (kept == clean).all()
    assert (tally.far, tally.not_finite) == (far, not_finite)
    assert (tally.kept, tally.removed) == (before.kept, before.removed)
    assert tally.kept + tally.removed + tally.far + tally.not_finite == len(mixed)


def test_the_edge_of_the_range_is_in_the_grid(ground_filter):
    edge = np.nextafter(np.float32(128.0), np.float32(0.0))
    corners = [cloud_of(sx * edge, sy * edge, [0.0, 1.0]) for sx in (-1, 1) for sy in (-1, 1)]
    kept, _ = ground_filter.apply(np.concatenate(corners))
    assert len(kept) == 8


def test_a_scan_leaves_nothing_behind(ground_filter):
    rng = np.random.default_rng(SEED)
    one, other = rng.uniform(-9.0, 9.0, (2, 2000, 3)).astype(np.float32)
    first, _ = ground_filter.apply(one)
    ground_filter.apply(other)
    again, _ = ground_filter.apply(one)
    fresh, _ = GroundFilter(ground_filter.config).apply(one)
    assert (first == again).all()
    assert (first == fresh).all()


def test_the_result_may_take_the_place_of_the_cloud(ground_filter):
    cloud = np.random.default_rng(SEED).uniform(-9.0, 9.0, (2000, 3)).astype(np.float32)
    apart, _ = ground_filter.apply(cloud)
    room = cloud.copy()
    kept, _ = ground_filter.apply(room, out=room)
    assert np.shares_memory(kept, room)
    assert (kept == apart).all()
    with pytest.raises(ValueError, match="room for 2000 points"):
        ground_filter.apply(cloud, out=room[:10])


def test_a_full_cloud_passes_and_a_fuller_one_is_refused(ground_filter):
    cloud = np.zeros((POINTS_MAX, 3), dtype=np.float32)
    assert ground_filter.apply(cloud)[1].removed == POINTS_MAX
    assert ground_filter.apply(cloud[:0])[1].kept == 0
    with pytest.raises(ValueError, match="TOO_MANY_POINTS"):
        ground_filter.apply(np.zeros((POINTS_MAX + 1, 3), dtype=np.float32))
    with pytest.raises(ValueError, match="NOT_FLOAT32"):
        ground_filter.apply(np.zeros((4, 3)))


@pytest.mark.parametrize(
    ("wrong", "allowed"),
    [
        ({"cell_size": 0.4}, "must be 0.5 to 128 m"),
        ({"cell_size": math.nan}, "must be 0.5 to 128 m"),
        ({"points_threshold": -1}, "must be 0 to"),
        ({"foot_points": POINTS_MAX + 1}, "must be 0 to"),
        ({"height_threshold": 0.0}, "must be above 0"),
        ({"slope_max_deg": 90.0}, "must be 0 to 80"),
    ],
)
def test_wrong_thresholds_are_refused(wrong, allowed):
    with pytest.raises(ValueError, match=allowed):
        GroundConfig(**wrong)
