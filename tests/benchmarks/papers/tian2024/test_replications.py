"""Replications: all simulations are counted, a line gives the run back, subsets hold what they should."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.papers.tian2024.replications import (
    CountedSimulations,
    ReplicationJob,
    ReplicationRun,
    driving_problem,
    run_replication,
)
from rare_envs.threads import use_one_thread
from tests.benchmarks.papers.tian2024.made_runs import made_run


@pytest.fixture(scope="module")
def subset_run() -> ReplicationRun:
    with use_one_thread():
        return run_replication(ReplicationJob("cut-in", "IDM", "SS", seed=3, points=True))


def test_all_simulations_are_counted(subset_run: ReplicationRun) -> None:
    assert subset_run.simulated == subset_run.n_sim == subset_run.final
    assert subset_run.trace[-1][0] == subset_run.n_sim
    assert 500 + 400 * (subset_run.levels - 1) <= subset_run.n_sim <= 500 * subset_run.levels


def test_subsets_hold_points_of_ever_smaller_gaps(subset_run: ReplicationRun) -> None:
    assert len(subset_run.level_means) == len(subset_run.level_points) == subset_run.levels
    assert {len(row) for level in subset_run.level_points for row in level} == {6}
    gaps = [means[3] for means in subset_run.level_means]
    assert gaps[-1] < 0.5 * gaps[0]
    shown = np.array(subset_run.level_points[0])
    assert shown[:, 5].min() >= 2.2
    assert shown[:, 5].max() <= 5.0


def test_the_search_of_importance_sampling_is_told_from_its_estimate() -> None:
    with use_one_thread():
        run = run_replication(ReplicationJob("car-following", "IDM", "IS", seed=0))
    assert run.simulated == run.n_sim > run.final >= 1000
    assert run.level_points == ()


def test_a_line_gives_the_run_back(subset_run: ReplicationRun) -> None:
    assert ReplicationRun.from_line(json.loads(json.dumps(subset_run.to_line()))) == subset_run


@pytest.mark.parametrize(
    "content", [{}, {"trace": 1}, {**made_run(ReplicationJob("a", "b", "c", 0)).to_line(), "x": 1}]
)
def test_a_line_of_something_else_is_no_run(content) -> None:
    with pytest.raises((KeyError, TypeError, ValueError)):
        ReplicationRun.from_line(content)


def test_the_counter_counts_rows_whatever_asks() -> None:
    problem = CountedSimulations(driving_problem("car-following", "IDM"))
    x = problem.base.sample(5, np.random.default_rng(0))
    assert problem.evaluate(x).shape == (5,)
    assert problem.simulated == 5
    assert problem.terms is not None
    assert problem.gradient is not None
    terms = problem.terms(x[:2])
    assert problem.simulated == 7
    cost = problem.gradient(x[:2], terms.least[:2], terms.ticks[[0, 1], terms.least[:2]]).cost
    assert problem.simulated == 7 + np.ceil(cost)


def test_noise_of_the_stack_is_part_of_x() -> None:
    assert [driving_problem("car-following", system).dim for system in ("IDM", "stack")] == [3, 178]
    assert [driving_problem("cut-in", system).dim for system in ("IDM", "stack")] == [6, 281]
