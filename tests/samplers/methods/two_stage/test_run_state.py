"""What is fixed for a run: its budget, its end and its target."""

import math

import numpy as np
import pytest

from samplers.method import Goal
from samplers.methods.two_stage.run_state import start_run
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS
from samplers.problem import FunctionProblem

PROBLEM = FunctionProblem(lambda u: 3.0 - u[:, 0], 3)


def start(budget=2000, **goal):
    return start_run(PROBLEM, Goal(gamma=0.0, **goal), budget, DEFAULT_SETTINGS, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("goal", "end"),
    [({"max_sim": 2000}, 2000), ({"max_sim": 2000, "target_cov": 0.1}, 2000), ({"target_cov": 0.1}, 2000 + 100 * 200)],
)
def test_only_a_target_alone_goes_beyond_the_budget(goal, end):
    """By at most 100 batches of a tenth of the budget."""
    context, state = start(**goal)
    assert (context.left, context.left_at_all, context.target_batch) == (2000, end, 200)
    assert (state.history.n, len(state.base_f), state.base_draws, state.trace) == (0, 0, 0, ())


def test_a_batch_of_a_small_budget_has_a_least_size():
    assert start(budget=300)[0].target_batch == DEFAULT_SETTINGS.min_target_batch == 100


def test_a_target_is_met_from_its_value_on():
    context, _ = start(target_cov=0.1)
    assert [context.meets_target(cov) for cov in (0.1, math.nextafter(0.1, 1.0), math.inf)] == [True, False, False]
    assert not start(max_sim=2000)[0].meets_target(0.0)
