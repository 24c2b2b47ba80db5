import math

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.mixture.proposal import UNSCREENED, MixtureProposal, ProposalComponent
from samplers.proposals.components import HalfSpaceNormal, IsotropicNormal, SubspaceGaussian

SHIFTED = SubspaceGaussian(np.eye(2)[:, :1], np.array([2.0]), np.array([0.5]))
CANDIDATES = [
    ProposalComponent(IsotropicNormal(2), "base"),
    ProposalComponent(SHIFTED, "gaussian", 0),
    ProposalComponent(HalfSpaceNormal(np.array([1.0, 0.0]), 1.0), "half-space"),
    ProposalComponent(IsotropicNormal(2, 3.0), "wide"),
]
WEIGHTS = np.array([0.1, 0.5, 0.4, 0.0])
PROPOSAL = MixtureProposal(CANDIDATES, WEIGHTS)


def density(u):
    """By hand: the second coordinate is standard normal in all components of weight."""
    x, y = u[:, 0], stats.norm.pdf(u[:, 1])
    beyond = np.where(x >= 1, stats.norm.pdf(x) / stats.norm.sf(1), 0.0)
    return y * (0.1 * stats.norm.pdf(x) + 0.5 * stats.norm.pdf(x, 2, math.sqrt(0.5)) + 0.4 * beyond)


def screen(u):
    return np.where(u[:, 0] > 1.5, 1.0, 0.4)


def test_weights_are_the_ratio_of_the_densities(rng):
    u = rng.normal(1, 2, (500, 2))
    phi = stats.norm.pdf(u).prod(axis=1)
    np.testing.assert_allclose(np.exp(PROPOSAL.log_weights(u)), phi / density(u), rtol=1e-10)


def test_draws_come_from_the_components_in_order_with_counts_as_their_weights(rng):
    u, counts = PROPOSAL.draw(1000, rng)
    assert u.shape == (1000, 2)
    assert counts.sum() == 1000
    assert np.abs(counts - 1000 * WEIGHTS).max() < 1
    assert counts[3] == 0
    last = u[counts[:2].sum() :]
    assert (last[:, 0] >= 1.0).all()
    assert stats.kstest(u[: counts[0], 0], "norm").pvalue > 1e-4


def test_weights_average_to_one_with_and_without_a_screen(rng):
    """E_q[phi / q] = 1, where q is positive."""
    for proposal in (PROPOSAL, PROPOSAL.with_screen(screen, rng)):
        u, _ = proposal.draw(20_000, rng)
        weights = np.exp(proposal.log_weights(u))
        error = math.hypot(weights.std() / math.sqrt(20_000), proposal.acceptance_cov)
        assert weights.mean() == pytest.approx(1.0, abs=4 * error)


def test_acceptance_of_a_screen_is_measured_for_what_it_thins(rng):
    screened = PROPOSAL.with_screen(screen, rng)
    np.testing.assert_array_equal(screened.screened, [kind not in UNSCREENED for _, kind, _ in CANDIDATES])
    share = stats.norm.sf(1.5, 2, math.sqrt(0.5))
    expected = share + 0.4 * (1 - share)
    assert screened.acceptance[0] == screened.acceptance[3] == 1.0
    assert screened.acceptance[1] == pytest.approx(expected, abs=4 * 0.3 / math.sqrt(7500))
    assert PROPOSAL.screen is None  # the mixture without it stays as it was


def test_the_error_of_the_acceptance_is_stated(rng):
    """The spread of p-hat over screens measured anew, from draws of which all fail, is `acceptance_cov`."""
    u = rng.normal(2, 0.5, (2000, 2))
    runs = [PROPOSAL.with_screen(screen, rng) for _ in range(60)]
    # q at fixed points: the densities of the thinned components move with their acceptance.
    p = np.array([np.exp(-run.log_weights(u)).mean() for run in runs])
    stated = np.mean([run.acceptance_cov for run in runs])
    assert p.std() / p.mean() < 2 * stated
    assert 0 < stated < 0.01
