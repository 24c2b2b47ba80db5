import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.execution.arguments import RunArguments
from samplers.execution.combination import combine, combined_cov
from samplers.execution.replicate import Replicate
from samplers.execution.run import Run
from samplers.limit_states import half_space
from samplers.method import Goal, Outcome
from samplers.sample import Sample
from samplers.statistics.intervals import binomial_cov, clopper_pearson
from samplers.trace import Status


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


def test_one_run_is_left_alone():
    only = outcome(1e-4)
    assert combine([only], 0.95) is only


def test_without_any_hit_the_interval_is_one_sided():
    none = [outcome(0.0, math.inf, Status.NO_HITS, interval=(0.0, h)) for h in (0.01, 0.02)]
    result = combine(none, 0.95)
    assert (result.p, result.interval, result.status) == (0.0, (0.0, 0.02), Status.NO_HITS)
    assert math.isinf(result.cov)


def test_some_runs_without_a_hit():
    result = combine([outcome(0.0, math.inf, Status.NO_HITS), outcome(2e-4), outcome(1e-4)], 0.95)
    assert result.p == pytest.approx(1e-4)
    assert result.interval[0] < 1e-4 < result.interval[1]


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


def one_after_another(problem, method, seed, replicates, max_sim):
    """The same runs without any interleaving."""
    outcomes = []
    for i in range(replicates):
        share = None if max_sim is None else max_sim // replicates
        goal = Goal(gamma=0.0, max_sim=share)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(i,)))
        run = Replicate(method.steps(problem, goal, rng), goal, problem.dim)
        while run.running:
            run.tell(problem.evaluate(run.requested))
        outcomes.append(run.outcome)
    return combine(outcomes, 0.95)


@pytest.mark.parametrize("max_sim", [None, 6000])
@pytest.mark.parametrize("method", sorted(samplers.METHODS))
def test_side_by_side_is_one_after_another_in_fewer_calls(method, max_sim, recorder):
    problem, chosen = half_space(3, 3.0).problem, samplers.get_method(method)
    alone, together = (recorder(problem.f) for _ in range(2))
    expected = one_after_another(samplers.FunctionProblem(alone, 3), chosen, 7, 3, max_sim)
    result = samplers.estimate(samplers.FunctionProblem(together, 3), chosen, seed=7, replicates=3, max_sim=max_sim)
    assert result.p == expected.p
    assert result.interval == expected.interval
    assert result.cov == expected.cov
    assert result.trace == expected.trace
    assert result.warnings == expected.warnings
    np.testing.assert_array_equal(np.unique(together.points, axis=0), np.unique(alone.points, axis=0))
    assert together.rows == alone.rows
    assert len(together.batches) < 0.6 * len(alone.batches)


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
    result = combine([few, many], 0.95)
    assert result.p == 4 / 1000
    assert result.interval == clopper_pearson(4, 1000, 0.95)
    assert result.no_outcome_share == 1 / 4
    assert combined_cov([few, many]) == result.cov == binomial_cov(0.004, 1000)
    assert result.warnings == ("Only 4 of 1,000 simulations failed; the estimate is coarse.",)
    assert combine([few, replace(many, counts=None)], 0.95).p == pytest.approx((1 / 100 + 3 / 900) / 2)


def test_pooled_runs_without_a_hit():
    none = outcome(0.0, math.inf, Status.NO_HITS, counts=(0, 500))
    result = combine([none, none], 0.95)
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


def sample(f, weights, first_x, n_units=None):
    f = np.array(f, dtype=float)
    n_units = len(f) if n_units is None else n_units
    x = first_x + np.arange(np.count_nonzero(f <= 0), dtype=float)[:, None]
    return Sample(f=f, weights=np.array(weights), units=np.arange(len(f)), n_units=n_units, x=x)


