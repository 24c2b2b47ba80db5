"""Tables II and III from runs made by hand."""

from __future__ import annotations

import pytest

from benchmarks.papers.tian2024.replications import ReplicationJob
from benchmarks.papers.tian2024.tables import make_method_tables
from tests.benchmarks.papers.tian2024.made_runs import made_run


def tables_of(*methods: str, scenarios=("car-following", "cut-in")):
    jobs = [
        ReplicationJob(scenario, system, method, seed)
        for scenario in scenarios
        for system in ("IDM", "stack")
        for method in methods
        for seed in (0, 1)
    ]
    return make_method_tables([made_run(job) for job in jobs])


def find(table, method: str, system: str, quantity: str):
    (found,) = [
        value
        for value in table.values
        if value.labels[0] == method and value.labels[1].startswith(system) and value.quantity.startswith(quantity)
    ]
    return found


def test_paper_ours_and_difference_of_table_2() -> None:
    table2, table3 = tables_of("MC", "SS")
    assert (table2.name, table3.name) == ("table2", "table3")
    p = find(table2, "SS", "IDM", "mean of p")
    assert (p.paper, p.ours) == (8.03e-4, pytest.approx(2e-4))
    assert p.difference == pytest.approx(2 / 8.03 - 1)
    squared = find(table2, "SS", "IDM", "square of the c.o.v.")
    assert (squared.paper, squared.ours) == (0.152, pytest.approx(0.125))
    assert find(table2, "SS", "IDM", "c.o.v.").paper == pytest.approx(0.152**0.5)
    assert find(table2, "SS", "stack", "simulations").paper == 4980
    assert find(table2, "SS", "stack", "simulations").ours == 1800
    assert find(table3, "SS", "stack", "mean of p").paper == 2.49e-4
    assert "text" in find(table3, "SS", "stack", "mean of p").reasons


def test_the_paper_counts_no_search_and_we_count_all() -> None:
    table2, _ = tables_of("MC", "IS")
    assert find(table2, "IS", "IDM", "simulations").ours == 1500
    assert find(table2, "IS", "IDM", "simulations").ours_all_in == 3000


def test_the_released_code_is_said_in_words() -> None:
    table2, _ = tables_of("MC", "SS", "ADSS", "IS")
    assert "does not run as released" in find(table2, "IS", "IDM", "mean of p").released
    assert find(table2, "SS", "IDM", "simulations").released == "N in every level: 2,000 for the same levels"
    assert find(table2, "ADSS", "IDM", "simulations").released.endswith(
        "once more at the end: 2,500 for the same levels"
    )
    assert "114,784" in find(table2, "Monte Carlo", "IDM", "simulations").released


def test_every_difference_has_its_reason() -> None:
    for table in tables_of("MC", "IS", "SS", "ADSS"):
        for value in table.values:
            assert value.reasons
            assert set(value.reasons) <= set(table.explanations)


def test_further_methods_stand_below_without_a_paper() -> None:
    table2, _ = tables_of("MC", "two-stage")
    assert [row.labels[0] for row in table2.measured] == ["two-stage"] * 2
    assert table2.measured[0].values["all simulations"] == 2681
    assert {value.labels[0] for value in table2.values} == {"Monte Carlo"}


def test_one_scenario_alone_is_one_table() -> None:
    assert [table.name for table in tables_of("MC", scenarios=("cut-in",))] == ["table3"]
