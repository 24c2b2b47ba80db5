"""Scenarios of the benchmark, and the counts behind their probabilities."""

import json

import numpy as np
import pytest

from benchmarks.estimators.truth import TRUTH_RESULT
from rare_envs.study.sampler_benchmark.problems import ALL_PROBLEMS, COUNTED_COLLISIONS, make_driving_state


def test_the_counts_agree_with_longer_ones() -> None:
    """Those of the benchmark are fixed with its version; the committed result has 15 times as many draws, others."""
    longer = {(row["env_id"], row["base"]): row for row in json.loads(TRUTH_RESULT.read_text())["results"]}
    assert {(each.env_id, each.base) for each in COUNTED_COLLISIONS.values()} == set(longer)
    for each in COUNTED_COLLISIONS.values():
        row, p = longer[each.env_id, each.base], each.collisions / each.rollouts
        error = np.hypot(row["standard_error"], np.sqrt(p / each.rollouts))
        assert abs(p - row["p"]) < 4 * error


@pytest.mark.parametrize("name", COUNTED_COLLISIONS)
def test_collisions_of_new_draws_fit_the_probability(name) -> None:
    state = make_driving_state(COUNTED_COLLISIONS[name])
    n = 20_000
    hits = int((state.f(np.random.default_rng(11).standard_normal((n, state.dim))) <= 0).sum())
    assert hits == pytest.approx(n * state.p, abs=4 * np.sqrt(n * state.p) + 1)
    assert name.endswith(f"_d{state.dim}")
    assert ALL_PROBLEMS[name].group == "driving"
