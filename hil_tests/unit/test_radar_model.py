"""The radar model against geometry, its own statistics against their distributions, and what must never be seen."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from autonomy.track_files import load_track
from bridge.sensors.lidar import PHASE_US as LIDAR_PHASE_US
from bridge.sensors.radar import (
    MOUNT_X,
    PERIOD_US,
    PHASE_US,
    Detections,
    Key,
    Radar,
    RadarErrors,
    Scan,
    Tracker,
    coverage,
    detect,
    false_alarms,
    find_echoes,
)
from bridge.sensors.radar_scene import Floats, OtherCar, Walls, mounted, nearest_point
from bridge.sensors.truth import Truth
from dbc.radar_tracks import TRACK_DTYPE, TRACKS, RangeMode, Tracks, TrackStatus, on_wire, pack, resolution, unpack

SEED = 2011
CG_TO_REAR = 1.247
X = MOUNT_X - CG_TO_REAR
ERRORS = RadarErrors()
TRACK = load_track(Path(__file__).parents[2] / "scenarios" / "tracks" / "lvms.yaml")
#: Probability below which a correct model fails one of the statistical tests.
UNLIKELY = 1.0e-4
NO_NOISE = {"range_white": 0.0, "rate_white": 0.0, "acceleration_white": 0.0, "lateral_white": 0.0}
#: No noise, no false alarms, everything in view detected.
EXACT = RadarErrors(
    long_range=Scan(math.radians(10.0), 174.0, 0.0),
    medium_range=Scan(math.radians(45.0), 60.0, 0.0),
    half_range=1.0e4,
    clutter=(0.0, 0.0),
    **NO_NOISE,
)


def truth(
    x: float = 0.0, y: float = 0.0, yaw: float = 0.0, vx: float = 0.0, vy: float = 0.0, yaw_rate: float = 0.0
) -> Truth:
    """On flat ground, with the acceleration of a steady turn."""
    return Truth(x, y, 0.0, yaw, vx, vy, yaw_rate, 0.0, 0.0, 0.0, 0.0, -yaw_rate * vy, yaw_rate * vx, 9.8, 0.0)


def radar(walls: list[Floats], errors: RadarErrors = ERRORS, seed: int = SEED) -> Radar:
    print(f"seed {seed}")
    return Radar(walls, CG_TO_REAR, np.random.default_rng(seed), errors)


def straight_wall(y: float, low: float = -500.0, high: float = 500.0, thick: float = 50.0) -> Floats:
    """A wall along x whose near side is at y, the body of it beyond."""
    return np.array([(low, y), (high, y), (high, y + math.copysign(thick, y)), (low, y + math.copysign(thick, y))])


def at(distance: float, bearing_deg: float = 0.0, vx: float = 0.0, **more: float) -> OtherCar:
    """A point that reflects, seen by a car at the origin that heads along x."""
    angle = math.radians(bearing_deg)
    place = X + distance * math.cos(angle), distance * math.sin(angle)
    return OtherCar(*place, 0.0, vx, **({"length": 0.0, "width": 0.0} | more))


def two_sided(statistic: float, distribution: stats.rv_frozen) -> bool:
    """Whether a statistic is not in the tails."""
    return bool(0.5 * UNLIKELY < distribution.cdf(statistic) < 1.0 - 0.5 * UNLIKELY)


def test_it_scans_twenty_times_a_second_in_time_for_the_lidars() -> None:
    model = radar([])
    assert [t for t in range(0, 150_000, 10_000) if model.due(t)] == [20_000, 70_000, 120_000]
    slowest_us = 64 * 135 * 2  # bits of a frame with all stuff bits, us of a bit
    assert PHASE_US + slowest_us <= LIDAR_PHASE_US < PHASE_US + slowest_us + 10_000, "no tick earlier than need be"


# --- geometry


@pytest.mark.parametrize("seed", range(5))
def test_rates_are_derivatives_of_the_range(seed: int) -> None:
    """Own car and the other turn steadily; range and bearing by differences of positions in closed form."""
    print(f"seed {seed}")
    generator = np.random.default_rng(seed)
    vx, vy, w = generator.uniform(20, 60), generator.uniform(-1, 1), generator.uniform(-0.3, 0.3)
    speed, turn = generator.uniform(20, 60), generator.uniform(-0.3, 0.3)
    start, yaw = generator.uniform(-0.5, 0.5), generator.uniform(-3, 3)
    heading, away = yaw + generator.uniform(-0.5, 0.5), generator.uniform(20, 50)

    def steady(x: float, y: float, psi: float, forward: float, left: float, rate: float, t: float) -> Floats:
        """Place and heading after t: the integral of a velocity that turns with the car."""
        s, c = math.sin(rate * t) / rate, (1.0 - math.cos(rate * t)) / rate
        dx, dy = forward * s - left * c, forward * c + left * s
        return np.array(
            (x + math.cos(psi) * dx - math.sin(psi) * dy, y + math.sin(psi) * dx + math.cos(psi) * dy, psi + rate * t)
        )

    def seen(t: float) -> tuple[float, float]:
        own = steady(0.0, 0.0, yaw, vx, vy, w, t)
        other = steady(away * math.cos(yaw + start), away * math.sin(yaw + start), heading, speed, 0.0, turn, t)
        dx = other[:2] - own[:2] - X * np.array((math.cos(own[2]), math.sin(own[2])))
        return math.hypot(*dx), math.atan2(dx[1], dx[0])

    h = 1e-3
    before, now, after = seen(-h), seen(0.0), seen(h)
    place = away * math.cos(yaw + start), away * math.sin(yaw + start)
    car = OtherCar(*place, heading, speed, 0.0, turn, 0.0, speed * turn, length=0.0, width=0.0)
    own = truth(0.0, 0.0, yaw, vx, vy, w)
    (echo,) = find_echoes(EXACT, Walls([], 10.0), mounted(own, X), yaw, [car]).tracks
    assert echo["range"] == pytest.approx(now[0])
    assert echo["angle"] == pytest.approx(math.remainder(now[1] - yaw, math.tau))
    assert echo["range_rate"] == pytest.approx((after[0] - before[0]) / (2 * h), abs=1e-4)
    assert echo["range_acceleration"] == pytest.approx((after[0] - 2 * now[0] + before[0]) / h**2, abs=1e-3)
    assert echo["lateral_rate"] == pytest.approx(now[0] * (after[1] - before[1]) / (2 * h), abs=1e-4)


def test_gravity_on_a_banked_road_is_no_acceleration() -> None:
    """A car that stands on a slope feels a specific force; its radar does not move."""
    bank, down = -0.3, 0.1
    force = (-9.80665 * math.sin(down), 9.80665 * math.sin(bank) * math.cos(down), 9.0)
    standing = Truth(0, 0, 0, 1.0, 0, 0, 0, bank, down, 0, 0, *force, 0)
    assert mounted(standing, X).acceleration == pytest.approx(np.zeros(2), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_nearest_point_of_a_car_by_trying(seed: int) -> None:
    print(f"seed {seed}")
    generator = np.random.default_rng(seed)
    car = OtherCar(*generator.uniform(-20, 20, 2), generator.uniform(-3, 3), 30.0, 0.0, 0.5)
    place = generator.uniform(-60, 60, (1, 2))
    point = nearest_point(car, place)
    x, y = np.meshgrid(np.linspace(-2.45, 2.45, 491), np.linspace(-0.965, 0.965, 194))
    c, s = math.cos(car.yaw), math.sin(car.yaw)
    tried = np.hypot(car.x + c * x - s * y - place[0, 0], car.y + s * x + c * y - place[0, 1]).min()
    assert np.hypot(*(point.place - place)[0]) == pytest.approx(tried, abs=1e-2)
    arm = point.place[0] - (car.x, car.y)
    assert point.velocity[0] == pytest.approx((30 * c - 0.5 * arm[1], 30 * s + 0.5 * arm[0]))


@pytest.mark.parametrize("yaw_rate", [0.0, 0.25])
def test_a_wall_comes_nearer_by_the_own_speed_times_cosine(yaw_rate: float) -> None:
    own = truth(3.0, 1.0, 0.2, 55.0, 0.5, yaw_rate)
    echoes = find_echoes(EXACT, Walls([straight_wall(8.0), straight_wall(-9.0)], 10.0), mounted(own, X), 0.2, [])
    assert len(echoes.keys) > 10
    assert {key.source for key in echoes.keys} == {"wall"}
    angle = echoes.tracks["angle"]
    left = 0.5 + yaw_rate * X
    assert echoes.tracks["range_rate"] == pytest.approx(-55.0 * np.cos(angle) - left * np.sin(angle))
    x, y = 3.0 + X * math.cos(0.2), 1.0 + X * math.sin(0.2)
    place = y + echoes.tracks["range"] * np.sin(angle + 0.2)
    assert np.minimum(np.abs(place - 8.0), np.abs(place + 9.0)).max() < 1e-9
    along = x + echoes.tracks["range"] * np.cos(angle + 0.2)
    assert np.abs(along / 10.0 - np.rint(along / 10.0)).max() < 1e-9, "a post every 10 m from -500 m on"


# --- ghosts


def ghosts(walls: list[Floats], own: Truth, cars: list[OtherCar]) -> Tracks:
    echoes = find_echoes(EXACT, Walls(walls, 1.0e6), mounted(own, X), own.yaw, cars)
    return echoes.tracks[[key.source == "ghost" for key in echoes.keys]]


@pytest.mark.parametrize("wall_y", [6.0, -4.0])
def test_a_ghost_is_the_car_mirrored(wall_y: float) -> None:
    """The bounce in closed form: the path is as long as the straight line to the image; speeds along and across."""
    own, car = truth(0.0, 0.0, 0.0, 60.0), OtherCar(X + 40.0, 1.0, 0.0, 50.0, 2.0, length=0.0, width=0.0)
    (ghost,) = ghosts([straight_wall(wall_y)], own, [car])
    image = 2.0 * wall_y - 1.0
    assert ghost["range"] == pytest.approx(math.hypot(40.0, image))
    assert ghost["angle"] == pytest.approx(math.atan2(image, 40.0))
    assert ghost["range_rate"] == pytest.approx((40.0 * -10.0 + image * -2.0) / math.hypot(40.0, image))
    # Fermat: the wave takes the shortest way over the wall.
    along = np.linspace(0.0, 40.0, 40_001)
    ways = np.hypot(along, wall_y) + np.hypot(40.0 - along, wall_y - 1.0)
    assert ghost["range"] == pytest.approx(ways.min(), abs=1e-6)


def test_there_is_a_ghost_only_where_a_wall_mirrors() -> None:
    own, car = truth(), OtherCar(X + 40.0, 0.0, 0.0, 0.0, length=0.0, width=0.0)
    bounce = X + 20.0
    assert len(ghosts([], own, [car])) == 0
    assert len(ghosts([straight_wall(6.0, bounce - 2.0, bounce + 2.0)], own, [car])) == 1
    assert len(ghosts([straight_wall(6.0, bounce + 1.0, bounce + 90.0)], own, [car])) == 0, "the wall begins later"
    assert len(ghosts([straight_wall(6.0, bounce - 90.0, bounce - 1.0)], own, [car])) == 0, "and ends before"
    assert len(ghosts([straight_wall(6.0), straight_wall(-8.0)], own, [car])) == 2
    assert len(ghosts([straight_wall(6.0)], own, [])) == 0
    pillar = np.array([(X + 9.0, 2.0), (X + 11.0, 2.0), (X + 11.0, 4.0), (X + 9.0, 4.0)])
    assert len(ghosts([straight_wall(6.0), pillar], own, [car])) == 0, "something stands in the way to the wall"
    assert len(ghosts([straight_wall(30.0)], own, [car])) == 0, "outside of the field of view"
    beyond = OtherCar(X + 40.0, 7.0, 0.0, 0.0, length=0.0, width=0.0)
    assert len(ghosts([straight_wall(6.0, thick=50.0)], own, [beyond])) == 0, (
        "no mirror between the two sides of a wall"
    )


def test_ghosts_on_the_track_lie_behind_its_wall() -> None:
    generator = np.random.default_rng(SEED)
    walls = [np.asarray(wall) for wall in TRACK.walls()]
    found = 0
    for station in generator.uniform(0.0, TRACK.length, 40):
        x, y, yaw = TRACK.pose_at(station, generator.uniform(-4.0, 4.0))
        car = OtherCar(*TRACK.pose_at(station + generator.uniform(10.0, 100.0), generator.uniform(-4.0, 4.0)), 60.0)
        own = truth(x, y, yaw, 60.0)
        for ghost in ghosts(walls, own, [car]):
            found += 1
            sensor = mounted(own, X).place
            sight = yaw + ghost["angle"]
            place = sensor + ghost["range"] * np.array((math.cos(sight), math.sin(sight)))
            _, lateral = TRACK.project(*place)
            assert lateral < -TRACK.width_right.min()
    assert found > 10


# --- what is in view


@pytest.mark.parametrize(
    ("distance", "bearing_deg", "mode"),
    [
        (30.0, 0.0, RangeMode.BOTH),
        (59.9, 9.9, RangeMode.BOTH),
        (60.1, 9.9, RangeMode.LONG_RANGE),
        (60.1, 10.1, RangeMode.NONE),
        (30.0, 44.9, RangeMode.MEDIUM_RANGE),
        (30.0, -44.9, RangeMode.MEDIUM_RANGE),
        (30.0, -45.1, RangeMode.NONE),
        (30.0, 180.0, RangeMode.NONE),
        (173.9, 0.0, RangeMode.LONG_RANGE),
        (174.1, 0.0, RangeMode.NONE),
        (0.9, 0.0, RangeMode.NONE),
        (1.1, 0.0, RangeMode.BOTH),
    ],
)
def test_fields_of_view(distance: float, bearing_deg: float, mode: RangeMode) -> None:
    tracks = radar([], EXACT).scan(truth(), [at(distance, bearing_deg)])
    assert tracks["mode"].tolist() == ([mode] if mode else [])


def test_nothing_is_ever_seen_outside_of_them() -> None:
    """A lap's worth of scenes with noise, clutter, walls and cars: every track of every scan."""
    generator = np.random.default_rng(SEED)
    model = radar(TRACK.walls())
    seen = Counter[int]()
    for station in np.linspace(0.0, TRACK.length, 150):
        x, y, yaw = TRACK.pose_at(station, 0.0)
        cars = [OtherCar(*TRACK.pose_at(station + 3.0 * d, 3.0), 60.0) for d in generator.uniform(0.0, 80.0, 4)]
        tracks = model.scan(truth(x, y, yaw, 62.0), cars)
        assert (coverage(ERRORS, tracks["range"], tracks["angle"]) != RangeMode.NONE).all()
        assert tracks["range"].max(initial=0.0) <= 174.0 + 1e-9
        assert np.degrees(np.abs(tracks["angle"])).max(initial=0.0) <= 45.0 + 1e-9
        assert len(np.unique(tracks["id"])) == len(tracks) <= TRACKS
        assert tracks.tobytes() == on_wire(tracks).tobytes()
        assert tracks.tobytes() == unpack(pack(tracks)).tobytes()
        seen.update(tracks["status"].tolist())
    assert set(seen) == {1, 2, 3, 4, 7}, "new, young, old and coasted tracks were among them"


