"""Fitted mixtures: known truth, determinism, collapsed components, the criterion in units of the points."""

import numpy as np
import pytest

from rare_envs.distributions.mixture import TruncatedGaussianMixture
from training.scenario_fitting import mixture as mixture_fit
from training.scenario_fitting.mixture import (
    COVARIANCE_FLOOR,
    SMALLEST_COMPONENT,
    Components,
    append_independent,
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


def test_fit_is_deterministic(quick):
    for one, other in zip(fit_truth(300).components, fit_truth(300).components, strict=True):
        assert np.array_equal(one, other)


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


def test_one_component_has_the_criterion_of_its_own_likelihood(monkeypatch):
    monkeypatch.setattr(mixture_fit, "COVARIANCE_FLOOR", 0.0)
    points = np.random.default_rng(3).normal(5.0, 2.0, (40, 1))
    log_likelihood = -0.5 * 40 * (np.log(2.0 * np.pi * points.var()) + 1.0)
    assert select_mixture(points, most=1).bic == pytest.approx(-2.0 * log_likelihood + 2.0 * np.log(40))


def test_independent_parts_stand_side_by_side():
    joint = Components(np.array([0.6, 0.4]), np.array([[1.0], [2.0]]), np.array([[[4.0]], [[9.0]]]))
    apart = Components(np.array([1.0]), np.array([[3.0]]), np.array([[[0.25]]]))
    both = append_independent(joint, apart)
    assert both.means.tolist() == [[1.0, 3.0], [2.0, 3.0]]
    assert both.covariances.tolist() == [[[4.0, 0.0], [0.0, 0.25]], [[9.0, 0.0], [0.0, 0.25]]]
