import numpy as np
import pytest

from samplers.importance.draws import Draws, weighted_interval
from samplers.methods.two_stage.discovery.unseen import (
    Discovery,
    count_lineages,
    discovery_interval,
)


def test_lineages_are_roots_and_what_wide_draws_are_worth():
    assert count_lineages(7, np.empty(0)) == 7
    assert count_lineages(7, np.zeros(12)) == pytest.approx(19)
    uneven = np.append(np.zeros(99), 100.0)  # one carries all: a fourth of their number
    assert count_lineages(7, uneven) == pytest.approx(32)


def test_skewness_and_what_is_unseen_raise_the_upper_end_only():
    draws = Draws(2000, np.zeros(1000), np.concatenate([np.full(990, np.log(1e-4)), np.full(10, np.log(2e-2))]))
    low, high = discovery_interval(draws, draws.cov, 0.95, 20.0, Discovery(lineages=1e9))
    plain = weighted_interval(draws, 0.95, 20.0, draws.cov)
    assert draws.skewness / 2000**0.5 > 0.2
    assert low == plain[0]
    assert high > plain[1]
    assert discovery_interval(draws, draws.cov, 0.95, 20.0, Discovery(lineages=4))[1] > 1.02 * high


def test_the_bound_of_few_draws_gives_way_to_that_of_the_levels():
    few = Draws(2000, np.zeros(5), np.full(5, np.log(1e-3)))
    assert discovery_interval(few, few.cov, 0.95, 20.0, Discovery(1e9))[1] > 1e-2
    assert discovery_interval(few, few.cov, 0.95, 20.0, Discovery(1e9, ceiling=1e-4))[1] < 1.1e-4


def test_without_failures_the_interval_is_that_of_the_draws():
    none = Draws(1000, np.empty(0), np.empty(0))
    assert discovery_interval(none, np.inf, 0.95, 20.0, Discovery(3)) == weighted_interval(none, 0.95, 20.0)
