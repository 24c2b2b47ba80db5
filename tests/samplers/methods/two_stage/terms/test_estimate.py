import numpy as np
import pytest

from samplers.methods.two_stage.terms.estimate import CombinedRounds, FinalRound, doubt
from samplers.methods.two_stage.terms.settings import DoubtSettings
from samplers.problem import Terms


def final_round(y, factor=1.0, strata=None, least=None, first=0):
    """Return a round of draws with these weights; those of 0 do not fail."""
    y = np.asarray(y, dtype=float)
    f = np.where(y > 0, -1.0, 1.0)
    values = np.full((len(y), 2), 1.0)
    values[np.arange(len(y)), np.zeros(len(y), int) if least is None else least] = np.where(f < 0, -1.0, 0.5)
    terms = Terms(f, values, np.zeros(values.shape, dtype=int), 0.0)
    log_weights = np.log(np.where(y > 0, y, 1.0))
    strata = np.zeros(len(y), int) if strata is None else strata
    return FinalRound(np.zeros((len(y), 1)), terms, log_weights, strata, factor, first)


def test_rounds_are_combined_by_size_and_factor():
    combined = CombinedRounds((final_round([1.0, 0.0], 0.5), final_round([0.5, 0.5, 0.0, 0.0])), 0.0)
    np.testing.assert_allclose(combined.shares, [0.2, 0.8])
    np.testing.assert_allclose(combined.means, [0.5, 0.25])
    assert combined.p == pytest.approx(0.3)
    assert combined.draws.p == pytest.approx(0.3)
    assert combined.draws.sample.weights[:3].sum() == pytest.approx(0.3)


def test_every_draw_has_its_weight_in_p():
    combined = CombinedRounds((final_round([1.0, 0.0], 0.5, first=7), final_round([0.5, 0.5, 0.0, 0.0], first=20)), 0.0)
    first, last = combined.draw_weights
    assert (first.first, last.first) == (7, 20)
    np.testing.assert_allclose(np.exp(first.log_weights), [0.1, 0.1])  # 0.2 / 2, whether or not they fail
    np.testing.assert_allclose(np.exp(last.log_weights), [0.1, 0.1, 0.2, 0.2])


def test_the_variance_is_that_within_the_strata_and_of_one_more_heavy_draw():
    """Strata with y = 1 throughout and y = 2, 0, 2, 0, ...: sum n_k var_k / n^2 = 10 (10 / 9) / 400, plus 2^2 / 400."""
    y, strata = np.r_[np.ones(10), np.tile([2.0, 0.0], 5)], np.repeat([0, 1], 10)
    assert final_round(y, strata=strata).variance(0.0) == pytest.approx((10 * 10 / 9 + 4) / 400)
    few = np.r_[np.ones(10), [2.0, 0.0]]
    assert final_round(few, strata=np.repeat([0, 1], [10, 2])).variance(0.0) == pytest.approx((4 + 4) / 144)


def test_rounds_that_differ_raise_the_variance():
    """p_r = 0.5 and 0.1 without any spread within: 1.5 sum c^2 (p_r - p)^2 = 1.5 x 2 x 0.25 x 0.04 beats 1 / n^2."""
    combined = CombinedRounds((final_round(np.full(1000, 0.5)), final_round(np.full(1000, 0.1))), 0.0)
    assert combined.cov(1.5) == pytest.approx(np.sqrt(1.5 * 2 * 0.25 * 0.04) / 0.3)
    assert combined.cov(0.0) < 0.01


def test_without_a_failure_the_interval_is_one_sided():
    combined = CombinedRounds((final_round(np.zeros(100)),), 0.0)
    assert (combined.p, combined.cov(1.5)) == (0.0, np.inf)
    low, high = combined.interval(0.95, 0.04, np.inf, 1.0)
    assert low == 0.0 < high


def test_base_draws_bound_p_where_few_draws_carry_it():
    """Of 100 draws 3 fail: Bernstein's bound is 7 / 3 x 25 x log(80) / 99 = 2.6 and more, base draws without a failure
    say 0.004."""
    combined = CombinedRounds((final_round(np.repeat([1e-4, 0.0], [3, 97])),), 0.0)
    assert combined.interval(0.95, 0.04, 0.6, 1.0)[1] == 1.0
    assert combined.interval(0.95, 0.04, 0.6, 0.004)[1] == 0.004


def test_failures_of_terms_that_nobody_pursued_are_told():
    """One in ten of the weight is the second term's."""
    round_ = final_round(np.ones(100), least=np.repeat([0, 1], [90, 10]))
    combined = CombinedRounds((round_,), 0.0)
    assert combined.share_of_others([0]) == pytest.approx(0.1)
    assert any("without a proposal of their own" in text for text in doubt(combined, [0], DoubtSettings()))
    assert doubt(combined, [0, 1], DoubtSettings()) == []
    few = CombinedRounds((final_round(np.ones(100), least=np.repeat([0, 1], [96, 4])),), 0.0)
    assert doubt(few, [0], DoubtSettings()) == []  # up to 5 % of p are no reason


def test_a_last_round_that_few_draws_carry_is_told():
    y = np.zeros(200)
    y[:4] = [10.0, 1.0, 1.0, 1.0]
    combined = CombinedRounds((final_round(np.ones(500)), final_round(y)), 0.0)
    warnings = doubt(combined, [0], DoubtSettings())
    assert any("last round's failing draws: 2;" in text for text in warnings)
    assert any("more than 25 % of the last round" in text for text in warnings)
