import numpy as np
import pytest
from scipy import stats

from samplers.kernels import accepted_step, adapted_scale, conditional_proposal, proposal_sigma

LEVEL = -1.0


def height(u):
    return -u[:, 0]


def conditional_step(evaluate, u, f, level, sigma, rng):
    proposal = conditional_proposal(u, sigma, rng)
    return accepted_step(u, f, proposal, evaluate(proposal), level)


@pytest.mark.parametrize("sigma", [0.3, 0.9])
def test_leaves_the_conditioned_law_invariant(rng, sigma):
    """Exact draws of N(0, I) given f <= level keep that law after ten moves."""
    n = 20_000
    u = rng.standard_normal((n, 2))
    u[:, 0] = stats.norm.isf(rng.random(n) * stats.norm.sf(-LEVEL))
    f = height(u)
    for _ in range(10):
        step = conditional_step(height, u, f, LEVEL, np.full(2, sigma), rng)
        u, f = step.u, step.f
    assert (f <= LEVEL).all()
    tail = stats.truncnorm(-LEVEL, np.inf)
    assert stats.kstest(u[:, 0], tail.cdf).pvalue > 1e-3
    assert stats.kstest(u[:, 1], stats.norm.cdf).pvalue > 1e-3


def test_forgets_where_it_started(rng):
    """A point mass at the boundary becomes the conditioned law."""
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
