import math
import sys

import numpy as np
import pytest

import samplers
from samplers.method import MANY_FAILURES, no_outcome_share
from samplers.statistics import binomial_cov, clopper_pearson


def test_budget_is_max_sim_or_without_limit():
    assert samplers.Goal(gamma=0.0, max_sim=7).budget == 7
    assert samplers.Goal(gamma=0.0).budget == sys.maxsize


@pytest.mark.parametrize(("hits", "n"), [(1, 50), (20, 400), (400, 400)])
def test_outcome_of_counts_is_the_binomial_share(hits, n):
    outcome = samplers.Outcome.of_counts(hits, n, 0.9, trace=())
    assert outcome.p == hits / n
    assert outcome.interval == clopper_pearson(hits, n, 0.9)
    assert outcome.cov == binomial_cov(hits / n, n)
    assert (outcome.counts, outcome.base_draws, outcome.status) == ((hits, n), n, "converged")


def test_no_hit_has_a_one_sided_interval_and_a_warning():
    outcome = samplers.Outcome.of_counts(0, 1000, 0.95, trace=())
    assert (outcome.p, outcome.cov, outcome.status) == (0.0, math.inf, "no_hits")
    assert outcome.interval[0] == 0 < outcome.interval[1] < 0.01
    assert outcome.warnings == ("None of 1,000 simulations failed: p = 0 with a one-sided interval.",)


@pytest.mark.parametrize(("hits", "warned"), [(1, True), (MANY_FAILURES - 1, True), (MANY_FAILURES, False)])
def test_few_hits_are_warned_of(hits, warned):
    outcome = samplers.Outcome.of_counts(hits, 10_000, 0.95, trace=())
    assert bool(outcome.warnings) == warned
    assert warned == (outcome.cov > 1 / math.sqrt(MANY_FAILURES))


def test_share_of_points_without_an_outcome():
    f = np.array([-np.inf, 1.0, -np.inf, 2.0])
    assert no_outcome_share(f) == 0.5
    assert no_outcome_share(f, np.log([1.0, 2.0, 3.0, 4.0])) == pytest.approx(0.4)
    assert no_outcome_share(np.empty(0)) == 0.0


def test_all_or_none_without_an_outcome_is_exact_whatever_the_weights():
    log_weights = np.log(np.array([0.1, 0.2, 0.7]))
    assert no_outcome_share(np.full(3, -np.inf), log_weights) == 1.0
    assert no_outcome_share(np.zeros(3), log_weights) == 0.0


def test_a_method_is_whatever_has_a_name_and_steps():
    class Mine:
        name, stops_at_target = "mine", False

        def steps(self, inputs, goal, rng):
            yield inputs.base.sample(1, rng)

    assert isinstance(Mine(), samplers.Stepping)
    assert not isinstance(Mine(), samplers.Method)  # has no `start`
    assert not isinstance(object(), samplers.Stepping)
