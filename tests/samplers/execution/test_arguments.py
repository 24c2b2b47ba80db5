import inspect
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest

import samplers
from samplers.execution.arguments import RunArguments, check_arguments, check_problem, choose_seed

PROBLEM = samplers.FunctionProblem(lambda x: x[:, 0], 2)


@pytest.mark.parametrize("door", [samplers.estimate, samplers.Method.start])
def test_the_defaults_of_the_front_doors_are_these(door):
    defaults = {name: each.default for name, each in inspect.signature(door).parameters.items()}
    assert {each.name: defaults[each.name] for each in fields(RunArguments)} == vars(RunArguments())


def test_goal_has_numbers_of_python():
    arguments = RunArguments(gamma=np.float32(0.5), max_sim=np.int16(900), target_cov=np.float32(0.25), confidence=0.9)
    goal = arguments.goal
    assert (goal.gamma, goal.max_sim, goal.target_cov, goal.confidence) == (0.5, 900, 0.25, 0.9)
    assert [type(value) for value in (goal.gamma, goal.max_sim, goal.target_cov)] == [float, int, float]


def test_goal_without_limits():
    goal = RunArguments().goal
    assert (goal.max_sim, goal.target_cov) == (None, None)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"gamma": np.nan}, "gamma to be a finite number, got nan"),
        ({"confidence": 1.0}, "confidence to be a number between 0 and 1, got 1.0"),
        ({"target_cov": 0}, "target_cov to be a number above 0, got 0"),
        ({"max_sim": 10**99}, "max_sim to be at most 1,000,000,000,000, got 1.00e"),
        ({"replicates": 4, "max_sim": 3}, "max_sim to be a whole number of at least 4, got 3"),
        ({"seed": -1}, "seed to be a whole number of at least 0, got -1"),
        ({"on_error": "fail"}, "Unknown on_error 'fail'. Did you mean 'failure'"),
    ],
)
def test_a_value_out_of_range_is_refused_where_it_is_given(options, expected):
    with pytest.raises(ValueError, match=expected):
        RunArguments(**options)


def test_a_seed_is_kept_or_drawn():
    assert choose_seed(np.int64(7)) == 7
    assert type(choose_seed(np.int64(7))) is int
    drawn = {choose_seed(None) for _ in range(8)}
    assert len(drawn) == 8  # equal by chance once in 1.5e8 times
    assert all(0 <= seed < 2**32 for seed in drawn)


def test_what_a_run_needs():
    check_arguments(SimpleNamespace(dim=2, base=samplers.StandardNormal(2)), samplers.MonteCarlo())
    for method, expected in [(samplers.MonteCarlo, "add brackets"), ("mc", "such as MonteCarlo"), (None, "got None")]:
        with pytest.raises(ValueError, match=expected):
            check_arguments(PROBLEM, method)


@pytest.mark.parametrize(
    ("problem", "expected"),
    [
        (
            SimpleNamespace(dim=2, base=samplers.StandardNormal(2)),
            "dim, base and evaluate, got SimpleNamespace without ev",
        ),
        (
            SimpleNamespace(dim=0, base=samplers.StandardNormal(2), evaluate=len),
            "dim to be a whole number of at least 1",
        ),
        (SimpleNamespace(dim=2, base=np.random, evaluate=len), "problem.base to have sample, log_prob, .* got module"),
    ],
    ids=["no f", "no dimension", "no distribution"],
)
def test_a_problem_that_is_none_is_named(problem, expected):
    with pytest.raises(ValueError, match=expected):
        check_problem(problem, ("dim", "base", "evaluate"))
