"""Cross-entropy by blocks: families, projections, products."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate, optimize, stats

import samplers
from samplers.distributions import (
    BetaBlock,
    Distribution,
    NormalBlock,
    Product,
    announced_blocks,
    beta_statistics,
    project_beta,
    project_mean,
)
from samplers.proposals import Gaussian

BETA = BetaBlock(alpha=[2.0, 3.0], beta=[2.0, 1.5], low=[80.0, -0.25], high=[120.0, 0.25])


def test_beta_density_against_scipy(rng):
    x = BETA.sample(500, rng)
    expected = stats.beta([2, 3], [2, 1.5], [80, -0.25], [40, 0.5]).logpdf(x).sum(axis=1)
    np.testing.assert_allclose(BETA.log_prob(x), expected)
    assert np.isneginf(BETA.log_prob(np.array([[79.0, 0.0], [100.0, 0.3]]))).all()


def test_beta_map_reaches_far_tails():
    u = np.array([[-9.0, -9.0], [9.0, 9.0], [-30.0, 30.0]])
    x = BETA.from_standard_normal(u)
    assert ((x > BETA.low) & (x < BETA.high)).all()
    assert np.isfinite(BETA.log_prob(x)).all()
    np.testing.assert_allclose(BETA.to_standard_normal(BETA.from_standard_normal(u / 3))[:2], u[:2] / 3, atol=1e-6)


@pytest.mark.parametrize("change", [{"alpha": 1.0}, {"low": 120.0}, {"box": (0.0, 7.0)}])
def test_beta_settings_out_of_range(change):
    with pytest.raises(ValueError, match="BetaBlock: expected alpha and beta in the box"):
        BetaBlock(**{"alpha": 2.0, "beta": 2.0, "low": 80.0, "high": 120.0, **change})


MEAN, COVARIANCE = np.array([0.3, -0.2, 0.1]), np.array([[0.5, 0.2, 0.0], [0.2, 0.4, 0.1], [0.0, 0.1, 0.3]])
NORMAL = NormalBlock(Gaussian.from_covariance(MEAN, COVARIANCE), radius=0.4)
BASE = Product((BETA, NORMAL))


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
        block = block.project(np.tile(MEAN + 3, (4, 1)), np.full(4, 0.25), 0.8)
    np.testing.assert_allclose(np.abs(block.gaussian.mean - MEAN).max(), 0.4)
    np.testing.assert_array_equal(block.gaussian.cholesky, NORMAL.gaussian.cholesky)


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
        (samplers.as_distribution([stats.norm()]), "expected a block with .*, got ScipyDistribution"),
        (SimpleNamespace(), "needs a base distribution with an attribute blocks"),
        (SimpleNamespace(blocks=(SimpleNamespace(mean=MEAN),)), "expected a block with alpha, beta, low and high"),
        (SimpleNamespace(blocks=(BETA,), log_prob=BETA.log_prob), "are not its distribution"),
        (SimpleNamespace(blocks=BASE.blocks, log_prob=lambda x: BASE.log_prob(x) + 0.01), "are not its distribution"),
    ],
)
def test_blocks_that_do_not_fit(base, message):
    with pytest.raises(ValueError, match=message):
        announced_blocks(SimpleNamespace(dim=5, base=base))


BOX = (1.5, 7.0)


def test_beta_projection_is_the_optimum(rng):
    """Statistics of distributions in and far out of the box: optima inside, on the four edges, in the four corners.

    The objective is convex: its gradient is 0 inside the box and points outwards at its ends.
    """
    alpha, beta = np.exp(rng.uniform(np.log(0.2), np.log(60), size=(2, 300)))
    statistics = beta_statistics(alpha, beta)
    # a few points instead of a distribution: both statistics high, as no Beta in the box has them
    few = rng.uniform(0.01, 0.99, size=(50, 3))
    statistics = np.concatenate([statistics, np.stack([np.log(few).mean(axis=1), np.log1p(-few).mean(axis=1)], 1)])
    found = project_beta(statistics, *BOX)
    slope = statistics - beta_statistics(*found.T)
    at_low, at_high = found == BOX[0], found == BOX[1]
    assert (np.abs(slope[~at_low & ~at_high]) < 1e-4).all()
    assert (slope[at_low] < 1e-4).all() and (slope[at_high] > -1e-4).all()
    kinds = {tuple(kind) for kind in (np.where(at_low, -1, 0) + np.where(at_high, 1, 0)).tolist()}
    assert len(kinds) == 9  # inside, four edges, four corners


def correlated(dim, rng, scale=0.05):
    factors = rng.standard_normal((dim, dim // 4 + 1))
    covariance = scale**2 * (factors @ factors.T / factors.shape[1] + 0.2 * np.eye(dim))
    return np.linalg.cholesky(covariance)


@pytest.mark.parametrize("scale", [1e-3, 0.05, 100.0])
def test_mean_projection_against_a_generic_solver(rng, scale):
    """The answer of bounded least squares; clipping each coordinate is worse."""
    for dim in (2, 5, 30):
        cholesky, centre = correlated(dim, rng, scale), scale * rng.standard_normal(dim)
        target, radius = centre + scale * rng.standard_normal(dim), 0.5 * scale
        inverse = np.linalg.inv(cholesky)
        generic = optimize.lsq_linear(inverse, inverse @ (target - centre), (-radius, radius), tol=1e-14).x + centre
        found = project_mean(target, centre, cholesky, radius)
        assert np.abs(found - centre).max() <= radius * (1 + 1e-12)
        np.testing.assert_allclose(found, generic, atol=1e-5 * scale)
    clipped = np.clip(target, centre - radius, centre + radius)
    far, farther = (np.sum((inverse @ (mean - target)) ** 2) for mean in (found, clipped))
    assert far < 0.99 * farther


CE = samplers.CrossEntropy


class BlockProblem:
    """f = beta + 4 (y_0 - 1/2) - z: y_0 ~ Beta(2, 2), z ~ N(0, 1) a sum over all Normal coordinates."""

    def __init__(self, n_beta, n_normal, beta, radius):
        rng = np.random.default_rng(3)
        factors = rng.standard_normal((n_normal, n_normal // 4 + 1))
        covariance = 0.05**2 * (factors @ factors.T / factors.shape[1] + 0.3 * np.eye(n_normal))
        self.beta, self.mean = beta, 0.1 * rng.standard_normal(n_normal)
        self.direction = np.ones(n_normal) / np.sqrt(covariance.sum())
        self.low, self.high = rng.uniform(-1, 0, n_beta), rng.uniform(1, 40, n_beta)
        normal = NormalBlock(Gaussian.from_covariance(self.mean, covariance), radius=radius)
        self.base = Product((BetaBlock(alpha=2.0, beta=2.0, low=self.low, high=self.high), normal))
        self.dim = n_beta + n_normal

    def evaluate(self, x):
        y = (x[:, 0] - self.low[0]) / (self.high[0] - self.low[0])
        return self.beta + 4 * (y - 0.5) - (x[:, len(self.low) :] - self.mean) @ self.direction

    @property
    def p(self):
        return integrate.quad(lambda y: stats.norm.sf(self.beta + 4 * (y - 0.5)) * stats.beta.pdf(y, 2, 2), 0, 1)[0]


@pytest.mark.slow
@pytest.mark.parametrize("ratio", ["joint", "block"])
def test_right_and_covered(study, ratio):
    problem = BlockProblem(3, 6, 4.0, radius=0.1)
    reference = SimpleNamespace(problem=problem, p=problem.p)
    found = study(reference, CE(family="blocks", likelihood_ratio=ratio), 60)
    found.check(0.01)
    assert found.own_cov < 0.08  # plain Monte Carlo with as many simulations: 0.3
    assert {str(result.status) for result in found.results} == {"converged"}


@pytest.mark.slow
def test_the_paper_s_highway_of_428_dimensions():
    """24 Beta, 404 Normal with full covariance and the mean in a box of 0.01."""
    problem = BlockProblem(24, 404, 4.0, radius=0.01)
    method = CE(family="blocks", n_iteration=5000, n_final=5000, wide_share=0.0)
    start = time.process_time()
    result = samplers.estimate(problem, method, seed=1)
    assert time.process_time() - start < 15.0  # 2 s as a rule
    assert result.p == pytest.approx(problem.p, rel=4 * result.cov)
    assert result.cov < 0.15  # plain Monte Carlo with 10,000: 0.23
    assert not result.warnings
    final = result.sample
    assert final.weights.sum() == pytest.approx(1.0, abs=4 * final.weights.std() * np.sqrt(len(final.weights)))


def test_joint_ratio_is_the_projection_of_equation_2(rng):
    """Two Beta coordinates that fail together, from a proposal shifted in both.

    Under Q, the base distribution given y_0 + y_1 <= 0.7, E[log y] is known by numerical integration. The joint ratio
    finds it, the blockwise one does not.
    """
    base = Product(tuple(BetaBlock(alpha=2.0, beta=2.0, low=0.0, high=1.0) for _ in range(2)))
    shifted = Product(tuple(BetaBlock(alpha=1.5, beta=4.0, low=0.0, high=1.0) for _ in range(2)))
    distribution = stats.beta(2, 2)

    def given(g):
        return integrate.quad(lambda y: g(y) * distribution.pdf(y) * distribution.cdf(0.7 - y), 0, 0.7)[0]

    expected = [given(np.log) / given(np.ones_like), given(lambda y: np.log1p(-y)) / given(np.ones_like)]
    u = shifted.sample(400_000, rng)
    elite = u[u.sum(axis=1) <= 0.7]
    ratios = base.log_probs(elite) - shifted.log_probs(elite)
    for ratio, right in (("joint", True), ("block", False)):
        moved = CE(family="blocks", likelihood_ratio=ratio, alpha=1.0)._project(shifted, elite, ratios)
        for block in moved.blocks:
            assert block.box[0] < block.alpha[0] < block.box[1]
            found = [stats.beta(block.alpha[0], block.beta[0]).expect(g) for g in (np.log, lambda y: np.log1p(-y))]
            assert np.allclose(found, expected, atol=0.02) == right
