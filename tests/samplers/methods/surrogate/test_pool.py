"""The pool and the proposal: unbiased whatever the surrogate says, weights bounded."""

import numpy as np
import pytest
from scipy.stats import norm

from samplers.methods.kriging import PoolSettings, Prediction, ProposalSettings
from samplers.methods.surrogate import Pool, build_pool_proposal, first_mixture, fit_mixture
from samplers.problem import StandardNormal

SCALES = (1.0, 1.5, 2.2, 3.0)


def pool_of(mean, n=4000, dim=2, seed=0, sd=0.3):
    """A pool whose surrogate predicts `mean(u)` with one standard deviation everywhere."""
    mixture = first_mixture(dim, SCALES)
    u = mixture.sample(n, np.random.default_rng(seed))
    log_weights = StandardNormal(dim).log_prob(u) - mixture.log_prob(u)
    return Pool(u, log_weights, Prediction(mean(u), np.full(n, sd)))


@pytest.mark.parametrize("seen_as", [2.0, 2.5, 99.0], ids=["right", "half a unit off", "nothing fails"])
def test_the_estimate_is_unbiased_whatever_the_surrogate_says(seen_as):
    """P[u_1 > 2] over 300 pools of 1,000 draws, 60 of them simulated."""
    rng, estimates = np.random.default_rng(1), []
    for seed in range(300):
        pool = pool_of(lambda u: seen_as - u[:, 0], n=1000, seed=seed)
        draws = build_pool_proposal(
            pool, SCALES, ProposalSettings(base_share=0.2, wide_share=0.2, doubted_share=0.1)
        ).draw(60, rng)
        estimates.append(np.exp(draws.log_weights)[draws.u[:, 0] > 2.0].sum() / 60)
    error = np.std(estimates, ddof=1) / np.sqrt(300)
    assert abs(np.mean(estimates) - norm.sf(2.0)) < 4 * error
    assert error < 0.1 * norm.sf(2.0)


def test_no_weight_exceeds_its_bound_and_the_parts_are_drawn_as_often_as_they_should():
    proposal = build_pool_proposal(pool_of(lambda u: 2.0 - u[:, 0]), SCALES, ProposalSettings())
    draws = proposal.draw(5000, np.random.default_rng(2))
    assert np.exp(draws.log_weights).max() <= proposal.largest_weight
    assert 9 < proposal.largest_weight < 11
    np.testing.assert_allclose(np.bincount(draws.part) / 5000, [0.7, 0.1, 0.05, 0.15], atol=4 * 0.5 / 5000**0.5)


def test_forecast_is_the_spread_that_draws_of_the_proposal_would_have():
    """A certain surrogate forecasts 0; else n cov^2 = E[1[fails] / P] E[sqrt P]^2 / E[P]^2 - 1 under b ~ w sqrt(P)."""
    certain = pool_of(lambda u: 2.0 - u[:, 0], sd=1e-9)
    assert certain.forecast_cov(100) < 1e-3
    doubtful = pool_of(lambda u: 2.0 - u[:, 0], n=20_000)
    rng = np.random.default_rng(3)
    proposal = build_pool_proposal(
        doubtful, SCALES, ProposalSettings(base_share=1e-9, wide_share=1e-9, doubted_share=0.0)
    )
    draws = proposal.draw(20_000, rng)
    fails = rng.random(20_000) < norm.cdf((draws.u[:, 0] - 2.0) / 0.3)  # the surrogate is right about its doubt
    terms = np.where(fails, np.exp(draws.log_weights), 0.0)
    assert doubtful.forecast_cov(1) == pytest.approx(terms.std() / terms.mean(), rel=0.05)


def test_the_mixture_moves_to_where_the_surrogate_sees_failures():
    pool = pool_of(lambda u: 3.0 - np.abs(u[:, 0]), n=8000)
    mixture = fit_mixture(pool, SCALES, PoolSettings(), np.random.default_rng(4))
    u = mixture.sample(5000, np.random.default_rng(5))
    assert mixture.weights.sum() == pytest.approx(1.0)
    assert (np.abs(u[:, 0]) > 2.7).mean() > 0.3  # N(0, 1): 0.007
    assert 0.35 < (u[np.abs(u[:, 0]) > 2.7, 0] > 0).mean() < 0.65  # both sides
