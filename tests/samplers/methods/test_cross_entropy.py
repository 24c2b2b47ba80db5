"""Cross-entropy: search, families, weights of the final draws, warnings."""

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.distributions import GaussianBlock, MixtureBlock, Product
from samplers.limit_states import four_branches, half_space, parabola, two_modes
from samplers.proposals import Gaussian

CE = samplers.CrossEntropy


@pytest.mark.parametrize(
    "reference",
    [two_modes(), *(pytest.param(each, marks=pytest.mark.slow) for each in (four_branches(3.0), parabola()))],
    ids=lambda r: r.name,
)
def test_mixture_family(study, reference):
    found = study(reference, CE(family="mixture"), 40)
    found.check(0.02)
    assert found.own_cov < 0.05


@pytest.mark.parametrize(("method", "dim"), [(CE(), 2), (samplers.TwoStage(), 100)], ids=["ce", "two-stage"])
def test_final_draws_serve_higher_thresholds(method, dim):
    """P[u >= beta - g] of all g from the weights of all final draws."""
    problem = half_space(dim, 3.5).problem
    sample = samplers.estimate(problem, method, seed=1).sample
    for g in (0.0, 0.5, 1.0, 2.0, 3.5):
        weights = sample.weights[sample.f <= g]
        assert weights.sum() == pytest.approx(stats.norm.sf(3.5 - g), abs=4 * np.sqrt((weights**2).sum()))
    np.testing.assert_allclose(problem.f(sample.x), sample.f[sample.f <= 0])


def test_a_step_of_the_search_uses_the_likelihood_ratio(rng):
    """From N((1.5, 0), I) the step aims at N(0, I) given u1 > 2: mean phi(2) / Phi(-2) = 2.373.

    Without the weights it would be 1.5 + phi(0.5) / Phi(-0.5) = 2.641.
    """
    proposal = Gaussian(np.array([1.5, 0.0]), np.eye(2))
    u = proposal.sample(200_000, rng)
    u = u[u[:, 0] > 2.0]
    log_ratios = (Gaussian.standard(2).log_prob(u) - proposal.log_prob(u))[None]
    moved = CE(alpha=1.0)._project(Product((GaussianBlock(proposal),)), u, log_ratios)
    np.testing.assert_allclose(moved.blocks[0].gaussian.mean, [stats.norm.pdf(2) / stats.norm.sf(2), 0.0], atol=0.02)


@pytest.mark.slow
def test_interval_of_a_hopeless_proposal_still_holds_p():
    """d = 300: the weights degenerate, p-hat is far too small, and the result does not hide it."""
    reference = half_space(300)
    for seed in range(4):
        result = samplers.estimate(reference.problem, CE(), seed=seed, max_sim=4000)
        assert result.interval[0] <= reference.p <= result.interval[1]
        assert result.warnings


def test_mixture_keeps_the_share_1_minus_alpha_of_the_present_distribution():
    """All of Q in one point: with alpha = 0.8 the mean of the new mixture is 0.8 of the way there."""
    elite = np.tile([2.0, 1.0], (50, 1))
    block = MixtureBlock(Gaussian.standard(2), 3).project(elite, np.full(50, 1 / 50), 0.8)
    mean = sum(w * c.mean for w, c in zip(block.mixture.weights, block.mixture.components, strict=True))
    np.testing.assert_allclose(mean, [1.6, 0.8])
    x = np.random.default_rng(1).standard_normal((100, 2))
    start = MixtureBlock(Gaussian.standard(2), 3)
    np.testing.assert_allclose(start.log_prob(x), Gaussian.standard(2).log_prob(x))