def test_samples_are_merged_as_the_runs_are():
    one = outcome(0.3, sample=sample([-1.0, 2.0], [0.3, 0.7], 10.0, n_units=4))
    two = outcome(0.1, sample=sample([3.0, -2.0, 0.0], [0.9, 0.06, 0.04], 20.0))
    merged = combine([one, two], 0.95).sample
    np.testing.assert_array_equal(merged.f, [-1, 2, 3, -2, 0])
    np.testing.assert_allclose(merged.weights, [0.15, 0.35, 0.45, 0.03, 0.02])
    np.testing.assert_array_equal(merged.units, [0, 1, 4, 5, 6])
    assert merged.n_units == 7
    np.testing.assert_array_equal(merged.x[:, 0], [10, 20, 21])
    assert combine([one, replace(two, sample=None)], 0.95).sample is None


def test_samples_of_pooled_counts_weigh_draws():
    few = outcome(0.5, counts=(1, 2), sample=sample([-1.0, 1.0], [0.5] * 2, 0.0))
    many = outcome(0.25, counts=(2, 8), sample=sample([-1.0] * 2 + [1.0] * 6, [1 / 8] * 8, 5.0))
    pooled = combine([few, many], 0.95)
    assert pooled.p == 0.3
    np.testing.assert_allclose(pooled.sample.weights, 0.1)
    assert pooled.sample.n_units == 10


def test_a_run_on_its_way_has_no_part_in_the_mean():
    ends = [outcome(1e-4), outcome(2e-4)]
    level = samplers.Level(gamma=1.0, p=0.1, estimate=0.1, n_sim=50, n_points=50, cov=0.1)
    cut = outcome(0.0, math.inf, Status.STOPPED, trace=(level,))
    result = combine([*ends, cut], 0.95)
    assert result.p == pytest.approx(1.5e-4)
    assert result.interval == combine(ends, 0.95).interval
    assert result.trace == (replace(level, run=2),)
    assert result.warnings == ("1 of 3 runs were stopped before their end and left out.",)
    single = combine([ends[0], cut], 0.95)
    assert (single.p, single.interval, single.trace) == (1e-4, (0.0, 1.0), (replace(level, run=1),))
    assert combine([cut, replace(cut, p=1e-3)], 0.95).p == 5e-4


def stopped_after(batches, method, **options):
    """The result of a run that is stopped after so many batches, and the run."""
    problem = half_space(2, 2.0).problem
    run = Run(problem, method, RunArguments(seed=1, **options))
    for _ in range(batches):
        run.tell(problem.evaluate(run.ask()))
    return run.result()


def test_replicates_stopped_on_their_way():
    result = stopped_after(2, samplers.MonteCarlo(batch=100), replicates=3, max_sim=5000)
    assert (result.n_sim, result.status) == (600, "stopped")
    assert result.p == result.failures.total / 600
    assert result.interval == clopper_pearson(result.failures.total, 600, 0.95)
    assert len(result.sample.f) == 600


def test_stopped_while_further_runs_are_made_for_the_target():
    """Two runs of 400 draws, then one more at a time: the third had not been told a thing, or is left out."""
    first = stopped_after(1, Fixed(False), replicates=2, target_cov=0.01)
    assert (first.n_sim, first.status) == (800, "stopped")
    assert not any("left out" in text for text in first.warnings)
    pooled = stopped_after(2, Fixed(True), replicates=2, target_cov=0.01)
    assert pooled.n_sim == 1200
    assert pooled.interval == clopper_pearson(pooled.failures.total, 1200, 0.95)


def test_runs_that_disagree_are_told_of():
    """One of five runs has found a region that holds a third of p."""
    runs = [outcome(p, cov=0.02) for p in (1.00e-4, 1.01e-4, 1.00e-4, 1.02e-4, 1.5e-4)]
    assert any("disagree" in text for text in combine(runs, 0.95).warnings)
    alike = [outcome(p, cov=0.02) for p in (1.00e-4, 1.03e-4, 0.97e-4, 1.02e-4, 0.99e-4)]
    assert not combine(alike, 0.95).warnings
