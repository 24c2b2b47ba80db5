"""Summaries of replications against numbers by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from benchmarks.papers.tian2024.replications import ReplicationJob
from benchmarks.papers.tian2024.summary import ReplicationSummary, ratio_of_work, summarise_runs
from tests.benchmarks.papers.tian2024.made_runs import made_run


def test_the_square_is_the_square_of_the_cov() -> None:
    summary = ReplicationSummary.of_estimates([1e-4, 3e-4], simulations=100.0)
    assert summary.cov == pytest.approx(2**0.5 / 2)
    assert summary.squared_cov == pytest.approx(0.5)
    assert summary.squared_cov_interval == pytest.approx([end**2 for end in summary.cov_interval])


def test_a_method_that_misses_most_of_p_has_no_gain() -> None:
    """Its c.o.v. is small, its error is not."""
    blind = ReplicationSummary.of_estimates([1e-9, 1.1e-9], 1000.0, 1000.0, truth=1e-3)
    assert blind.cov < 0.1
    assert blind.error == pytest.approx(-1.0, abs=1e-5)
    assert blind.gain == pytest.approx(0.999, rel=1e-3)
    nothing = ReplicationSummary.of_estimates([0.0, 0.0], 1000.0, 1000.0, truth=1e-3)
    assert math.isnan(nothing.cov)
    assert nothing.gain == pytest.approx(0.999)


def test_intervals_hold_the_truth_in_95_percent() -> None:
    rng = np.random.default_rng(1)
    gain = (1 - 1e-3) / (1e-3 * 1000 * 0.1**2)
    held = np.zeros(3)
    for _ in range(1000):
        draws = list(1e-3 * rng.normal(1.0, 0.1, 20))
        summary = ReplicationSummary.of_estimates(draws, 1000.0, truth=1e-3)
        ends = (summary.mean_interval, summary.cov_interval, summary.gain_interval)
        held += [low <= known <= high for (low, high), known in zip(ends, (1e-3, 0.1, gain), strict=True)]
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], 1000, 0.95)
    assert low <= held[0] <= high
    assert low - 20 <= held[1] <= high + 20  # the mean that divides is estimated, too
    assert low - 20 <= held[2] <= high + 20


def test_plain_monte_carlo_has_a_gain_of_one() -> None:
    p, n, rng = 0.01, 2000, np.random.default_rng(0)
    summary = ReplicationSummary.of_estimates(list(rng.binomial(n, p, 4000) / n), float(n), truth=p)
    assert summary.gain == pytest.approx(1.0, rel=0.1)


def test_runs_are_compared_with_monte_carlo_of_their_cell() -> None:
    jobs = [ReplicationJob("cut-in", "IDM", method, seed) for method in ("MC", "IS") for seed in (0, 1)]
    found = summarise_runs([made_run(job, 2e-4 if job.method == "MC" else 1e-4) for job in jobs])
    assert found["cut-in", "IDM", "IS"].error == pytest.approx(-0.5)
    assert found["cut-in", "IDM", "IS"].simulations == 1500
    assert found["cut-in", "IDM", "IS"].all_simulations == 3000


def test_one_replication_has_no_spread() -> None:
    with pytest.raises(ValueError, match="2 replications at least, got 1"):
        ReplicationSummary.of_estimates([1e-4], 10.0)


def test_a_ratio_of_equal_methods_is_one_inside_its_interval() -> None:
    one = ReplicationSummary.of_estimates([1.0, 2.0, 3.0], 10.0, truth=2.0)
    ratio, (low, high) = ratio_of_work(one, one)
    assert ratio == 1.0
    assert low < 1.0 < high
    assert low == pytest.approx(1 / high)
