import json
import time
from types import SimpleNamespace

import numpy as np
import pytest

import samplers
from samplers.distributions import NormalBlock, StandardNormal
from samplers.limit_states import half_space
from samplers.proposals import Gaussian
from tests.samplers.fitted_bases import FittedWithEnsemble, HalfSpace, fitted, normal

PROBLEM = half_space().problem


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"gamma": float("inf")}, "gamma to be a finite number, got inf"),
        ({"gamma": "0"}, "gamma to be a finite number, got '0'"),
        ({"gamma": 10**400}, "gamma to be a finite number, got 10"),
        ({"confidence": 1.2}, "confidence to be a number between 0 and 1, got 1.2"),
        ({"max_sim": 1e4}, "max_sim to be a whole number of at least 1, got 10000.0"),
        ({"max_sim": 10**99}, "max_sim to be at most 1,000,000,000,000, got 1.00e"),
        ({"max_sim": 3, "replicates": 4}, "max_sim to be a whole number of at least 4, got 3"),
        ({"target_cov": 0.0}, "target_cov to be a number above 0, got 0.0"),
        ({"replicates": None}, "replicates to be a whole number of at least 1, got None"),
        ({"seed": -1}, "seed to be a whole number of at least 0, got -1"),
        ({"on_error": "fail"}, "Unknown on_error 'fail'. Did you mean 'failure'.*Valid: raise, failure, bound"),
        (
            {"method": "adds"},
            "method 'adds'. Did you mean 'adss'.*Valid: auto, two-stage, series, surrogate, .*adss",
        ),
        ({"method": samplers.MonteCarlo}, "the class MonteCarlo; add brackets"),
        ({"method": 3}, "a method such as MonteCarlo"),
        ({"progress": 1}, "progress to be True, False or a function"),
        ({"time_limit": 0}, "time_limit to be a number above 0, got 0"),
        ({"stop": True}, "stop to be a function of Progress, got True"),
    ],
)
def test_bad_arguments_are_refused_before_any_simulation(options, expected, recorder):
    f = recorder(PROBLEM.f)
    with pytest.raises(ValueError, match=expected):
        samplers.estimate(samplers.FunctionProblem(f, 2), **options)
    assert f.rows == 0


@pytest.mark.parametrize(
    ("problem", "expected"),
    [
        (lambda x: x, "FunctionProblem"),
        (SimpleNamespace(dim=2, base=StandardNormal(2)), "dim, base and evaluate, got .* without evaluate"),
        (SimpleNamespace(dim=0, base=StandardNormal(2), evaluate=len), "dim to be a whole number of at least"),
        (SimpleNamespace(dim=2, base=np.random, evaluate=len), "problem.base to have sample, log_prob, .* got module"),
    ],
    ids=["a function", "no f", "no dimension", "no distribution"],
)
def test_a_problem_must_look_like_one(problem, expected):
    with pytest.raises(ValueError, match=expected):
        samplers.estimate(problem)


def test_numbers_of_numpy_are_numbers():
    method = samplers.MonteCarlo(n=np.int64(500), batch=np.int32(100))
    result = samplers.estimate(
        PROBLEM, method, gamma=np.float32(2.0), confidence=np.float32(0.5), seed=np.int64(1), replicates=np.int8(2)
    )
    assert result.n_sim == 1000
    assert json.loads(result.to_json())["method"]["settings"] == {"n": 500, "batch": 100}


def test_a_drawn_seed_repeats_the_run():
    first = samplers.estimate(PROBLEM, "mc", max_sim=1000)
    assert samplers.estimate(PROBLEM, "mc", max_sim=1000, seed=first.seed) == first
    assert samplers.estimate(PROBLEM, "mc", max_sim=1000).seed != first.seed


@pytest.mark.parametrize("method", ["mc", "ce", "adss", "two-stage"])
def test_nan_as_failure_or_bound(method):
    """p = P[u1 >= 1.5 or u2 > 1.28] with NaN as failure; 0.9 x 0.0668 fail for certain."""
    problem = samplers.FunctionProblem(lambda x: np.where(x[:, 1] > 1.2815515655446004, np.nan, 1.5 - x[:, 0]), 2)
    certain, doubtful = 0.9 * 0.0668072, 0.1
    counted, bound = (
        samplers.estimate(problem, method, seed=2, max_sim=5000, on_error=on_error) for on_error in ("failure", "bound")
    )
    assert counted.p == pytest.approx(certain + doubtful, rel=4 * counted.cov)
    assert counted.cov < 0.1
    assert counted.interval[0] > 0.1
    assert bound.p == counted.p
    assert bound.interval[1] == counted.interval[1]
    assert 0.5 * certain < bound.interval[0] < certain
    assert any("gave no outcome" in text for text in bound.warnings)
    assert np.isnan(bound.failures.f).any()


