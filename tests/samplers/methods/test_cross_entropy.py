"""Cross-entropy: search, families, weights of the final draws, warnings."""

import math

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.limit_states import four_branches, half_space, parabola, two_modes
from samplers.methods.blocks import GaussianBlock, MixtureBlock, Product
from samplers.proposals import Gaussian

CE = samplers.CrossEntropy


def mean_error(found):
    return found.ratios.std(ddof=1) / math.sqrt(len(found.results))


def test_search_goes_down_to_gamma_and_is_counted():
    result = samplers.estimate(half_space().problem, CE(), seed=1)
    levels = [level.gamma for level in result.trace]
    assert levels == sorted(levels, reverse=True)
    assert levels[-1] == 0.0
    assert result.n_sim == sum(level.n_sim for level in result.trace)
    assert result.trace[-1].n_sim == 4000
    assert result.p == result.trace[-1].estimate  # the fresh draws alone


@pytest.mark.parametrize(
    "reference",
    [
        two_modes(),
        pytest.param(four_branches(3.0), marks=pytest.mark.slow),
        pytest.param(parabola(), marks=pytest.mark.slow),
    ],
    ids=lambda r: r.name,
)
def test_mixture_family(study, reference):
    found = study(reference, CE(family="mixture"), 40)
    assert abs(found.ratios.mean() - 1) < 4 * mean_error(found) + 0.02
    assert found.covered >= stats.binom.ppf(1e-3, 40, 0.90)
    assert found.own_cov < 0.05


def test_final_draws_serve_higher_thresholds():
    """P[u >= beta - g] of all g from the weights of all final draws."""
    sample = samplers.estimate(half_space(2, 3.5).problem, CE(), seed=1).sample
    assert sample.n_units == len(sample.f) == 4000
    for g in (0.0, 0.5, 1.0, 2.0, 3.5):
        weights = sample.weights[sample.f <= g]
        assert weights.sum() == pytest.approx(stats.norm.sf(3.5 - g), abs=4 * np.sqrt((weights**2).sum()))
    np.testing.assert_allclose(half_space(2, 3.5).problem.f(sample.x), sample.f[sample.f <= 0])


def test_a_step_of_the_search_matches_moments():
    """Equation 2 for a Gaussian: with alpha = 1 and many points the moments of the elite."""
    elite = np.random.default_rng(1).standard_normal((100_000, 2)) * [0.5, 1.0] + [2.0, 0.0]
    start, ratios = Product((GaussianBlock(Gaussian.standard(2)),)), np.zeros((1, len(elite)))
    moved = CE()._project(start, elite, ratios, 1.0).blocks[0].gaussian
    np.testing.assert_allclose(moved.mean, elite.mean(axis=0))
    np.testing.assert_allclose(moved.covariance, np.cov(elite.T), atol=1e-3)
    half = CE()._project(start, elite, ratios, 0.5).blocks[0].gaussian
    np.testing.assert_allclose(half.mean, elite.mean(axis=0) / 2)
    # mixture of N(0, I) and the elite: mean of the variances plus a quarter of the shift squared
    np.testing.assert_allclose(np.diag(half.covariance), [0.625 + 1.0, 1.0], atol=0.02)


def test_a_step_of_the_search_uses_the_likelihood_ratio(rng):
    """From N((1.5, 0), I) the step aims at N(0, I) given u1 > 2: mean phi(2) / Phi(-2) = 2.373.

    Without the weights it would be 1.5 + phi(0.5) / Phi(-0.5) = 2.641.
    """
    proposal = Gaussian(np.array([1.5, 0.0]), np.eye(2))
    u = proposal.sample(200_000, rng)
    u = u[u[:, 0] > 2.0]
    log_ratios = (Gaussian.standard(2).log_prob(u) - proposal.log_prob(u))[None]
    moved = CE()._project(Product((GaussianBlock(proposal),)), u, log_ratios, 1.0)
    np.testing.assert_allclose(moved.blocks[0].gaussian.mean, [stats.norm.pdf(2) / stats.norm.sf(2), 0.0], atol=0.02)


def test_target_cov_is_met_by_more_final_draws():
    loose = samplers.estimate(half_space().problem, CE(), seed=1)
    tight = samplers.estimate(half_space().problem, CE(), seed=1, target_cov=0.01)
    assert loose.cov > 0.01 >= tight.cov
    assert tight.status == "converged"
    assert tight.n_sim > loose.n_sim


@pytest.mark.slow
def test_interval_of_a_hopeless_proposal_still_holds_p():
    """d = 300: the weights degenerate, p-hat is far too small, and the result does not hide it."""
    reference = half_space(300)
    for seed in range(4):
        result = samplers.estimate(reference.problem, CE(), seed=seed, max_sim=4000)
        assert result.interval[0] <= reference.p <= result.interval[1]
        assert result.warnings


def uniform_weights(n):
    return np.full(n, 1 / n)


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
    for distribution in (block, block.project(other, uniform_weights(20_000), 0.7)):
        values.append(0.7 * distribution.log_prob(other).mean() + 0.3 * distribution.log_prob(draws).mean())
    assert values[1] > values[0] + 0.01


def test_mixture_keeps_the_share_1_minus_alpha_of_the_present_distribution():
    """All of Q in one point: with alpha = 0.8 the mean of the new mixture is 0.8 of the way there."""
    elite = np.tile([2.0, 1.0], (50, 1))
    block = MixtureBlock(Gaussian.standard(2), 3).project(elite, uniform_weights(50), 0.8)
    mean = sum(w * c.mean for w, c in zip(block.mixture.weights, block.mixture.components, strict=True))
    np.testing.assert_allclose(mean, [1.6, 0.8])
    x = np.random.default_rng(1).standard_normal((100, 2))
    start = MixtureBlock(Gaussian.standard(2), 3)
    np.testing.assert_allclose(start.log_prob(x), Gaussian.standard(2).log_prob(x))
