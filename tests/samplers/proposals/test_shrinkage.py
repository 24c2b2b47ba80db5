"""Shrinkage of covariances: between what the points say and a simple target."""

import numpy as np
import pytest

from samplers.proposals import (
    Gaussian,
    Moments,
    correct_eigenvalues,
    fit_shrunk_gaussian,
    shrink_covariance,
    shrink_towards_present,
)

DISTRIBUTION = Gaussian(np.array([-1.0, 3.0]), np.array([[0.8, 0.0], [0.3, 0.4]]))


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


def test_target_is_the_identity_but_for_one_direction():
    v = np.array([0.6, 0.8])
    target, share = shrink_covariance(np.eye(2) + (0.3 - 1) * np.outer(v, v), v, 0.3, 10.0)
    assert share == 1.0
    assert v @ target @ v == pytest.approx(0.3)
    np.testing.assert_allclose(np.linalg.eigvalsh(target), [0.3, 1.0])


def test_covariance_is_shrunk_where_points_are_few_for_the_dimensions(rng):
    """Failures beyond a plane: I but for the variance along the mean."""
    dim = 60
    u = rng.standard_normal((120, dim))
    u[:, 0] = 3.5 + 0.3 * abs(u[:, 0])
    found = np.linalg.eigvalsh(fit_shrunk_gaussian(u, equal(120)).covariance)
    own = np.linalg.eigvalsh(np.cov(u.T))
    assert own[-1] > 2.5  # noise of the covariance itself
    assert found[0] < 0.2  # the direction that matters
    assert 0.8 < found[1] < found[-1] < 1.3


def test_covariance_is_kept_where_points_are_many(rng):
    found = fit_shrunk_gaussian(DISTRIBUTION.sample(50_000, rng), equal(50_000))
    np.testing.assert_allclose(found.covariance, DISTRIBUTION.covariance, atol=0.02)


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


def test_eigenvalues_stay_in_order_and_equal_ones_positive(rng):
    for n in (9.0, 12.0, 1e6):
        values = np.sort(rng.uniform(0.9, 1.1, 8))
        assert (np.diff(correct_eigenvalues(values, n)) >= 0).all()
        assert (correct_eigenvalues(np.ones(8), n) > 0).all()
    np.testing.assert_allclose(correct_eigenvalues(np.array([0.1, 1.0, 3.0]), 1e9), [0.1, 1.0, 3.0], rtol=1e-6)