@pytest.mark.parametrize("replicates", [1, 3])
def test_time_limit(replicates, recorder):
    f = recorder(lambda x: time.sleep(0.02) or 2.0 - x[:, 0])
    problem, method = samplers.FunctionProblem(f, 2), samplers.MonteCarlo(batch=100)
    result = samplers.estimate(problem, method, seed=1, max_sim=10**6, time_limit=0.1, replicates=replicates)
    assert result.status == "stopped"
    assert result.n_sim == f.rows == 100 * replicates * len(f.batches)
    assert 1 <= len(f.batches) <= 6
    assert any(f"time limit of 0.1 s after {f.rows:,} simulations" in text for text in result.warnings)
    assert result.p == result.failures.total / f.rows


@pytest.mark.parametrize(("name", "replicates"), [("mc", 1), ("adss", 2), ("two-stage", 1), ("two-stage", 2)])
def test_stopped_by_a_callback(name, replicates, recorder):
    f = recorder(PROBLEM.f)
    seen = []

    def after_1000(progress):
        seen.append(progress.n_sim)
        return progress.n_sim >= 1000

    method = samplers.MonteCarlo(batch=400) if name == "mc" else samplers.methods.get_method(name)
    result = samplers.estimate(
        samplers.FunctionProblem(f, 2), method, seed=1, max_sim=5000, replicates=replicates, stop=after_1000
    )
    assert result.status == "stopped"
    assert result.n_sim == f.rows == seen[-1] == sum(level.n_sim for level in result.trace)
    assert len(seen) == len(f.batches)
    assert 0 <= result.interval[0] <= result.p <= result.interval[1] <= 1
    assert any(f"Stopped by the callback after {f.rows:,} simulations" in text for text in result.warnings)


FAR_REFITS = [normal(7.0, 0.2 + 0.01 * i) for i in range(30)]


def test_stopping_holds_for_the_further_run_too_and_a_stopped_run_has_none():
    problem, seen = HalfSpace(fitted(FAR_REFITS, FittedWithEnsemble), 2.0), []

    def stop(progress):
        seen.append(progress.n_sim)
        return len(seen) == 3

    method = samplers.MonteCarlo(batch=1000)
    once = samplers.estimate(problem, method, seed=1, max_sim=2000, stop=lambda at: at.n_sim >= 1000)
    assert (once.status, once.ensemble_run) == (samplers.Status.STOPPED, None)
    result = samplers.estimate(problem, method, seed=1, max_sim=2000, stop=stop)
    assert result.status is samplers.Status.CONVERGED
    assert (result.ensemble_run.status, result.ensemble_run.n_sim) == (samplers.Status.STOPPED, 1000)
    assert any("Stopped by the callback" in text for text in result.base_uncertainty.warnings)


def test_the_further_run_repeats_with_the_seed_that_the_result_states():
    problem = HalfSpace(fitted(FAR_REFITS, FittedWithEnsemble), 1.8)  # 72 failures expected: 30 are needed
    first = samplers.estimate(problem, "mc", max_sim=2000)
    again = samplers.estimate(problem, "mc", seed=first.seed, max_sim=2000)
    assert first.ensemble_run.n_sim == 2000
    assert again.base_uncertainty == first.base_uncertainty
    assert (again.ensemble_run.seed, again.ensemble_run.p) == (first.seed, first.ensemble_run.p)


def test_what_cannot_search_under_a_mixture_is_left_to_two_stage_and_refits_that_cannot_be_mixed_are_told():
    class WithBlocks(FittedWithEnsemble):
        blocks = (NormalBlock(Gaussian.standard(1)), NormalBlock(Gaussian.standard(1)))

    class Unmixed(FittedWithEnsemble):
        def ensemble(self):
            raise ValueError("An ensemble needs refits that are Gaussian mixtures.")

    problem = HalfSpace(fitted(FAR_REFITS, WithBlocks), 2.0)
    result = samplers.estimate(problem, samplers.CrossEntropy(family="blocks"), seed=1, max_sim=4000)
    assert (result.method.name, result.ensemble_run.method.name) == ("ce", "two-stage")
    assert len(result.base_uncertainty.value_refits) == 30
    result = samplers.estimate(HalfSpace(fitted(FAR_REFITS, Unmixed), 2.0), "mc", seed=1, max_sim=2000)
    assert result.ensemble_run is None and result.p > 0
    assert "30 of 30 refits rest on fewer than 10" in result.base_uncertainty.warnings[0]
