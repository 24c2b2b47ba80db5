"""The page about papers is what the committed records give, and the records are what the command gives."""

from __future__ import annotations

import pytest

from benchmarks.papers.page import PAPERS_PAGE, format_papers_page, read_records
from rare_envs.study.reproduction.tian2024.replications import ReplicationJob, run_replication
from rare_envs.study.reproduction.tian2024.summary import ReplicationSummary
from rare_envs.threads import use_one_thread


@pytest.fixture(scope="module")
def tian():
    return read_records()["tian2024"]


def runs_of(record, scenario: str, system: str, method: str):
    (found,) = [
        runs
        for runs in record["runs"]
        if (runs["scenario"], runs["system"], runs["method"]) == (scenario, system, method)
    ]
    return found


def test_the_page_is_what_the_records_give() -> None:
    assert PAPERS_PAGE.read_text(encoding="utf-8") == format_papers_page(), "run python -m benchmarks.papers.page"


@pytest.mark.parametrize(
    ("scenario", "method", "place"),
    [("car-following", "IS", 0), ("car-following", "SS", 7), ("cut-in", "ADSS", 19), ("cut-in", "cross-entropy", 3)],
)
def test_a_cheap_run_made_again_gives_the_committed_value(tian, scenario: str, method: str, place: int) -> None:
    runs = runs_of(tian, scenario, "IDM", method)
    with use_one_thread():
        again = run_replication(ReplicationJob(scenario, "IDM", method, runs["seed"][place]))
    assert again.p == pytest.approx(runs["p"][place], rel=1e-6)
    assert (again.n_sim, again.simulated) == (runs["n_sim"][place], runs["simulated"][place])


def test_committed_tables_are_those_of_the_committed_runs(tian) -> None:
    counts = {runs["method"]: len(runs["p"]) for runs in tian["runs"]}
    assert counts.pop("MC") == tian["about"]["replications_of_monte_carlo"]
    assert {counts.pop(method) for method in ("IS", "SS", "ADSS")} == {tian["about"]["replications"]}
    assert set(counts.values()) == {tian["about"]["replications_of_further_methods"]}
    assert tian["about"]["replications"] >= 20
    for table, scenario in zip(tian["tables"], ("car-following", "cut-in"), strict=True):
        runs = runs_of(tian, scenario, "stack", "ADSS")
        summary = ReplicationSummary.of_estimates(runs["p"], 1.0)
        shown = {
            value["quantity"]: value["ours"]
            for value in table["values"]
            if value["labels"][0] == "ADSS" and value["labels"][1].startswith("stack")
        }
        assert shown["c.o.v. of p"] == pytest.approx(summary.cov)
        assert shown['square of the c.o.v. (printed as "COV")'] == pytest.approx(summary.cov**2)
        assert shown["mean of p"] == pytest.approx(summary.mean)


def test_no_method_hides_simulations_by_its_own_count(tian) -> None:
    for runs in tian["runs"]:
        assert all(made >= stated for made, stated in zip(runs["simulated"], runs["n_sim"], strict=True))
