import numpy as np
import pytest

import samplers
from samplers.problem import FloatArray


def of_simulations(method: str, replicates: int, gamma: float) -> tuple[samplers.Estimate, FloatArray]:
    f: list[FloatArray] = []

    def evaluate(x: FloatArray) -> FloatArray:
        f.append(3.0 - np.abs(x[:, 0]))
        return f[-1]

    problem = samplers.FunctionProblem(evaluate, dim=4)
    result = samplers.estimate(problem, method, gamma=gamma, seed=1, max_sim=3000, replicates=replicates)
    return result, np.concatenate(f)


@pytest.mark.parametrize("gamma", [0.0, 1.5])
@pytest.mark.parametrize("replicates", [1, 2])
@pytest.mark.parametrize(
    "method", ["mc", "is", "ce", "ice", "two-stage", pytest.param("surrogate", marks=pytest.mark.slow)]
)
def test_weights_of_single_simulations_add_up_to_p(method: str, replicates: int, gamma: float) -> None:
    result, f = of_simulations(method, replicates, gamma)
    index = result.simulations
    assert index is not None and index.n == len(f) == result.n_sim
    rows = index.describe(0, index.n)
    known = ~np.isnan(rows.log_weight)
    assert np.exp(rows.log_weight[known & (f <= gamma)]).sum() == pytest.approx(result.p, rel=1e-12)
    # the weights of all draws from a proposal have mean 1, and here a c.o.v. of 10 at most: see their spread
    weights = np.exp(rows.log_weight[known])
    assert abs(weights.sum() - 1) <= 5 * weights.std() * len(weights) ** 0.5 + 1e-9
    counts = [np.sum((rows.run == level.run) & (rows.stage >= 0)) for level in result.trace]
    assert sum(level.n_sim for level in result.trace) == index.n and min(counts) > 0


@pytest.mark.parametrize("after", [100, 700, 1500])
@pytest.mark.parametrize("method", ["is", "ce", "ice", "two-stage", pytest.param("surrogate", marks=pytest.mark.slow)])
def test_weights_of_a_run_that_is_stopped_add_up_to_p(method: str, after: int) -> None:
    """p is that of the draws of the search then, of which cross-entropy keeps the first round and the last."""
    problem = samplers.FunctionProblem(lambda x: 3.0 - np.abs(x[:, 0]), dim=4)
    result = samplers.estimate(
        problem, method, seed=1, max_sim=3000, keep_points=True, stop=lambda seen: seen.n_sim >= after
    )
    assert result.simulations is not None and result.points is not None
    rows = result.simulations.describe(0, len(result.points.f))
    known = ~np.isnan(rows.log_weight)
    assert known.any()
    assert np.exp(rows.log_weight[known & (result.points.f <= 0)]).sum() == pytest.approx(result.p, rel=1e-12)


def test_stages_are_levels_and_parts_of_the_index_agree_with_the_whole() -> None:
    result, f = of_simulations("ce", 2, 0.0)
    assert result.simulations is not None
    rows = result.simulations.describe(0, len(f))
    parts = [result.simulations.describe(first, min(700, len(f) - first)) for first in range(0, len(f), 700)]
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
    assert result.simulations is not None
    assert np.isnan(result.simulations.describe(0, len(f)).log_weight).all()


def test_gradients_cost_simulations_that_have_no_row() -> None:
    calls: list[int] = []

    def terms(x: FloatArray) -> FloatArray:
        calls.append(len(x))
        return np.stack([4.5 - x.sum(axis=1) / 40**0.5, 6.0 - x[:, 0]], axis=1)

    def gradient(x: FloatArray, term: np.ndarray) -> FloatArray:
        slope = np.zeros_like(x)
        slope[term == 0], slope[term == 1, 0] = -1 / 40**0.5, -1.0
        return slope

    problem = samplers.FunctionProblem(dim=40, terms=terms, gradient=gradient)
    result = samplers.estimate(problem, "two-stage", seed=0, max_sim=4000)
    index = result.simulations
    assert index is not None and index.n == sum(calls) < result.n_sim
    rows = index.describe(0, index.n)
    assert sum(cost for _, _, cost in index.spans) == result.n_sim
    assert (rows.stage >= 0).all() and (np.diff(rows.stage) >= 0).all() and rows.stage[-1] == len(result.trace) - 1