def test_a_wall_hides_what_is_behind_it() -> None:
    wall = np.array([(20.0, -1.0), (21.0, -1.0), (21.0, 1.0), (20.0, 1.0)])
    hidden, free = at(40.0, vx=5.0), at(40.0, 9.0, vx=5.0)
    echoes = find_echoes(EXACT, Walls([wall], 1.0e6), mounted(truth(), X), 0.0, [hidden, free])
    assert [key for key in echoes.keys if key.source == "car"] == [Key("car", 1)]


# --- statistics


def test_detection_becomes_less_likely_with_distance() -> None:
    """Against Swerling's first case by integration, and the figure that half_range names."""
    assert float(ERRORS.detection_probability(np.array(ERRORS.half_range))) == pytest.approx(0.5)
    distance = np.linspace(1.0, 174.0, 300)
    probability = ERRORS.detection_probability(distance)
    assert (np.diff(probability) <= 0.0).all()
    assert (ERRORS.detection_probability(distance, -10.0)[100:] < probability[100:]).all()
    # The mean over an exponential echo power of the chance of one in noise: exponential with the sum of both as mean.
    for r in (60.0, 120.0, 170.0):
        mean = 1.0 + float(ERRORS.signal_to_noise(np.array(r)))
        assert float(ERRORS.detection_probability(np.array(r))) == pytest.approx(
            stats.expon(scale=mean).sf(ERRORS.threshold)
        )
    assert float(ERRORS.signal_to_noise(np.array(50.0)) / ERRORS.signal_to_noise(np.array(100.0))) == pytest.approx(
        16.0
    )


