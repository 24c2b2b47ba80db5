"""The choice of a method."""

import numpy as np
import pytest

import samplers
from samplers.limit_states import half_space
from samplers.method import Goal


def choice(dim=2, seconds=None, **goal):
    inputs = half_space(dim, 3.0).problem
    return samplers.Auto(seconds_per_simulation=seconds).choose(inputs, Goal(gamma=0.0, **goal))[0].name


@pytest.mark.parametrize(
    ("expected", "arguments"),
    [
        ("two-stage", {}),
        ("two-stage", {"max_sim": 6000}),
        ("two-stage", {"max_sim": 99}),
        ("two-stage", {"max_sim": 1001}),
        ("two-stage", {"max_sim": 300, "dim": 7}),
        ("two-stage", {"seconds": 5.0, "dim": 7}),
        ("two-stage", {"seconds": 5.0, "target_cov": 0.1}),
        ("two-stage", {"seconds": 0.9}),
        ("surrogate", {"max_sim": 100}),
        ("surrogate", {"max_sim": 1000, "dim": 6}),
        ("surrogate", {"seconds": 1.0}),
    ],
)
def test_rule(expected, arguments):
    assert choice(**arguments) == expected


def test_noise_does_not_count_as_dimensions():
    class Base(samplers.StandardNormal):
        noise = np.arange(102) >= 2

    class Noisy:
        dim, base = 102, Base(102)

    method, why = samplers.Auto().choose(Noisy(), Goal(gamma=0.0, max_sim=300))
    assert (method.name, why) == ("surrogate", "surrogate: 300 simulations for 2 dimensions")


@pytest.mark.parametrize(("max_sim", "name"), [(150, "surrogate"), (2000, "two-stage")])
def test_the_result_is_that_of_the_method_chosen(max_sim, name):
    problem = half_space(2, 3.0).problem
    result = samplers.estimate(problem, "auto", seed=4, max_sim=max_sim)
    assert result == samplers.estimate(problem, name, seed=4, max_sim=max_sim)
    assert result.method.name == name
    assert result.choice.startswith(f"{name}: {max_sim:,} simulations")
    assert f"chosen {result.choice}" in str(result)
    assert result.to_dict()["choice"] == result.choice
    assert samplers.estimate(problem, name, seed=4, max_sim=max_sim).choice == ""


def test_replicates_share_the_budget_before_the_choice():
    result = samplers.estimate(half_space(2, 3.0).problem, "auto", seed=4, max_sim=3000, replicates=3)
    assert result.method.name == "surrogate"


def test_steps_are_those_of_the_method_chosen():
    """For callers that drive a method by themselves."""
    problem = half_space(2, 3.0).problem
    goal = Goal(gamma=0.0, max_sim=100)
    first = [next(m.steps(problem, goal, np.random.default_rng(1))) for m in (samplers.Auto(), samplers.Surrogate())]
    np.testing.assert_array_equal(*first)


def test_settings_are_checked():
    with pytest.raises(ValueError, match="seconds_per_simulation"):
        samplers.Auto(seconds_per_simulation=-1.0)
