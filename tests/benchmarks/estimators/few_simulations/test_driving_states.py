import json

import numpy as np

import rare_envs
from benchmarks.estimators.few_simulations.driving_states import TRUTH, make


def test_states_are_the_scenarios_in_standard_normal_space():
    states = make()
    rows = json.loads(TRUTH.read_text())["results"]
    assert [p for _, _, p in states.values()] == [row["p"] for row in rows]
    f, dim, _ = states["CutIn us101-15-offsets"]
    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego="idm", base="us101-15-offsets")
    u = np.random.default_rng(0).standard_normal((20, dim))
    np.testing.assert_array_equal(f(u), problem.evaluate(problem.base.from_standard_normal(u)))
