"""OpenTURNS on our problems, and the clock."""

import json

import pytest

from benchmarks.estimators import against_openturns, overhead
from benchmarks.estimators.against_openturns import ALGORITHMS, run_openturns
from samplers.benchmark.runs import Job, limit_state


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


def test_ours_stand_beside_theirs_at_their_cost(tmp_path, capsys, monkeypatch):
    """None stands beside a method that raised in every run (f has no slope at the origin of plateau_d3)."""
    monkeypatch.setattr(against_openturns, "ALGORITHMS", {"openturns-form": ALGORITHMS["openturns-form"]})
    table = tmp_path / "table.json"
    against_openturns.main(runs=2, problems="lin_d2,lin_d100,plateau_d3", points=200, most=150, out=table)
    runs = json.loads(table.read_text())["runs"]
    for method, problems in (("two-stage", ["lin_d2", "lin_d100"]), ("surrogate", ["lin_d2"])):
        own = [run for run in runs if run["method"] == method]
        assert [run["problem"] for run in own] == [name for name in problems for _ in range(2)]
        assert {run["n_sim"] for run in own} == {150}
    rows = [line.split(" | ")[:2] for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[0] for row in rows[:3]] == ["| openturns-form", "| two-stage", "| surrogate"]


def test_overhead_counts_calls_and_leaves_out_f():
    row = overhead.measure_overhead("ss", 6, runs=1, max_sim=2000)
    assert row.n_sim <= 2000
    assert row.points_per_call == pytest.approx(row.n_sim / row.calls)
    assert 0 < row.processor_seconds < 5
    assert "| ss | 6 |" in overhead.format_overheads([row])
