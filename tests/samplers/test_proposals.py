"""Gaussians and mixtures fitted to weighted points."""

import numpy as np
import pytest

from samplers.components import VonMisesFisherNakagami
from samplers.proposals import (
    Gaussian,
    Mixture,
    Moments,
    correct_eigenvalues,
    fit_proposal_mixture,
    fit_shrunk_gaussian,
    shrink_covariance,
    shrink_towards_present,
)


def equal(n):
    return np.full(n, 1 / n)


def test_share_of_the_target_by_hand():
    """S = diag(3, 1), T = I: noise (16 + 10) / n over a distance of 4, but at least that of (d + 1) / 2 points."""
    s, v = np.diag([3.0, 1.0]), np.array([0.0, 1.0])
    shrunk, share = shrink_covariance(s, v, 1.0, 26.0)
    assert share == pytest.approx(0.25)
    np.testing.assert_allclose(shrunk, np.diag([2.5, 1.0]))
    assert shrink_covariance(s, v, 1.0, 5.0)[1] == 1.0  # noise 5.2 over 4
    assert shrink_covariance(s, v, 1.0, 100.0)[1] == pytest.approx(0.065)
    far = np.diag([1000.0, 1, 1, 1, 1, 1])  # noise over distance is 2.01 / n: the floor of about 3.5 / n holds
    assert shrink_covariance(far, np.eye(6)[5], 1.0, 1e4)[1] == pytest.approx(7 / (2 * 10_007))


@pytest.mark.parametrize("n", [1, 2, 5])
def test_few_or_equal_points_give_a_proper_gaussian(n, rng):
    for u in (rng.standard_normal((n, 4)), np.ones((n, 4)), np.zeros((n, 4))):
        assert np.isfinite(fit_shrunk_gaussian(u, equal(n)).log_prob(u)).all()


def test_present_covariance_counts_as_points():
    """In 2 dimensions as 3 points, in 20 as 21 x 2."""
    target = Moments(np.array([1.0, 0.0]), np.diag([1.0, 0.0]))  # covariance 0
    found = shrink_towards_present(target, Gaussian.standard(2), 7.0)
    np.testing.assert_allclose(found.covariance, 0.3 * np.eye(2))
    np.testing.assert_allclose(found.mean, [1.0, 0.0])
    zero = Moments(np.zeros(20), np.zeros((20, 20)))
    np.testing.assert_allclose(shrink_towards_present(zero, Gaussian.standard(20), 42.0).covariance, 0.5 * np.eye(20))


def test_eigenvalues_lose_their_bias(rng):
    """30 points in 8 dimensions: the least eigenvalue is a fifth too small on average, the corrected one is right."""
    truth = np.array([0.05, 0.2, 0.4, 1.0, 1.0, 1.0, 1.3, 1.6])
    draws = rng.standard_normal((300, 30, 8)) * np.sqrt(truth)
    values, vectors = np.linalg.eigh(np.array([np.cov(u.T) for u in draws]))
    corrected = np.array([correct_eigenvalues(each, 30.0) for each in values])
    assert values[:, 0].mean() < 0.85 * 0.05
    assert abs(corrected[:, 0].mean() - 0.05) < 4 * corrected[:, 0].std() / np.sqrt(300)
    # Stein's loss of K, tr(K / S) - log det(K / S) - d, for which the estimator is made
    spread = np.einsum("nij,nij,i->nj", vectors, vectors, 1 / truth)
    own, new = ((spread * each).sum(axis=1) - np.log(each / truth).sum(axis=1) - 8 for each in (values, corrected))
    assert (own - new).mean() > 4 * (own - new).std() / np.sqrt(300)


TWO = Mixture(
    np.array([0.3, 0.7]),
    [
        Gaussian(np.array([3.0, 0.0]), np.diag([0.5, 1.0])),
        Gaussian(np.array([-1.0, 3.0]), np.array([[0.8, 0.0], [0.3, 0.4]])),
    ],
)


def test_mixture_is_recovered(rng):
    found = fit_proposal_mixture(fit_shrunk_gaussian, TWO.sample(8000, rng), equal(8000), 4, 5, rng)
    order = np.argsort(found.weights)
    assert len(order) == 2  # the criterion finds the number
    np.testing.assert_allclose(found.weights[order], TWO.weights, atol=0.03)
    for k, component in zip(order, TWO.components, strict=True):
        np.testing.assert_allclose(found.components[k].mean, component.mean, atol=0.1)
        np.testing.assert_allclose(found.components[k].covariance, component.covariance, atol=0.1)


def test_weighted_points_stand_for_their_distribution(rng):
    """Draws of a wide distribution under weights p / q."""
    wide = Gaussian(np.zeros(2), 3 * np.eye(2))
    u = wide.sample(40_000, rng)
    weights = np.exp(TWO.log_prob(u) - wide.log_prob(u))
    found = fit_proposal_mixture(fit_shrunk_gaussian, u, weights / weights.sum(), 4, 5, rng)
    test = TWO.sample(4000, rng)
    assert np.mean(TWO.log_prob(test) - found.log_prob(test)) < 0.02  # Kullback-Leibler divergence


def test_mixture_of_directions(rng):
    distributions = [VonMisesFisherNakagami(np.eye(8)[k], 40.0, 10.0, 16.0) for k in (0, 3)]
    u = np.concatenate([distribution.sample(1000, rng) for distribution in distributions])
    found = fit_proposal_mixture(VonMisesFisherNakagami.fit, u, equal(2000), 4, 10, rng)
    assert len(found.components) == 2
    assert sorted(int(np.argmax(c.mu)) for c in found.components) == [0, 3]
