import math

import numpy as np
import pytest
from scipy import stats

import samplers
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


def test_coverage_of_replicated_runs(study):
    runs = 60
    found = study(half_space(2, 3.0), samplers.AdaptiveSubsetSimulation(n=500), runs, replicates=6)
    assert found.covered >= stats.binom.ppf(1e-3, runs, 0.93)


@pytest.mark.slow
def test_coverage_of_replicated_runs_with_many_seeds(study):
    runs = 400
    found = study(half_space(), samplers.AdaptiveSubsetSimulation(), runs, replicates=10)
    assert found.covered >= stats.binom.ppf(1e-3, runs, 0.93)
