import numpy as np
from scipy import stats
from scipy.special import logsumexp

from samplers.methods.two_stage.terms.law import ComponentGroup, TermLaw, TermProposal
from samplers.proposals.components import SubspaceGaussian


def gaussian(mean, variance):
    return SubspaceGaussian(np.eye(len(mean)), np.array(mean), np.array(variance))


def make_proposal(dim=6):
    """Two terms in different planes that are not orthogonal to one another, one with two groups."""
    first = TermLaw(
        np.eye(dim)[:, :2],
        (
            ComponentGroup(0.7, (gaussian([3.0, 0.0], [0.3, 1.0]),), np.ones(1)),
            ComponentGroup(
                0.3, (gaussian([2.0, 1.0], [1.5, 1.5]), gaussian([0.0, 2.0], [0.7, 0.7])), np.array([0.4, 0.6])
            ),
        ),
    )
    axis = np.zeros((dim, 1))
    axis[[0, 3]] = np.sqrt(0.5)
    second = TermLaw(axis, (ComponentGroup(1.0, (gaussian([2.5], [0.5]),), np.ones(1)),))
    return TermProposal(dim, 0.1, (first, second), np.array([0.75, 0.25]))


def test_the_density_ratio_is_that_of_full_gaussians(rng):
    """Each component written out as a Gaussian of all six dimensions."""
    proposal, u = make_proposal(), 2 * rng.standard_normal((50, 6))
    terms = [np.log(0.1) + stats.multivariate_normal(np.zeros(6)).logpdf(u)]
    for share, law in zip(proposal.shares, proposal.laws, strict=True):
        v = law.axes
        for group in law.groups:
            for weight, one in zip(group.weights, group.components, strict=True):
                covariance = np.eye(6) - v @ v.T + v @ np.diag(one.variance) @ v.T
                density = stats.multivariate_normal(v @ one.mean, covariance).logpdf(u)
                terms.append(np.log(0.9 * share * group.share * weight) + density)
    expected = logsumexp(terms, axis=0) - stats.multivariate_normal(np.zeros(6)).logpdf(u)
    np.testing.assert_allclose(proposal.log_ratio(u), expected, rtol=1e-9)


def test_weights_of_draws_average_to_one_and_give_a_known_probability(rng):
    """Means of 40,000 draws with weights of at most 10: 5 standard errors."""
    proposal = make_proposal()
    u, strata = proposal.draw(40_000, rng)
    w = np.exp(-proposal.log_ratio(u))
    assert w.max() <= 10 * (1 + 1e-9)
    assert abs(w.mean() - 1) < 5 * w.std() / 200
    y = w * (u[:, 0] > 3)
    assert abs(y.mean() - stats.norm.sf(3)) < 5 * y.std() / 200
    np.testing.assert_allclose(np.bincount(strata) / 40_000, proposal.stratum_shares, atol=1 / 40_000)


def test_draws_of_each_stratum_are_its_own(rng):
    u, strata = make_proposal().draw(20_000, rng)
    for stratum, column, mean in ((0, 0, 0.0), (1, 0, 3.0), (2, 1, 0.4 * 1.0 + 0.6 * 2.0)):
        mine = u[strata == stratum, column]
        assert abs(mine.mean() - mean) < 5 * mine.std() / np.sqrt(len(mine))
    along = u[strata == 3][:, [0, 3]].sum(axis=1) * np.sqrt(0.5)
    assert abs(along.mean() - 2.5) < 5 * np.sqrt(0.5 / len(along))
