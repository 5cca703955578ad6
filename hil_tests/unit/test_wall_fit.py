"""The wall's polynomial against closed forms: straight, circle and clothoid walls, noise, outliers, gaps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from autonomy.wall_fit import AHEAD, BEHIND, LEAST_SHARE, WallFit, fit_wall

RIGHT, LEFT = -1, 1
NOISE = 0.01
#: Largest error of a fit beside the car and at the look-ahead of 227 km/h, m: what a controller would feel.
CLOSE, FAR = 0.02, 0.05

Points = NDArray[np.float64]


def cloud(points: Points) -> NDArray[np.float32]:
    return np.column_stack((points, np.full(len(points), 0.3))).astype(np.float32)


def straight(offset: float, heading: float) -> Points:
    """A wall at a distance, seen from a car that heads away from it by an angle."""
    along = np.arange(-60.0, 80.0, 0.5)
    c, s = math.cos(-heading), math.sin(-heading)
    return np.column_stack((c * along - s * offset, s * along + c * offset))


def circle(offset: float, radius: float, heading: float = 0.0) -> Points:
    """A wall of constant curvature beside the car; a positive radius bends to the left."""
    angle = np.arange(-60.0, 80.0, 0.5) / radius
    x, y = radius * np.sin(angle), radius * (1.0 - np.cos(angle)) + offset
    c, s = math.cos(-heading), math.sin(-heading)
    return np.column_stack((c * x - s * y, s * x + c * y))


def clothoid(offset: float, rate: float) -> Points:
    """A wall whose curvature grows with the way, from zero beside the car; integrated finely."""
    way = np.arange(-60.0, 80.0, 0.01)
    heading = 0.5 * rate * way * way * np.sign(way)
    x = np.concatenate(([0.0], np.cumsum(0.01 * np.cos(heading[:-1]))))
    y = np.concatenate(([0.0], np.cumsum(0.01 * np.sin(heading[:-1]))))
    beside = int(np.argmin(np.abs(way)))
    return np.column_stack((x - x[beside], y - y[beside] + offset))[::50]


def noisy(points: Points, seed: int = 1, sigma: float = NOISE) -> Points:
    return points + np.random.default_rng(seed).normal(0.0, sigma, points.shape)


def error(fit: WallFit, points: Points, x: float) -> float:
    """Distance along y to the true wall."""
    order = np.argsort(points[:, 0])
    return abs(fit.at(x) - float(np.interp(x, points[order, 0], points[order, 1])))


def fitted(points: Points, side: int = RIGHT) -> WallFit:
    fit = fit_wall(cloud(points), side)
    assert fit is not None
    return fit


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("offset", "heading"), [(-7.5, 0.0), (-1.0, 0.05), (-14.0, -0.1), (-3.0, 0.2)])
def test_a_straight_wall_is_of_first_order(offset: float, heading: float, seed: int) -> None:
    points = straight(offset, heading)
    fit = fitted(noisy(points, seed))
    assert fit.order == 1
    assert fit.coefficients[2:] == (0.0, 0.0)
    assert fit.coefficients[1] == pytest.approx(-math.tan(heading), abs=2e-4)
    assert fit.coefficients[0] == pytest.approx(offset / math.cos(heading), abs=5e-3)
    assert fit.residual == pytest.approx(NOISE, rel=0.3)
    assert fit.share == 1.0


@pytest.mark.parametrize("radius", [233.0, 475.0, -300.0, 150.0])
@pytest.mark.parametrize("heading", [-0.06, 0.0, 0.06])
def test_a_circle_is_of_third_order(radius: float, heading: float) -> None:
    points = circle(-6.0, radius, heading)
    fit = fitted(noisy(points))
    assert fit.order == 3
    assert error(fit, points, 0.0) < CLOSE
    assert error(fit, points, 28.0) < FAR


@pytest.mark.parametrize("rate", [1 / 233.0 / 182.0, 1 / 233.0 / 50.0, -1 / 300.0 / 100.0])
def test_a_clothoid_is_of_third_order(rate: float) -> None:
    points = clothoid(-5.0, rate)
    fit = fitted(noisy(points))
    assert fit.order == 3
    assert error(fit, points, 0.0) < CLOSE
    assert error(fit, points, 28.0) < FAR
    assert fit.coefficients[3] == pytest.approx(rate / 6.0, rel=0.5)


def test_without_noise_a_cubic_is_found_exactly() -> None:
    x = np.linspace(-20.0, 60.0, 200)
    c = (-5.0, 0.03, 1.1e-3, 2.0e-5)
    fit = fitted(np.column_stack((x, c[0] + c[1] * x + c[2] * x**2 + c[3] * x**3)))
    assert fit.order == 3
    assert fit.coefficients == pytest.approx(c, rel=1e-3)


def test_a_wall_on_the_left() -> None:
    points = noisy(circle(6.0, 240.0))
    assert fitted(points, LEFT).coefficients[0] == pytest.approx(6.0, abs=0.02)
    assert fit_wall(cloud(points), RIGHT) is None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("share", [0.05, 0.15, 0.3])
def test_points_off_the_wall_do_not_pull(seed: int, share: float) -> None:
    generator = np.random.default_rng(seed)
    points = circle(-6.0, 240.0)
    count = int(share * len(points))
    stray = np.column_stack((generator.uniform(-20.0, 60.0, count), generator.uniform(-12.0, 12.0, count)))
    fit = fitted(np.vstack((noisy(points, seed), stray)))
    assert error(fit, points, 0.0) < CLOSE
    assert error(fit, points, 28.0) < FAR
    assert fit.share < 1.0


def test_a_car_beside_does_not_pull() -> None:
    """Its side between ours and the wall, which it hides."""
    points = circle(-9.0, 240.0)
    hidden = (points[:, 0] > 8.0) & (points[:, 0] < 20.0)
    side = np.column_stack((np.linspace(4.0, 9.0, 30), np.full(30, -4.0)))
    fit = fitted(np.vstack((noisy(points[~hidden]), noisy(side))))
    assert error(fit, points, 0.0) < CLOSE
    assert error(fit, points, 28.0) < FAR


def test_gaps_do_not_matter() -> None:
    points = circle(-7.0, 240.0)
    for low, high in ((-5.0, 5.0), (20.0, 40.0)):
        kept = points[(points[:, 0] < low) | (points[:, 0] > high)]
        fit = fitted(noisy(kept))
        assert error(fit, points, 0.0) < CLOSE
        assert error(fit, points, 28.0) < 2.0 * FAR


def test_reach_is_that_of_the_points() -> None:
    points = circle(-7.0, 240.0)
    fit = fitted(points[(points[:, 0] > -8.0) & (points[:, 0] < 31.0)])
    assert fit.begin == pytest.approx(-8.0, abs=0.5)
    assert fit.end == pytest.approx(31.0, abs=0.5)
    whole = fitted(points)
    assert BEHIND < whole.begin < BEHIND + 0.5
    assert AHEAD - 0.5 < whole.end < AHEAD


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 2)),
        straight(-7.5, 0.0)[:10],
        straight(-7.5, 0.0) + np.array((200.0, 0.0)),
        np.column_stack((np.linspace(0.0, 15.0, 100), np.full(100, -5.0))),
        np.column_stack((np.full(100, 3.0), np.linspace(-9.0, -1.0, 100))),
        np.tile((5.0, -5.0), (100, 1)),
        np.full((100, 2), np.nan),
        np.column_stack((np.linspace(-20.0, 60.0, 100), np.full(100, np.inf))),
        straight(7.5, 0.0),
    ],
    ids=["none", "few", "beyond", "short", "across", "one place", "nan", "infinite", "other side"],
)
def test_what_is_no_wall(points: Points) -> None:
    assert fit_wall(cloud(points), RIGHT) is None


@pytest.mark.parametrize("seed", range(10))
def test_chaos_is_no_wall(seed: int) -> None:
    generator = np.random.default_rng(seed)
    points = np.column_stack((generator.uniform(-20.0, 60.0, 300), generator.uniform(-12.0, 12.0, 300)))
    assert fit_wall(cloud(points), RIGHT) is None
    assert LEAST_SHARE >= 0.5  # two walls cannot both have it


def test_a_guess_changes_the_way_and_not_the_result() -> None:
    """Of a car that goes 3 m and turns by 0.01 rad between two scans, then of a wall that is somewhere else."""
    points = circle(-6.0, 240.0)
    before = fitted(noisy(circle(-6.1, 240.0, 0.01), 2))
    now = cloud(noisy(points, 3))
    cold, warm = fit_wall(now, RIGHT), fit_wall(now, RIGHT, before)
    assert cold is not None
    assert warm is not None
    assert [warm.at(x) for x in (-10.0, 0.0, 28.0)] == pytest.approx([cold.at(x) for x in (-10.0, 0.0, 28.0)], abs=2e-3)
    astray = fitted(straight(-14.0, 0.1))
    led = fit_wall(now, RIGHT, astray)
    assert led is not None
    assert error(led, points, 28.0) < FAR
