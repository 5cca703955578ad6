"""The quadratic program with bounds against its optimality conditions and another solver."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.sparse import csc_array

from autonomy.box_qp import solve_box_qp

SEEDS = range(12)


@pytest.mark.parametrize("seed", SEEDS)
def test_random_problems_match_bounded_least_squares(seed):
    print("seed", seed)
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 40))
    a, b = rng.normal(size=(n + 3, n)), rng.normal(size=n + 3)
    lower = -rng.uniform(0.01, 0.5, n)
    upper = rng.uniform(0.01, 0.5, n)
    x = solve_box_qp(csc_array(a.T @ a), -a.T @ b, lower, upper)
    reference = lsq_linear(a, b, (lower, upper), method="bvls", tol=1e-14)
    np.testing.assert_allclose(x, reference.x, atol=1e-6)
    assert np.all((x > lower) & (x < upper))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_optimality_conditions_hold(seed):
    print("seed", seed)
    rng = np.random.default_rng(100 + seed)
    n = 30
    a = rng.normal(size=(n // 2, n))  # only semidefinite
    hessian, gradient = a.T @ a, rng.normal(size=n)
    lower, upper = np.full(n, -1.0), rng.uniform(0.0, 2.0, n)
    x = solve_box_qp(csc_array(hessian), gradient, lower, upper)
    slope = hessian @ x + gradient
    inside = (x - lower > 1e-4) & (upper - x > 1e-4)
    assert np.max(np.abs(slope[inside]), initial=0.0) < 1e-4
    assert np.all(slope[x - lower <= 1e-4] > -1e-4)
    assert np.all(slope[upper - x <= 1e-4] < 1e-4)


def test_an_unconstrained_minimum_inside_the_box_is_found():
    hessian = csc_array(np.diag([1.0, 4.0, 9.0]))
    x = solve_box_qp(hessian, np.array([-0.5, 1.0, 0.0]), np.full(3, -10.0), np.full(3, 10.0))
    np.testing.assert_allclose(x, [0.5, -0.25, 0.0], atol=1e-6)


def test_a_linear_problem_ends_in_the_corner():
    x = solve_box_qp(csc_array((2, 2)), np.array([1.0, -1.0]), np.array([-3.0, -3.0]), np.array([5.0, 5.0]))
    np.testing.assert_allclose(x, [-3.0, 5.0], atol=1e-6)
