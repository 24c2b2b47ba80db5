import math

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.mixture.proposal import MixtureProposal, ProposalComponent
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


def test_weights_average_to_one(rng):
    """E_q[phi / q] = 1, where q is positive."""
    u, _ = PROPOSAL.draw(20_000, rng)
    weights = np.exp(PROPOSAL.log_weights(u))
    assert weights.mean() == pytest.approx(1.0, abs=4 * weights.std() / math.sqrt(20_000))
