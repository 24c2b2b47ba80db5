from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from samplers import Distribution
from samplers.methods.blocks import BetaBlock, GaussianBlock, NormalBlock, Product, announced_blocks
from samplers.proposals import Gaussian

MEAN, COVARIANCE = np.array([0.3, -0.2, 0.1]), np.array([[0.5, 0.2, 0.0], [0.2, 0.4, 0.1], [0.0, 0.1, 0.3]])
BETA = BetaBlock(alpha=[2.0, 3.0], beta=[2.0, 1.5], low=[80.0, -0.25], high=[120.0, 0.25])
NORMAL = NormalBlock(Gaussian.from_covariance(MEAN, COVARIANCE), radius=0.4)
BASE = Product((BETA, NORMAL))


def uniform_weights(n):
    return np.full(n, 1 / n)


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
        (SimpleNamespace(blocks=(BETA,), log_prob=BETA.log_prob), "are not its distribution"),
        (SimpleNamespace(blocks=BASE.blocks, log_prob=lambda x: BASE.log_prob(x) + 0.01), "are not its distribution"),
    ],
)
def test_blocks_that_do_not_fit(base, message):
    with pytest.raises(ValueError, match=message):
        announced_blocks(SimpleNamespace(dim=5, base=base))


def test_no_blocks():
    with pytest.raises(ValueError, match="at least one block"):
        Product(())


def test_gaussian_block_is_pulled_towards_its_present_covariance():
    elite = np.tile([2.0, 1.0], (10, 1))
    moved = GaussianBlock(Gaussian.standard(2)).project(elite, uniform_weights(10), 1.0)
    np.testing.assert_allclose(moved.gaussian.mean, [2.0, 1.0])
    np.testing.assert_allclose(moved.gaussian.covariance, 3 / 13 * np.eye(2), atol=1e-12)
