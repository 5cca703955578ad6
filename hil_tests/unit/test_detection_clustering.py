"""Clustering against scipy: single linkage, and components of the graph of all pairs."""

import math

import numpy as np
import pytest
from point_clouds import cloud_of, spoilt
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist

from autonomy._native import ffi, lib
from autonomy.detection.cloud import POINTS_MAX, DetectionStatus
from autonomy.detection.clustering import OBJECT_DTYPE, OUTLIER, Clustering, ClusteringConfig

SEED = 20261130
ROUND = ClusteringConfig(link_distance=0.8, points_min=3, join_along=1.5, join_across=1.5)


@pytest.fixture(scope="module")
def space():
    return ffi.new("connectivity *")


@pytest.fixture(scope="module")
def clustering():
    return Clustering()


def components(space, cloud, along, across):
    found = np.empty(len(cloud), dtype=np.uint32)
    count = lib.connectivity_find(
        space,
        ffi.from_buffer("cloud_point[]", cloud),
        len(cloud),
        along,
        across,
        ffi.from_buffer("uint32_t[]", found),
    )
    assert count > 0
    assert set(found.tolist()) == set(range(count))
    return found


def all_pairs(cloud, along, across):
    """Components of the graph of all pairs, by the same float32 operations, so the same to the bit."""
    x, y = cloud[:, 0] * (np.float32(across) / np.float32(along)), cloud[:, 1]
    dx, dy = x[:, None] - x[None, :], y[:, None] - y[None, :]
    linked = dx * dx + dy * dy <= np.float32(across) * np.float32(across)
    return connected_components(csr_array(linked), directed=False)[1]


def same_partition(one, other):
    pairs = set(zip(one.tolist(), other.tolist(), strict=True))
    return len(pairs) == len(set(one.tolist())) == len(set(other.tolist()))


