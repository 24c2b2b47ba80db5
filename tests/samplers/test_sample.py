"""Weights and stages of single simulations, and their table."""

import math

import numpy as np
import pytest

import samplers
from samplers.problem import FloatArray


def of_simulations(
    method: str, replicates: int, gamma: float, after: float = math.inf
) -> tuple[samplers.Estimate, FloatArray]:
    f: list[FloatArray] = []

    def evaluate(x: FloatArray) -> FloatArray:
        f.append(3.0 - np.abs(x[:, 0]))
        return f[-1]

    problem = samplers.FunctionProblem(evaluate, dim=4)
    result = samplers.estimate(
        problem, method, gamma, 1, 3000, replicates=replicates, stop=lambda seen: seen.n_sim >= after
    )
    return result, np.concatenate(f)


@pytest.mark.parametrize(
    ("replicates", "gamma", "after"), [(1, 0.0, math.inf), (2, 1.5, math.inf), (1, 0.0, 100), (1, 0.0, 1500)]
)
@pytest.mark.parametrize(
    "method", ["mc", "is", "ce", "ice", "two-stage", pytest.param("surrogate", marks=pytest.mark.slow)]
)
def test_weights_of_single_simulations_add_up_to_p(method: str, replicates: int, gamma: float, after: float) -> None:
    """A run that is stopped has the draws so far, of which cross-entropy keeps the first round and the last."""
    result, f = of_simulations(method, replicates, gamma, after)
    assert len(f) == result.n_sim
    rows = result.describe_simulations(0, len(f))
    known = ~np.isnan(rows.log_weight)
    assert known.any()
    assert np.exp(rows.log_weight[known & (f <= gamma)]).sum() == pytest.approx(result.p, rel=1e-12)
    if after < math.inf:
        return
    # the weights of all draws from a proposal have mean 1, and here a c.o.v. of 10 at most: see their spread
    weights = np.exp(rows.log_weight[known])
    assert abs(weights.sum() - 1) <= 5 * weights.std() * len(weights) ** 0.5 + 1e-9
    counts = [np.sum((rows.run == level.run) & (rows.stage >= 0)) for level in result.trace]
    assert sum(level.n_sim for level in result.trace) == len(f) and min(counts) > 0


def test_stages_are_levels_and_parts_of_the_index_agree_with_the_whole() -> None:
    result, f = of_simulations("ce", 2, 0.0)
    rows = result.describe_simulations(0, len(f))
    parts = [result.describe_simulations(first, min(700, len(f) - first)) for first in range(0, len(f), 700)]
    for name in ("run", "stage", "log_weight"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        assert np.array_equal(joined, getattr(rows, name), equal_nan=True)
    for run in (0, 1):
        levels = [level for level in result.trace if level.run == run]
        made = np.bincount(rows.stage[rows.run == run], minlength=len(levels))
        assert made.tolist() == [level.n_sim for level in levels]
        # a level's own count of points under its threshold is that of the simulations said to be its own
        under = [(f[(rows.run == run) & (rows.stage == k)] <= level.gamma).sum() for k, level in enumerate(levels)]
        assert under == [round(level.p * level.n_points) for level in levels]


@pytest.mark.parametrize("method", ["ss", "adss"])
def test_chains_give_no_weights_of_single_simulations(method: str) -> None:
    result, f = of_simulations(method, 1, 0.0)
    assert np.isnan(result.describe_simulations(0, len(f)).log_weight).all()


PROBLEM = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)


@pytest.mark.parametrize("method", ["adss", "ce", "mc", "two-stage"])
def test_every_simulated_point_is_there_with_its_outcome(method):
    result = samplers.estimate(PROBLEM, method, seed=0, max_sim=300, keep_points=True)
    x = result.to_pandas()[["x1", "x2"]].to_numpy()
    assert x.shape == (result.n_sim, 2)
    np.testing.assert_array_equal(PROBLEM.evaluate(x), result.points.f)


def test_simulations_without_an_outcome_are_null():
    def f(x):
        return np.where(x[:, 1] > 2.0, np.nan, 3.0 - x[:, 0])

    problem = samplers.FunctionProblem(f, dim=2)
    result = samplers.estimate(problem, "mc", seed=0, max_sim=3000, on_error="failure", keep_points=True)
    bound = samplers.estimate(problem, "mc", seed=0, max_sim=3000, on_error="bound")
    for table in (result.to_arrow(), bound.to_arrow()):
        lost = table.filter(table["f"].is_null())
        assert 0 < len(lost) == table["f"].null_count
        assert all(lost["failed"].to_pylist())


def test_columns_are_named_by_the_problem():
    named = samplers.FunctionProblem(PROBLEM.f, dim=2, column_names=["load", "f"])
    for keep in (False, True):
        result = samplers.estimate(named, "mc", seed=0, max_sim=6000, keep_points=keep)
        assert result.to_arrow().column_names[-2:] == ["load", "x.f"]
        assert result.to_arrow(["a", "b"]).column_names[-2:] == ["a", "b"]
    assert [each.name for each in result.sensitivity().columns] == ["load", "f"]
