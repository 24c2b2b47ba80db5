from types import SimpleNamespace

import numpy as np
import pytest
from scipy import optimize, stats

from samplers import Distribution
from samplers.methods.cross_entropy.beta_block import BetaBlock
from samplers.methods.cross_entropy.blocks import GaussianBlock, MixtureBlock, NormalBlock, Product, announced_blocks
from samplers.proposals.gaussian import Gaussian

MEAN, COVARIANCE = np.array([0.3, -0.2, 0.1]), np.array([[0.5, 0.2, 0.0], [0.2, 0.4, 0.1], [0.0, 0.1, 0.3]])
BETA = BetaBlock(alpha=[2.0, 3.0], beta=[2.0, 1.5], low=[80.0, -0.25], high=[120.0, 0.25])
NORMAL = NormalBlock(Gaussian.from_covariance(MEAN, COVARIANCE), radius=0.4)
BASE = Product((BETA, NORMAL))


def uniform_weights(n):
    return np.full(n, 1 / n)


def test_beta_density_against_scipy(rng):
    x = BETA.sample(500, rng)
    expected = stats.beta([2, 3], [2, 1.5], [80, -0.25], [40, 0.5]).logpdf(x).sum(axis=1)
    np.testing.assert_allclose(BETA.log_prob(x), expected)
    assert np.isneginf(BETA.log_prob(np.array([[79.0, 0.0], [100.0, 0.3]]))).all()


def test_beta_draws_follow_their_law(rng):
    x = BETA.sample(20_000, rng)
    for column, law in zip(x.T, (stats.beta(2, 2, 80, 40), stats.beta(3, 1.5, -0.25, 0.5)), strict=True):
        assert stats.kstest(column, law.cdf).pvalue > 1e-3


def test_product_is_a_distribution_with_an_exact_map(rng):
    assert isinstance(BASE, Distribution)
    assert BASE.dim == 5
    x = BASE.sample(20_000, rng)
    u = BASE.to_standard_normal(x)
    np.testing.assert_allclose(BASE.from_standard_normal(u), x, rtol=1e-9, atol=1e-9)
    for column in u.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3
    np.testing.assert_allclose(np.cov(u.T), np.eye(5), atol=0.05)
    expected = BETA.log_prob(x[:, :2]) + stats.multivariate_normal(MEAN, COVARIANCE).logpdf(x[:, 2:])
    np.testing.assert_allclose(BASE.log_prob(x), expected)


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


def test_normal_steps_stay_in_the_box_around_the_base_mean():
    block = NORMAL
    for _ in range(5):
        block = block.project(np.tile(MEAN + 3, (4, 1)), uniform_weights(4), 0.8)
    np.testing.assert_allclose(np.abs(block.gaussian.mean - MEAN).max(), 0.4)
    np.testing.assert_array_equal(block.gaussian.cholesky, NORMAL.gaussian.cholesky)


def test_a_normal_step_inside_the_box_matches_the_mean():
    moved = NORMAL.project(np.tile(MEAN + 0.1, (4, 1)), uniform_weights(4), 0.5)
    np.testing.assert_allclose(moved.gaussian.mean, MEAN + 0.05)


def test_a_block_of_radius_0_stays():
    moved = NormalBlock(NORMAL.gaussian, radius=0.0).project(np.ones((4, 3)), uniform_weights(4), 1.0)
    np.testing.assert_array_equal(moved.gaussian.mean, MEAN)


def test_blocks_move_on_their_own(rng):
    x, weights = BASE.sample(50, rng), rng.dirichlet(np.ones(50), size=2)
    moved = BASE.project(x, weights, 0.7)
    np.testing.assert_array_equal(moved.blocks[0].alpha, BETA.project(x[:, :2], weights[0], 0.7).alpha)
    np.testing.assert_array_equal(
        moved.blocks[1].gaussian.mean, NORMAL.project(x[:, 2:], weights[1], 0.7).gaussian.mean
    )


def test_blocks_by_attributes_alone(rng):
    """A base distribution that knows nothing of this package announces its blocks as plain objects."""
    entries = (
        SimpleNamespace(alpha=BETA.alpha, beta=BETA.beta, low=BETA.low, high=BETA.high, box=(1.0, 8.0)),
        SimpleNamespace(mean=MEAN, covariance=COVARIANCE, radius=0.4),
    )
    base = SimpleNamespace(blocks=entries, log_prob=BASE.log_prob)
    found = announced_blocks(SimpleNamespace(dim=5, base=base))
    x = BASE.sample(10, rng)
    np.testing.assert_allclose(found.log_prob(x), BASE.log_prob(x))
    assert found.blocks[0].box == (1.0, 8.0)
    assert found.blocks[1].radius == 0.4


