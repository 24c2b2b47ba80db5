import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.intervals import binomial_cov, clopper_pearson
from samplers.method import Outcome
from samplers.reference import half_space
from samplers.replication import combined, combined_cov
from samplers.result import Status


def outcome(p, cov=0.2, status=Status.CONVERGED, warnings=(), interval=(0.0, 1.0), **more):
    return Outcome(p=p, interval=interval, cov=cov, status=status, warnings=warnings, **more)


def test_t_interval_on_the_log_scale():
    p = [1e-4, 2e-4, 4e-4]
    result = combined([outcome(x) for x in p], 0.95)
    assert result.p == pytest.approx(np.mean(p))
    half = stats.t.ppf(0.975, 2) * math.log(2) / math.sqrt(3)  # the logs are log 2 apart
    assert result.interval == pytest.approx((result.p * np.exp(-half), result.p * np.exp(half)))


def test_cov_is_the_larger_of_own_and_seen():
    assert combined_cov([outcome(1.0, 0.3)] * 4) == pytest.approx(0.15)
    apart = combined_cov([outcome(1.0, 0.01), outcome(3.0, 0.01)])
    assert apart == pytest.approx(math.sqrt(2) / 2 / math.sqrt(2))


def test_one_run_is_left_alone():
    only = outcome(1e-4)
    assert combined([only], 0.95) is only


def test_without_any_hit_the_interval_is_one_sided():
    none = [outcome(0.0, math.inf, Status.NO_HITS, interval=(0.0, h)) for h in (0.01, 0.02)]
    result = combined(none, 0.95)
    assert (result.p, result.interval, result.status) == (0.0, (0.0, 0.02), Status.NO_HITS)
    assert math.isinf(result.cov)


def test_some_runs_without_a_hit():
    result = combined([outcome(0.0, math.inf, Status.NO_HITS), outcome(2e-4), outcome(1e-4)], 0.95)
    assert result.p == pytest.approx(1e-4)
    assert result.interval[0] < 1e-4 < result.interval[1]


def test_warnings_are_counted_and_the_worst_status_kept():
    runs = [outcome(1e-4, warnings=("odd",)), outcome(2e-4, status=Status.BUDGET)]
    result = combined([*runs, outcome(1e-4, warnings=("odd",))], 0.95)
    assert result.warnings == ("In 2 of 3 runs: odd",)
    assert result.status is Status.BUDGET


def test_replicates_are_independent_and_all_counted(recorder):
    f = recorder(half_space().problem.f)
    problem = samplers.FunctionProblem(f, 2)
    result = samplers.estimate(problem, "adss", seed=1, replicates=4)
    assert result.n_sim == f.rows
    assert len(np.unique(f.points, axis=0)) == f.rows
    assert {level.run for level in result.trace} == {0, 1, 2, 3}
    ends = [level.estimate for level in result.trace if level.gamma == 0.0]
    assert len(set(ends)) == 4
    assert result.p == pytest.approx(np.mean(ends))


def test_replicates_share_the_budget(recorder):
    f = recorder(half_space().problem.f)
    problem = samplers.FunctionProblem(f, 2)
    result = samplers.estimate(problem, "mc", seed=1, replicates=3, max_sim=1000)
    assert f.rows == result.n_sim == 1000
    assert [level.n_sim for level in result.trace] == [333, 333, 334]


def test_first_replicate_is_the_single_run():
    single = samplers.estimate(half_space().problem, "adss", seed=1)
    several = samplers.estimate(half_space().problem, "adss", seed=1, replicates=2)
    assert several.trace[: len(single.trace)] == single.trace


def test_target_cov_adds_runs_until_it_is_met():
    result = samplers.estimate(half_space().problem, "adss", seed=1, target_cov=0.12)
    assert result.cov <= 0.12
    assert result.status == "converged"
    assert max(level.run for level in result.trace) + 1 >= 5
    enough = samplers.estimate(half_space().problem, "adss", seed=1, target_cov=0.5)
    assert {level.run for level in enough.trace} == {0}


def test_target_cov_keeps_to_the_budget_and_says_so(recorder):
    f = recorder(half_space().problem.f)
    problem = samplers.FunctionProblem(f, 2)
    result = samplers.estimate(problem, "adss", seed=1, target_cov=0.05, max_sim=12_000)
    assert f.rows == result.n_sim <= 12_000
    assert result.status == "budget"
    assert any("target c.o.v. 0.05 was not met" in text for text in result.warnings)


def test_target_cov_of_pooled_runs_uses_all_of_max_sim():
    """Three runs meet their share of the target early, all together they miss it at first."""
    problem, method = half_space(2, 3.0).problem, samplers.MonteCarlo(batch=1000)
    budget = (1 - half_space(2, 3.0).p) / half_space(2, 3.0).p / 0.05**2
    missed = samplers.estimate(problem, method, seed=1, target_cov=0.05, replicates=3, max_sim=int(budget / 2) + 7)
    assert missed.n_sim == int(budget / 2) + 7
    assert missed.status == "budget"
    met = samplers.estimate(problem, method, seed=1, target_cov=0.05, replicates=3, max_sim=2 * int(budget))
    assert met.cov <= 0.05
    assert met.status == "converged"
    assert met.n_sim < 1.5 * budget


class Fixed:
    """Up to 400 plain draws, whatever the target; says that they pool, or not."""

    name, stops_at_target = "fixed", False

    def __init__(self, pools):
        self.pools = pools

    def steps(self, inputs, goal, rng):
        n = min(400, goal.budget)
        f = yield rng.standard_normal((n, 2))
        hits = int(np.count_nonzero(f <= goal.gamma))
        counts = (hits, n) if self.pools else None
        return outcome(hits / n, binomial_cov(hits / n, n), counts=counts)


