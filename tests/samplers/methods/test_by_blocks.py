"""Cross-entropy on bases of blocks, those of O'Kelly et al. among them."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate, stats

import samplers
from samplers.method import Goal
from samplers.methods.blocks import BetaBlock, NormalBlock, Product
from samplers.proposals import Gaussian

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
    assert abs(found.ratios.mean() - 1) < 4 * found.ratios.std() / np.sqrt(60) + 0.01
    assert found.covered >= stats.binom.ppf(1e-3, 60, 0.90)
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


def test_every_proposal_keeps_to_the_boxes(drive):
    problem, method = BlockProblem(4, 12, 5.0, radius=0.01), CE(family="blocks")
    base, space = method._start(problem)
    steps = method._search(base, space, Goal(gamma=0.0), np.random.default_rng(1))
    _, kept = drive(steps, problem).value
    assert len(kept) > 3
    for iterate in kept:
        beta, normal = iterate.proposal.blocks
        assert min(beta.alpha.min(), beta.beta.min()) >= 1.5
        assert max(beta.alpha.max(), beta.beta.max()) <= 7.0
        assert np.abs(normal.gaussian.mean - problem.mean).max() <= 0.01 * (1 + 1e-9)
    last = kept[-1].proposal.blocks
    assert last[0].alpha[0] < 2.0 < last[0].beta[0]
    assert (last[1].gaussian.mean - problem.mean).mean() > 0.005  # of at most 0.01


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
        moved = CE(family="blocks", likelihood_ratio=ratio)._project(shifted, elite, ratios, 1.0)
        for block in moved.blocks:
            assert block.box[0] < block.alpha[0] < block.box[1]
            found = [stats.beta(block.alpha[0], block.beta[0]).expect(g) for g in (np.log, lambda y: np.log1p(-y))]
            assert np.allclose(found, expected, atol=0.02) == right
