"""Fusion of LiDAR and radar objects: assignment against every permutation, what is kept, and every bad input."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from autonomy.detection.cloud import Pose
from autonomy.detection.detector import Detector
from autonomy.detection.fusion import (
    Fused,
    Fusion,
    FusionConfig,
    SensorObjects,
    SourceStatus,
    assign,
    mahalanobis2,
    moved,
    scan_of,
)
from autonomy.detection.road_objects import (
    ROAD_OBJECT_DTYPE,
    LidarBelief,
    RoadObjects,
    Sensor,
    lidar_objects,
    no_objects,
    turned,
)
from autonomy.frenet import FloatArray
from autonomy.opponents.imm_pdaf import SensorModel
from autonomy.opponents.tracker import OpponentTracker, ScanStatus
from autonomy.track_files import load_track
from tools.lidar_scene import LidarScene

SEED = 99
CONFIG = FusionConfig()
TRACK = load_track(Path(__file__).parents[2] / "scenarios" / "tracks" / "lvms.yaml")


def objects(*places: tuple[float, float], sensor: Sensor, std: float, confidence: float = 0.8) -> RoadObjects:
    found = no_objects(len(places))
    if places:
        found["x"], found["y"] = np.array(places, dtype=float).T
    found["covariance"], found["confidence"], found["sensors"] = std**2 * np.eye(2), confidence, sensor
    if sensor is Sensor.RADAR:
        found["range_rate"], found["ground_rate"], found["rate_std"] = -10.0, 50.0, 0.12
        found["radar_track"] = np.arange(1, len(places) + 1)
    found["range"] = np.hypot(found["x"], found["y"])
    return found


def seen(*places: tuple[float, float], std: float = 0.3) -> RoadObjects:
    return objects(*places, sensor=Sensor.LIDAR, std=std)


def heard(*places: tuple[float, float], std: float = 1.8) -> RoadObjects:
    return objects(*places, sensor=Sensor.RADAR, std=std, confidence=0.5)


def fuse(lidar: RoadObjects | None, radar: RoadObjects | None) -> Fused:
    """Both at the time of the step."""
    return Fusion().step(0, *(None if each is None else SensorObjects(0, each) for each in (lidar, radar)))


# --- assignment


def best_by_trying(distance2: FloatArray, gate: float) -> float:
    """Largest sum of (gate - distance) over every way to pair rows with columns, or to leave them apart."""
    rows, columns = distance2.shape
    if rows > columns:
        return best_by_trying(distance2.T, gate)
    best = 0.0
    for choice in itertools.permutations(range(columns + rows), rows):  # beyond the columns: apart
        total = sum(gate - distance2[row, column] for row, column in enumerate(choice) if column < columns)
        best = max(best, float(total))
    return best


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (4, 1), (2, 3), (3, 2), (3, 3), (4, 3), (4, 4)])
def test_assignment_against_every_permutation(shape: tuple[int, int]) -> None:
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    for _ in range(40):
        distance2 = generator.exponential(8.0, shape)
        rows, columns = assign(distance2, CONFIG.gate)
        assert len(set(rows.tolist())) == len(rows) == len(set(columns.tolist()))
        assert (np.diff(rows) > 0).all()
        assert (distance2[rows, columns] < CONFIG.gate).all()
        got = float((CONFIG.gate - distance2[rows, columns]).sum())
        assert got == pytest.approx(best_by_trying(distance2, CONFIG.gate))


def test_the_nearest_pair_is_not_always_the_best() -> None:
    """Greedy would take 1 and leave 100: global takes 2 and 3."""
    rows, columns = assign(np.array([[1.0, 2.0], [3.0, 100.0]]), 9.0)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 1), (1, 0)]


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0)])
def test_nothing_to_assign(shape: tuple[int, int]) -> None:
    rows, columns = assign(np.empty(shape), 9.0)
    assert len(rows) == len(columns) == 0


def test_beyond_the_gate_nothing_is_paired() -> None:
    rows, _ = assign(np.full((3, 3), CONFIG.gate), CONFIG.gate)
    assert len(rows) == 0
    rows, _ = assign(np.full((3, 3), np.inf), CONFIG.gate)
    assert len(rows) == 0


def test_the_distance_is_mahalanobis() -> None:
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    one, two = seen(*generator.uniform(-5, 5, (4, 2)).tolist()), heard(*generator.uniform(-5, 5, (3, 2)).tolist())
    for each in (one, two):
        factor = generator.normal(size=(len(each), 2, 2))
        each["covariance"] = factor @ factor.transpose(0, 2, 1) + 0.1 * np.eye(2)
    for (i, a), (j, b) in itertools.product(enumerate(one), enumerate(two)):
        off = np.array((a["x"] - b["x"], a["y"] - b["y"]))
        expected = off @ np.linalg.inv(a["covariance"] + b["covariance"]) @ off
        assert mahalanobis2(one, two)[i, j] == pytest.approx(expected)


def test_the_gate_holds_what_it_says() -> None:
    assert pytest.approx(stats.chi2(2).ppf(CONFIG.gate_probability)) == CONFIG.gate
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    trials, together = 2000, 0
    for _ in range(trials):
        off = generator.normal(0.0, math.hypot(0.3, 1.8), 2)
        together += len(fuse(seen((50.0, 0.0)), heard((50.0 + off[0], off[1]))).objects) == 1
    assert stats.binomtest(together, trials, CONFIG.gate_probability).pvalue > 1e-4


# --- what comes out


def test_the_lidar_says_where_and_the_radar_how_fast() -> None:
    lidar, radar = seen((50.0, 1.0)), heard((52.0, 0.0))
    (both,) = fuse(lidar, radar).objects
    for name in ("x", "y", "yaw", "length", "width", "range"):
        assert both[name] == lidar[0][name]
    assert (both["covariance"] == lidar[0]["covariance"]).all()
    for name in ("range_rate", "ground_rate", "rate_std", "radar_track"):
        assert both[name] == radar[0][name]
    assert both["sensors"] == Sensor.LIDAR | Sensor.RADAR
    assert both["confidence"] == pytest.approx(1.0 - 0.2 * 0.5)


def test_each_pair_has_the_rate_of_its_own_radar_object() -> None:
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    order = generator.permutation(20)
    lidar = seen(*((30.0 * k, 0.0) for k in range(20)))
    radar = heard(*((30.0 * k + 1.0, 0.5) for k in order.tolist()))
    radar["range_rate"] = -order
    radar["confidence"] = 0.01 * order
    fused = fuse(lidar, radar).objects
    assert len(fused) == 20
    assert fused["range_rate"].tolist() == [-k for k in range(20)]
    assert fused["radar_track"].tolist() == (np.argsort(order) + 1).tolist()
    assert fused["confidence"] == pytest.approx(1.0 - 0.2 * (1.0 - 0.01 * np.arange(20)))


def test_what_only_one_of_them_has_stays_what_it_is() -> None:
    lidar, radar = seen((20.0, 0.0), (60.0, 3.0)), heard((100.0, 0.0), (60.0, 3.5))
    fused = fuse(lidar, radar).objects
    assert fused["sensors"].tolist() == [Sensor.LIDAR, Sensor.LIDAR | Sensor.RADAR, Sensor.RADAR]
    assert fused[0].tobytes() == lidar[0].tobytes()
    assert fused[2].tobytes() == radar[0].tobytes()
    assert math.isinf(fused[0]["rate_std"])


@pytest.mark.parametrize("seed", range(20))
def test_no_lidar_object_is_ever_lost_and_no_radar_object_used_twice(seed: int) -> None:
    print(f"seed {seed}")
    generator = np.random.default_rng(seed)
    count, other = generator.integers(0, 65, 2)
    spread = generator.choice([2.0, 20.0, 100.0])
    lidar = seen(*generator.uniform(-spread, spread, (count, 2)).tolist())
    radar = heard(*generator.uniform(-spread, spread, (other, 2)).tolist())
    before = lidar.tobytes(), radar.tobytes()
    fused = fuse(lidar, radar).objects
    for name in ("x", "y", "yaw", "length", "width", "range", "covariance"):
        assert (fused[name][:count] == lidar[name]).all()
    assert (fused["confidence"][:count] >= lidar["confidence"]).all()
    numbers = fused["radar_track"][fused["radar_track"] > 0]
    assert sorted(numbers.tolist()) == list(range(1, other + 1)), "each once"
    assert (fused["sensors"][count:] == Sensor.RADAR).all()
    assert (lidar.tobytes(), radar.tobytes()) == before, "what was given is not touched"


def test_one_sensor_alone() -> None:
    lidar, radar = seen((20.0, 0.0)), heard((90.0, 0.0))
    for given, alone in (
        ((lidar, None), lidar),
        ((None, radar), radar),
        ((lidar, heard()), lidar),
        ((seen(), radar), radar),
    ):
        assert fuse(*given).objects.tobytes() == alone.tobytes()
    assert fuse(None, None).objects.tobytes() == b""
    assert (fuse(None, None).lidar, fuse(None, None).radar) == (SourceStatus.MISSING, SourceStatus.MISSING)


# --- time


@pytest.mark.parametrize("later_us", [-20_000, 10_000, 40_000])
def test_the_radar_is_brought_to_the_time_of_the_lidar(later_us: int) -> None:
    """Closing at 40 m/s in a turn of 0.3 rad/s: the object as the car sees it then, in closed form."""
    radar = heard((CONFIG.mount_x + 50.0, 0.0))
    radar["range_rate"] = -40.0
    t = 1e-6 * later_us
    fused = Fusion().step(200_000, SensorObjects(150_000 + later_us, seen()), SensorObjects(150_000, radar), 0.3)
    (later,) = fused.objects
    assert fused.time_us == 150_000 + later_us
    ahead = CONFIG.mount_x + 50.0 - 40.0 * t
    assert (later["x"], later["y"]) == pytest.approx((ahead * math.cos(0.3 * t), -ahead * math.sin(0.3 * t)))
    assert later["yaw"] == pytest.approx(-0.3 * t)
    assert later["range"] == pytest.approx(radar[0]["range"] - 40.0 * t)
    grown = (0.12 * abs(t) + 0.5 * 10.0 * t * t) ** 2
    assert np.sort(np.linalg.eigvalsh(later["covariance"])) == pytest.approx([1.8**2, 1.8**2 + grown])
    back = moved(moved(radar, t, 0.3, CONFIG), -t, 0.3, CONFIG)
    assert (back["x"][0], back["y"][0]) == pytest.approx((radar["x"][0], radar["y"][0]), abs=0.02)


def test_scans_out_of_order_stale_or_of_the_future_are_left_out() -> None:
    fusion = Fusion()

    def step(now_us: int, lidar_us: int, radar_us: int) -> tuple[str, str, list[int]]:
        fused = fusion.step(
            now_us, SensorObjects(lidar_us, seen((20.0, 0.0))), SensorObjects(radar_us, heard((90.0, 0.0)))
        )
        return fused.lidar.name, fused.radar.name, fused.objects["sensors"].tolist()

    assert step(1_000_000, 1_000_000, 990_000) == ("USED", "USED", [1, 2])
    assert step(1_050_000, 1_000_000, 1_040_000) == ("OUT_OF_ORDER", "USED", [2])
    assert step(1_100_000, 1_100_000, 1_030_000) == ("USED", "OUT_OF_ORDER", [1])
    assert step(1_150_000, 1_150_001, 1_049_999) == ("FROM_THE_FUTURE", "STALE", [])
    assert step(1_150_000, 1_150_000, 1_050_000) == ("USED", "USED", [1, 2]), "what was refused left no trace"


# --- bad input


@pytest.mark.parametrize(
    "wrong", [None, "objects", [1.0], np.zeros(3), np.zeros((1, 1), dtype=ROAD_OBJECT_DTYPE), no_objects(65)]
)
def test_what_is_no_array_of_objects(wrong: object) -> None:
    good, bad = SensorObjects(0, seen((20.0, 0.0))), SensorObjects(0, wrong)  # type: ignore[arg-type]
    fused = Fusion().step(0, good, bad)
    assert (fused.lidar, fused.radar, len(fused.objects)) == (SourceStatus.USED, SourceStatus.MALFORMED, 1)
    fused = Fusion().step(0, bad, good)
    assert (fused.lidar, fused.radar, len(fused.objects)) == (SourceStatus.MALFORMED, SourceStatus.USED, 1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *itertools.product(
            ("x", "y", "yaw", "length", "range", "range_rate", "confidence"), (math.nan, -math.inf, 1e300)
        ),
        *(("rate_std", value) for value in (math.nan, -math.inf, 0.0)),
    ],
)
def test_an_object_of_numbers_that_are_none_goes_and_the_others_stay(name: str, value: float) -> None:
    for sensor in (seen, heard):
        found = sensor((20.0, 0.0), (40.0, 0.0))
        found[name][0] = value
        pair = (found, heard((40.0, 0.0))) if sensor is seen else (seen((40.0, 0.0)), found)
        fused = fuse(*pair)
        assert SourceStatus.PARTLY_USED in (fused.lidar, fused.radar)
        assert fused.objects["x"].tolist() == [40.0]


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((2, 2)),
        np.diag([1.0, -1.0]),
        np.array([[1.0, 2.0], [2.0, 1.0]]),
        np.full((2, 2), math.nan),
        np.diag([1.0, math.inf]),
        np.diag([1e-300, 1e-300]),
    ],
)
def test_a_covariance_that_is_none(covariance: FloatArray) -> None:
    lidar = seen((20.0, 0.0), (40.0, 0.0))
    lidar["covariance"][0] = covariance
    fused = fuse(lidar, heard((40.0, 0.0)))
    assert (fused.lidar, fused.objects["x"].tolist()) == (SourceStatus.PARTLY_USED, [40.0])


def test_a_covariance_off_symmetry_by_rounding_is_one() -> None:
    lidar = seen((20.0, 0.0))
    lidar["covariance"][0] = turned(np.array([0.7]), np.array([[0.3, 2.0]]))[0] + [[0.0, 1e-15], [0.0, 0.0]]
    assert fuse(lidar, None).lidar is SourceStatus.USED


def test_no_numbers_make_it_raise() -> None:
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    partly = 0
    for _ in range(300):
        raw = generator.integers(0, 256, (2, generator.integers(0, 20), ROAD_OBJECT_DTYPE.itemsize), dtype=np.uint8)
        given = [each.reshape(-1).view(ROAD_OBJECT_DTYPE).copy() for each in raw]
        for each in given:
            each["covariance"] = generator.choice([1.0, 1e-12, 1e6], (len(each), 1, 1)) * np.eye(2)
            for name in ("x", "y", "yaw", "length", "width", "range", "range_rate", "ground_rate", "confidence"):
                usual = generator.random(len(each)) < 0.95
                each[name] = np.where(usual, generator.uniform(-1.0, 1.0, len(each)), each[name])
            each["rate_std"] = generator.choice([1.0, 1e300, math.inf], len(each))
        fused = Fusion().step(
            20_000, *(SensorObjects(t, each) for t, each in zip((10_000, 0), given, strict=True)), math.nan
        )
        partly += fused.lidar is SourceStatus.PARTLY_USED
        assert np.isfinite(fused.objects["x"]).all()
    assert partly > 50


# --- from LiDAR scans, and on to the tracker


def test_lidar_objects_say_how_well_they_are_known() -> None:
    """On scans by ray casting: in the order of the detector, variance larger where less of the car is seen."""
    scan = LidarScene(TRACK).scan(100.0, 0.0, [(120.0, 2.0), (145.0, -2.0)], SEED)
    found = Detector(TRACK).step(scan.cloud, scan.pose)
    objects_ = lidar_objects(found)
    assert len(objects_) == len(found.objects) >= 2
    belief = LidarBelief()
    for car, there in zip(scan.cars, objects_, strict=False):
        off = np.array((there["x"], there["y"])) - car[:2]
        assert float(off @ np.linalg.solve(there["covariance"], off)) < CONFIG.gate
        along = np.array((math.cos(there["yaw"]), math.sin(there["yaw"])))
        missing = max(4.9 - float(there["length"]), 0.0)
        assert along @ there["covariance"] @ along == pytest.approx(belief.deviation**2 + missing**2 / 12.0)
        assert (there["sensors"], there["confidence"]) == (Sensor.LIDAR, belief.confidence)
        assert math.isinf(there["rate_std"])
    empty = lidar_objects(Detector(TRACK).step(np.empty((0, 3), dtype=np.float32), scan.pose))
    assert (empty.dtype, len(empty)) == (ROAD_OBJECT_DTYPE, 0)


def test_the_tracker_takes_what_comes_out() -> None:
    """A car ahead on the road, first within reach of both, then of the radar alone."""
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    tracker, fusion = OpponentTracker(), Fusion()
    model = SensorModel("fused", detection_probability=0.9, clutter_density=1.0e-5)
    yaw = 0.4
    for k in range(1, 60):
        now = 50_000 * k
        own, car = 60.0 * 0.05 * k, 60.0 + 62.0 * 0.05 * k  # along the heading
        off = generator.normal(0.0, 1.0, (2, 2))
        lidar = seen((car - own + 0.3 * off[0, 0], 0.3 * off[0, 1])) if k < 30 else seen()
        radar = heard((car - own + 1.0 * off[1, 0], 1.0 * off[1, 1]), std=1.0)
        fused = fusion.step(now, SensorObjects(now, lidar), SensorObjects(now, radar))
        scan = scan_of(fused, Pose(own * math.cos(yaw), own * math.sin(yaw), yaw))
        assert tracker.update(now, scan, model) is ScanStatus.USED
    (followed,) = tracker.objects(50_000 * 59)
    at = 60.0 + 62.0 * 0.05 * 59
    assert math.hypot(followed.x - at * math.cos(yaw), followed.y - at * math.sin(yaw)) < 2.0
    assert math.hypot(followed.vx, followed.vy) == pytest.approx(62.0, abs=5.0)