@pytest.mark.parametrize(("pools", "n_sim"), [(True, 1000), (False, 800)])
def test_a_rest_of_max_sim_is_used_where_runs_pool(pools, n_sim):
    """A run of 200 draws beside two of 400 would spoil a mean, not a pooled share."""
    problem = half_space(2, 1.0).problem
    result = samplers.estimate(problem, Fixed(pools), seed=1, target_cov=0.01, replicates=2, max_sim=1000)
    assert result.n_sim == n_sim


def test_runs_that_pool_need_not_be_five():
    """Hits are binomial: cov^2 = (1 - p) / (p n) is 0.066^2 with 1200 draws, 0.081^2 with 800."""
    problem = half_space(2, 1.0).problem
    pooled, mean = (
        samplers.estimate(problem, Fixed(pools), seed=1, target_cov=0.073, replicates=2) for pools in (True, False)
    )
    assert pooled.n_sim == 1200
    assert mean.n_sim >= 2000


def test_one_run_at_the_limit_of_its_method_is_not_the_end():
    method, target, share = samplers.MonteCarlo(n=1000), 0.12, 0.12 * math.sqrt(3)
    gone_on = 0
    for seed in range(20):
        result = samplers.estimate(half_space(2, 2.0).problem, method, seed=seed, target_cov=target, replicates=3)
        at_limit = sum(level.cov > share for level in result.trace)
        assert (result.status == "converged") == (result.cov <= target)
        assert result.cov <= target or at_limit == 3
        gone_on += len(result.trace) > 3 and at_limit > 0
    assert gone_on > 0


@pytest.mark.parametrize("method", ["mc", "ce"])
@pytest.mark.parametrize("replicates", [2, 3])
def test_target_cov_with_replicates_is_met(method, replicates):
    """The runs meet target_cov sqrt(R) each; their spread, or where they stopped, may still miss the target."""
    target = {"mc": 0.2, "ce": 0.02}[method]
    runs = []
    for seed in range(12):
        result = samplers.estimate(half_space().problem, method, seed=seed, target_cov=target, replicates=replicates)
        assert result.cov <= target, seed
        assert result.status == "converged"
        runs.append(max(level.run for level in result.trace) + 1)
    assert replicates in runs
    assert max(runs) <= 20


def test_a_target_out_of_reach_is_given_up_at_the_limit_of_the_method():
    method = samplers.MonteCarlo(n=1000)
    result = samplers.estimate(half_space().problem, method, seed=1, target_cov=0.01, replicates=3)
    assert result.n_sim == 3000


def test_target_cov_is_given_up_after_200_runs():
    method = samplers.AdaptiveSubsetSimulation(n=10)
    result = samplers.estimate(half_space(2, 2.0).problem, method, seed=1, target_cov=1e-3)
    assert max(level.run for level in result.trace) + 1 == 200
    assert result.status == "budget"


def test_replicates_of_monte_carlo_are_one_longer_run():
    """Two runs with 252 hits in all: a t interval of two runs would be 20 times wider."""
    result = samplers.estimate(half_space(2, 2.8).problem, "mc", seed=1, replicates=2, max_sim=100_001)
    hits = result.failures.total
    assert 200 < hits < 310
    assert result.p == hits / 100_001
    assert result.interval == clopper_pearson(hits, 100_001, 0.95)
    assert result.cov == binomial_cov(hits / 100_001, 100_001)


def test_pooled_counts_weigh_draws_not_runs():
    few, many = (
        outcome(hits / n, cov=0.5, counts=(hits, n), no_outcome_share=share, warnings=("coarse",))
        for hits, n, share in ((1, 100, 1.0), (3, 900, 0.0))
    )
    result = combined([few, many], 0.95)
    assert result.p == 4 / 1000
    assert result.interval == clopper_pearson(4, 1000, 0.95)
    assert result.no_outcome_share == 1 / 4
    assert combined_cov([few, many]) == result.cov == binomial_cov(0.004, 1000)
    assert result.warnings == ("Only 4 of 1,000 simulations failed; the estimate is coarse.",)
    assert combined([few, replace(many, counts=None)], 0.95).p == pytest.approx((1 / 100 + 3 / 900) / 2)


def test_pooled_runs_without_a_hit():
    none = outcome(0.0, math.inf, Status.NO_HITS, counts=(0, 500))
    result = combined([none, none], 0.95)
    assert (result.p, result.interval, result.status) == (0.0, clopper_pearson(0, 1000, 0.95), Status.NO_HITS)


def test_coverage_of_two_pooled_runs(study):
    runs = 200
    found = study(half_space(2, 2.0), "mc", runs, replicates=2, max_sim=2000)
    assert found.covered >= stats.binom.ppf(1e-3, runs, 0.95)
    high_over_low = [result.interval[1] / result.interval[0] for result in found.results]
    assert np.mean(high_over_low) < 2.5  # about 45 hits: exp(2 x 1.96 / sqrt(45)) = 1.8


def test_coverage_of_replicated_runs(study):
    runs = 60
    found = study(half_space(2, 3.0), samplers.AdaptiveSubsetSimulation(n=500), runs, replicates=6)
    assert found.covered >= stats.binom.ppf(1e-3, runs, 0.93)


@pytest.mark.slow
def test_coverage_of_replicated_runs_with_many_seeds(study):
    runs = 400
    found = study(half_space(), samplers.AdaptiveSubsetSimulation(), runs, replicates=10)
    assert found.covered >= stats.binom.ppf(1e-3, runs, 0.93)
