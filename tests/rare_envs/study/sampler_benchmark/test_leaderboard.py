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
        *(
            "## All problems of a set together",
            "### Set analytic",
            "## adss",
            "### 500 simulations",
            "### 1,000 simulations",
        ),
        *("## mc", "### 500 simulations", "### 1,000 simulations", "## Problems"),
    ]
    assert "no method can know of its main region" in page
    tables = [line for line in page.splitlines() if line.startswith("| common_d4")]
    assert len(tables) == 5
    assert len({line.count("|") for line in tables[:4]}) == 1


def test_all_problems_of_a_set_together_by_hand() -> None:
    """Of 4 + 6 runs 3 and 6 hold p, one is below, none above; 9 of 10 is 55 to 100 %."""
    plan = BenchmarkPlan(("mc",), ("common_d4", "lin_d2"), (500,), runs=2)
    result = summarise_study(plan, [run_once(job) for job in plan.jobs()])
    first, second = result["cells"]
    first.update(runs=4, coverage=0.75, below=0.25, raised=0, warned=0.5, faults=["biased"])
    second.update(runs=6, coverage=1.0, below=0.0, raised=0, warned=None, faults=[])
    assert "| mc | 500 | 1 of 2 | 90 (55 to 100) | 10 | 0 | 0 | 20 |" in format_leaderboard(result).splitlines()
    first.update(coverage=0.25, below=0.0, raised=3, faults=["raised"])
    assert "| mc | 500 | 1 of 2 | 70 (35 to 93) | 0 | 0 | 30 | 5 |" in format_leaderboard(result).splitlines()


def test_rates_of_warnings_are_those_of_a_budget() -> None:
    """With few simulations nearly every run has a warning, which says nothing of those with many."""
    plan = BenchmarkPlan(("mc",), ("common_d4",), (20, 3000), runs=4)
    result = summarise_study(plan, [run_once(job) for job in plan.jobs()])
    few, many = result["warnings"]["mc"]["20"], result["warnings"]["mc"]["3000"]
    assert few["right_warned"] == few["right"] > 0
    assert many["right_warned"] < many["right"]
    lines = format_leaderboard(result).splitlines()
    shown = lines[lines.index("### 20 simulations") + 2]
    assert f"of runs within 2 {few['right']} of {few['right']} (100 %; " in shown


def test_bars_in_what_a_method_raised_do_not_break_the_table() -> None:
    plan = BenchmarkPlan(("tests.samplers.benchmark.wrong_samplers:leaving",), ("common_d4",), (100,), runs=2)
    page = format_leaderboard(summarise_study(plan, [run_once(job) for job in plan.jobs()]))
    (row,) = [line for line in page.splitlines() if "SystemExit" in line]
    assert "(SystemExit: enough / of this)" in row
    head = next(line for line in page.splitlines() if line.startswith("| problem | p | mean"))
    assert row.count("|") == head.count("|")
    assert "| c.o.v. |" in head


def test_only_the_worst_problems_are_shown_where_that_is_asked_for() -> None:
    plan = BenchmarkPlan(("mc",), ("common_d4", "lin_d2", "never_d4"), (500,), runs=2)
    page = format_leaderboard(summarise_study(plan, [run_once(job) for job in plan.jobs()]), most=1)
    table = page[page.index("### 500") : page.index("## Problems")]
    assert sum(line.startswith(("| common", "| lin", "| never")) for line in table.splitlines()) == 1
    assert "The worst 1 of 3 problems." in table
