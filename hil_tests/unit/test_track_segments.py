"""Centre lines from segments: closure, turn, length, bank and width."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import fresnel

from autonomy.segments import Piece, mirrored_lap
from autonomy.track_files import load_track

TRACKS = Path(__file__).parents[2] / "scenarios" / "tracks"


@pytest.fixture(scope="module", params=["lvms", "ims"])
def track(request):
    return load_track(TRACKS / f"{request.param}.yaml")


@pytest.fixture(scope="module")
def lvms():
    return load_track(TRACKS / "lvms.yaml")


def integrate_lap(curve, steps=200_000):
    """End of the lap by integrating the sampled curvature with a fine trapezoid rule."""
    s = np.linspace(0.0, curve.length, steps + 1)
    k = np.interp(s, np.append(curve.stations, curve.length), np.append(curve.curvature, curve.curvature[0]))
    heading = curve.heading[0] + np.concatenate(([0.0], np.cumsum(0.5 * (k[1:] + k[:-1]) * np.diff(s))))
    return np.trapezoid(np.cos(heading), s), np.trapezoid(np.sin(heading), s), heading[-1] - heading[0]


def test_the_lap_closes_within_a_millimetre(track):
    curve = track.centre
    step = np.hypot(np.roll(curve.x, -1) - curve.x, np.roll(curve.y, -1) - curve.y)
    # The last chord, over the seam, is a chord like all others only when the lap closes.
    arc = curve.spacing * (1.0 - (curve.curvature * curve.spacing) ** 2 / 24.0)
    assert np.max(np.abs(step - arc)) < 1e-3


def test_the_lap_turns_two_pi(track):
    curve = track.centre
    assert curve.turn == pytest.approx(2.0 * math.pi, abs=1e-12)
    last = curve.spacing * 0.5 * (curve.curvature[-1] + curve.curvature[0])
    assert curve.heading[-1] + last - curve.heading[0] == pytest.approx(2.0 * math.pi, abs=1e-6)


def test_curvature_heading_and_points_agree(track):
    x, y, turn = integrate_lap(track.centre)
    # The nodes sample the joints of the pieces at 1 m: a jump of 0.004 1/m is blurred by 2 mrad, which is 2 m at 1 km.
    assert math.hypot(x, y) < 2.0
    assert turn == pytest.approx(2.0 * math.pi, abs=5e-3)


def test_lvms_has_the_surveyed_length(lvms):
    assert lvms.length == pytest.approx(2471.6, abs=1.0)


def test_ims_is_two_and_a_half_miles():
    assert load_track(TRACKS / "ims.yaml").length == pytest.approx(2.5 * 1609.344, abs=1.0)


def test_lvms_is_mirror_symmetric(lvms):
    s = np.linspace(0.0, 0.5 * lvms.length, 500)
    _, _, _, ahead = lvms.centre.at(s)
    _, _, _, behind = lvms.centre.at(-s)
    assert np.max(np.abs(ahead - behind)) < 1e-9
    ahead_bank = [lvms.road_at_station(float(v))[0] for v in s]
    behind_bank = [lvms.road_at_station(float(-v))[0] for v in s]
    np.testing.assert_allclose(ahead_bank, behind_bank, atol=1e-4)


@pytest.mark.parametrize(
    ("station", "degrees"),
    [(0, 9), (100, 9), (261, 9), (385.5, 14.5), (600, 20), (818, 20), (949.5, 13), (1081, 6), (1200, 6)],
)
def test_lvms_bank_is_linear_between_its_points(lvms, station, degrees):
    assert math.degrees(lvms.road_at_station(station)[0]) == pytest.approx(degrees, abs=0.06)
    assert math.degrees(lvms.road_at_station(lvms.length - station)[0]) == pytest.approx(degrees, abs=0.06)
    assert lvms.road_at_station(station)[1] == 0.0


def test_bank_is_found_anywhere_across_the_track(lvms):
    for lateral in (-7.0, 0.0, 7.0):
        x, y, _ = lvms.pose_at(700.0, lateral)
        assert math.degrees(lvms.road_at(x, y)[0]) == pytest.approx(20.0)


def test_boundaries_are_a_width_apart(lvms):
    left, right = lvms.boundaries()
    np.testing.assert_allclose(np.hypot(*(left - right).T), 14.9, atol=1e-9)
    # Counter-clockwise: the left boundary is the inner one.
    assert enclosed_area(left) < enclosed_area(right)


def enclosed_area(points):
    x, y = points.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def test_a_clothoid_matches_the_fresnel_integrals():
    length, curvature = 182.0, 1.0 / 233.1
    piece = Piece(length, 0.0, curvature)
    # One arc after the clothoid completes the half turn.
    arc = Piece((math.pi - piece.turn) / curvature, curvature, curvature)
    curve = mirrored_lap([piece, arc], (0.0, 0.0, 0.0), 1.0)
    scale = math.sqrt(math.pi * length / curvature)
    s = curve.stations[curve.stations < length]
    sine, cosine = fresnel(s / scale)
    np.testing.assert_allclose(curve.x[: len(s)], scale * cosine, atol=1e-9)
    np.testing.assert_allclose(curve.y[: len(s)], scale * sine, atol=1e-9)


def test_a_chain_matches_an_ode_solution():
    half = [Piece(80.0, 0.004, 0.004), Piece(30.0, 0.004, -0.001), Piece(100.0, -0.001, 0.02), Piece(100.0, 0.02, 0.02)]
    curve = mirrored_lap(half, (3.0, -2.0, 0.7), 1.0)
    factor = math.pi / sum(p.turn for p in half)
    knots = np.concatenate(([0.0], np.cumsum([p.length for p in half])))

    def curvature(s):
        i = min(int(np.searchsorted(knots, s, side="right")) - 1, len(half) - 1)
        p = half[i]
        return factor * (p.curvature_start + (p.curvature_end - p.curvature_start) * (s - knots[i]) / p.length)

    state = np.array([3.0, -2.0, 0.7])
    for a, b in itertools.pairwise(knots):  # the curvature jumps at the joints
        solution = solve_ivp(
            lambda s, q, a=a, b=b: [math.cos(q[2]), math.sin(q[2]), curvature(min(max(s, a), b - 1e-12))],
            (a, b),
            state,
            rtol=1e-11,
            atol=1e-11,
        )
        state = solution.y[:, -1]
        x, y, heading, _ = curve.at(np.array([b]))
        # at() interpolates between nodes, which blurs a jump of curvature.
        assert math.hypot(x[0] - state[0], y[0] - state[1]) < 2e-3
        assert heading[0] == pytest.approx(state[2], abs=5e-3)


@pytest.mark.parametrize(
    ("half", "problem"),
    [
        ([Piece(100.0, 0.0, 0.0)], "do not turn"),
        ([Piece(300.0, 0.002, 0.002), Piece(300.0, -0.002, -0.002)], "do not turn"),
        ([Piece(1.0, 3.0, 3.0), Piece(500.0, 0.0, 0.0)], "overshoot"),
    ],
)
def test_pieces_that_cannot_close_are_refused(half, problem):
    with pytest.raises(ValueError, match=problem):
        mirrored_lap(half, (0.0, 0.0, 0.0), 1.0)


def test_a_clockwise_lap_is_built_from_right_turns():
    curve = mirrored_lap([Piece(100.0, 0.0, 0.0), Piece(300.0, -0.01, -0.01)], (0.0, 0.0, 0.0), 1.0)
    assert curve.turn == pytest.approx(-2.0 * math.pi)
