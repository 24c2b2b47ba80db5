"""Importance sampling: weighted draws, calibration, search and final draws."""

import math

import numpy as np
import pytest
from scipy import stats

from samplers.importance import (
    Draws,
    Round,
    Search,
    bernstein_bound,
    calibrate,
    draw_after_search,
    pool_rounds,
    round_record,
    weight_warnings,
    weighted_interval,
)
from samplers.limit_states import half_space
from samplers.method import Goal
from samplers.problem import StandardNormal
from samplers.proposals import TiltedNormal
from samplers.sample import Status

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


def log_normal(p, cov, quantile):
    half = quantile * math.sqrt(math.log(1 + cov**2))
    return p * math.exp(-half), p * math.exp(half)


def test_p_and_cov_by_hand():
    draws = weighing(3.0, 1.0, n=8)
    terms = np.array([3.0, 1.0, 0, 0, 0, 0, 0, 0])
    assert draws.p == pytest.approx(terms.mean())
    # the variance of a mean, and (largest term / n)^2
    assert draws.cov == pytest.approx(math.sqrt(terms.var(ddof=1) / 8 + (3 / 8) ** 2) / terms.mean())
    assert draws.ess == pytest.approx(16 / 10)


def test_of_few_draws_the_upper_end_is_guaranteed():
    few = equal(29)
    low, high = weighted_interval(few, 0.95, 10.0)
    assert low == pytest.approx(log_normal(few.p, few.cov, stats.t.ppf(0.975, 29 / 4))[0])
    assert high == bernstein_bound(few, 0.95, 10.0)
    assert weighted_interval(equal(31), 0.95, 10.0)[1] < bernstein_bound(equal(31), 0.95, 10.0)
    tiny = equal(8)
    assert weighted_interval(tiny, 0.95, 10.0)[0] == pytest.approx(
        log_normal(tiny.p, tiny.cov, stats.t.ppf(0.975, 3))[0]
    )


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


def test_doubts_are_of_few_and_of_heavy_draws():
    assert "draws: 29;" in weight_warnings(equal(29))[0]
    assert weight_warnings(equal(31)) == []
    others = [1.0] * 100
    assert weight_warnings(weighing(*others, 17.5)) == []  # 14.9 %
    (doubt,) = weight_warnings(weighing(*others, 17.8))  # 15.1 %
    assert "One draw carries 15 %" in doubt
    assert "None of 1,000 final draws failed" in weight_warnings(weighing())[0]


BASE = StandardNormal(2)


def rounds_of(inputs, shifts, n, rng):
    """Return rounds of n draws from N(shift, I)."""
    proposals = [TiltedNormal(np.full(2, shift)) for shift in shifts]
    points = [proposal.sample(n, rng) for proposal in proposals]
    return [Round(BASE, q, u, inputs.problem.evaluate(u)) for q, u in zip(proposals, points, strict=True)]


def test_rounds_pool_into_one_sample(rng):
    """Weights by the mixture of the proposals: right on average and bounded by the share of base draws."""
    inputs = half_space(2, 2.0)
    estimates = []
    for _ in range(200):
        draws = pool_rounds(rounds_of(inputs, [0.0, 1.5, 3.0], 200, rng), np.asarray, 0.0)
        assert draws.n == 600
        assert np.exp(draws.log_weights).max() <= 3
        estimates.append(draws.p)
    error = np.std(estimates, ddof=1) / math.sqrt(200)
    assert abs(np.mean(estimates) - inputs.p) < 4 * error


def test_a_stopped_search_is_its_own_estimate(drive, rng):
    """No further simulation; the weights are bounded by all draws over base draws."""
    inputs = half_space(2, 2.0)
    rounds = rounds_of(inputs, [0.0, 2.0], 500, rng)
    trace = [round_record(0.0, 500, one.log_weights[one.f <= 0]) for one in rounds]
    search = Search(rounds, trace, Status.STOPPED)
    steps = draw_after_search(inputs.problem, Goal(gamma=0.0), search, BASE, 1.0, 1000, 100, rng)
    with pytest.raises(StopIteration) as ended:
        next(steps)
    final = ended.value.value
    assert (final.n_first, final.stopped, final.largest_weight, final.base_draws) == (500, True, 2.0, 500)
    outcome = final.outcome(Goal(gamma=0.0), Status.CONVERGED, ["not said"])
    assert outcome.status is Status.STOPPED
    assert outcome.warnings[0].startswith("Stopped before the final draws")
    assert outcome.p == pytest.approx(inputs.p, rel=5 * outcome.cov)
