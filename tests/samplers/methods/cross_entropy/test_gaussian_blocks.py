import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.distributions import as_distribution
from samplers.methods.blocks import GaussianBlock, MappedBlock
from samplers.proposals import Gaussian


@pytest.fixture
def moved():
    block = MappedBlock(as_distribution(stats.expon()))
    elite = stats.expon.isf([[1e-3], [2e-3], [4e-3], [8e-3]])
    return block.project(elite, np.full(4, 0.25), alpha=0.8)


def test_a_moved_block_is_a_distribution(moved):
    """Its density integrates to 1, and its draws have it."""
    x = np.linspace(1e-9, 60.0, 600_001)[:, None]
    density = np.exp(moved.log_prob(x))
    assert np.trapezoid(density, x[:, 0]) == pytest.approx(1.0, abs=1e-4)
    cdf = np.interp(np.sort(moved.sample(4000, np.random.default_rng(0))[:, 0]), x[:, 0], np.cumsum(density) * 1e-4)
    assert stats.kstest(cdf, "uniform").pvalue > 1e-3


def test_its_image_is_moved_as_a_gaussian_block(moved):
    elite = stats.norm.isf([[1e-3], [2e-3], [4e-3], [8e-3]])
    wanted = GaussianBlock(Gaussian.standard(1)).project(elite, np.full(4, 0.25), alpha=0.8)
    np.testing.assert_allclose(moved.image.gaussian.mean, wanted.gaussian.mean)
    np.testing.assert_allclose(moved.image.gaussian.covariance, wanted.gaussian.covariance)


def test_outside_the_support_the_density_is_zero(moved):
    assert moved.log_prob(np.array([[-1.0]])).tolist() == [-np.inf]
    assert moved.widen(2.0).image.gaussian.covariance == pytest.approx(4.0 * moved.image.gaussian.covariance)


def test_a_product_takes_distributions_of_scipy_and_openturns():
    openturns = pytest.importorskip("openturns")
    base = samplers.Product(
        [stats.lognorm(0.5), samplers.BetaBlock(alpha=2.0, beta=2.0, low=0.0, high=1.0), openturns.ClaytonCopula(2.0)]
    )
    assert base.dim == 4
    assert isinstance(base.blocks[0], MappedBlock)


def test_cross_entropy_by_blocks_finds_p_under_them():
    """P[x1 + x2 >= 12] for independent Exp(1): (1 + 12) exp(-12) = 8.0e-5."""
    base = samplers.Product([stats.expon(), stats.expon()])
    problem = samplers.FunctionProblem(lambda x: 12.0 - x.sum(axis=1), base=base)
    result = samplers.estimate(problem, samplers.CrossEntropy(family="blocks"), seed=0, max_sim=10_000)
    assert abs(result.p / (13 * np.exp(-12.0)) - 1) < 4 * result.cov < 1.0
