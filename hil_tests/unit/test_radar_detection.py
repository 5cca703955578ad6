"""Radar tracks to objects: what is kept, what is removed and why, how well it is placed, and every bad input."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from autonomy.detection.cloud import Pose
from autonomy.detection.radar import OwnMotion, RadarConfig, RadarDetector, RadarStatus, Verdict
from autonomy.detection.road_objects import Sensor
from autonomy.frenet import Curve
from autonomy.track import Track
from autonomy.track_files import load_track
from bridge.sensors.radar import Radar, RadarErrors
from bridge.sensors.radar_scene import OtherCar, mounted
from bridge.sensors.truth import Truth
from dbc.radar_tracks import TRACK_DTYPE, TRACKS, RangeMode, Tracks, TrackStatus, on_wire, wire_limits

SEED = 4321
CONFIG = RadarConfig()
TRACK = load_track(Path(__file__).parents[2] / "scenarios" / "tracks" / "lvms.yaml")
PERIOD_US = 50_000


def circle(radius: float = 1000.0, half_width: float = 8.0) -> Track:
    """A wide left turn around the origin that starts at (radius, 0) heading along y."""
    count = 2000
    angle = 2.0 * math.pi * np.arange(count) / count
    curve = Curve(
        radius * np.cos(angle),
        radius * np.sin(angle),
        angle + 0.5 * math.pi,
        np.full(count, 1.0 / radius),
        2.0 * math.pi * radius,
    )
    flat = np.zeros(count)
    width = np.full(count, half_width)
    return Track("circle", None, curve, width_left=width, width_right=width, bank=flat, grade=flat)


CIRCLE = circle()
#: In the middle of the road of CIRCLE, in its direction.
OWN = OwnMotion(Pose(1000.0, 0.0, 0.5 * math.pi), 60.0, 0.0, 0.06)


def tracks_of(*rows: tuple[float, float, float], status: TrackStatus = TrackStatus.UPDATED) -> Tracks:
    """Tracks from range (m), angle (degrees) and range rate (m/s)."""
    tracks = np.zeros(len(rows), dtype=TRACK_DTYPE)
    tracks["id"], tracks["status"], tracks["mode"] = np.arange(1, len(rows) + 1), status, RangeMode.BOTH
    for track, (distance, angle, rate) in zip(tracks, rows, strict=True):
        track["range"], track["angle"], track["range_rate"] = distance, math.radians(angle), rate
    return tracks


def verdicts(tracks: Tracks, motion: OwnMotion = OWN, config: RadarConfig | None = None) -> list[str]:
    found = RadarDetector(CIRCLE, config).step(0, tracks, motion)
    assert found.status is RadarStatus.OK
    assert len(found.objects) == (found.verdicts == Verdict.KEPT).sum()
    return [Verdict(int(verdict)).name for verdict in found.verdicts]


def test_a_car_ahead_is_an_object() -> None:
    found = RadarDetector(CIRCLE).step(0, tracks_of((50.0, 0.0, -10.0)), OWN)
    (car,) = found.objects
    assert (car["sensors"], car["radar_track"], car["range"]) == (Sensor.RADAR, 1, 50.0)
    assert (car["range_rate"], car["ground_rate"]) == pytest.approx((-10.0, 50.0))
    assert car["rate_std"] == CONFIG.rate_std
    assert (car["length"], car["width"]) == (4.9, 1.93)
    assert car["confidence"] == CONFIG.confidence[TrackStatus.UPDATED]
    assert car["yaw"] == pytest.approx(50.0 / 1000.0, abs=2e-3)
    assert car["x"] == pytest.approx(CONFIG.mount_x + 50.0 + 2.45, abs=0.01)


# --- stationary or moving


@pytest.mark.parametrize("angle", [-40.0, -5.0, 0.0, 8.0, 30.0])
@pytest.mark.parametrize("yaw_rate", [0.0, 0.3])
def test_what_stands_is_removed_by_the_own_speed(angle: float, yaw_rate: float) -> None:
    motion = OwnMotion(OWN.pose, 60.0, -0.5, yaw_rate)
    left = -0.5 + yaw_rate * CONFIG.mount_x
    still = -60.0 * math.cos(math.radians(angle)) - left * math.sin(math.radians(angle))
    for off in (0.0, 2.9, -2.9):
        assert verdicts(tracks_of((5.0, angle, still + off)), motion) == ["STATIONARY"]
    for off in (9.0, -9.0):
        assert verdicts(tracks_of((5.0, angle, still + off)), motion) != ["STATIONARY"]


def test_the_angle_s_error_counts_where_the_sight_is_oblique() -> None:
    """At 30 degrees and 60 m/s an error of one degree is 0.52 m/s, four sigmas of it 2.1; the speed 3 m/s rules. At
    80 m/s and 45 degrees it is the angle: 3.95 m/s."""
    fast = OwnMotion(OWN.pose, 80.0, 0.0, 0.0)
    one = tracks_of((5.0, 45.0, 0.0))
    one["mode"] = RangeMode.MEDIUM_RANGE
    across = 80.0 * math.sin(math.radians(45.0)) * math.radians(1.0)
    gate = 4.0 * math.sqrt(0.12**2 + 0.1**2 + across**2)
    assert gate > 3.9
    for off, stands in ((gate - 0.01, True), (gate + 0.01, False)):
        one["range_rate"] = -80.0 * math.cos(math.radians(45.0)) + off
        assert (verdicts(one, fast) == ["STATIONARY"]) is stands


def test_a_wall_faster_than_the_wire_can_say_stands() -> None:
    slowest, _ = wire_limits("range_rate")
    fast = OwnMotion(OWN.pose, 90.0, 0.0, 0.0)
    assert verdicts(on_wire(tracks_of((50.0, 0.0, -90.0))), fast) == ["STATIONARY"]
    assert verdicts(tracks_of((50.0, 0.0, slowest)), OWN) == ["KEPT"], "it comes at us"


def test_a_rate_at_the_end_of_the_scale_says_nothing() -> None:
    found = RadarDetector(CIRCLE).step(0, on_wire(tracks_of((50.0, 0.0, -85.0), (60.0, 0.0, -30.0))), OWN)
    assert found.objects["rate_std"].tolist() == [math.inf, CONFIG.rate_std]


def test_posts_of_the_model_are_stationary_and_cars_are_not() -> None:
    """With all errors of the model, over a lap: every return of a wall, by its own key, against the verdict."""
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    errors = RadarErrors(clutter=(0.0, 0.0))
    model = Radar(TRACK.walls(), 1.247, generator, errors)
    detector = RadarDetector(TRACK)
    for k, station in enumerate(np.arange(0.0, TRACK.length, 3.0)):
        x, y, yaw = TRACK.pose_at(station, 0.0)
        yaw_rate = 60.0 * float(TRACK.centre.at(np.array(station))[3])
        own = Truth(x, y, 0.0, yaw, 60.0, 0.0, yaw_rate, *(0.0,) * 8)
        found = detector.step(PERIOD_US * (k + 1), model.scan(own), OwnMotion(Pose(x, y, yaw), 60.0, 0.0, yaw_rate))
        assert found.status in (RadarStatus.OK, RadarStatus.EMPTY)
        assert len(found.objects) == 0, "there is no other car"
    seen = detector.tracks
    print(dict(seen))
    assert seen[Verdict.STATIONARY] > 2000
    measured = seen[Verdict.STATIONARY] + seen[Verdict.OUTSIDE]
    assert stats.binomtest(seen[Verdict.OUTSIDE], measured, stats.norm.sf(4.0) * 2, alternative="greater").pvalue > 1e-4


# --- geofence


def test_a_ghost_behind_the_wall_is_removed_and_its_car_is_not() -> None:
    """A wall on the boundary, to the right; the mirrored car is as far behind it as the car is before."""
    radius, wall_at = 1000.0, 1008.0
    angle = np.linspace(0.0, 2.0 * math.pi, 1500, endpoint=False)
    wall = wall_at * np.column_stack((np.cos(angle), np.sin(angle)))
    exact = RadarErrors(half_range=1e4, clutter=(0.0, 0.0), range_white=0.0, rate_white=0.0)
    own = Truth(radius, 0.0, 0.0, 0.5 * math.pi, 60.0, 0.0, 0.06, *(0.0,) * 8)
    ahead = 40.0 / radius
    car = OtherCar(radius * math.cos(ahead), radius * math.sin(ahead), 0.5 * math.pi + ahead, 50.0)
    model = Radar([wall], 1.247, np.random.default_rng(SEED), exact)
    found = RadarDetector(CIRCLE).step(0, model.scan(own, [car]), OWN)
    moving = found.verdicts[found.verdicts != Verdict.STATIONARY]
    assert sorted(moving.tolist()) == [Verdict.KEPT, Verdict.OUTSIDE]
    (kept,) = found.objects
    assert math.hypot(kept["x"] - 40.0, kept["y"] - 0.8) < 2.0


def test_the_geofence_is_one_metre_inside_the_boundary() -> None:
    """The middle of the car, by the radius: the road is 8 m wide to each side."""
    generator = np.random.default_rng(SEED)
    rows = [(generator.uniform(20.0, 55.0), generator.uniform(-20.0, 20.0), -10.0) for _ in range(60)]
    found = RadarDetector(CIRCLE, RadarConfig(mount_x=0.0)).step(0, tracks_of(*rows), OWN)
    for (distance, angle, _), verdict in zip(rows, found.verdicts, strict=True):
        bearing = math.radians(angle)
        x, y = 1000.0 - distance * math.sin(bearing), distance * math.cos(bearing)
        # Heading of the road there, to the nearest node of 3.1 m; half a car behind the point that is seen.
        nearest = 2.0 * math.pi / 2000 * round(math.atan2(y, x) * 2000 / (2.0 * math.pi))
        middle = np.array((x, y)) + 2.45 * np.array((-math.sin(nearest), math.cos(nearest)))
        radius = math.hypot(*middle)
        if abs(abs(radius - 1000.0) - 7.0) > 0.05:
            assert verdict == (Verdict.KEPT if abs(radius - 1000.0) < 7.0 else Verdict.OUTSIDE)
    assert 10 < (found.verdicts == Verdict.KEPT).sum() < 50


# --- plausibility


def test_what_was_not_measured_is_no_object() -> None:
    for status in TrackStatus:
        one = tracks_of((50.0, 0.0, -10.0), status=status)
        measured = status in (TrackStatus.NEW, TrackStatus.NEW_UPDATED, TrackStatus.UPDATED, TrackStatus.MERGED)
        assert verdicts(one) == (["KEPT"] if measured else ["NOT_MEASURED"]), status.name


@pytest.mark.parametrize(
    "row", [(0.5, 0.0, -10.0), (204.7, 0.0, -10.0), (-5.0, 0.0, -10.0), (50.0, 52.0, -10.0), (50.0, 0.0, 70.0)]
)
def test_what_cannot_be(row: tuple[float, float, float]) -> None:
    assert verdicts(tracks_of(row, (50.0, 0.0, -10.0))) == ["IMPLAUSIBLE", "KEPT"]


@pytest.mark.parametrize("name", ["range", "angle", "range_rate"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, -1e300])
def test_numbers_that_are_none_go_and_the_others_stay(name: str, value: float) -> None:
    tracks = tracks_of((50.0, 0.0, -10.0), (60.0, 0.0, -10.0))
    tracks[name][0] = value
    (first, second) = verdicts(tracks)
    assert first == ("IMPLAUSIBLE" if math.isfinite(value) else "NOT_FINITE")
    assert second == "KEPT"


def test_all_sixty_four_may_be_valid() -> None:
    found = RadarDetector(CIRCLE).step(0, tracks_of(*((20.0 + k, 0.0, -10.0) for k in reversed(range(TRACKS)))), OWN)
    assert found.status is RadarStatus.OK
    assert (found.verdicts == Verdict.KEPT).all()
    assert (np.diff(found.objects["range"]) > 0.0).all(), "nearest first"
    assert found.objects["radar_track"].tolist() == list(range(TRACKS, 0, -1))


# --- bad input


def test_bad_input_is_refused_with_its_reason() -> None:
    good = tracks_of((50.0, 0.0, -10.0))
    twice, none, high = np.concatenate((good, good)), good.copy(), good.copy()
    none["id"], high["id"] = 0, 65
    broken = {
        name: OwnMotion(Pose(*((1000.0, 0.0, 0.5 * math.pi) if name != "pose" else (math.nan, 0.0, 0.0))), *values)
        for name, values in {
            "pose": (60.0, 0.0, 0.0),
            "vx": (math.nan, 0.0, 0.0),
            "vy": (60.0, math.inf, 0.0),
            "yaw_rate": (60.0, 0.0, math.nan),
            "speed": (1e300, 0.0, 0.0),
        }.items()
    }
    detector = RadarDetector(CIRCLE)
    assert detector.step(1000, good, OWN).status is RadarStatus.OK
    expected: list[tuple[int, object, OwnMotion, RadarStatus]] = [
        (2000, None, OWN, RadarStatus.NOT_TRACKS),
        (2000, [1, 2, 3], OWN, RadarStatus.NOT_TRACKS),
        (2000, np.zeros(3), OWN, RadarStatus.NOT_TRACKS),
        (2000, good.reshape(1, 1), OWN, RadarStatus.BAD_SHAPE),
        (2000, good[0], OWN, RadarStatus.NOT_TRACKS),
        (2000, np.zeros(65, dtype=TRACK_DTYPE), OWN, RadarStatus.TOO_MANY_TRACKS),
        (2000, twice, OWN, RadarStatus.BAD_NUMBERS),
        (2000, none, OWN, RadarStatus.BAD_NUMBERS),
        (2000, high, OWN, RadarStatus.BAD_NUMBERS),
        *((2000, good, motion, RadarStatus.BAD_MOTION) for motion in broken.values()),
        (999, good, OWN, RadarStatus.OUT_OF_ORDER),
        (1000, good, OWN, RadarStatus.OUT_OF_ORDER),
    ]
    for time_us, tracks, motion, status in expected:
        found = detector.step(time_us, tracks, motion)
        assert (found.status, len(found.objects), len(found.verdicts)) == (status, 0, 0)
    assert detector.step(1001, good[:0], OWN).status is RadarStatus.EMPTY
    assert detector.step(1002, good, OWN).status is RadarStatus.OK, "nothing that was refused has left a trace"
    assert sum(detector.scans.values()) == len(expected) + 3
    assert detector.tracks == {Verdict.KEPT: 2}


def test_no_array_makes_it_raise() -> None:
    """Random bytes as tracks: whatever a frame can hold, and what it cannot."""
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    detector = RadarDetector(CIRCLE)
    for k in range(300):
        raw = generator.integers(0, 256, (generator.integers(0, 66), TRACK_DTYPE.itemsize), dtype=np.uint8)
        raw[:, TRACK_DTYPE.fields["oncoming"][1]] &= 1  # type: ignore[index]
        tracks = raw.reshape(-1).view(TRACK_DTYPE)
        if k % 2:
            tracks["id"] = np.arange(1, len(tracks) + 1)
        found = detector.step(k, tracks, OWN)
        assert np.isfinite(found.objects["x"]).all()
        assert np.isfinite(found.objects["covariance"]).all()
    assert detector.scans[RadarStatus.OK] > 100
    assert detector.scans[RadarStatus.BAD_NUMBERS] > 100


def test_a_margin_that_leaves_nothing() -> None:
    with pytest.raises(ValueError, match="margin"):
        RadarDetector(CIRCLE, RadarConfig(margin=9.0))


# --- how well it is placed


@pytest.mark.parametrize("lateral", [0.0, 3.0])
def test_the_covariance_is_that_of_the_errors(lateral: float) -> None:
    """Normalised squared error of the middle: with two degrees of freedom it has the mean 2. The covariance also holds
    where across the car the echo came from, in which the model's nearest point does not scatter: it may be less.
    """
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    errors = RadarErrors(half_range=1e4, clutter=(0.0, 0.0))
    own = Truth(1000.0, 0.0, 0.0, 0.5 * math.pi, 60.0, 0.0, 0.06, *(0.0,) * 8)
    ahead = 50.0 / 1000.0
    radius = 1000.0 - lateral
    car = OtherCar(radius * math.cos(ahead), radius * math.sin(ahead), 0.5 * math.pi + ahead, 50.0)
    true = np.array((car.y, 1000.0 - car.x))  # in the vehicle frame
    model, detector = Radar([], 1.247, generator, errors), RadarDetector(CIRCLE)
    squares = []
    for k in range(600):
        for found in detector.step(k, model.scan(own, [car]), OWN).objects:
            off = np.array((found["x"], found["y"])) - true
            squares.append(float(off @ np.linalg.solve(found["covariance"], off)))
            assert np.linalg.eigvalsh(found["covariance"]).min() > 0.0
    assert len(squares) > 500
    mean = float(np.mean(squares))
    print(f"{lateral} m: {len(squares)} placed, mean of the normalised squared error {mean:.2f}")
    assert 1.0 < mean < stats.chi2(2 * len(squares)).ppf(0.9999) / len(squares)


@pytest.mark.parametrize(("mode", "angle_deg"), [(RangeMode.LONG_RANGE, 0.5), (RangeMode.MEDIUM_RANGE, 1.0)])
def test_the_covariance_straight_ahead_in_closed_form(mode: RangeMode, angle_deg: float) -> None:
    """Along the sight the range's; across it the angle's and half a car's width."""
    one = tracks_of((50.0, 0.0, -10.0))
    one["mode"] = mode
    (car,) = (
        RadarDetector(circle(radius=1.0e5)).step(0, one, OwnMotion(Pose(1.0e5, 0.0, 0.5 * math.pi), 60, 0, 0)).objects
    )
    across = (50.0 * math.radians(angle_deg)) ** 2 + (0.5 * 1.93) ** 2
    assert car["covariance"] == pytest.approx(np.diag([1.8**2, across]), abs=0.01)


def test_the_radar_sits_where_the_model_has_it() -> None:
    """Both sides say on their own where the radar sits; they have to agree."""
    sensor = mounted(Truth(0.0, 0.0, 0.0, 0.0, *(0.0,) * 11), 1.784 - 1.247)
    assert sensor.place == pytest.approx((CONFIG.mount_x, 0.0))