@pytest.mark.parametrize("distance", [40.0, 100.0, 120.0, 140.0, 160.0])
def test_missed_detections_are_binomial(distance: float) -> None:
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    cars = [at(distance)] * 20  # independent of each other
    echoes = find_echoes(ERRORS, Walls([], 10.0), mounted(truth(), X), 0.0, cars)
    scans = 200
    hits = sum(len(detect(ERRORS, echoes, generator).keys) for _ in range(scans))
    expected = float(ERRORS.detection_probability(np.array(distance)))
    print(f"{distance} m: {hits} of {20 * scans}, expected {expected:.4f}")
    test = stats.binomtest(hits, 20 * scans, expected)
    assert test.pvalue > UNLIKELY


def test_errors_have_their_sigmas() -> None:
    """Chi-square of the variance, and the mean; at 50 m long range, at 30 degrees medium range."""
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    own = mounted(truth(vx=40.0), X)
    for bearing, angle_white in ((0.0, ERRORS.long_range.angle_white), (30.0, ERRORS.medium_range.angle_white)):
        echoes = find_echoes(ERRORS, Walls([], 10.0), own, 0.0, [at(45.0, bearing, 30.0)] * 20)
        scans = [detect(ERRORS, echoes, generator).tracks for _ in range(100)]
        found = np.concatenate(scans)
        for name, white in (
            ("range", ERRORS.range_white),
            ("angle", angle_white),
            ("range_rate", ERRORS.rate_white),
            ("range_acceleration", ERRORS.acceleration_white),
        ):
            off = found[name] - echoes.tracks[name][0]
            sigma = math.hypot(white, resolution(name) / math.sqrt(12.0))  # rounding is uniform
            print(f"{bearing} {name}: {off.std():.4f}, stated {sigma:.4f}, {len(off)} draws")
            assert two_sided(float((off**2).sum() / sigma**2), stats.chi2(len(off)))
            assert two_sided(float(off.mean() / sigma * math.sqrt(len(off))), stats.norm())


