"""Expectation maximisation of all starts at once: scikit-learn's, which takes them one after the other."""

import numpy as np
import pytest
from sklearn.mixture import GaussianMixture

from training.scenario_fitting.expectation_maximisation import EM_ITERATIONS, TOLERANCE, fit_mixture_of_starts


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(0)
    spread = np.array([[1.0, 0.5, 0.0], [0.0, 0.6, 0.2], [0.0, 0.0, 0.3]])
    x = np.concatenate([rng.standard_normal((150, 3)) @ spread, 1.5 + 0.4 * rng.standard_normal((60, 3))])
    return (x - x.mean(axis=0)) / x.std(axis=0)


def fit_reference(points, components, seed, starts):
    model = GaussianMixture(
        components, tol=TOLERANCE, reg_covar=0.01, max_iter=EM_ITERATIONS, n_init=starts, random_state=seed
    )
    return model.fit(points)


@pytest.mark.parametrize(("components", "seed"), [(1, 0), (2, 0), (2, 1), (4, 2)])
def test_a_start_leads_where_it_does_in_an_independent_implementation(points, components, seed):
    """The same k-means clusters, steps and rule of convergence: equal up to rounding."""
    model = fit_reference(points, components, seed, starts=1)
    fit = fit_mixture_of_starts(points, components, floor=0.01, seed=seed, starts=1)
    np.testing.assert_allclose(fit.weights, model.weights_, atol=1e-9)
    np.testing.assert_allclose(fit.means, model.means_, atol=1e-9)
    np.testing.assert_allclose(fit.covariances, model.covariances_, atol=1e-9)
    assert fit.log_likelihood == pytest.approx(len(points) * model.score(points), rel=1e-12)


def test_the_best_start_is_as_likely_as_that_of_an_independent_implementation(points):
    """Starts that reach one optimum differ by what is left when they stop: some hundred times the tolerance."""
    model, fit = fit_reference(points, 4, 3, starts=6), fit_mixture_of_starts(points, 4, 0.01, seed=3, starts=6)
    assert fit.log_likelihood / len(points) == pytest.approx(model.score(points), abs=100 * TOLERANCE)


def test_more_starts_are_never_less_likely(points):
    one, many = (fit_mixture_of_starts(points, 4, 0.01, seed=0, starts=starts).log_likelihood for starts in (1, 8))
    assert many >= one - len(points) * TOLERANCE
