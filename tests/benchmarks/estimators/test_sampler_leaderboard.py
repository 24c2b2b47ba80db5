"""The leaderboard is what its committed result gives, and the result is what the command gives."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.estimators.sampler_leaderboard import (
    LEADERBOARD_PAGE,
    condense_result,
    format_leaderboard_page,
    read_leaderboard,
)
from rare_envs.study.sampler_benchmark.study import BenchmarkPlan, choose_problems, run_study
from rare_envs.threads import use_one_thread


@pytest.fixture(scope="module")
def committed():
    return read_leaderboard()


def test_the_page_is_what_the_result_gives() -> None:
    said = "run python -m benchmarks.estimators.sampler_leaderboard"
    assert LEADERBOARD_PAGE.read_text(encoding="utf-8") == format_leaderboard_page(), said


def test_every_method_has_every_problem_of_the_sets(committed) -> None:
    plan = committed["about"]["plan"]
    assert tuple(plan["problems"]) == choose_problems(["analytic", "highdim", "driving"])
    cells = {(cell["method"], cell["problem"], cell["max_sim"]) for cell in committed["cells"]}
    assert len(cells) == len(committed["cells"]) == 41 * len(plan["methods"]) * len(plan["budgets"])
    assert {cell["runs"] for cell in committed["cells"]} == {plan["runs"]}
    assert {"openturns-ss", "openturns-ce", "openturns-form", "uqpy-ss", "auto", "mc"} <= set(plan["methods"])


@pytest.mark.parametrize(("method", "problem"), [("mc", "common_d4"), ("adss", "lin_d2"), ("ce", "cut_in_d6")])
def test_a_cheap_cell_made_again_is_the_committed_one(committed, tmp_path: Path, method: str, problem: str) -> None:
    plan = committed["about"]["plan"]
    with use_one_thread():
        result = run_study(BenchmarkPlan((method,), (problem,), (1500,), plan["runs"], plan["seed"]), tmp_path)
    (cell,) = condense_result(result)["cells"]
    again = dict(zip(condense_result(result)["columns"], cell, strict=True))
    (shown,) = [
        each
        for each in committed["cells"]
        if (each["method"], each["problem"], each["max_sim"]) == (method, problem, 1500)
    ]
    for name in ("mean_over_p", "cov", "own_cov", "gain", "n_sim"):
        assert again[name] == pytest.approx(shown[name], rel=1e-3), name
    assert (again["coverage"], again["faults"]) == (shown["coverage"], shown["faults"])


def test_what_is_committed_has_no_single_runs_and_few_digits(tmp_path: Path) -> None:
    result = condense_result(run_study(BenchmarkPlan(("mc",), ("lin_d2",), (100,), 2), tmp_path))
    assert "runs" not in result
    (row,) = result["cells"]
    assert row[result["columns"].index("p")] == 0.00023263
    assert json.loads(json.dumps(result, allow_nan=False)) == result
