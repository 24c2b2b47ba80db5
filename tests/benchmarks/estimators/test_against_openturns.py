"""OpenTURNS on our problems, and the clock."""

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
    assert run.n_sim >= 1500
    assert run.calls == run.n_sim / 100
    again = run_openturns(Job(algorithm, "lin_d2", 1), points=500)
    assert again.p == run.p


def test_openturns_is_stopped_where_it_has_no_bound(monkeypatch):
    monkeypatch.setattr(against_openturns, "GUARD", 3000)
    run = run_openturns(Job("openturns-ce", "never_d4", 0), points=500)
    assert "LimitReached: more than 3,000 evaluations" in run.error
    assert run.n_sim == 3000


def test_overhead_counts_calls_and_leaves_out_f():
    row = overhead.measure_overhead("ss", 6, runs=1, max_sim=2000)
    assert row.n_sim <= 2000
    assert row.points_per_call == pytest.approx(row.n_sim / row.calls)
    assert 0 < row.processor_seconds < 5
    assert "| ss | 6 |" in overhead.format_overheads([row])
