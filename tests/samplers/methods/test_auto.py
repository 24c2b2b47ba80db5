"""The default: which method it takes, and that nothing else changes."""

import numpy as np
import pytest

import samplers
from samplers.limit_states import half_space
from samplers.method import Goal, TermsOffer
from samplers.replicate import InputsOnly


def choice(dim=2, seconds=None, **goal):
    inputs = half_space(dim, 3.0).problem
    return samplers.Auto(seconds_per_simulation=seconds).choose(inputs, Goal(gamma=0.0, **goal)).method.name


@pytest.mark.parametrize(
    ("expected", "arguments"),
    [
        ("two-stage", {}),
        ("two-stage", {"max_sim": 300, "dim": 7}),
        ("two-stage", {"seconds": 5.0, "dim": 7}),
        ("surrogate", {"max_sim": 300}),
        ("surrogate", {"max_sim": 500, "dim": 6}),
        ("two-stage", {"seconds": 1.0}),
        ("two-stage", {"max_sim": 501}),
    ],
)
def test_rule(expected, arguments):
    assert choice(**arguments) == expected


def test_noise_does_not_count_as_dimensions_and_terms_are_searched():
    """Two coordinates are searched and 100 are noise: with terms and 1,000 simulations `series` takes them."""

    class Base(samplers.StandardNormal):
        noise = np.arange(102) >= 2

    for offer, max_sim, name, why in (
        (None, 300, "surrogate", "surrogate: 300 simulations for 2 dimensions"),
        (None, 1000, "two-stage", "two-stage: 1,000"),
        (TermsOffer(gradient_cost=5.0), 1000, "series", "series: 1,000"),
    ):
        choice = samplers.Auto().choose(InputsOnly(102, Base(102), offer), Goal(gamma=0.0, max_sim=max_sim))
        assert choice.method.name == name and choice.why.startswith(why)


@pytest.mark.parametrize(
    ("max_sim", "name"), [pytest.param(300, "surrogate", marks=pytest.mark.slow), (2000, "two-stage")]
)
def test_the_result_is_that_of_the_method_chosen(max_sim, name):
    problem = half_space(2, 3.0).problem
    result = samplers.estimate(problem, "auto", seed=4, max_sim=max_sim)
    assert result == samplers.estimate(problem, name, seed=4, max_sim=max_sim)
    assert result.method.name == name
    assert result.choice.startswith(f"{name}: {max_sim:,} simulations")
    assert (f"chosen {result.choice}" in str(result)) == (name == "surrogate")  # the usual one is not announced
    assert result.to_dict()["choice"] == result.choice
    assert samplers.estimate(problem, name, seed=4, max_sim=max_sim).choice == ""


@pytest.mark.slow
def test_a_run_goes_on_from_its_journal_in_chunks_and_by_ask_and_tell(tmp_path, recorder):
    f = recorder(half_space(2, 3.0).problem.evaluate)
    problem = samplers.FunctionProblem(f, dim=2)
    first = samplers.estimate(problem, seed=4, max_sim=300, journal=tmp_path / "journal")
    assert (first.method.name, f.rows) == ("surrogate", 300)
    again = samplers.estimate(problem, seed=4, max_sim=300, journal=tmp_path / "journal", executor=samplers.InProcess())
    assert again == first and again.choice == first.choice != ""
    assert f.rows < 330  # the journal compares a few rows with f
    run = samplers.Auto().start(problem, seed=4, max_sim=300)
    while not run.done:
        run.tell(problem.evaluate(run.ask()))
    assert run.result() == first
    assert samplers.plan_runs(first.pilot(), target_cov=first.cov / 2)[0].method == "surrogate"
