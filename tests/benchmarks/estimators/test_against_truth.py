"""Rows of the comparison with the truth: those of some methods are made anew, the others stay."""

import json

import numpy as np
import pytest

import samplers
from benchmarks.estimators import against_truth
from benchmarks.estimators.against_truth import TruthComparison, main, side_by_side


@pytest.fixture
def compared(monkeypatch):
    """Replace the runs of a comparison by a count of them."""
    calls = []

    def compare(row, method, seeds):
        calls.append((row["env_id"], row["base"], method, len(seeds)))
        figures = {"mean": row["p"], "z": 0.0, "coverage": 1.0, "cov": 0.1, "own_cov": 0.1, "n_sim": 100.0}
        names = {"env_id": row["env_id"], "base": row["base"], "method": method}
        return TruthComparison(**names, seeds=len(seeds), truth=row["p"], **figures, gain=7.0, warned=0.0)

    monkeypatch.setattr(against_truth, "compare_with_truth", compare)
    return calls


def read_cells(path):
    return json.loads(path.read_text())["cells"]


def test_one_method_leaves_the_rows_of_the_others(compared, tmp_path):
    out = tmp_path / "cells.json"
    main(seeds=2, method="mc,adss", out=out)
    before = read_cells(out)
    changed = [cell | {"gain": 1.0} for cell in before]
    out.write_text(json.dumps({"cells": changed}))
    compared.clear()
    main(seeds=3, method="adss", out=out)
    assert {method for _, _, method, _ in compared} == {"adss"}
    assert {cell["gain"] for cell in read_cells(out) if cell["method"] == "mc"} == {1.0}
    assert {(cell["gain"], cell["seeds"]) for cell in read_cells(out) if cell["method"] == "adss"} == {(7.0, 3)}
    assert [cell["method"] for cell in read_cells(out)] == [cell["method"] for cell in before]


def test_one_environment_is_compared_alone(compared, tmp_path):
    main(seeds=2, env="CutIn", method="mc", out=tmp_path / "cells.json")
    assert {env_id for env_id, _, _, _ in compared} == {"rare_envs/CutIn-v0"}


def test_runs_side_by_side_are_those_of_estimate():
    problem = samplers.FunctionProblem(lambda u: 2.0 - u[:, 0], dim=2)
    method = samplers.AdaptiveSubsetSimulation(n=300)
    seeds = range(2)
    together = side_by_side(
        problem, [samplers.Run(problem, method, samplers.RunArguments(seed=seed)) for seed in seeds]
    )
    alone = [samplers.estimate(problem, method, seed=seed) for seed in seeds]
    np.testing.assert_array_equal([run.p for run in together], [run.p for run in alone])
