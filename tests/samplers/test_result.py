"""What an estimate says and keeps."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import samplers
from samplers.limit_states import half_space
from tests.samplers.fitted_bases import fitted, resampled, run


def result(**options):
    return samplers.estimate(half_space().problem, "adss", seed=1, **options)


def test_to_dict_is_plain_json():
    estimate = result()
    data = json.loads(estimate.to_json())
    assert data == estimate.to_dict()
    assert data["p"] == estimate.p
    assert data["status"] == "converged"
    assert data["method"]["name"] == "adss"
    assert data["method"]["settings"]["n"] == 1000
    assert len(data["trace"]) == len(estimate.trace)
    assert data["failures"]["total"] == estimate.failures.total


def test_to_dict_has_no_infinities():
    never = samplers.FunctionProblem(lambda x: np.ones(len(x)), 1)
    data = samplers.estimate(never, "mc", seed=1, max_sim=100).to_dict()
    assert data["cov"] is None
    assert data["gain"] is None
    json.dumps(data, allow_nan=False)


def test_says_how_large_a_region_may_have_been_missed():
    estimate = result()
    assert estimate.base_draws == 1000
    assert (1 - estimate.unseen) ** 1000 == pytest.approx(0.05)
    assert (
        "valid if no failure region was missed; 1,000 base draws would have met one with probability above 3.0e-03 "
        "(95 % confidence)" in str(estimate)
    )
    assert (1 - result(confidence=0.9).unseen) ** 1000 == pytest.approx(0.1)
    assert estimate.to_dict()["unseen"] == estimate.unseen
    without = replace(estimate, base_draws=0)
    assert without.unseen == 1
    assert "no base draws" in str(without)


def test_without_a_failure_it_says_which_bound_has_which_level():
    never = samplers.FunctionProblem(lambda x: np.ones(len(x)), 1)
    estimate = samplers.estimate(never, "mc", seed=1, max_sim=1000)
    assert (1 - estimate.interval[1]) ** 1000 == pytest.approx(0.025)
    assert estimate.proviso == (
        "without further assumptions: none of 1,000 base draws failed, so p is below 3.0e-03 with 95 % confidence "
        "(the upper end of the interval has 97.5 % or more)"
    )
    assert "with 90 % confidence (the upper end of the interval has 95 %" in replace(estimate, confidence=0.9).proviso


def test_says_what_the_problem_holds_fixed():
    problem = samplers.FunctionProblem(lambda u: 2.0 - u[:, 0], 2)
    free = samplers.estimate(problem, "mc", seed=1, max_sim=500)
    assert (free.given, free.to_dict()["given"]) == ("", "")
    problem = SimpleNamespace(dim=2, base=problem.base, evaluate=problem.evaluate, given="one die is fixed")
    fixed = samplers.estimate(problem, "mc", seed=1, max_sim=500)
    assert fixed.to_dict()["given"] == "one die is fixed"
    assert "valid given that one die is fixed, if no failure region was missed; " in str(fixed)
    assert (
        "one die is fixed, if no failure region was missed (no base draws limit" in replace(fixed, base_draws=0).proviso
    )
    run = samplers.MonteCarlo(n=500).start(problem, seed=1)
    while not run.done:
        run.tell(problem.evaluate(run.ask()))
    assert run.result().given == "one die is fixed"


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        (samplers.MonteCarlo(n=3000), 3000),
        (samplers.SubsetSimulation(n=500), 500),
        (samplers.AdaptiveSubsetSimulation(n=500), 500),
        (samplers.CrossEntropy(n_iteration=500, n_final=2000), 500 + 200),
        (samplers.ImprovedCrossEntropy(n_round=500, n_final=2000), 500 + 200),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_counts_base_draws_of_search_and_estimate(method, expected):
    assert samplers.estimate(half_space().problem, method, seed=1).base_draws == expected


@pytest.mark.slow
@pytest.mark.parametrize("method", ["two-stage", "ce"])
def test_a_region_as_large_as_said_is_rarely_missed(method):
    """A sliver that nothing leads to, beside a half-space: it is seen unless all base draws miss it."""
    missed = 0
    for seed in range(100):
        seen = []

        def f(x, seen=seen):
            sliver = np.abs(x[:, 0] + 0.5) < 0.006  # p = 0.0042
            seen.append(sliver.any())
            return np.where(sliver, -1.0, 3.5 - x[:, 0])

        unseen = samplers.estimate(samplers.FunctionProblem(f, 2), method, seed=seed, max_sim=6000).unseen
        assert unseen < 0.006
        missed += not any(seen)
    assert missed <= 10


def test_failures_read_as_arrays_and_one_by_one():
    failures = result().failures
    assert failures.x.shape == (len(failures), 2)
    assert (failures.f <= 0).all()
    assert (np.diff(failures.log_p0) <= 0).all()
    x, f, log_p0 = failures[0]
    np.testing.assert_array_equal(x, failures.x[0])
    assert f == failures.f[0]
    assert log_p0 == max(failure.log_p0 for failure in failures)
    assert failures != result(gamma=0.1).failures


def test_an_estimate_comes_back_from_its_file(tmp_path):
    found = result(replicates=2)
    found.save(tmp_path / "result")
    loaded = samplers.Estimate.load(tmp_path / "result")
    assert loaded == found
    assert loaded.to_json() == found.to_json()
    assert loaded.base is None
    again = samplers.estimate(half_space().problem, loaded.method, seed=loaded.seed, replicates=2)
    assert again == found
    np.testing.assert_array_equal(loaded.curve([0.0, 1.0]).high, found.curve([0.0, 1.0]).high)


def test_the_uncertainty_of_the_base_is_kept_and_computed_anew_with_the_base(tmp_path):
    base = fitted(resampled(200))
    found = run(base, "ce", max_sim=6000)
    assert found.base_uncertainty is not None
    found.save(tmp_path / "result")
    assert str(samplers.Estimate.load(tmp_path / "result")) == str(found)
    with_base = samplers.Estimate.load(tmp_path / "result", base=base)
    assert "base_uncertainty" not in vars(with_base)
    assert with_base.base_uncertainty == found.base_uncertainty


def test_the_most_likely_failures_are_kept_a_thousand_of_them(recorder):
    f = recorder(lambda x: -np.abs(x[:, 0]))
    found = samplers.estimate(samplers.FunctionProblem(f, 1), "mc", seed=1, max_sim=5000).failures
    nearest = np.sort(np.abs(f.points[:, 0]))[:1000]
    np.testing.assert_array_equal(np.abs(found.x[:, 0]), nearest)
    assert (len(found), found.total) == (1000, 5000)
