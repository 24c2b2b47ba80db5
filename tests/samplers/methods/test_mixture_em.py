import numpy as np
import pytest

from samplers.components import VonMisesFisherNakagami
from samplers.proposals import (
    Gaussian,
    Mixture,
    WidenableMixture,
    fit_mixture_of_size,
    fit_proposal_mixture,
    fit_shrunk_gaussian,
)

TWO = Mixture(
    np.array([0.3, 0.7]),
    [
        Gaussian(np.array([3.0, 0.0]), np.diag([0.5, 1.0])),
        Gaussian(np.array([-1.0, 3.0]), np.array([[0.8, 0.0], [0.3, 0.4]])),
    ],
)


def equal(n):
    return np.full(n, 1 / n)


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


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_or_equal_points_give_a_proper_distribution(rng, n):
    for u in (rng.standard_normal((n, 4)), np.ones((n, 4))):
        for k in (1, 3):
            assert np.isfinite(fit_mixture_of_size(fit_shrunk_gaussian, u, equal(n), k, rng).log_prob(u)).all()
            assert np.isfinite(fit_mixture_of_size(VonMisesFisherNakagami.fit, u, equal(n), k, rng).log_prob(u)).all()


def test_widened(rng):
    wide = WidenableMixture(TWO.weights, TWO.components).widen(2.0)
    np.testing.assert_allclose(wide.components[0].covariance, 4 * TWO.components[0].covariance)
    np.testing.assert_array_equal(wide.weights, TWO.weights)