def test_clutter_is_a_poisson_number_all_over_the_view() -> None:
    print(f"seed {SEED}")
    generator = np.random.default_rng(SEED)
    scans = 3000
    found = [false_alarms(ERRORS, generator) for _ in range(scans)]
    counts = np.array([len(scan.keys) for scan in found])
    mean = sum(ERRORS.clutter)
    assert two_sided(counts.sum(), stats.poisson(mean * scans))
    # Dispersion: the sum of squares over the mean is chi-square for a Poisson number.
    assert two_sided(float(((counts - counts.mean()) ** 2).sum() / counts.mean()), stats.chi2(scans - 1))
    tracks = np.concatenate([scan.tracks for scan in found])
    assert all(key is None for scan in found for key in scan.keys)
    assert (tracks["mode"] != RangeMode.NONE).all()
    rate = (tracks["range_rate"] + 81.92) / (81.92 + 81.91)
    assert stats.kstest(rate, "uniform").pvalue > UNLIKELY
    wide = tracks[np.abs(tracks["angle"]) > math.radians(10.1)]
    assert stats.kstest((wide["range"] - 1.0) / 59.0, "uniform").pvalue > UNLIKELY
    far = tracks[tracks["range"] > 60.1]
    assert stats.kstest((np.degrees(far["angle"]) + 10.0) / 20.0, "uniform").pvalue > UNLIKELY
    assert two_sided(len(far), stats.poisson(ERRORS.clutter[0] * scans * (174.0 - 60.1) / 173.0))


