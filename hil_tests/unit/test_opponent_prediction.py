"""Prediction of opponents: against an own spline of the centre line, Algorithm 2, and a tracked car on the track."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from autonomy.opponents.imm_pdaf import SensorModel
from autonomy.opponents.prediction import OpponentPredictor, PredictionLimits
from autonomy.opponents.tracker import OpponentTracker, TrackedObject
from autonomy.track_files import load_track
from tools.opponent_scenes import SCAN_US, Truth, scans

TRACKS = Path(__file__).resolve().parents[2] / "scenarios" / "tracks"
LVMS = load_track(TRACKS / "lvms.yaml")


class Reference:
    """Centre line by scipy's periodic spline over the nodes, and what Frenet coordinates on it mean."""

    def __init__(self, track):
        centre = track.centre
        stations = np.arange(centre.count + 1) * centre.spacing
        nodes = np.column_stack((np.append(centre.x, centre.x[0]), np.append(centre.y, centre.y[0])))
        self._line = CubicSpline(stations, nodes, bc_type="periodic")
        self.length = stations[-1]

    def place(self, s, d):
        """x, y of a point."""
        tangent = self._line(s, 1)
        tangent /= np.hypot(tangent[..., 0], tangent[..., 1])[..., None]
        normal = np.stack((-tangent[..., 1], tangent[..., 0]), axis=-1)
        return self._line(s) + np.asarray(d)[..., None] * normal

    def velocity(self, s, d, progress):
        """vx, vy of a point that keeps d and moves along s with progress, by a difference."""
        step = 1e-4
        return (self.place(s + step * progress, d) - self.place(s - step * progress, d)) / (2.0 * step)


REFERENCE = Reference(LVMS)


def seen(s, d, progress, now_us, identity=1, seen_us=None):
    """What the tracker says of a car at s, d."""
    (x, y), (vx, vy) = REFERENCE.place(s, d), REFERENCE.velocity(s, d, progress)
    return TrackedObject(
        identity,
        now_us,
        now_us if seen_us is None else seen_us,
        float(x),
        float(y),
        0.6,
        float(vx),
        float(vy),
        math.atan2(vy, vx),
        0.0,
        np.eye(6),
        np.ones(3),
        np.ones(3) / 3.0,
        1.0,
    )


def test_the_papers_figures_are_the_default():
    limits = PredictionLimits()
    assert (limits.horizon_s, limits.step_s, limits.kept_us) == (4.0, 0.1, 2_000_000)


@pytest.mark.parametrize("station", np.linspace(0.0, REFERENCE.length, 13))
@pytest.mark.parametrize("offset", [-3.0, 0.0, 4.0])
def test_it_keeps_offset_and_speed_along_the_centre_line(station, offset):
    progress = 70.0
    (prediction,) = OpponentPredictor(LVMS).step(0, [seen(station, offset, progress, 0)])
    assert prediction.time.shape == (41,)
    np.testing.assert_allclose(prediction.time, np.linspace(0.0, 4.0, 41), atol=1e-12)
    np.testing.assert_allclose(prediction.d, offset, atol=0.01)
    along = np.unwrap(prediction.s, period=LVMS.length)
    np.testing.assert_allclose(np.diff(along), 7.0, rtol=2e-3)
    ways = station + progress * prediction.time
    expected = REFERENCE.place(ways, np.full(41, offset))
    off = np.hypot(prediction.x - expected[:, 0], prediction.y - expected[:, 1])
    assert off.max() < 0.3
    velocity = np.array([REFERENCE.velocity(s, offset, progress) for s in ways])
    np.testing.assert_allclose(prediction.speed, np.hypot(velocity[:, 0], velocity[:, 1]), rtol=5e-3)
    turn = np.angle(np.exp(1j * (prediction.yaw - np.arctan2(velocity[:, 1], velocity[:, 0]))))
    assert np.abs(turn).max() < 5e-3


