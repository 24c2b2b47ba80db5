"""The leaderboard is what its committed result gives, and the result is what the command gives."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.estimators import sampler_leaderboard
from benchmarks.estimators.sampler_leaderboard import (
    LEADERBOARD_PAGE,
    PLANNED,
    PlannedRuns,
    condense_results,
    format_leaderboard_page,
    leave_out,
    read_leaderboard,
    renew_rows,
)
from rare_envs.study.sampler_benchmark.leaderboard import list_parts
from rare_envs.study.sampler_benchmark.study import BenchmarkPlan, choose_problems, run_study
from rare_envs.threads import use_one_thread


@pytest.fixture(scope="module")
def committed():
    return read_leaderboard()


def test_the_page_is_what_the_result_gives() -> None:
    said = "run python -m benchmarks.estimators.sampler_leaderboard"
    assert LEADERBOARD_PAGE.read_text(encoding="utf-8") == format_leaderboard_page(), said


def test_every_method_has_every_problem_of_the_sets(committed) -> None:
    assert {planned.budget for planned in PLANNED} == {300, 1500, 6000}
    wanted = {
        (method, problem, planned.budget): planned.runs
        for planned in PLANNED
        for problem in choose_problems(planned.groups)
        for method in planned.methods
    }
    found = {(cell["method"], cell["problem"], cell["max_sim"]): cell["runs"] for cell in committed["cells"]}
    assert found == wanted
    assert len(found) == len(committed["cells"])
    said = {
        (method, problem, budget): part["plan"]["runs"]
        for part in list_parts(committed)
        for method in part["plan"]["methods"]
        for problem in part["plan"]["problems"]
        for budget in part["plan"]["budgets"]
    }
    assert said == wanted


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
    seed = list_parts(committed)[0]["plan"]["seed"]
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


def test_benchmarks_are_put_together_and_say_what_made_each(tmp_path: Path) -> None:
    first, second = (
        run_study(BenchmarkPlan(("mc",), (problem,), (budget,), 2), tmp_path)
        for problem, budget in (("never_d4", 100), ("common_d4", 200))
    )
    second["about"]["code"] = "0"  # rows of other code stand beside them, and say so
    both = condense_results([first, second])
    assert [part["plan"]["budgets"] for part in list_parts(both)] == [[100], [200]]
    assert [part["code"] for part in list_parts(both)] == [first["about"]["code"], "0"]
    assert list(both["problems"]) == ["common_d4", "never_d4"]
    assert len(both["cells"]) == 2
    assert both["warnings"]["mc"]["200"]["right"] == second["warnings"]["mc"]["200"]["right"]
    with pytest.raises(ValueError, match="other methods, problems or budgets"):
        condense_results([first, first])


def test_rows_of_a_method_are_made_anew_and_the_others_stay(tmp_path: Path, monkeypatch) -> None:
    """The runs that are there are not made again, and what was wrong in a row is put right."""
    for name in ("LEADERBOARD_RESULT", "LEADERBOARD_PAGE"):
        monkeypatch.setattr(sampler_leaderboard, name, tmp_path / name)
    monkeypatch.setattr(sampler_leaderboard, "READING", "print('one row')\n")
    monkeypatch.setattr(sampler_leaderboard, "PLANNED", (PlannedRuns(300, ("mc", "ss"), 2, ("highdim",)),))
    renew_rows(tmp_path / "runs")
    made = read_leaderboard()
    place = made["columns"].index("n_sim")
    result = json.loads(sampler_leaderboard.LEADERBOARD_RESULT.read_text())
    for row in result["cells"]:
        row[place] += row[0] == "mc"
    sampler_leaderboard.LEADERBOARD_RESULT.write_text(json.dumps(result))
    runs = (tmp_path / "runs" / "300_mc" / "runs.jsonl").read_text()
    renew_rows(tmp_path / "runs", ["mc"])
    assert (tmp_path / "runs" / "300_mc" / "runs.jsonl").read_text() == runs
    again = read_leaderboard()
    assert [part["plan"]["methods"] for part in again["parts"]] == [["ss"], ["mc"]]
    key = lambda cell: (cell["method"], cell["problem"])  # noqa: E731
    assert sorted(again["cells"], key=key) == sorted(made["cells"], key=key)
    with pytest.raises(ValueError, match="Unknown method 'nothing' of the leaderboard"):
        renew_rows(tmp_path / "runs", ["nothing"])
    assert {cell["method"] for cell in leave_out(again, ["mc"])["cells"]} == {"ss"}
    assert leave_out(again, budgets=[1500]) == again | {"parts": leave_out(again, budgets=[1500])["parts"]}
    assert leave_out(again, budgets=[300])["cells"] == [] == leave_out(again, budgets=[300])["parts"]
    with pytest.raises(ValueError, match=r"Expected budgets of 300, got \[7\]"):
        renew_rows(tmp_path / "runs", ["mc"], [7])
