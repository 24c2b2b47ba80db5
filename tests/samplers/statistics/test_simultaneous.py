import numpy as np
import pytest

import samplers
from samplers.analysis.weighted import simultaneous_intervals, simultaneous_level, unit_sums
from samplers.statistics import clopper_pearson


def level_of(correlation):
    return simultaneous_level(np.array(correlation), 0.95, np.random.default_rng(0))


def test_one_estimate_or_several_that_move_together_need_no_more_than_the_confidence():
    assert level_of([[1.0]]) == 0.95
    assert level_of(np.ones((4, 4))) == 0.95
    assert level_of(np.zeros((3, 3))) == 0.95


@pytest.mark.parametrize("number", [2, 5])
def test_independent_estimates_need_the_root(number):
    """All of k hold together with 0.95 if each does with 0.95^(1 / k); 10,000 draws know the quantile to about 1 %."""
    assert level_of(np.eye(number)) == pytest.approx(0.95 ** (1 / number), abs=0.004)


def test_intervals_of_counts_are_exact_at_the_common_level_and_open_where_they_are_not_used():
    f = np.concatenate([np.full(20, -1.0), np.full(30, 0.5), np.full(950, 2.0)])
    sums = unit_sums(samplers.Sample.of_equal_draws(f, np.zeros((20, 1))), np.array([0.0, 1.0]))
    low, high = simultaneous_intervals(sums, np.array([0]), sums.p, sums.cov, 0.95, seed=0)
    assert (low[0], high[0]) == pytest.approx(clopper_pearson(20, 1000, 0.95))
    assert (low[1], high[1]) == (0.0, 1.0)
    both, _ = simultaneous_intervals(sums, np.array([0, 1]), sums.p, sums.cov, 0.95, seed=0)
    assert both[0] < low[0]
