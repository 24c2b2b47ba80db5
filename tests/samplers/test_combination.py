import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.limit_states import half_space
from samplers.method import Outcome
from samplers.replicate import combine, combined_cov
from samplers.sample import Sample, Status, binomial_cov, clopper_pearson


def outcome(p, cov=0.2, status=Status.CONVERGED, warnings=(), interval=(0.0, 1.0), **more):
    return Outcome(p=p, interval=interval, cov=cov, status=status, warnings=warnings, **more)


def test_t_interval_on_the_log_scale():
    p = [1e-4, 2e-4, 4e-4]
    result = combine([outcome(x) for x in p], 0.95)
    assert result.p == pytest.approx(np.mean(p))
    half = stats.t.ppf(0.975, 2) * math.log(2) / math.sqrt(3)  # the logs are log 2 apart
    assert result.interval == pytest.approx((result.p * np.exp(-half), result.p * np.exp(half)))


def test_cov_is_the_larger_of_own_and_seen():
    assert combined_cov([outcome(1.0, 0.3)] * 4) == pytest.approx(0.15)
    apart = combined_cov([outcome(1.0, 0.01), outcome(3.0, 0.01)])
    assert apart == pytest.approx(math.sqrt(2) / 2 / math.sqrt(2))


def test_runs_that_nearly_tie_are_no_closer_than_their_own_errors_allow():
    """Three shares of 333, 333 and 334 draws with five hits each: their spread is rounding."""
    result = combine([outcome(5 / n, 0.45) for n in (333, 333, 334)], 0.95)
    half = stats.t.ppf(0.975, 2) * 0.45 / 3 / math.sqrt(3)
    assert result.interval == pytest.approx((result.p * np.exp(-half), result.p * np.exp(half)), rel=1e-3)


def test_runs_that_know_nothing_have_their_own_intervals_together():
    """One draw carries each: the spread of such runs is no measure of what they all missed."""
    runs = [outcome(p, 1.4, interval=(p / 40, 0.1)) for p in (1e-200, 2e-200, 4e-180, 1e-316)]
    result = combine(runs, 0.95)
    assert result.interval == (min(run.interval[0] for run in runs), 0.1)
    assert result.cov == pytest.approx(1.4)


def test_warnings_are_counted_and_the_worst_status_kept():
    runs = [outcome(1e-4, warnings=("odd",)), outcome(2e-4, status=Status.BUDGET)]
    result = combine([*runs, outcome(1e-4, warnings=("odd",))], 0.95)
    assert result.warnings == ("In 2 of 3 runs: odd",)
    assert result.status is Status.BUDGET


def test_replicates_of_monte_carlo_are_one_longer_run():
    """Two runs with 252 hits in all: a t interval of two runs would be 20 times wider."""
    result = samplers.estimate(half_space(2, 2.8).problem, "mc", seed=1, replicates=2, max_sim=100_001)
    hits = result.failures.total
    assert 200 < hits < 310
    assert result.p == hits / 100_001
    assert result.interval == clopper_pearson(hits, 100_001, 0.95)
    assert result.cov == binomial_cov(hits / 100_001, 100_001)
    assert result.gain == pytest.approx(1.0)


def test_pooled_counts_weigh_draws_not_runs():
    few, many = (
        outcome(hits / n, cov=0.5, counts=(hits, n), no_outcome_share=share, warnings=("coarse",))
        for hits, n, share in ((1, 100, 1.0), (3, 900, 0.0))
    )
    result = combine([few, many], 0.95)
    assert result.p == 4 / 1000
    assert result.interval == clopper_pearson(4, 1000, 0.95)
    assert result.no_outcome_share == 1 / 4
    assert combined_cov([few, many]) == result.cov == binomial_cov(0.004, 1000)
    assert result.warnings == ("Only 4 of 1,000 simulations failed; the estimate is imprecise.",)
    assert combine([few, replace(many, counts=None)], 0.95).p == pytest.approx((1 / 100 + 3 / 900) / 2)


def sample(f, weights, n_units, *x):
    f, x = np.array(f, dtype=float), np.array(x)[:, None]
    return Sample(f=f, weights=np.array(weights), units=np.arange(len(f)), n_units=n_units, x=x)


def test_samples_are_merged_as_the_runs_are():
    one = outcome(0.3, sample=sample([-1.0, 2.0], [0.3, 0.7], 4, 10.0))
    two = outcome(0.1, sample=sample([3.0, -2.0, 0.0], [0.9, 0.06, 0.04], 3, 20.0, 21.0))
    merged = combine([one, two], 0.95).sample
    np.testing.assert_array_equal(merged.f, [-1, 2, 3, -2, 0])
    np.testing.assert_allclose(merged.weights, [0.15, 0.35, 0.45, 0.03, 0.02])
    np.testing.assert_array_equal(merged.units, [0, 1, 4, 5, 6])
    assert merged.n_units == 7
    np.testing.assert_array_equal(merged.x[:, 0], [10, 20, 21])
    assert combine([one, replace(two, sample=None)], 0.95).sample is None


def test_a_run_on_its_way_has_no_part_in_the_mean():
    ends = [outcome(1e-4), outcome(2e-4)]
    level = samplers.methods.Level(gamma=1.0, p=0.1, estimate=0.1, n_sim=50, n_points=50, cov=0.1)
    cut = outcome(0.0, math.inf, Status.STOPPED, trace=(level,))
    result = combine([*ends, cut], 0.95)
    assert result.p == pytest.approx(1.5e-4)
    assert result.interval == combine(ends, 0.95).interval
    assert result.trace == (replace(level, run=2),)
    assert result.warnings == ("1 of 3 runs were stopped before their end and left out.",)
    single = combine([ends[0], cut], 0.95)
    assert (single.p, single.interval, single.trace) == (1e-4, (0.0, 1.0), (replace(level, run=1),))
    assert combine([cut, replace(cut, p=1e-3)], 0.95).p == 5e-4


def test_runs_that_disagree_are_told_of():
    """One of five runs has found a region that holds a third of p."""
    runs = [outcome(p, cov=0.02) for p in (1.00e-4, 1.01e-4, 1.00e-4, 1.02e-4, 1.5e-4)]
    assert any("disagree" in text for text in combine(runs, 0.95).warnings)
    alike = [outcome(p, cov=0.02) for p in (1.00e-4, 1.03e-4, 0.97e-4, 1.02e-4, 0.99e-4)]
    assert not combine(alike, 0.95).warnings
