"""Motion models of opponents: against an ODE solver, Van Loan's method, and linearisation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from autonomy.opponents.motion_models import ConstantTurnRate, ConstantVelocity, RandomMotion, turned
from tools.opponent_peers import discretised

STATE = np.array([3.0, -5.0, 55.0, 20.0, 0.3])
MODELS = [ConstantVelocity(), ConstantTurnRate(), RandomMotion()]


def covariance(seed=0, scale=1.0):
    a = np.random.default_rng(seed).normal(size=(5, 5)) * [0.3, 0.3, 1.0, 1.0, 0.05]
    return scale * (a.T @ a + np.diag([0.1, 0.1, 0.5, 0.5, 0.01]))


@pytest.mark.parametrize("rate", [0.3, -1.2, 1e-9, 0.0])
@pytest.mark.parametrize("dt", [0.05, 1.0])
def test_turning_is_what_an_ode_solver_finds(rate, dt):
    start = np.array([*STATE[:4], rate])
    moved = solve_ivp(
        lambda _, s: [s[2], s[3], -s[4] * s[3], s[4] * s[2], 0.0], (0.0, dt), start, rtol=1e-11, atol=1e-11
    )
    np.testing.assert_allclose(turned(start, dt), moved.y[:, -1], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
def test_noise_is_that_of_the_continuous_process(model):
    """Van Loan, from scipy's matrix exponential: the noise of the linear part is what a prediction adds to it."""
    dt = 0.05
    drift = np.zeros((5, 5))
    if not isinstance(model, RandomMotion):
        drift[0, 2] = drift[1, 3] = 1.0
    position = model.position_noise if isinstance(model, RandomMotion) else 0.0
    density = np.diag(np.square([position, position, *[model.acceleration_noise] * 2, model.turn_rate_noise]))
    block = expm(dt * np.block([[-drift, density], [np.zeros((5, 5)), drift.T]]))
    transition = block[5:, 5:].T
    noise = transition @ block[:5, 5:]
    np.testing.assert_allclose(discretised(model, dt), noise, atol=1e-15)
    # At a standstill with nothing known better than that it does not turn, all three are linear.
    p = np.diag([0.2, 0.3, 1e-12, 1e-12, 1e-12])
    mean, predicted = model.predict(np.zeros((1, 5)), p[None], dt)
    np.testing.assert_allclose(mean[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(predicted[0], transition @ p @ transition.T + noise, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("model", [ConstantVelocity(), RandomMotion()], ids=lambda m: type(m).__name__)
def test_two_half_steps_are_one_step_of_a_linear_model(model):
    once = model.predict(STATE[None], covariance()[None], 0.1)
    twice = model.predict(*model.predict(STATE[None], covariance()[None], 0.05), 0.05)
    np.testing.assert_allclose(once[0], twice[0])
    np.testing.assert_allclose(once[1], twice[1])


@pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
def test_no_time_changes_nothing(model):
    mean, p = model.predict(STATE[None], covariance()[None], 0.0)
    np.testing.assert_allclose(mean[0], STATE, rtol=1e-13)
    np.testing.assert_allclose(p[0], covariance(), rtol=1e-9, atol=1e-12)


def test_a_small_spread_turns_as_the_jacobian_says():
    dt, small = 0.5, 1e-8
    jacobian = np.column_stack(
        [(turned(STATE + 1e-6 * e, dt) - turned(STATE - 1e-6 * e, dt)) / 2e-6 for e in np.eye(5)]
    )
    quiet = ConstantTurnRate(0.0, 0.0)
    mean, p = quiet.predict(STATE[None], covariance(scale=small)[None], dt)
    np.testing.assert_allclose(mean[0], turned(STATE, dt), atol=1e-6)
    np.testing.assert_allclose(p[0], jacobian @ covariance(scale=small) @ jacobian.T, rtol=1e-3, atol=1e-3 * small)


def test_a_wide_spread_turns_as_a_million_samples_do():
    dt, p = 0.2, covariance()
    rng = np.random.default_rng(4)
    samples = turned(rng.multivariate_normal(STATE, p, 1_000_000), dt)
    mean, predicted = ConstantTurnRate(0.0, 0.0).predict(STATE[None], p[None], dt)
    np.testing.assert_allclose(mean[0], samples.mean(axis=0), atol=0.01)  # a sample's mean is good to 0.001
    np.testing.assert_allclose(predicted[0], np.cov(samples.T), rtol=0.02, atol=0.02)
