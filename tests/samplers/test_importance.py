"""Importance sampling: weighted draws, calibration, search and final draws."""

import math

import numpy as np
import pytest
from scipy import stats

from samplers.importance import Draws, bernstein_bound, calibrate, weight_warnings, weighted_interval
from samplers.proposals import (
    Gaussian,
    Mixture,
    VonMisesFisherNakagami,
    correct_eigenvalues,
    fit_proposal_mixture,
    fit_shrunk_gaussian,
)

BETA = 1.7
P = stats.norm.sf(BETA)
NORMAL, SHIFTED, BEYOND = stats.norm(0, 1), stats.norm(2.3, 1.0), stats.truncnorm(1.5, np.inf)
PARTS = (NORMAL, SHIFTED, BEYOND)


def draw(counts, rng):
    """Draws of the three components: u, strata and their densities over that of the mixture."""
    u = np.concatenate([part.rvs(n, random_state=rng) for part, n in zip(PARTS, counts, strict=True)])
    densities = np.stack([part.pdf(u) for part in PARTS], axis=1)
    return u, np.repeat(range(3), counts), densities / (densities @ counts / sum(counts))[:, None]


def variance(residuals, strata):
    """Of their mean, from the variances within the strata."""
    own = [residuals[strata == k] for k in np.unique(strata)]
    return sum(len(one) * one.var(ddof=1) for one in own) / len(residuals) ** 2


def test_right_on_average_with_the_variance_that_it_says(rng):
    runs, counts = 200, [60, 270, 270]
    p, own, plain = [], [], []
    for _ in range(runs):
        u, strata, h = draw(counts, rng)
        y, calibrated = h[:, 0] * (u > BETA), calibrate(h, strata, 30)
        p.append((calibrated.factors * y).mean())
        own.append(variance(calibrated.residuals(y), strata))
        plain.append(variance(y, strata))
    # the bias by estimated slopes is of the order of 1 / n
    assert np.mean(p) == pytest.approx(P, abs=4 * np.std(p) / math.sqrt(runs) + 0.001 * P)
    assert np.var(p) == pytest.approx(np.mean(own), rel=4 * math.sqrt(2 / runs))
    saved = np.subtract(plain, own)
    assert saved.mean() > 4 * saved.std() / math.sqrt(runs)


def weighing(*weights, n=1000):
    """n draws of which those with these weights fail."""
    return Draws(n, np.zeros(len(weights)), np.log(weights))


def equal(k, weight=0.01):
    return weighing(*[weight] * k)


def test_p_and_cov_by_hand():
    draws = weighing(3.0, 1.0, n=8)
    terms = np.array([3.0, 1.0, 0, 0, 0, 0, 0, 0])
    assert draws.p == pytest.approx(terms.mean())
    # the variance of a mean, and (largest term / n)^2
    assert draws.cov == pytest.approx(math.sqrt(terms.var(ddof=1) / 8 + (3 / 8) ** 2) / terms.mean())
    assert draws.ess == pytest.approx(16 / 10)


def test_of_few_draws_the_upper_end_is_guaranteed():
    for few, freedom in ((equal(29), 29 / 4), (equal(8), 3)):
        low, high = weighted_interval(few, 0.95, 10.0)
        half = stats.t.ppf(0.975, freedom) * math.sqrt(math.log(1 + few.cov**2))
        assert low == pytest.approx(few.p * math.exp(-half))
        assert high == bernstein_bound(few, 0.95, 10.0)
    assert weighted_interval(equal(31), 0.95, 10.0)[1] < bernstein_bound(equal(31), 0.95, 10.0)


def test_bernstein_bound_is_that_of_the_theorem():
    """Maurer and Pontil, theorem 4, for terms scaled to [0, 1], each end of the interval at half of 1 - confidence."""
    terms = np.concatenate([[0.5, 2.0, 4.0], np.zeros(197)]) / 10.0
    delta, n = 0.05, 200
    theorem = (
        terms.mean()
        + math.sqrt(2 * terms.var(ddof=1) * math.log(2 / delta) / n)
        + 7 * math.log(2 / delta) / (3 * (n - 1))
    )
    assert bernstein_bound(weighing(0.5, 2.0, 4.0, n=n), 0.9, 10.0) == pytest.approx(10.0 * theorem)
    assert bernstein_bound(weighing(0.5, 2.0, 4.0, n=n), 0.9, 1e4) == 1.0


def test_one_heavy_draw_does_not_lift_the_lower_end_above_what_the_others_say():
    """100 failures of weight 0.01 among 1,000 draws say 0.001, whatever one more weighs: here p-hat is 0.051."""
    low, high = weighted_interval(weighing(*[0.01] * 100, 50.0), 0.95, 50.0)
    assert 0.0005 < low < 0.001 < 0.051 < high


def test_doubts_are_of_few_and_of_heavy_draws():
    assert "size of 9;" in weight_warnings(equal(9))[0]
    assert weight_warnings(equal(10)) == []
    others = [1.0] * 100
    assert weight_warnings(weighing(*others, 44.0)) == []  # 144^2 / 2036 = 10.2
    assert weight_warnings(weighing(*others, 50.0)) == [  # 150^2 / 2600
        "The failing draws have an effective sample size of 9; the estimate is imprecise."
    ]
    assert "None of 1,000 final draws failed" in weight_warnings(weighing())[0]


def even(n):
    return np.full(n, 1 / n)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_few_or_equal_points_give_a_proper_gaussian(n, rng):
    for u in (rng.standard_normal((n, 4)), np.ones((n, 4)), np.zeros((n, 4))):
        assert np.isfinite(fit_shrunk_gaussian(u, even(n)).log_prob(u)).all()


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


def test_weighted_points_stand_for_their_distribution(rng):
    """Draws of a wide distribution under weights p / q."""
    wide = Gaussian(np.zeros(2), 3 * np.eye(2))
    u = wide.sample(40_000, rng)
    weights = np.exp(TWO.log_prob(u) - wide.log_prob(u))
    found = fit_proposal_mixture(fit_shrunk_gaussian, u, weights / weights.sum(), 4, 5, rng)
    assert len(found.weights) == 2  # the criterion finds the number
    test = TWO.sample(4000, rng)
    assert np.mean(TWO.log_prob(test) - found.log_prob(test)) < 0.02  # Kullback-Leibler divergence


def test_mixture_of_directions(rng):
    distributions = [VonMisesFisherNakagami(np.eye(8)[k], 40.0, 10.0, 16.0) for k in (0, 3)]
    u = np.concatenate([distribution.sample(1000, rng) for distribution in distributions])
    found = fit_proposal_mixture(VonMisesFisherNakagami.fit, u, even(2000), 4, 10, rng)
    assert len(found.components) == 2
    assert sorted(int(np.argmax(c.mu)) for c in found.components) == [0, 3]
