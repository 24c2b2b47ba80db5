"""Fitted mixtures: known truth, determinism, collapsed components, mass outside the box."""

import numpy as np
import pytest

from rare_envs.distributions.truncated_mixture import TruncatedGaussianMixture
from training.scenario_fitting import mixture as mixture_fit
from training.scenario_fitting.mixture import COVARIANCE_FLOOR, SMALLEST_COMPONENT, mass_outside, select_mixture

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
    return select_mixture(points, TRUTH.low, TRUTH.high, seed)


def test_fit_recovers_a_known_mixture(quick):
    n = 2000
    fit = fit_truth(n)
    mixture = fit.mixture
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
    assert fit_truth(300).mixture.to_dict() == fit_truth(300).mixture.to_dict()


def test_a_component_on_a_handful_of_events_is_rejected(quick):
    rng = np.random.default_rng(0)
    few = 2 * SMALLEST_COMPONENT - 4
    far = np.array([60.0, 60.0]) + 0.01 * rng.standard_normal((few, 2))
    points = np.concatenate([rng.standard_normal((200, 2)), far])
    fit = select_mixture(points, np.full(2, -99.0), np.full(2, 99.0))
    second = fit.candidates[1]
    assert second.smallest == pytest.approx(few)
    assert second.bic < fit.candidates[0].bic
    assert not second.accepted
    chosen = min((c for c in fit.candidates if c.accepted), key=lambda c: c.bic)
    assert len(fit.mixture.weights) == chosen.components


def test_few_events_get_one_component_and_too_few_an_error():
    points = np.random.default_rng(0).standard_normal((15, 6))
    assert len(select_mixture(points, np.full(6, -9.0), np.full(6, 9.0)).candidates) == 1
    with pytest.raises(ValueError, match="6 events are too few to fit 6 parameters"):
        select_mixture(points[:6], np.full(6, -9.0), np.full(6, 9.0))
    points[:, 2] = 1.0
    with pytest.raises(ValueError, match="Parameter 2 is the same in all 15 events"):
        select_mixture(points, np.full(6, -9.0), np.full(6, 9.0))


def test_mass_outside_of_a_known_box():
    mixture = TruncatedGaussianMixture([1.0], [[0.0, 0.0]], [np.eye(2)], [-1.0, -9.0], [9.0, 9.0])
    mass = mass_outside(mixture)
    assert abs(mass["any"] - 0.15865525) < 4.0 * mass["standard_error"]
    assert mass["each"] == pytest.approx([0.15865525, 0.0], abs=1e-3)