def clumps(rng, count, spread=40.0, size=0.6):
    middles = rng.uniform(-spread, spread, (max(count // 25, 1), 2))
    xy = middles[rng.integers(0, len(middles), count)] + rng.normal(0.0, size, (count, 2))
    return cloud_of(xy[:, 0], xy[:, 1], rng.uniform(0.0, 1.0, count))


def rings(rng):
    angle = rng.uniform(0.0, 2.0 * math.pi, 1200)
    radius = rng.integers(1, 9, 1200) * 0.81 + rng.normal(0.0, 0.01, 1200)
    return cloud_of(radius * np.cos(angle), radius * np.sin(angle), 0.0)


SHAPES = {
    "uniform": lambda rng: cloud_of(*rng.uniform(-18.0, 18.0, (3, 1200))),
    "sparse": lambda rng: cloud_of(*rng.uniform(-120.0, 120.0, (3, 1200))),
    "clumps": lambda rng: clumps(rng, 1200),
    "tight clumps": lambda rng: clumps(rng, 1200, size=0.05),
    "rings": rings,
    "lattice at the limit": lambda rng: cloud_of(*(rng.integers(-15, 15, (2, 900)) * np.float32(0.8)), 0.0),
    "lattice": lambda rng: cloud_of(*(rng.integers(-60, 60, (2, 1200)) * 0.25), 0.0),
    "line": lambda rng: cloud_of(np.arange(1000) * 0.2 - 100.0, rng.normal(0.0, 0.35, 1000), 0.0),
    "duplicates": lambda rng: np.repeat(cloud_of(*rng.uniform(-6.0, 6.0, (3, 40))), 30, axis=0),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("along", "across"), [(0.2, 0.2), (0.8, 0.8), (1.5, 1.5), (3.0, 1.0), (30.0, 0.5), (128, 128)])
def test_components_are_those_of_all_pairs(space, shape, along, across):
    print("seed", SEED)
    cloud = SHAPES[shape](np.random.default_rng(SEED))
    assert same_partition(components(space, cloud, along, across), all_pairs(cloud, along, across))


@pytest.mark.parametrize("number", range(8))
def test_components_are_those_of_single_linkage(space, number):
    print("seed", SEED + number)
    cloud = clumps(np.random.default_rng(SEED + number), 600)
    xy = cloud[:, :2].astype(float)
    merges = linkage(xy, method="single")
    gaps = np.abs(merges[:, 2] - 0.8)
    assert gaps.min() > 1e-5  # no link is within rounding of the limit
    expected = fcluster(merges, 0.8, criterion="distance")
    assert 5 < expected.max() < 500
    assert same_partition(components(space, cloud, 0.8, 0.8), expected)


def test_points_at_the_edges_of_the_range_are_linked(space):
    edge = np.nextafter(np.float32(128.0), np.float32(0.0))
    for sx in (-1, 1):
        for sy in (-1, 1):
            cloud = cloud_of([sx * edge, sx * (edge - 0.19), -sx * edge], [sy * edge, sy * edge, sy * edge], 0.0)
            found = components(space, cloud, 0.2, 0.2)
            assert found[0] == found[1] != found[2]


def test_components_are_numbered_by_y_then_x(space):
    cloud = cloud_of([5.0, -5.0, 5.0, -5.0], [5.0, 5.0, -5.0, -5.0], 0.0)
    assert components(space, cloud, 1.0, 1.0).tolist() == [3, 2, 1, 0]


# --- both steps ---


def two_steps(cloud, config):
    """Labels by the graph of all pairs: components with enough points, then components of what is left."""
    first = all_pairs(cloud, config.link_distance, config.link_distance)
    stays = np.bincount(first)[first] >= config.points_min
    labels = np.full(len(cloud), OUTLIER)
    if stays.any():
        labels[stays] = all_pairs(cloud[stays], config.join_along, config.join_across)
    return labels


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("config", [ClusteringConfig(), ROUND, ClusteringConfig(0.5, 10, 20.0, 2.0)])
def test_objects_are_what_the_two_steps_leave(shape, config):
    cloud = SHAPES[shape](np.random.default_rng(SEED))
    found = Clustering(config).apply(cloud)
    expected = two_steps(cloud, config)
    count = len(set(expected.tolist()) - {OUTLIER})
    assert found.status is (
        DetectionStatus.OK if count <= lib.CLUSTERS_OBJECTS_MAX else DetectionStatus.TOO_MANY_OBJECTS
    )
    assert len(found.objects) == min(count, lib.CLUSTERS_OBJECTS_MAX)
    if found.status is DetectionStatus.OK:
        assert ((found.labels == OUTLIER) == (expected == OUTLIER)).all()
        assert same_partition(found.labels, expected)
    distance = np.hypot(cloud[:, 0], cloud[:, 1])
    for number, seen in enumerate(found.objects):
        members = cloud[found.labels == number]
        assert seen["points"] == len(members)
        assert (seen["z_low"], seen["z_high"]) == (members[:, 2].min(), members[:, 2].max())
        assert seen["range"] == pytest.approx(distance[found.labels == number].min(), rel=1e-6)
    assert (np.diff(found.objects["range"]) >= 0.0).all()
    assert found.tally.kept == np.count_nonzero(found.labels >= 0)
    assert found.tally.kept + found.tally.removed == len(cloud)


def test_the_nearest_stay_when_objects_are_too_many(clustering):
    side = np.arange(-9.0, 10.0, 2.0) * 10.0
    x, y = (v.ravel() + 0.3 for v in np.meshgrid(side, side))
    cloud = np.repeat(cloud_of(x, y, 0.0), 3, axis=0)
    found = clustering.apply(cloud)
    assert found.status is DetectionStatus.TOO_MANY_OBJECTS
    nearest = np.sort(np.hypot(x, y))[: lib.CLUSTERS_OBJECTS_MAX]
    assert found.objects["range"] == pytest.approx(nearest, rel=1e-6)
    assert found.tally.kept == 3 * lib.CLUSTERS_OBJECTS_MAX


def test_an_outlier_does_not_bridge_two_objects(clustering):
    one, other = cloud_of(10.0, [0.0, 0.1, 0.2], 0.5), cloud_of(10.0, [1.6, 1.7, 1.8], 0.5)
    between = cloud_of(10.0, 0.9, 0.5)
    assert len(clustering.apply(np.concatenate((one, other))).objects) == 2
    # Within the first distance it is no outlier but a link; with both gaps longer it is dropped.
    assert len(clustering.apply(np.concatenate((one, between, other))).objects) == 1
    apart = np.concatenate((one, cloud_of(10.0, 1.1, 0.5), other + np.float32([0, 0.4, 0])))
    found = clustering.apply(apart)
    assert found.labels.tolist() == [0, 0, 0, OUTLIER, 1, 1, 1]


def test_parts_of_a_car_are_joined_and_cars_beside_each_other_are_not(clustering):
    rear, nose = cloud_of(10.0, [-0.7, 0.0, 0.7], 0.5), cloud_of(12.9, [-0.7, 0.0, 0.7], 0.2)
    beside = cloud_of(10.0, [1.8, 2.4, 3.0], 0.5)
    found = clustering.apply(np.concatenate((rear, nose, beside)))
    assert found.labels.tolist() == [0] * 6 + [1] * 3


def test_the_order_of_points_does_not_matter(clustering):
    rng = np.random.default_rng(SEED)
    for shape in ("clumps", "lattice", "line"):
        cloud = SHAPES[shape](rng)
        found = clustering.apply(cloud)
        for _ in range(4):
            shuffle = rng.permutation(len(cloud))
            again = clustering.apply(cloud[shuffle])
            assert again.objects.tobytes() == found.objects.tobytes()
            assert (again.labels == found.labels[shuffle]).all()


@pytest.mark.parametrize("angle", [0.3, 1.2, 2.9])
def test_turning_and_moving_the_cloud_turns_and_moves_the_objects(angle):
    clustering = Clustering(ROUND)
    cloud = clumps(np.random.default_rng(SEED), 500, spread=30.0)
    lengths = pdist(cloud[:, :2].astype(float))
    assert min(np.abs(lengths - limit).min() for limit in (0.8, 1.5)) > 1e-6
    c, s = math.cos(angle), math.sin(angle)
    moved = cloud.astype(float) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [14.0, -9.0, 0.5]
    one, other = clustering.apply(cloud), clustering.apply(moved.astype(np.float32))
    assert len(one.objects) > 3
    assert same_partition(one.labels, other.labels)
    partner = {int(a): int(b) for a, b in zip(one.labels, other.labels, strict=True)}
    for number, seen in enumerate(one.objects):
        match = other.objects[partner[number]]
        assert match["length"] + match["width"] == pytest.approx(seen["length"] + seen["width"], abs=1e-3)
        assert match["points"] == seen["points"]
        assert match["z_high"] == pytest.approx(seen["z_high"] + 0.5, abs=1e-5)


def test_what_is_not_finite_or_far_is_dropped_and_counted(clustering):
    rng = np.random.default_rng(SEED)
    cloud = clumps(rng, 400)
    clean = clustering.apply(cloud)
    mixed, far, not_finite = spoilt(rng, cloud)
    found = clustering.apply(mixed)
    assert found.objects.tobytes() == clean.objects.tobytes()
    assert (found.tally.far, found.tally.not_finite) == (far, not_finite)
    good = np.isfinite(mixed).all(axis=1) & (np.abs(np.nan_to_num(mixed, posinf=999, neginf=999)) < 128).all(axis=1)
    assert (found.labels[good] == clean.labels).all()
    assert (found.labels[~good] == OUTLIER).all()


def stubborn(count):
    """Two cells whose boxes are near while their points are not, so that all pairs have to be tried."""
    one = cloud_of(*np.array([[0.1, 0.555, 0.0]] * count + [[0.5, 0.02, 0.0]]).T)
    other = cloud_of(*np.array([[1.05, 1.13, 0.0]] * count + [[0.57, 1.67, 0.0]]).T)
    return np.concatenate((one, other))


def test_what_would_take_too_long_is_refused(clustering):
    config = ClusteringConfig(0.8, 3, 0.8, 0.8)
    cloud = stubborn(2000)
    found = Clustering(config).apply(cloud)
    assert found.status is DetectionStatus.OK
    assert same_partition(found.labels, two_steps(cloud, config))
    crowd = stubborn(3000)
    found = clustering.apply(crowd)
    assert found.status is DetectionStatus.TOO_DENSE
    assert (len(found.objects), found.tally.kept, found.tally.removed) == (0, 0, len(crowd))
    assert (found.labels == OUTLIER).all()
    # The next scan is not the worse for it.
    assert clustering.apply(cloud_of(5.0, [0.0, 0.1, 0.2], 0.0)).status is DetectionStatus.OK


def test_a_full_cloud_is_clustered(clustering):
    cloud = np.random.default_rng(SEED).uniform(-100.0, 100.0, (POINTS_MAX, 3)).astype(np.float32)
    found = clustering.apply(cloud)
    assert found.status is not DetectionStatus.TOO_DENSE
    assert clustering.apply(cloud[:0]).status is DetectionStatus.OK
    crowd = np.zeros((POINTS_MAX, 3), dtype=np.float32)
    assert clustering.apply(crowd).objects["points"].tolist() == [POINTS_MAX]


def test_the_record_of_an_object_is_the_struct_in_c():
    assert ffi.sizeof("clusters_object") == OBJECT_DTYPE.itemsize
    where = {name: ffi.offsetof("clusters_object", name) for name in ("z_low", "z_high", "range", "points")}
    box = ffi.offsetof("clusters_object", "box")
    where |= {name: box + ffi.offsetof("oriented_box", name) for name in ("x", "y", "length", "width", "yaw")}
    assert where == {name: offset for name, (_, offset) in OBJECT_DTYPE.fields.items()}


@pytest.mark.parametrize(
    ("wrong", "allowed"),
    [
        ({"link_distance": 0.1}, "must be 0.2 to 128 m"),
        ({"link_distance": math.nan}, "must be 0.2 to 128 m"),
        ({"join_along": 200.0}, "must be 0.2 to 128 m"),
        ({"join_across": 5.0}, "join_across is 5; must be 0.2 to 4.5 m"),
        ({"points_min": 0}, "must be 1 to"),
    ],
)
def test_wrong_criteria_are_refused(wrong, allowed):
    with pytest.raises(ValueError, match=allowed):
        ClusteringConfig(**wrong)


def test_numbers_are_sorted_by_their_keys_and_equal_ones_stay_in_order():
    rng = np.random.default_rng(SEED)
    numbers = np.concatenate((rng.normal(0.0, 50.0, 900), rng.integers(-3, 4, 300), [0.0, -0.0, 1e-45, -1e38, 1e38]))
    numbers = rng.permutation(numbers).astype(np.float32)
    keys = np.array([lib.radix_key(number) for number in numbers.tolist()], dtype=np.uint32)
    places, scratch = np.arange(len(numbers), dtype=np.uint32), np.empty(len(numbers), dtype=np.uint32)
    lib.radix_sort(*(ffi.from_buffer("uint32_t[]", each) for each in (keys, places, scratch)), len(numbers))
    assert places.tolist() == np.argsort(numbers, kind="stable").tolist()