@pytest.mark.parametrize(
    ("base", "message"),
    [
        (SimpleNamespace(), "needs a base distribution with an attribute blocks"),
        (SimpleNamespace(blocks=(SimpleNamespace(mean=MEAN),)), "expected a block with alpha, beta, low and high"),
        (SimpleNamespace(blocks=(BETA,), log_prob=BETA.log_prob), "are not its law"),
        (SimpleNamespace(blocks=BASE.blocks, log_prob=lambda x: BASE.log_prob(x) + 0.01), "are not its law"),
    ],
)
def test_blocks_that_do_not_fit(base, message):
    with pytest.raises(ValueError, match=message):
        announced_blocks(SimpleNamespace(dim=5, base=base))


@pytest.mark.parametrize("change", [{"alpha": 1.0}, {"beta": 9.0}, {"low": 120.0}, {"box": (0.0, 7.0)}])
def test_beta_settings_out_of_range(change):
    with pytest.raises(ValueError, match="BetaBlock: expected alpha and beta in the box"):
        BetaBlock(**{"alpha": 2.0, "beta": 2.0, "low": 80.0, "high": 120.0, **change})


def test_no_blocks():
    with pytest.raises(ValueError, match="at least one block"):
        Product(())


def test_mixture_splits_into_two_regions(rng):
    """Two clusters and a step alpha = 1: one component each, with the share and the mean of its cluster."""
    elite = rng.standard_normal((4000, 2)) * 0.3 + np.where(rng.random((4000, 1)) < 0.25, [3.0, 0.0], [-3.0, 1.0])
    moved = MixtureBlock(Gaussian.standard(2), 2).project(elite, uniform_weights(4000), 1.0)
    order = np.argsort(moved.mixture.weights)
    np.testing.assert_allclose(moved.mixture.weights[order], [0.25, 0.75], atol=0.03)
    means = np.array([moved.mixture.components[j].mean for j in order])
    np.testing.assert_allclose(means, [[3.0, 0.0], [-3.0, 1.0]], atol=0.05)
    np.testing.assert_allclose(moved.mixture.components[0].covariance, 0.09 * np.eye(2), atol=0.02)


def test_mixture_steps_raise_the_objective_of_equation_2(rng):
    """alpha E_Q[log p] + (1 - alpha) E_P[log p], by draws; no pull worth mentioning at 20,000 points."""
    elite = rng.standard_normal((20_000, 2)) + np.where(rng.random((20_000, 1)) < 0.3, [3.0, 0.0], [0.0, 3.0])
    block = MixtureBlock(Gaussian.standard(2), 3).project(elite, uniform_weights(20_000), 0.5)
    other = elite * [1.0, 0.6]
    values = []
    draws = block.sample(20_000, rng)
    for law in (block, block.project(other, uniform_weights(20_000), 0.7)):
        values.append(0.7 * law.log_prob(other).mean() + 0.3 * law.log_prob(draws).mean())
    assert values[1] > values[0] + 0.01


def test_mixture_keeps_the_share_1_minus_alpha_of_the_present_law():
    """All of Q in one point: with alpha = 0.8 the mean of the new mixture is 0.8 of the way there."""
    elite = np.tile([2.0, 1.0], (50, 1))
    block = MixtureBlock(Gaussian.standard(2), 3).project(elite, uniform_weights(50), 0.8)
    mean = sum(w * c.mean for w, c in zip(block.mixture.weights, block.mixture.components, strict=True))
    np.testing.assert_allclose(mean, [1.6, 0.8])
    x = np.random.default_rng(1).standard_normal((100, 2))
    start = MixtureBlock(Gaussian.standard(2), 3)
    np.testing.assert_allclose(start.log_prob(x), Gaussian.standard(2).log_prob(x))


def test_gaussian_block_is_pulled_towards_its_present_covariance():
    elite = np.tile([2.0, 1.0], (10, 1))
    moved = GaussianBlock(Gaussian.standard(2)).project(elite, uniform_weights(10), 1.0)
    np.testing.assert_allclose(moved.gaussian.mean, [2.0, 1.0])
    np.testing.assert_allclose(moved.gaussian.covariance, 3 / 13 * np.eye(2), atol=1e-12)
