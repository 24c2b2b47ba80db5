"""Beta blocks: density, draws and map against SciPy, and steps of cross-entropy in a box."""

import numpy as np
import pytest
from scipy import optimize, stats

from samplers.methods.blocks import BetaBlock

BETA = BetaBlock(alpha=[2.0, 3.0], beta=[2.0, 1.5], low=[80.0, -0.25], high=[120.0, 0.25])


def uniform_weights(n):
    return np.full(n, 1 / n)


def test_beta_density_against_scipy(rng):
    x = BETA.sample(500, rng)
    expected = stats.beta([2, 3], [2, 1.5], [80, -0.25], [40, 0.5]).logpdf(x).sum(axis=1)
    np.testing.assert_allclose(BETA.log_prob(x), expected)
    assert np.isneginf(BETA.log_prob(np.array([[79.0, 0.0], [100.0, 0.3]]))).all()


def test_beta_draws_follow_their_distribution(rng):
    x = BETA.sample(20_000, rng)
    for column, distribution in zip(x.T, (stats.beta(2, 2, 80, 40), stats.beta(3, 1.5, -0.25, 0.5)), strict=True):
        assert stats.kstest(column, distribution.cdf).pvalue > 1e-3


def test_beta_map_reaches_far_tails():
    u = np.array([[-9.0, -9.0], [9.0, 9.0], [-30.0, 30.0]])
    x = BETA.from_standard_normal(u)
    assert ((x > BETA.low) & (x < BETA.high)).all()
    assert np.isfinite(BETA.log_prob(x)).all()
    np.testing.assert_allclose(BETA.to_standard_normal(BETA.from_standard_normal(u / 3))[:2], u[:2] / 3, atol=1e-6)


def test_beta_step_is_the_projection_of_the_mixture(rng):
    """Against the mixture's own likelihood: draws of Q and of P, weighted, in a generic solver."""
    block = BetaBlock(alpha=2.0, beta=2.0, low=0.0, high=1.0)
    elite = rng.beta(4.0, 1.8, size=(40_000, 1))
    moved = block.project(elite, uniform_weights(len(elite)), 0.8)
    y = np.concatenate([elite[:, 0], rng.beta(2.0, 2.0, size=10_000)])  # 0.8 to 0.2
    generic = optimize.minimize(lambda t: -stats.beta(*t).logpdf(y).mean(), [2.0, 2.0], bounds=[(1.5, 7.0)] * 2)
    np.testing.assert_allclose([moved.alpha[0], moved.beta[0]], generic.x, rtol=0.03)


def test_beta_steps_stay_in_the_box(rng):
    elite = np.stack([80 + 1e-9 * rng.random(9), 0.25 - 1e-12 * rng.random(9)], axis=1)
    moved = BETA.project(elite, uniform_weights(9), 1.0)
    np.testing.assert_array_equal(moved.alpha, [1.5, 7.0])
    np.testing.assert_array_equal(moved.beta, [7.0, 1.5])
    assert np.isfinite(moved.log_prob(elite)).all()


def test_beta_widened():
    block = BetaBlock(alpha=6.0, beta=6.0, low=0.0, high=1.0)
    wide = block.widen(1.3)
    assert stats.beta(wide.alpha, wide.beta).std() == pytest.approx(1.3 * stats.beta(6, 6).std())
    np.testing.assert_array_equal(block.widen(100.0).alpha, 1.5)


@pytest.mark.parametrize("change", [{"alpha": 1.0}, {"beta": 9.0}, {"low": 120.0}, {"box": (0.0, 7.0)}])
def test_beta_settings_out_of_range(change):
    with pytest.raises(ValueError, match="BetaBlock: expected alpha and beta in the box"):
        BetaBlock(**{"alpha": 2.0, "beta": 2.0, "low": 80.0, "high": 120.0, **change})
