"""The leaderboard is what its committed result gives, and the result is what the command gives."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.estimators.sampler_leaderboard import (
    LEADERBOARD_PAGE,
    condense_results,
    format_leaderboard_page,
    read_leaderboard,
)
from rare_envs.study.sampler_benchmark.leaderboard import list_plans
from rare_envs.study.sampler_benchmark.study import BenchmarkPlan, choose_problems, run_study
from rare_envs.threads import use_one_thread


@pytest.fixture(scope="module")
def committed():
    return read_leaderboard()


def test_the_page_is_what_the_result_gives() -> None:
    said = "run python -m benchmarks.estimators.sampler_leaderboard"
    assert LEADERBOARD_PAGE.read_text(encoding="utf-8") == format_leaderboard_page(), said


def test_every_method_has_every_problem_of_the_sets(committed) -> None:
    plans = list_plans(committed)
    (main,) = (plan for plan in plans if plan["budgets"] == [1500] and len(plan["problems"]) >= 67)
    assert set(choose_problems(["analytic", "public", "highdim", "driving"])) <= set(main["problems"])
    assert {"openturns-ss", "openturns-ce", "openturns-form", "uqpy-ss", "auto", "mc"} <= set(main["methods"])
    wanted = {
        (method, problem, budget): plan["runs"]
        for plan in plans
        for method in plan["methods"]
        for problem in plan["problems"]
        for budget in plan["budgets"]
    }
    found = {(cell["method"], cell["problem"], cell["max_sim"]): cell["runs"] for cell in committed["cells"]}
    assert found == wanted
    assert len(found) == len(committed["cells"])
    for group in ("analytic", "public"):
        assert {budget for _, name, budget in found if name in choose_problems([group])} == {300, 1500, 6000}


@pytest.mark.parametrize(
    ("method", "problem", "budget"),
    [
        ("mc", "common_d4", 6000),
        ("ss", "rp111_d2", 1500),
        ("adss", "lin_d2", 1500),
        ("ce", "cut_in_d6", 1500),
        ("ss", "cut_in_us101_d6", 300),
    ],
)
def test_a_cheap_cell_made_again_is_the_committed_one(
    committed, tmp_path: Path, method: str, problem: str, budget: int
) -> None:
    (shown,) = [
        each
        for each in committed["cells"]
        if (each["method"], each["problem"], each["max_sim"]) == (method, problem, budget)
    ]
    seed = list_plans(committed)[0]["seed"]
    with use_one_thread():
        result = run_study(BenchmarkPlan((method,), (problem,), (budget,), shown["runs"], seed), tmp_path)
    again = condense_results([result])
    again = dict(zip(again["columns"], again["cells"][0], strict=True))
    for name in ("mean_over_p", "cov", "own_cov", "gain", "n_sim"):
        assert again[name] == pytest.approx(shown[name], rel=1e-3), name
    assert (again["coverage"], again["faults"]) == (shown["coverage"], shown["faults"])


def test_what_is_committed_has_no_single_runs_and_few_digits(tmp_path: Path) -> None:
    result = condense_results([run_study(BenchmarkPlan(("mc",), ("lin_d2",), (100,), 2), tmp_path)])
    assert "runs" not in result
    (row,) = result["cells"]
    assert row[result["columns"].index("p")] == 0.00023263
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_benchmarks_of_one_code_are_put_together_and_others_refused(tmp_path: Path) -> None:
    first, second = (
        run_study(BenchmarkPlan(("mc",), (problem,), (budget,), 2), tmp_path)
        for problem, budget in (("never_d4", 100), ("common_d4", 200))
    )
    both = condense_results([first, second])
    assert [plan["budgets"] for plan in list_plans(both)] == [[100], [200]]
    assert list(both["problems"]) == ["common_d4", "never_d4"]
    assert len(both["cells"]) == 2
    assert both["warnings"]["mc"]["right"] == first["warnings"]["mc"]["right"] + second["warnings"]["mc"]["right"]
    with pytest.raises(ValueError, match="other methods, problems or budgets"):
        condense_results([first, first])
    with pytest.raises(ValueError, match="one code and machine"):
        condense_results([first, {**second, "about": {**second["about"], "code": "0"}}])
