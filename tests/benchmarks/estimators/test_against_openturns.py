"""OpenTURNS on our problems, and the clock."""

import json

import pytest

from benchmarks.estimators import against_openturns, overhead
from benchmarks.estimators.against_openturns import ALGORITHMS, run_openturns
from benchmarks.estimators.runs import Job, limit_state


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_openturns_finds_the_half_space(algorithm):
    run = run_openturns(Job(algorithm, "lin_d2", 1), points=500)
    assert not run.error
    assert run.p == pytest.approx(limit_state("lin_d2").p, rel=5 * run.cov)
    assert run.low < run.p < run.high
    if algorithm == "openturns-form":  # 500 draws, and a design point after few gradients
        assert 500 < run.n_sim < 600
    else:
        assert run.n_sim >= 1500
        assert run.calls == run.n_sim / 100
    again = run_openturns(Job(algorithm, "lin_d2", 1), points=500)
    assert again.p == run.p


def test_openturns_is_stopped_where_it_has_no_bound(monkeypatch):
    monkeypatch.setattr(against_openturns, "GUARD", 3000)
    run = run_openturns(Job("openturns-ce", "never_d4", 0), points=500)
    assert "LimitReached: more than 3,000 evaluations" in run.error
    assert run.n_sim == 3000


def test_form_without_a_gradient_is_recorded_as_raised():
    """At the origin f is at its cap."""
    assert run_openturns(Job("openturns-form", "plateau_d3", 0), points=500).error


def test_ours_stand_beside_theirs_at_their_cost(tmp_path, capsys):
    table = tmp_path / "table.json"
    against_openturns.main(runs=2, problems="lin_d2,lin_d100", points=200, most=1200, out=table)
    runs = json.loads(table.read_text())["runs"]
    for method, most, problems in (("two-stage", 1200, {"lin_d2", "lin_d100"}), ("surrogate", 1000, {"lin_d2"})):
        own = [run for run in runs if run["method"] == method]
        assert {run["problem"] for run in own} == problems
        assert max(run["n_sim"] for run in own) <= most
    assert capsys.readouterr().out.count("surrogate") >= len(ALGORITHMS)


def test_overhead_counts_calls_and_leaves_out_f():
    row = overhead.measure_overhead("ss", 6, runs=1, max_sim=2000)
    assert row.n_sim <= 2000
    assert row.points_per_call == pytest.approx(row.n_sim / row.calls)
    assert 0 < row.processor_seconds < 5
    assert "| ss | 6 |" in overhead.format_overheads([row])