def test_false_alarms_are_new_and_gone_in_the_next_scan() -> None:
    model = radar([], RadarErrors(clutter=(3.0, 3.0)))
    counts = []
    for _ in range(300):
        tracks = model.scan(truth())
        assert (tracks["status"] == TrackStatus.NEW).all()
        counts.append(len(tracks))
    assert two_sided(sum(counts), stats.poisson(6.0 * 300))


# --- tracks


def detection(*keys: int) -> Detections:
    tracks = np.zeros(len(keys), dtype=TRACK_DTYPE)
    tracks["range"], tracks["range_rate"], tracks["mode"] = 50.0, -20.0, RangeMode.BOTH
    return Detections([Key("car", key) for key in keys], tracks)


def test_a_track_keeps_its_number_for_as_long_as_it_is_seen() -> None:
    tracker, visible = Tracker(ERRORS), {Key("car", 1), Key("car", 2)}
    seen = [tracker.step(detection(*keys), visible) for keys in ((1,), (2, 1), (1,), (1, 2), (2, 1), ())]
    assert [scan["id"].tolist() for scan in seen] == [[1], [1, 2], [1, 2], [1, 2], [1, 2], [1, 2]]
    statuses = [[TrackStatus(int(s)).name for s in scan["status"]] for scan in seen]
    assert statuses == [
        ["NEW"],
        ["NEW_UPDATED", "NEW"],
        ["NEW_UPDATED", "NEW_COASTED"],
        ["UPDATED", "NEW_UPDATED"],
        ["UPDATED", "NEW_UPDATED"],
        ["COASTED", "NEW_COASTED"],
    ]
    assert [scan["rolling_count"].tolist()[0] for scan in seen] == [1, 0, 1, 0, 1, 0]


