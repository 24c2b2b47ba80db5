import numpy as np
import pytest
from scipy import stats

from samplers.mcmc import (
    FixedMetropolis,
    ScaledKernel,
    accept_candidates,
    adapted_scale,
    conditional_proposal,
    metropolis_candidates,
    proposal_sigma,
)

LEVEL = -1.0


def height(u):
    return -u[:, 0]


def scaled(proposal, scale, dim=2):
    return ScaledKernel(proposal, "unit", scale, 0.44, np.ones(dim))


KERNELS = {
    "conditional, small": scaled("conditional", 0.3),
    "conditional, large": scaled("conditional", 0.9),
    "metropolis": scaled("metropolis", 0.8),
    "metropolis, uniform": FixedMetropolis(1.0, "uniform"),
    "metropolis, normal": FixedMetropolis(2.5, "normal"),
}


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
def test_every_kernel_leaves_the_conditioned_distribution_invariant(rng, kernel):
    n = 20_000
    u = rng.standard_normal((n, 2))
    u[:, 0] = stats.norm.isf(rng.random(n) * stats.norm.sf(-LEVEL))
    f = height(u)
    for _ in range(10):
        candidates = kernel.propose(u, rng)
        u, f, _ = accept_candidates(u, f, candidates, height(candidates), LEVEL)
    assert (f <= LEVEL).all()
    assert stats.kstest(u[:, 0], stats.truncnorm(-LEVEL, np.inf).cdf).pvalue > 1e-3
    assert stats.kstest(u[:, 1], stats.norm.cdf).pvalue > 1e-3


def test_the_printed_ratio_is_wrong_for_the_conditional_proposal(rng):
    """Why "metropolis" takes a symmetric step: with the AR-1 one the ratio makes the distribution N(0, 1/2)."""
    u = rng.standard_normal((20_000, 1))
    for _ in range(60):
        steps = conditional_proposal(u, np.full(1, 0.8), rng) - u
        u = metropolis_candidates(u, steps, rng)
    assert stats.kstest(u[:, 0], stats.norm(0, np.sqrt(0.5)).cdf).pvalue > 1e-3
    assert stats.kstest(u[:, 0], stats.norm.cdf).pvalue < 1e-12


def test_metropolis_moves_components_one_by_one(rng):
    u = rng.standard_normal((2000, 3))
    stays = FixedMetropolis(1.0, "uniform").propose(u, rng) == u
    assert 0.1 < stays.mean() < 0.4
    assert stays.all(axis=1).mean() < 0.1


def test_only_the_adaptive_kernel_changes(rng):
    fixed, kernel = FixedMetropolis(1.0, "uniform"), scaled("conditional", 0.6)
    assert fixed.adapt(1.0, 1) == fixed == fixed.start_level(np.ones((4, 2)))
    assert kernel.adapt(0.64, 4).scale == pytest.approx(0.6 * np.exp(0.1))
    assert kernel.adapt(1.0, 1).scale == 1.0
    seeds = rng.standard_normal((50, 2)) * [0.2, 3.0]
    np.testing.assert_array_equal(kernel.start_level(seeds).deviations, [1, 1])
    own = ScaledKernel("conditional", "seeds", 0.6, 0.44, np.ones(2)).start_level(seeds).deviations
    np.testing.assert_allclose(own, seeds.std(axis=0, ddof=1))


def conditional_step(evaluate, u, f, level, sigma, rng):
    proposal = conditional_proposal(u, sigma, rng)
    return accept_candidates(u, f, proposal, evaluate(proposal), level)


def test_forgets_where_it_started(rng):
    """A point mass at the boundary becomes the conditioned distribution."""
    n = 5000
    u, f = np.tile([1.0, 2.0], (n, 1)), np.full(n, -1.0)
    for _ in range(60):
        step = conditional_step(height, u, f, LEVEL, np.full(2, 0.7), rng)
        u, f = step.u, step.f
    assert stats.kstest(u[:, 0], stats.truncnorm(1, np.inf).cdf).pvalue > 1e-3
    assert stats.kstest(u[:, 1], stats.norm.cdf).pvalue > 1e-3


def test_a_chain_that_stays_keeps_its_stored_outcome(rng):
    u, f = np.ones((50, 2)), np.arange(50.0) - 100
    step = conditional_step(lambda v: np.full(len(v), 5.0), u, f, 0.0, np.full(2, 0.5), rng)
    assert not step.accepted.any()
    np.testing.assert_array_equal(step.u, u)
    np.testing.assert_array_equal(step.f, f)


def test_sigma_is_cut_at_one():
    np.testing.assert_array_equal(proposal_sigma(2.0, np.array([0.2, 0.8])), [0.4, 1.0])


def test_scale_follows_the_acceptance():
    assert adapted_scale(0.6, 0.44, 1, 0.44, 1.0) == pytest.approx(0.6)
    assert adapted_scale(0.6, 0.64, 4, 0.44, 1.0) == pytest.approx(0.6 * np.exp(0.1))
    assert adapted_scale(0.6, 0.0, 1, 0.44, 1.0) == pytest.approx(0.6 * np.exp(-0.44))
    assert adapted_scale(0.9, 1.0, 1, 0.44, 1.0) == 1.0