def test_over_the_finish_line_it_goes_on():
    (prediction,) = OpponentPredictor(LVMS).step(0, [seen(LVMS.length - 50.0, 2.0, 60.0, 0)])
    assert (prediction.s >= 0.0).all()
    assert (prediction.s < LVMS.length).all()
    assert prediction.s[-1] == pytest.approx(190.0, abs=1.0)
    assert np.hypot(np.diff(prediction.x), np.diff(prediction.y)).max() < 6.5


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_opponent_stays_on_the_track(side):
    width = LVMS.width_left[0] if side > 0.0 else LVMS.width_right[0]
    (beside,) = OpponentPredictor(LVMS).step(0, [seen(0.0, side * (width + 2.5), 50.0, 0)])
    nodes = np.rint(beside.s / LVMS.centre.spacing).astype(int) % LVMS.centre.count
    room = np.where(side > 0.0, LVMS.width_left[nodes], LVMS.width_right[nodes]) - 0.95
    np.testing.assert_allclose(side * beside.d, room, atol=0.05)
    assert not OpponentPredictor(LVMS).step(0, [seen(0.0, side * (width + 3.5), 50.0, 0)])


def test_a_standing_and_a_reversing_car():
    (standing,) = OpponentPredictor(LVMS).step(0, [seen(100.0, 1.0, 0.0, 0)])
    assert np.ptp(standing.x) == np.ptp(standing.y) == 0.0
    (reversing,) = OpponentPredictor(LVMS).step(0, [seen(100.0, 1.0, -2.0, 0)])
    assert reversing.s[-1] == pytest.approx(92.0, abs=0.1)


# --- Algorithm 2 ---


def test_without_perception_the_last_prediction_is_propagated_then_cleared():
    predictor = OpponentPredictor(LVMS)
    (first,) = predictor.step(0, [seen(300.0, 2.0, 60.0, 0)])
    for now_us in range(10_000, 2_000_001, 10_000):
        (later,) = predictor.step(now_us, [])
        assert (later.time_us, later.seen_us) == (now_us, 0)
        if now_us % 100_000 == 0:  # where its points are the first one's
            shift = now_us // 100_000
            np.testing.assert_allclose(later.x[: 41 - shift], first.x[shift:], atol=1e-6)
            np.testing.assert_allclose(later.y[: 41 - shift], first.y[shift:], atol=1e-6)
        assert len(later.time) == 41
    assert predictor.step(2_010_000, []) == []
    assert predictor.step(2_020_000, []) == []
    assert len(predictor.step(2_030_000, [seen(430.0, 2.0, 60.0, 2_030_000)])) == 1


@pytest.mark.parametrize("seed", range(3))
def test_it_does_what_algorithm_2_says(seed):
    """The paper's loop, written out with its condition the right way round, over random losses of perception."""
    rng = np.random.default_rng(seed)
    predictor, held, now_us, changes = OpponentPredictor(LVMS), None, 0, 0
    visible = True
    for _ in range(3000):
        now_us += 10_000
        if rng.random() < (0.02 if visible else 0.007):
            visible = not visible
        perceived = visible and now_us % SCAN_US == 0
        objects = [seen(0.02e-3 * now_us, 2.0, 20.0, now_us)] if perceived else []
        if perceived:
            held, since_us = (0.02e-3 * now_us, 20.0), now_us
        elif held is not None and now_us - since_us > 2_000_000:
            held, changes = None, changes + 1
        predictions = predictor.step(now_us, objects)
        assert bool(predictions) == (held is not None)
        if held is not None:
            expected = held[0] + held[1] * (now_us - since_us) * 1e-6
            off = math.remainder(predictions[0].s[0] - expected, LVMS.length)
            assert abs(off) < 0.1
    assert changes > 0


def test_an_object_that_no_scan_held_since_is_no_new_perception():
    """The tracker goes on telling of a car that is hidden; that does not keep its prediction."""
    predictor = OpponentPredictor(LVMS)
    for now_us in range(0, 2_000_001, 50_000):
        (prediction,) = predictor.step(now_us, [seen(300.0, 2.0, 60.0, now_us, seen_us=0)])
        assert prediction.seen_us == 0
        assert prediction.s[0] == pytest.approx(300.0 + 60.0 * now_us * 1e-6, abs=0.1)
    assert not predictor.step(2_050_000, [seen(300.0, 2.0, 60.0, 2_050_000, seen_us=0)])


def test_new_perception_takes_over():
    predictor = OpponentPredictor(LVMS)
    predictor.step(0, [seen(300.0, 2.0, 60.0, 0)])
    (prediction,) = predictor.step(50_000, [seen(310.0, -1.0, 40.0, 50_000)])
    assert (prediction.s[0], prediction.d[0]) == pytest.approx((310.0, -1.0), abs=0.05)
    assert prediction.s[-1] == pytest.approx(470.0, abs=0.5)


# --- several cars ---


