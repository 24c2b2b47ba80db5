"""The default: which method it takes, what it says of it, and that few simulations give more than p = 0."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

import samplers
from samplers.executors import InProcess
from samplers.limit_states import half_space


def ring(dim=50, p=1e-3):
    """Failure outside a sphere: no direction leads to it."""
    radius = np.sqrt(chi2.isf(p, dim))
    return samplers.FunctionProblem(lambda u: radius - np.linalg.norm(u, axis=1), dim)


def test_above_1000_simulations_the_result_is_that_of_two_stage():
    problem = half_space(2, 3.0).problem
    result = samplers.estimate(problem, seed=4, max_sim=2000)
    assert result == samplers.estimate(problem, "two-stage", seed=4, max_sim=2000)
    assert result.choice == result.to_dict()["choice"] == "two-stage: 2,000 simulations for 2 dimensions"
    assert "chosen" not in result.details()  # the usual one is not announced


@pytest.mark.parametrize(
    ("dim", "max_sim", "name"), [(20, 2000, "two-stage"), (21, 2000, "adss"), (21, 2001, "two-stage")]
)
def test_few_simulations_in_many_dimensions_are_for_subset_simulation(dim, max_sim, name):
    result = samplers.estimate(half_space(dim, 3.0).problem, seed=0, max_sim=max_sim)
    assert result.choice == f"{name}: {max_sim:,} simulations for {dim} dimensions"
    assert result.interval[0] < norm.sf(3.0) < result.interval[1]


@pytest.mark.parametrize(("max_sim", "name"), [(1000, "surrogate"), (None, "two-stage")])
def test_noise_does_not_count_as_dimensions(max_sim, name):
    """Two coordinates are searched, 100 are noise; failures are common, so that nothing is to be learned."""

    class Base(samplers.distributions.StandardNormal):
        noise = np.arange(102) >= 2

    problem = samplers.FunctionProblem(lambda x: 0.5 - x[:, 0], base=Base(102), dim=102)
    result = samplers.estimate(problem, seed=0, max_sim=max_sim)
    assert result.choice == f"{name}: {result.n_sim:,} simulations for 2 dimensions"
    assert (result.method.name, result.n_sim) == (name, 6000 if name == "two-stage" else 1000)


def test_subset_simulation_has_the_rest_where_nothing_is_to_be_learned():
    result = samplers.estimate(ring(), seed=1, max_sim=300)
    assert result.choice.startswith("adss: 300 simulations for 50 dimensions, kriging explains ")
    assert f"chosen {result.choice}" in result.details()
    assert sum(level.n_sim for level in result.trace) == result.n_sim <= 300
    assert result.trace[0].n_sim == 100 and 0 < result.interval[0] < 1e-3 < result.interval[1] < 0.2


def test_a_run_that_is_stopped_where_another_method_has_begun_keeps_what_is_known():
    """f falls by steps, and jumps to failure: two-stage has the rest from 200 simulations on."""
    problem = samplers.FunctionProblem(lambda u: np.where(np.floor(3 * u[:, :2]).sum(axis=1) > 10.5, -1.0, 1.0), 3)
    assert samplers.estimate(problem, seed=0, max_sim=900).choice.startswith("two-stage: 900 simulations")
    result = samplers.estimate(problem, seed=0, max_sim=900, stop=lambda at: at.n_sim >= 200)
    assert (str(result.status), result.n_sim, result.p) == ("stopped", 200, 0.0) and 0.1 < result.interval[1] < 0.3


def test_without_a_failure_the_answer_is_a_bound_the_nearest_approach_and_what_to_do():
    seen = []

    def f(u):
        seen.append(20.0 - np.linalg.norm(u, axis=1))
        return seen[-1]

    result = samplers.estimate(samplers.FunctionProblem(f, 40), seed=0, max_sim=150)
    assert result.p == 0 and result.interval[1] < 0.1
    assert result.closest.f == np.concatenate(seen).min() == 20.0 - np.linalg.norm(result.closest.x[None], axis=1)
    text = result.details()
    assert f"P[f <= 0] below {result.interval[1]:.1e} (95 %): no failure in 150 simulations" in text
    assert f"The nearest approach was f = {result.closest.f:.3g} at x = (" in text and "--max-sim 2000" in text
    assert result.to_dict()["closest"]["f"] == result.closest.f


@pytest.mark.slow
@pytest.mark.parametrize(("dim", "max_sim"), [(100, 300), (30, 1000)])
def test_a_plane_in_many_dimensions_is_learned(dim, max_sim):
    reference = half_space(dim, 3.5)
    result = samplers.estimate(reference.problem, seed=0, max_sim=max_sim)
    assert (result.method.name, result.n_sim) == ("surrogate", max_sim)
    assert result.interval[0] < reference.p < result.interval[1] and result.cov < 0.6  # 300 base draws: 4


@pytest.mark.slow
def test_a_run_goes_on_from_its_journal_in_chunks_and_by_ask_and_tell(tmp_path, recorder):
    f = recorder(half_space(2, 3.0).problem.evaluate)
    problem = samplers.FunctionProblem(f, dim=2)
    first = samplers.estimate(problem, seed=4, max_sim=300, journal=tmp_path / "journal")
    assert (first.method.name, f.rows) == ("surrogate", 300)
    assert first.p == samplers.estimate(problem, "surrogate", seed=4, max_sim=300).p
    again = samplers.estimate(problem, seed=4, max_sim=300, journal=tmp_path / "journal", executor=InProcess())
    assert again == first and again.choice == first.choice != ""
    assert f.rows < 630  # the journal compares a few rows with f
    run = samplers.Auto().start(problem, seed=4, max_sim=300)
    while not run.done:
        run.tell(problem.evaluate(run.ask()))
    assert run.result() == first
    assert samplers.plan(first.pilot(), target_cov=first.cov / 2)[0].method == "surrogate"
