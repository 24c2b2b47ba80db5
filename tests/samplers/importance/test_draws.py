"""Weighted draws: p, c.o.v., intervals and warnings, by hand and by the theorem."""

import math

import numpy as np
import pytest
from scipy import stats

from samplers.importance import Draws, bernstein_bound, weight_warnings, weighted_interval
from samplers.statistics import clopper_pearson


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


def test_outcomes_at_gamma_fail_and_draws_join():
    f, log_weights, x = np.array([2.0, 1.0, 0.0]), np.log([1.0, 2.0, 3.0]), np.arange(6.0).reshape(3, 2)
    draws = Draws.from_outcomes(f, log_weights, x, gamma=1.0)
    np.testing.assert_array_equal(draws.x, x[1:])
    both = draws.join(draws)
    assert (both.n, both.p) == (6, pytest.approx(5 / 3))
    sample = both.sample
    np.testing.assert_array_equal(sample.f, [1.0, 0.0, 1.0, 0.0, 2.0, 2.0])
    np.testing.assert_allclose(sample.weights, np.array([2.0, 3.0, 2.0, 3.0, 1.0, 1.0]) / 6)
    assert Draws(0, np.empty(0), np.empty(0)).join(draws) is draws


@pytest.mark.parametrize(("ess", "df"), [(201, math.inf), (200, 50.0), (40, 10.0)])
def test_quantiles_are_of_as_many_degrees_as_a_quarter_of_the_failing_draws_are_worth(ess, df):
    draws = equal(ess)
    expected = log_normal(draws.p, draws.cov, stats.t.ppf(0.95, df))
    assert weighted_interval(draws, 0.9, 10.0) == pytest.approx(expected)
    wider = log_normal(draws.p, 0.5, stats.t.ppf(0.95, df))
    assert weighted_interval(draws, 0.9, 10.0, cov=0.5) == pytest.approx((wider[0], wider[1]))


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


def test_without_a_failing_draw_and_without_weights_the_interval_is_the_binomial_one():
    assert weighted_interval(weighing(), 0.95, 4.0) == (0.0, pytest.approx(4.0 * clopper_pearson(0, 1000, 0.95)[1]))
    assert weighted_interval(weighing(n=5), 0.95, 10.0) == (0.0, 1.0)
    assert weighted_interval(equal(7, weight=1.0), 0.95, 1.0) == clopper_pearson(7, 1000, 0.95)


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