def test_a_track_coasts_by_its_rate_and_ends() -> None:
    tracker, visible = Tracker(ERRORS), {Key("car", 1)}
    tracker.step(detection(1), visible)
    ranges = [scan["range"].tolist() for scan in (tracker.step(detection(), visible) for _ in range(ERRORS.coast + 2))]
    assert ranges == [[pytest.approx(50.0 - 0.05 * 20.0 * (k + 1))] for k in range(ERRORS.coast)] + [[], []]


def test_what_is_out_of_sight_does_not_coast() -> None:
    tracker = Tracker(ERRORS)
    tracker.step(detection(1), {Key("car", 1)})
    assert len(tracker.step(detection(), set())) == 0
    near = detection(1)
    near.tracks["range"] = 1.5
    tracker.step(near, {Key("car", 1)})
    assert len(tracker.step(detection(), {Key("car", 1)})) == 0, "the next place would be 0.5 m from the radar"


def test_numbers_are_given_again_as_late_as_possible() -> None:
    tracker = Tracker(ERRORS)
    numbers = [tracker.step(detection(k), {Key("car", k)})["id"].tolist() for k in range(70)]
    assert numbers == [[k % TRACKS + 1] for k in range(70)]


def test_sixty_four_tracks_are_enough() -> None:
    tracker = Tracker(ERRORS)
    everything = {Key("car", k) for k in range(80)}
    first = tracker.step(detection(*range(70)), everything)
    assert first["id"].tolist() == list(range(1, 65))
    again = tracker.step(detection(*reversed(range(80))), everything)
    assert again["id"].tolist() == list(range(1, 65))
    assert (again["status"] == TrackStatus.NEW_UPDATED).all(), "those that had a number have it still"


def test_the_nearest_get_numbers_where_there_are_not_enough() -> None:
    cars = [at(100.0 - k) for k in range(70)]
    tracks = radar([], EXACT).scan(truth(), cars)
    assert len(tracks) == TRACKS
    assert tracks["range"].max() == pytest.approx(31.0 + 63.0)


def test_a_car_that_is_followed_keeps_its_number_on_the_track() -> None:
    model = radar(TRACK.walls(), RadarErrors(clutter=(2.0, 2.0)))
    numbers = []
    for k in range(100):
        x, y, yaw = TRACK.pose_at(200.0 + 3.0 * k, 0.0)
        car = OtherCar(*TRACK.pose_at(240.0 + 3.0 * k, 0.0), 60.0)
        tracks = model.scan(truth(x, y, yaw, 60.0), [car])
        still = tracks[(np.abs(tracks["range_rate"]) < 2.0) & (tracks["range"] < 48.0) & (tracks["range"] > 28.0)]
        straight_on = still[np.abs(still["angle"]) < math.radians(9.0)]
        numbers += straight_on["id"].tolist()
    (most, times), *_ = Counter(numbers).most_common()
    assert times > 90, f"track {most} {times} times in 100"


def test_oncoming_is_what_comes_nearer_over_ground() -> None:
    cars = [at(50.0, vx=30.0), at(60.0, vx=0.0), at(70.0, vx=-20.0)]
    tracks = radar([], EXACT).scan(truth(vx=50.0), cars)
    assert tracks["oncoming"].tolist() == [False, False, True]


def test_same_seed_same_bytes() -> None:
    def bytes_of(seed: int) -> bytes:
        model, data = radar(TRACK.walls(), seed=seed), b""
        for k in range(40):
            x, y, yaw = TRACK.pose_at(3.0 * k, 0.0)
            cars = [OtherCar(*TRACK.pose_at(3.0 * k + ahead, 2.0), 58.0) for ahead in (30.0, 90.0)]
            data += model.scan(truth(x, y, yaw, 60.0), cars).tobytes()
        return data

    assert bytes_of(1) == bytes_of(1)
    assert bytes_of(1) != bytes_of(2)
    assert PERIOD_US == 50_000