def test_each_car_has_its_own():
    cars = [(300.0, 2.0, 60.0), (310.0, -3.0, 70.0), (1500.0, 0.0, 30.0)]
    predictions = OpponentPredictor(LVMS).step(0, [seen(*car, 0, identity=9 - i) for i, car in enumerate(cars)])
    assert [each.identity for each in predictions] == [7, 8, 9]
    for each, (s, d, progress) in zip(reversed(predictions), cars, strict=True):
        assert (each.s[0], each.d[0]) == pytest.approx((s, d), abs=0.05)
        assert each.s[10] - each.s[0] == pytest.approx(progress, abs=0.1)


def test_a_car_with_a_new_track_is_not_predicted_twice():
    predictor = OpponentPredictor(LVMS)
    predictor.step(0, [seen(300.0, 2.0, 60.0, 0, identity=1)])
    (prediction,) = predictor.step(1_000_000, [seen(361.0, 2.2, 60.0, 1_000_000, identity=2)])
    assert prediction.identity == 2


def test_a_hidden_car_beside_a_seen_one_is_kept():
    predictor = OpponentPredictor(LVMS)
    predictor.step(0, [seen(300.0, 2.0, 60.0, 0, identity=1)])
    both = predictor.step(1_000_000, [seen(361.0, -0.5, 60.0, 1_000_000, identity=2)])
    assert [each.identity for each in both] == [1, 2]


def test_the_same_across_the_finish_line():
    predictor = OpponentPredictor(LVMS)
    predictor.step(0, [seen(LVMS.length - 30.0, 2.0, 60.0, 0, identity=1)])
    (prediction,) = predictor.step(500_000, [seen(1.0, 2.0, 60.0, 500_000, identity=2)])
    assert prediction.identity == 2


# --- bad input ---


@pytest.mark.parametrize("field", ["x", "y", "vx", "vy"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_object_that_is_not_finite_is_left_out(field, value):
    predictor = OpponentPredictor(LVMS)
    good = seen(300.0, 2.0, 60.0, 0)
    assert not predictor.step(0, [good._replace(**{field: value})])
    predictor.step(0, [good])
    (kept,) = predictor.step(50_000, [seen(303.0, 2.0, 60.0, 50_000)._replace(**{field: value})])
    assert kept.seen_us == 0


def test_an_object_far_away_or_from_the_future_is_left_out():
    predictor = OpponentPredictor(LVMS)
    good = seen(300.0, 2.0, 60.0, 0)
    assert not predictor.step(0, [good._replace(x=1e300), good._replace(identity=2, seen_us=1)])


def test_a_clock_that_runs_backwards_clears():
    predictor = OpponentPredictor(LVMS)
    assert predictor.step(1_000_000, [seen(300.0, 2.0, 60.0, 1_000_000)])
    assert not predictor.step(500_000, [])


# --- with the tracker ---


@pytest.mark.parametrize("seed", range(2))
def test_a_tracked_defender_is_where_it_was_predicted(seed):
    """A defender inside, at a steady 57 m/s over ground, half a lap in clutter: the prediction when its time comes."""
    sensor, offset, speed = SensorModel("lidar", 0.9, 2.0e-3), 4.0, 57.0
    s, state = 0.0, []
    for _ in range(400):
        unit = np.linalg.norm(REFERENCE.velocity(s, offset, 1.0))
        state.append([*REFERENCE.place(s, offset), *REFERENCE.velocity(s, offset, speed / unit), 0.0])
        s += speed / unit * SCAN_US * 1e-6
    truth = Truth(np.arange(400) * SCAN_US, np.array(state), np.full(400, 0.6))
    tracker, predictor = OpponentTracker(), OpponentPredictor(LVMS)
    errors = {20: [], 40: [], 80: []}  # scans ahead
    for k, scan in enumerate(scans(truth, np.random.default_rng(seed), sensor)):
        tracker.update(scan.time_us, scan, sensor)
        for prediction in predictor.step(scan.time_us, tracker.objects(scan.time_us)):
            for ahead, values in errors.items():
                if 30 <= k < 400 - ahead:
                    x, y = truth.state[k + ahead, :2]
                    values.append(math.hypot(prediction.x[ahead // 2] - x, prediction.y[ahead // 2] - y))
    rms = {ahead: math.sqrt(np.mean(np.square(values))) for ahead, values in errors.items()}
    print("rms after 1, 2, 4 s", rms)
    assert all(len(values) == 370 - ahead for ahead, values in errors.items())  # one prediction at all times
    assert rms[20] < 1.5
    assert rms[40] < 3.5
    assert rms[80] < 8.0
