"""Projection on to a curve against a brute-force search."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from autonomy.frenet import Curve, Projector, wrap_angle
from autonomy.track_files import load_track

TRACKS = Path(__file__).parents[2] / "scenarios" / "tracks"
SEED = 20230105


@pytest.fixture(scope="module")
def curve():
    return load_track(TRACKS / "lvms.yaml").centre


def brute_force(curve, x, y):
    """Nearest point by a coarse look at everything and a fine search around the best."""
    best = int(np.argmin(np.hypot(curve.x - x, curve.y - y)))

    def distance(s):
        px, py, _, _ = curve.at(np.array([s]))
        return math.hypot(px[0] - x, py[0] - y)

    around = best * curve.spacing
    found = minimize_scalar(distance, bounds=(around - 1.5, around + 1.5), method="bounded", options={"xatol": 1e-9})
    px, py, heading, _ = (v[0] for v in curve.at(np.array([found.x])))
    side = math.copysign(1.0, math.cos(heading) * (y - py) - math.sin(heading) * (x - px))
    return found.x % curve.length, side * found.fun


def station_gap(curve, a, b):
    return math.remainder(a - b, curve.length)


def test_projection_matches_brute_force_anywhere(curve):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    stations = rng.uniform(0.0, curve.length, 150)
    offsets = rng.uniform(-15.0, 15.0, 150)
    for x, y in zip(*curve.offset(stations, offsets), strict=True):
        s, d = Projector(curve).project(float(x), float(y))
        s_ref, d_ref = brute_force(curve, x, y)
        # Nodes sample the joints of the pieces at 1 m; there, and only there, both differ by millimetres.
        assert abs(station_gap(curve, s, s_ref)) < 5e-3
        assert d == pytest.approx(d_ref, abs=1e-3)


def test_round_trip(curve):
    stations = np.arange(0.37, curve.length, 7.1)
    for lateral in (-7.45, 0.0, 7.45):
        xs, ys = curve.offset(stations, np.full(len(stations), lateral))
        projector = Projector(curve)
        for station, x, y in zip(stations, xs, ys, strict=True):
            s, d = projector.project(float(x), float(y))
            assert abs(station_gap(curve, s, float(station))) < 2e-3
            assert d == pytest.approx(lateral, abs=1e-4)


def test_incremental_search_gives_what_a_fresh_one_gives(curve):
    stations = np.arange(0.0, 2.0 * curve.length, 0.63)
    xs, ys = curve.offset(stations, 5.0 * np.sin(stations / 40.0))
    moving = Projector(curve)
    for x, y in zip(xs[::3].tolist(), ys[::3].tolist(), strict=True):
        assert moving.project(x, y) == pytest.approx(Projector(curve).project(x, y), abs=1e-3)


def test_the_station_runs_through_the_seam(curve):
    projector = Projector(curve)
    stations = [-2.0, -1.0, -0.4, 0.0, 0.4, 1.0, 2.0]
    xs, ys = curve.offset(np.array(stations), np.zeros(7))
    for station, x, y in zip(stations, xs.tolist(), ys.tolist(), strict=True):
        s, _ = projector.project(x, y)
        assert 0.0 <= s < curve.length
        assert station_gap(curve, s, station) == pytest.approx(0.0, abs=1e-6)


def test_a_jump_to_the_other_straight_is_found(curve):
    projector = Projector(curve)
    for station in (10.0, 0.5 * curve.length, 100.0, 0.4 * curve.length, 1.0):
        x, y = (float(v[0]) for v in curve.offset(np.array([station]), np.array([3.0])))
        s, d = projector.project(x, y)
        assert station_gap(curve, s, station) == pytest.approx(0.0, abs=1e-3)
        assert d == pytest.approx(3.0, abs=1e-4)


def test_a_jump_backwards_along_the_lap_is_found(curve):
    projector = Projector(curve)
    for station in (900.0, 300.0, 1200.0, 20.0):
        x, y = (float(v[0]) for v in curve.offset(np.array([station]), np.array([-6.0])))
        assert projector.project(x, y)[0] == pytest.approx(station, abs=1e-2)


def test_a_circle_through_points_has_its_radius():
    angle = np.linspace(0.0, 2.0 * math.pi, 60, endpoint=False)
    circle = Curve.through(50.0 * np.cos(angle), 50.0 * np.sin(angle), 300)
    assert circle.length == pytest.approx(2.0 * math.pi * 50.0, rel=1e-6)
    np.testing.assert_allclose(circle.curvature, 0.02, rtol=3e-3)
    np.testing.assert_allclose(np.hypot(circle.x, circle.y), 50.0, atol=1e-4)
    assert Projector(circle).project(40.0, 0.0) == pytest.approx((0.0, 10.0), abs=1e-3)


@pytest.mark.parametrize("turns", [-3, 0, 1, 7])
def test_wrapped_angles(turns):
    for angle in (-3.1, -0.5, 0.0, 3.1):
        assert wrap_angle(angle + 2.0 * math.pi * turns) == pytest.approx(angle, abs=1e-12)
    assert wrap_angle(math.pi) == math.pi
    assert wrap_angle(-math.pi) == math.pi
