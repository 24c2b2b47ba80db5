"""Order and words of the page."""

from rare_envs.study.sampler_benchmark.leaderboard import format_leaderboard, sort_worst_first
from rare_envs.study.sampler_benchmark.study import BenchmarkPlan, summarise_study
from samplers.benchmark import run_once


def test_problems_with_faults_come_first_then_the_least_covered_then_the_least_gain() -> None:
    def cell(name, faults, coverage, gain):
        return {"problem": name, "faults": faults, "coverage": coverage, "gain": gain}

    cells = [
        cell("good", [], 0.95, 100.0),
        cell("poor", [], 0.95, 3.0),
        cell("none", [], 0.95, None),
        cell("low", [], 0.9, 1000.0),
        cell("wrong", ["biased"], 0.95, 1000.0),
    ]
    assert [each["problem"] for each in sort_worst_first(cells)] == ["wrong", "low", "poor", "good", "none"]


def test_the_page_has_a_table_for_each_method_and_budget_and_says_how_each_p_is_known() -> None:
    plan = BenchmarkPlan(("mc", "adss"), ("common_d4", "decep_box_d3"), (500, 1000), runs=3)
    page = format_leaderboard(summarise_study(plan, [run_once(job) for job in plan.jobs()]))
    assert [line for line in page.splitlines() if line.startswith("##")] == [
        *("## adss", "### 500 simulations", "### 1,000 simulations"),
        *("## mc", "### 500 simulations", "### 1,000 simulations", "## Problems"),
    ]
    assert "no method can know of its main region" in page
    tables = [line for line in page.splitlines() if line.startswith("| common_d4")]
    assert len(tables) == 5
    assert len({line.count("|") for line in tables[:4]}) == 1
