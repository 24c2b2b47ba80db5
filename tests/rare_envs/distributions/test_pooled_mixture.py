"""Pools of mixtures: density, exact map and draws, in the same coordinates and in different ones."""

import numpy as np
import pytest
from scipy import integrate, stats

from rare_envs.distributions import ClosingSpeed, Coordinates, TruncatedGaussianMixture
from rare_envs.distributions.mixture import PooledMixture, pool_mixtures

NAMES = ("speed", "lead_speed", "gap")
BOX = {"low": [0.0, 0.0, 1.0], "high": [45.0, 45.0, 150.0], "names": NAMES}
CLOSING = Coordinates(**BOX, kinds=("plain", ClosingSpeed("speed", "gap"), "log"), order=("speed", "gap", "lead_speed"))
LOG_GAP = Coordinates(**BOX, kinds=("plain", "plain", "log"))
PLAIN = Coordinates(BOX["low"], BOX["high"], ("plain",) * 3)  # a file may leave the names of plain columns out
IN_CLOSING = TruncatedGaussianMixture([1.0], [[15.0, 3.0, 0.1]], [np.diag([4.0, 0.2, 0.1])], coordinates=CLOSING)
IN_LOG_GAP = TruncatedGaussianMixture(
    [0.7, 0.3],
    [[15.0, 15.0, 3.0], [25.0, 24.0, 3.5]],
    [[[4.0, 3.0, 0.2], [3.0, 4.0, 0.1], [0.2, 0.1, 0.2]], np.diag([4.0, 9.0, 0.1])],
    coordinates=LOG_GAP,
)
IN_PLAIN = TruncatedGaussianMixture([1.0], [[14.0, 14.0, 30.0]], [np.diag([9.0, 9.0, 100.0])], coordinates=PLAIN)
POOL = pool_mixtures([IN_CLOSING, IN_LOG_GAP, IN_LOG_GAP, IN_PLAIN])


def test_the_density_is_the_mean_of_the_densities() -> None:
    """Another order of the columns cuts a mixture otherwise at the box, beyond which lie 1e-3 and less of these."""
    assert isinstance(POOL, PooledMixture)
    assert POOL.shares.tolist() == [0.25, 0.5, 0.25]
    x = POOL.sample(2000, np.random.default_rng(0))
    mean = np.mean([np.exp(each.log_prob(x)) for each in (IN_CLOSING, IN_LOG_GAP, IN_LOG_GAP, IN_PLAIN)], axis=0)
    np.testing.assert_allclose(np.exp(POOL.log_prob(x)), mean, rtol=5e-3)
    assert POOL.log_prob([[50.0, 10.0, 10.0]])[0] == -np.inf


def test_the_map_goes_there_and_back_far_into_the_tails() -> None:
    u = np.vstack([np.random.default_rng(1).standard_normal((500, 3)), np.full((1, 3), -6.0), np.full((1, 3), 6.0)])
    x = POOL.from_standard_normal(u)
    assert ((x > POOL.low) & (x < POOL.high)).all()
    assert np.abs(POOL.to_standard_normal(x) - u).max() < 1e-7
    assert (POOL.from_standard_normal(u[:7]) == x[:7]).all()  # a row does not depend on the others


def test_the_map_is_that_of_the_density() -> None:
    """|det du/dx| phi(u) = p(x), by central differences of relative error 1e-6."""
    x = POOL.sample(20, np.random.default_rng(2))
    step = 1e-5
    jacobian = np.stack(
        [
            (POOL.to_standard_normal(x + step * e) - POOL.to_standard_normal(x - step * e)) / (2 * step)
            for e in np.eye(3)
        ],
        axis=2,
    )
    u = POOL.to_standard_normal(x)
    log_p = stats.norm.logpdf(u).sum(axis=1) + np.log(np.abs(np.linalg.det(jacobian)))
    np.testing.assert_allclose(log_p, POOL.log_prob(x), atol=1e-4)


def test_draws_follow_the_density() -> None:
    """In one dimension against the integral of the density: Kolmogorov-Smirnov at the level 1e-4."""
    plain, log = (Coordinates([1.0], [99.0], (kind,), ("gap",)) for kind in ("plain", "log"))
    parts = (
        TruncatedGaussianMixture([1.0], [[20.0]], [[[9.0]]], coordinates=plain),
        TruncatedGaussianMixture([1.0], [[3.5]], [[[0.01]]], coordinates=log),
    )
    pool = pool_mixtures(parts)
    x = pool.sample(4000, np.random.default_rng(3))[:, 0]
    grid = np.linspace(1.0, 99.0, 4001)
    density = np.exp(pool.log_prob(grid[1:-1, None]))
    cdf = integrate.cumulative_trapezoid(np.concatenate([[0.0], density, [0.0]]), grid, initial=0.0)
    assert cdf[-1] == pytest.approx(1.0, abs=1e-4)
    assert stats.kstest(x, lambda values: np.interp(values, grid, cdf)).pvalue > 1e-4


def test_pools_that_cannot_be_are_refused() -> None:
    other = TruncatedGaussianMixture([1.0], [[0.0] * 3], [np.eye(3)], [-1.0] * 3, [1.0] * 3)
    with pytest.raises(ValueError, match="same box, but mixtures 0 and 1 differ"):
        pool_mixtures([IN_CLOSING, other])
    backward = Coordinates(**BOX, kinds=(ClosingSpeed("lead_speed", "gap"), "plain", "log"), order=NAMES[::-1])
    against = TruncatedGaussianMixture([1.0], [[3.0, 15.0, 0.1]], [np.diag([0.2, 4.0, 0.1])], coordinates=backward)
    with pytest.raises(ValueError, match="No order of the columns serves the coordinates of all mixtures"):
        pool_mixtures([IN_CLOSING, against])
