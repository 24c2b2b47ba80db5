"""Fitted mixtures: known truth, collapsed components, the criterion in units of the points, scikit-learn's optimum."""

import numpy as np
import pytest
from sklearn.mixture import GaussianMixture

from rare_envs.distributions.mixture import TruncatedGaussianMixture
from training.fit import mixture as mixture_fit
from training.fit.mixture import (
    COVARIANCE_FLOOR,
    EM_ITERATIONS,
    SMALLEST_COMPONENT,
    TOLERANCE,
    fit_mixture,
    select_mixture,
)

TRUTH = TruncatedGaussianMixture(
    [0.65, 0.35],
    [[10.0, 5.0], [20.0, 12.0]],
    [[[4.0, 1.5], [1.5, 2.0]], [[2.0, -0.6], [-0.6, 1.0]]],
    [-20.0, -20.0],
    [50.0, 50.0],
)


@pytest.fixture
def quick(monkeypatch):
    """Fewer starts: enough for well separated clusters."""
    monkeypatch.setattr(mixture_fit, "EM_STARTS", 2)


def fit_truth(n, seed=0):
    points = TRUTH.sample(n, np.random.default_rng(1))
    return select_mixture(points, seed)


def test_fit_recovers_a_known_mixture(quick):
    n = 2000
    fit = fit_truth(n)
    mixture = fit.components
    assert len(mixture.weights) == 2
    assert abs(mixture.weights[0] - 0.65) < 4.0 * np.sqrt(0.65 * 0.35 / n)
    counts = n * TRUTH.weights
    for k in range(2):
        variance = np.diag(TRUTH.covariances[k])
        assert (np.abs(mixture.means[k] - TRUTH.means[k]) < 4.0 * np.sqrt(variance / counts[k])).all()
        # Sampling error of a covariance, and the floor: 1 % of the overall variance.
        error = 4.0 * np.sqrt(2.0 / counts[k]) * np.sqrt(np.outer(variance, variance))
        floor = COVARIANCE_FLOOR * np.diag([30.0, 15.0])
        assert (np.abs(mixture.covariances[k] - TRUTH.covariances[k]) < error + floor).all()


def test_a_component_on_a_handful_of_events_is_rejected(quick):
    rng = np.random.default_rng(0)
    few = 2 * SMALLEST_COMPONENT - 4
    far = np.array([60.0, 60.0]) + 0.01 * rng.standard_normal((few, 2))
    points = np.concatenate([rng.standard_normal((200, 2)), far])
    fit = select_mixture(points)
    second = fit.candidates[1]
    assert second.smallest == pytest.approx(few)
    assert second.bic < fit.candidates[0].bic
    assert not second.accepted
    chosen = min((c for c in fit.candidates if c.accepted), key=lambda c: c.bic)
    assert len(fit.components.weights) == chosen.components


def test_few_events_get_one_component_and_too_few_an_error():
    points = np.random.default_rng(0).standard_normal((15, 6))
    assert len(select_mixture(points).candidates) == 1
    with pytest.raises(ValueError, match="6 events are too few to fit 6 parameters"):
        select_mixture(points[:6])
    points[:, 2] = 1.0
    with pytest.raises(ValueError, match=r"Expected parameter 2 to vary, got 1 in all 15 events"):
        select_mixture(points)


def test_the_criterion_is_in_units_of_the_points(quick):
    """In units ten times as small, each of n densities in two dimensions is 100 times as small."""
    points = TRUTH.sample(100, np.random.default_rng(2))
    fine, coarse = select_mixture(points), select_mixture(10.0 * points)
    assert coarse.bic - fine.bic == pytest.approx(2.0 * 100 * np.log(100.0))


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


@pytest.mark.parametrize(("components", "seed"), [(1, 0), (2, 1), (4, 2)])
def test_a_start_leads_where_it_does_in_an_independent_implementation(points, components, seed):
    """The same k-means clusters, steps and rule of convergence: equal up to rounding."""
    model = fit_reference(points, components, seed, starts=1)
    fit, likelihood = fit_mixture(points, components, floor=0.01, seed=seed, starts=1)
    np.testing.assert_allclose(fit.weights, model.weights_, atol=1e-9)
    np.testing.assert_allclose(fit.means, model.means_, atol=1e-9)
    np.testing.assert_allclose(fit.covariances, model.covariances_, atol=1e-9)
    assert likelihood == pytest.approx(len(points) * model.score(points), rel=1e-12)


def test_the_best_start_is_as_likely_as_that_of_an_independent_implementation(points):
    """Starts that reach one optimum differ by what is left when they stop: some hundred times the tolerance."""
    model, (_, likelihood) = fit_reference(points, 4, 3, starts=6), fit_mixture(points, 4, 0.01, seed=3, starts=6)
    assert likelihood / len(points) == pytest.approx(model.score(points), abs=100 * TOLERANCE)
